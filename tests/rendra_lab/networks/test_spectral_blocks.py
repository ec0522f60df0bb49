"""Residual blocks of spectral norm 1, and the noise in their batch norms."""

import copy

import pytest
import torch
from assertions import assert_close
from far_device import far  # noqa: F401
from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.networks.spectral_blocks import NoiseBatchNorm, ResidualBlock, ResidualChain, spectral_conv


def sizes(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_norm_of_a_convolution_is_one_however_large_its_weights_grow() -> None:
    conv = spectral_conv(5, 7, 3)
    with torch.no_grad():
        conv.parametrizations.weight.original.mul_(50).add_(1)
    for _ in range(30):
        conv(torch.zeros(1, 5, 4, 4))
    norms = torch.linalg.svdvals(conv.weight.detach().flatten(1))
    assert_close(norms[0], 1.0, atol=1e-3)
    assert float(norms[1]) < 1


def test_evaluation_iterates_no_power() -> None:
    conv = spectral_conv(5, 7, 3).eval()
    before = copy.deepcopy(conv.state_dict())
    first = conv(torch.ones(1, 5, 4, 4))
    assert torch.equal(first, conv(torch.ones(1, 5, 4, 4)))
    assert all(torch.equal(value, before[name]) for name, value in conv.state_dict().items())
    conv.train()(torch.ones(1, 5, 4, 4))
    assert not all(torch.equal(value, before[name]) for name, value in conv.state_dict().items())


def test_a_noisy_norm_without_noise_is_a_norm() -> None:
    norm, x = NoiseBatchNorm(6, torch.randn(20), std=0.0), 3 + 2 * torch.randn(5, 6, 4, 4)
    assert_close(norm(x), F.batch_norm(x, None, None, training=True), atol=1e-6)


def test_gain_and_shift_are_linear_in_the_noise() -> None:
    still = torch.randn(20)
    norm, x = NoiseBatchNorm(6, still).eval(), torch.randn(2, 6, 4, 4)
    gain, shift = norm.gain.weight @ still, norm.shift.weight @ still
    normal = x / (1 + 1e-5) ** 0.5  # a new norm has seen nothing: mean 0, variance 1
    assert_close(norm(x), (1 + gain)[:, None, None] * normal + shift[:, None, None], atol=1e-6)
    for weight in (norm.gain.weight, norm.shift.weight):
        assert_close(torch.linalg.svdvals(weight)[0], 1.0, atol=0.1)


def test_in_training_each_sample_has_noise_of_its_own_from_the_global_stream() -> None:
    norm, x = NoiseBatchNorm(6, torch.zeros(20)), torch.randn(1, 6, 4, 4).expand(3, -1, -1, -1)
    frozen = copy.deepcopy(norm)
    torch.manual_seed(5)
    first = norm(x)
    torch.manual_seed(5)
    assert torch.equal(first, frozen(x))
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(first, norm(x))


def test_in_evaluation_pictures_do_not_depend_on_each_other_nor_on_the_stream() -> None:
    x = torch.randn(3, 4, 8, 8)
    chain = ResidualChain(4, [6, 5], ["down", "up"], noise_seed=3).eval()
    stream = torch.get_rng_state()
    together = chain(x)
    assert torch.equal(stream, torch.get_rng_state())
    assert_close(chain(x[1:2]), together[1:2], atol=1e-6)
    assert torch.equal(chain(x), together)
    other = ResidualChain(4, [6, 5], ["down", "up"], noise_seed=4).eval()
    other.load_state_dict(chain.state_dict())
    assert not torch.allclose(other(x), together, atol=1e-3)
    assert not any("still" in name for name in chain.state_dict())


def test_a_block_is_what_its_table_says() -> None:
    block = ResidualBlock(3, 8, torch.randn(2, 20), "down").eval()
    x = torch.randn(2, 3, 8, 10)
    norm0, _, conv0, norm1, _, conv1 = block.branch
    left = conv1(F.relu(norm1(conv0(F.relu(norm0(x))))))
    expected = F.avg_pool2d(left, 3, 2, 1) + F.avg_pool2d(block.shortcut(x), 3, 2, 1)
    assert_close(block(x), expected, atol=1e-6)
    assert block(x).shape == (2, 8, 4, 5)
    assert isinstance(ResidualBlock(8, 8, torch.randn(2, 20)).shortcut, nn.Identity)
    assert not isinstance(ResidualBlock(8, 8, torch.randn(2, 20), "up").shortcut, nn.Identity)
    # two norms of 20 x 2C, two 3x3 and a 1x1 with biases
    assert sizes(block) == 40 * (3 + 8) + (27 * 8 + 8) + (72 * 8 + 8) + (3 * 8 + 8)


@pytest.mark.parametrize("fold", [1, 2])
def test_a_chain_keeps_the_resolution_and_gives_finite_gradients(fold: int) -> None:
    chain = ResidualChain(3 * fold**2, [8, 8, 2 * fold**2], ["down", "keep", "up"], fold=fold).double()
    assert chain.multiple == 2 * fold
    x = torch.randn(2, 3, 8, 12, dtype=torch.float64, requires_grad=True)
    y = chain(x)
    assert y.shape == (2, 2, 8, 12)
    y.square().sum().backward()
    gradients = [x.grad, *(parameter.grad for parameter in chain.parameters())]
    assert all(isinstance(one, Tensor) and bool(one.isfinite().all()) for one in gradients)


def test_a_smooth_chain_makes_no_pattern_of_what_has_none() -> None:
    even = torch.ones(1, 3, 24, 24)
    for smooth in (False, True):
        torch.manual_seed(0)
        chain = ResidualChain(12, [8, 12], fold=2, smooth=smooth).eval()
        made = chain(even)
        assert made.shape[1:] == ((12, 24, 24) if smooth else (3, 24, 24))
        spread = made[..., 10:14, 10:14].flatten(2).std(2)  # further from zeros around than convolutions reach
        assert bool((spread < 1e-5).all()) is smooth


def test_no_pictures_give_no_features() -> None:
    assert ResidualChain(3, [4, 2]).eval()(torch.zeros(0, 3, 8, 8)).shape == (0, 2, 8, 8)


def test_sides_and_settings_that_do_not_fit_are_refused() -> None:
    chain = ResidualChain(12, [4, 4, 4], ["down", "up", "keep"], fold=2)
    with pytest.raises(ValueError, match=r"multiples of 4 pixels, got 10 x 8"):
        chain(torch.zeros(1, 3, 10, 8))
    for wrong in (["down", "keep"], ["up"], ["keep"] * 3, ["sideways", "keep"]):
        with pytest.raises(UserError, match="keep, down or up for each width"):
            ResidualChain(3, [4, 4], wrong)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="for 0 widths"):
        ResidualChain(3, [])


def test_noise_is_drawn_where_the_features_lie(far) -> None:  # noqa: F811
    chain = ResidualChain(3, [4, 2])
    for module in chain.modules():
        for name, buffer in module._buffers.items():
            module._buffers[name] = buffer.to(far)
        for name, parameter in module.named_parameters(recurse=False):
            module._parameters[name] = nn.Parameter(parameter.detach().to(far))
    chain(torch.rand(2, 3, 8, 8).to(far)).sum().backward()
    assert chain.eval()(torch.rand(2, 3, 8, 8).to(far)).device == far


def test_weights_come_back_to_the_bit_and_training_goes_on_as_it_would_have() -> None:
    def steps(chain: ResidualChain, count: int) -> Tensor:
        optimizer = torch.optim.SGD(chain.parameters(), 0.1)
        for _ in range(count):
            optimizer.zero_grad()
            loss = chain(x).square().mean()
            loss.backward()
            optimizer.step()
        return loss

    x, chain = torch.randn(2, 3, 8, 8), ResidualChain(3, [4, 2])
    steps(chain, 2)
    kept, stream = copy.deepcopy(chain.state_dict()), torch.get_rng_state()
    expected = steps(chain, 3)
    again = ResidualChain(3, [4, 2])
    again.load_state_dict(kept)
    torch.set_rng_state(stream)
    assert torch.equal(steps(again, 3), expected)
    assert torch.equal(again.eval()(x), chain.eval()(x))
