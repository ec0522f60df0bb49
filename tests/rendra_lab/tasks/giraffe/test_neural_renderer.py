"""Painting: sizes, smooth colours, and a convolution of half a pixel's stride."""

import pytest
import torch
from assertions import assert_close
from torch import nn
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.tasks.giraffe.discriminator import Discriminator
from rendra_lab.tasks.giraffe.neural_renderer import NeuralRenderer, blurred, doubled_and_convolved


def test_doubling_and_convolving_at_once_is_doubling_and_then_convolving() -> None:
    x, weight, bias = torch.randn(2, 3, 4, 5), torch.randn(6, 3, 3, 3), torch.randn(6)
    expected = F.conv2d(F.interpolate(x, scale_factor=2, mode="nearest"), weight, bias, padding=1)
    assert_close(doubled_and_convolved(x, weight, bias), expected)


def test_a_blur_keeps_sums_inside_and_what_is_even() -> None:
    assert_close(blurred(torch.full((1, 2, 3, 4), 0.7)), torch.full((1, 2, 3, 4), 0.7))
    point = torch.zeros(1, 1, 5, 5)
    point[..., 2, 2] = 16
    assert_close(blurred(point)[0, 0, 1:4, 1:4], [[1, 2, 1], [2, 4, 2], [1, 2, 1]])
    assert float(blurred(point).sum()) == 16


@pytest.mark.parametrize("sides", [(16, 64), (8, 32), (4, 4), (4, 64)])
def test_sides_and_gradients(sides: tuple[int, int]) -> None:
    renderer = NeuralRenderer(8, *sides, least_width=4)
    features = torch.randn(2, 8, sides[0], sides[0], requires_grad=True)
    pictures = renderer(features)
    assert pictures.shape == (2, 3, sides[1], sides[1])
    assert 0 < float(pictures.detach().min()) < float(pictures.detach().max()) < 1
    pictures.sum().backward()
    assert all(each.grad is not None for each in [features, *renderer.parameters()])
    assert renderer(features[:0]).shape == (0, 3, sides[1], sides[1])


def test_each_option_of_the_ablation_changes_pictures() -> None:
    def painted(**options: object) -> torch.Tensor:
        torch.manual_seed(0)
        return NeuralRenderer(8, 4, 16, 4, **options)(4 * torch.randn(1, 8, 4, 4)).detach()

    usual = painted()
    for name, value in (
        ("rgb_skips", False), ("sigmoid", False), ("rgb_upsampling", "nearest"), ("feature_upsampling", "bilinear")
    ):  # fmt: skip
        assert float((painted(**{name: value}) - usual).abs().max()) > 1e-4
    assert_close(painted(sigmoid=False).sigmoid(), usual)


def test_sides_that_cannot_be() -> None:
    for sides in ((16, 48), (16, 8)):
        with pytest.raises(UserError, match=r"1, 2, 4, 8 .. times"):
            NeuralRenderer(8, *sides)


def test_a_discriminator_halves_down_to_four_pixels() -> None:
    network = Discriminator(32, 16, biases=False)  # what is added has no part in a slope
    assert [layer.out_channels for layer in network.layers if isinstance(layer, nn.Conv2d)] == [4, 8, 16, 1]
    pictures = torch.rand(3, 3, 32, 32, requires_grad=True)
    logits = network(pictures)
    assert logits.shape == (3, 1)
    slope = torch.autograd.grad(logits.sum(), pictures, create_graph=True)[0]
    slope.square().sum().backward()
    assert all(each.grad is not None and bool(each.grad.isfinite().all()) for each in network.parameters())
    with pytest.raises(ValueError, match=r"judges pictures \(B, 3, 32, 32\), got \(3, 3, 16, 16\)"):
        network(torch.rand(3, 3, 16, 16))
    with pytest.raises(UserError, match="must be 8, 16, 32"):
        Discriminator(48)
    with pytest.raises(UserError, match="widest must be at least 8"):
        Discriminator(64, 4)


@torch.no_grad()
def test_a_discriminator_judges_colours_about_0_or_as_published_from_0() -> None:
    torch.manual_seed(0)
    grey, black = torch.full((1, 3, 32, 32), 0.5), torch.zeros(1, 3, 32, 32)
    assert float(Discriminator(32, 16)(grey)) == 0
    assert float(Discriminator(32, 16)(black)) != 0
    assert float(Discriminator(32, 16, biases=False, centred=False)(black)) == 0
