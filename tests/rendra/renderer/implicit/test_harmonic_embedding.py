"""Harmonic embedding: order, frequencies, identities, blur."""

import math

import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401

from rendra.renderer import HarmonicEmbedding


def test_the_order_of_the_waves() -> None:
    angles = torch.tensor([0.1, 0.2, 0.2, 0.4])
    embedded = HarmonicEmbedding(2)(torch.tensor([0.1, 0.2]))
    assert_close(embedded, torch.cat((angles.sin(), angles.cos(), torch.tensor([0.1, 0.2]))))
    assert_close(HarmonicEmbedding(2, append_input=False)(torch.tensor([0.1, 0.2])), embedded[:8])


@pytest.mark.parametrize(("logspace", "expected"), [(True, [0.3, 0.6, 1.2, 2.4]), (False, [0.3, 1.0, 1.7, 2.4])])
def test_frequencies(logspace, expected) -> None:
    embedded = HarmonicEmbedding(4, omega_0=0.3, logspace=logspace, append_input=False)(torch.ones(5, 1))
    assert_close(embedded[:, :4], torch.tensor(expected).sin().expand(5, 4))


@pytest.mark.parametrize(("n", "append"), [(6, True), (4, False), (0, True), (0, False), (1, True)])
@pytest.mark.parametrize("shape", [(2, 5, 3), (7, 1), (0, 3), (2,)])
def test_sizes(n, append, shape) -> None:
    embedding = HarmonicEmbedding(n, append_input=append)
    size = shape[-1] * (2 * n + append)
    assert embedding(torch.rand(shape)).shape == (*shape[:-1], size)
    assert embedding.get_output_dim(shape[-1]) == size
    assert HarmonicEmbedding.get_output_dim_static(shape[-1], n, append) == size


def test_defaults() -> None:
    embedding = HarmonicEmbedding()
    assert embedding.get_output_dim() == 39
    assert embedding.state_dict() == {}


def test_sines_and_cosines_lie_on_circles() -> None:
    x = torch.randn(4, 3, dtype=torch.float64)
    embedded = HarmonicEmbedding(8, omega_0=0.1, append_input=False)(x)
    assert embedded.dtype == torch.float64
    sin, cos = embedded.chunk(2, dim=-1)
    assert_close(sin.square() + cos.square(), torch.ones(4, 24), atol=1e-12)
    assert_close(HarmonicEmbedding(8, omega_0=0.1)(-x)[:, :24], -sin, atol=1e-12)


def test_gaussians_fade_as_their_mean_does() -> None:
    torch.manual_seed(0)
    mean, variance = torch.tensor([[0.4, -0.3]]), torch.tensor([[0.2, 0.05]])
    embedding = HarmonicEmbedding(3, omega_0=0.7)
    many = embedding(mean + variance.sqrt() * torch.randn(200_000, 2)).mean(0)
    assert_close(embedding(mean, diag_cov=variance)[0], many, atol=5e-3)
    assert_close(embedding(mean, torch.zeros_like(variance)), embedding(mean))


def test_gradients() -> None:
    x = torch.randn(3, 2, dtype=torch.float64, requires_grad=True)
    variance = torch.rand(3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(HarmonicEmbedding(3, omega_0=math.pi), (x, variance))


def test_waves_stay_where_the_input_is(far) -> None:  # noqa: F811
    embedding = HarmonicEmbedding(3)
    embedding._frequencies = embedding._frequencies.to(far)
    waves = embedding(torch.ones(4, 2, device=far), torch.ones(4, 2, device=far))
    assert isinstance(waves, Far)
    assert_close(waves.cpu(), HarmonicEmbedding(3)(torch.ones(4, 2), torch.ones(4, 2)))


def test_less_than_no_wave_is_refused() -> None:
    with pytest.raises(ValueError, match="must not be negative, got -1"):
        HarmonicEmbedding(-1)
