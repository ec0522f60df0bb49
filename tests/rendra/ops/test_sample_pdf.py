"""Draws from histograms, against the inverse of their distribution functions."""

import numpy as np
import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.ops import sample_pdf
from rendra.renderer.implicit.sample_pdf import sample_pdf as renderers_sample_pdf
from rendra.renderer.implicit.sample_pdf import sample_pdf_python

EDGES = torch.tensor([0.0, 1.0, 1.5, 4.0, 4.5])
WEIGHTS = torch.tensor([1.0, 4.0, 2.0, 3.0])


def inverse_of_the_distribution(edges, weights, u):
    """By linear interpolation, in float64."""
    cdf = np.concatenate(([0.0], np.cumsum(weights.double().numpy())))
    return torch.from_numpy(np.interp(u.double().numpy(), cdf / cdf[-1], edges.double().numpy()))


@pytest.mark.parametrize("n", [1, 2, 7, 50])
def test_quantiles(n) -> None:
    drawn = sample_pdf(EDGES, WEIGHTS, n, det=True, eps=0.0)
    assert_close(drawn, inverse_of_the_distribution(EDGES, WEIGHTS, torch.linspace(0, 1, n)), atol=1e-5)


def test_random_batches_against_numpy() -> None:
    torch.manual_seed(0)
    edges, weights = torch.rand(2, 3, 9).cumsum(-1), torch.rand(2, 3, 8)
    u = torch.linspace(0, 1, 33)
    drawn = sample_pdf(edges, weights, 33, det=True)
    for i, j in np.ndindex(2, 3):
        expected = inverse_of_the_distribution(edges[i, j], weights[i, j] + 1e-5, u)
        assert_close(drawn[i, j], expected, atol=1e-4)


def test_draws_follow_the_density() -> None:
    torch.manual_seed(0)
    drawn = sample_pdf(EDGES, WEIGHTS, 100_000)
    counts = torch.histogram(drawn, EDGES).hist / len(drawn)
    assert_close(counts, WEIGHTS / 10, atol=0.006)
    widest = drawn[(drawn > 1.5) & (drawn < 4.0)]
    assert_close(torch.histc(widest, 5, 1.5, 4.0) / len(widest), torch.full((5,), 0.2), atol=0.012)  # even inside


def test_no_weight_at_all_is_even() -> None:
    edges = torch.linspace(2, 3, 5)
    assert_close(sample_pdf(edges, torch.zeros(4), 9, det=True), torch.linspace(2, 3, 9))
    drawn = sample_pdf(edges, torch.zeros(4), 1000, eps=0.0)
    assert_finite(drawn)
    assert ((drawn >= 2) & (drawn <= 3)).all()


def test_bins_without_weight_stay_empty() -> None:
    drawn = sample_pdf(EDGES, torch.tensor([0.0, 1.0, 0.0, 1.0]), 5000, eps=0.0)
    assert (((drawn >= 1.0) & (drawn <= 1.5)) | ((drawn >= 4.0) & (drawn <= 4.5))).all()


def test_both_names_are_one() -> None:
    assert renderers_sample_pdf is sample_pdf
    torch.manual_seed(1)
    first = sample_pdf(EDGES, WEIGHTS, 6)
    torch.manual_seed(1)
    assert torch.equal(sample_pdf_python(EDGES, WEIGHTS, N_samples=6), first)
    assert not torch.equal(sample_pdf(EDGES, WEIGHTS, 6), first)


def test_little_and_nothing() -> None:
    assert sample_pdf(EDGES, WEIGHTS, 0).shape == (0,)
    assert sample_pdf(torch.zeros(0, 5), torch.zeros(0, 4), 3).shape == (0, 3)
    assert_close(sample_pdf(torch.tensor([1.0, 2.0]), torch.tensor([7.0]), 3, det=True), [1.0, 1.5, 2.0])


def test_gradients() -> None:
    edges, weights = (each.double().requires_grad_() for each in (EDGES, WEIGHTS))

    def draw(edges, weights):
        torch.manual_seed(0)
        return sample_pdf(edges, weights, 9)

    assert torch.autograd.gradcheck(draw, (edges, weights))
    nothing = torch.zeros(4, requires_grad=True)
    sample_pdf(EDGES, nothing, 9, eps=0.0).sum().backward()
    assert nothing.grad is not None


def test_draws_stay_where_the_weights_are(far) -> None:  # noqa: F811
    drawn = sample_pdf(EDGES.to(far), WEIGHTS.to(far), 6, det=True)
    assert isinstance(drawn, Far)
    assert_close(drawn.cpu(), sample_pdf(EDGES, WEIGHTS, 6, det=True))


@pytest.mark.parametrize(
    ("bins", "weights", "n", "message"),
    [
        (EDGES, EDGES, 3, r"\(5,\) and \(5,\)"),
        (EDGES.expand(2, 5), WEIGHTS, 3, r"\(2, 5\) and \(4,\)"),
        (EDGES[:1], WEIGHTS[:0], 3, "K > 0"),
        (EDGES, -WEIGHTS, 3, "must not be negative, got -4"),
        (EDGES, WEIGHTS, -1, "must not be negative, got -1"),
    ],
)
def test_impossible_input_is_refused(bins, weights, n, message) -> None:
    with pytest.raises(ValueError, match=message):
        sample_pdf(bins, weights, n)
