"""Feature pyramids: levels, sums from coarse to fine, and the published size."""

import pytest
import torch
from assertions import assert_close
from torch import nn
from torch.nn import functional as F

from rendra_lab.networks.feature_pyramid import FeaturePyramid


def test_the_published_size() -> None:
    # torchvision's: four 1x1 and four 3x3 convolutions with biases
    expected = sum(channels * 256 + 256 + 256 * 256 * 9 + 256 for channels in (256, 512, 1024, 2048))
    pyramid = FeaturePyramid((256, 512, 1024, 2048))
    assert sum(parameter.numel() for parameter in pyramid.parameters()) == expected == 3_344_384


@pytest.mark.parametrize("norm", ["none", "group"])
@pytest.mark.parametrize("sides", [(16, 8, 4, 2), (7, 4, 2, 1), (5, 3, 2, 1)])
def test_levels_have_the_sizes_of_their_maps_and_one_is_coarser(norm: str, sides: tuple[int, ...]) -> None:
    pyramid = FeaturePyramid((3, 4, 5, 6), 8, norm)
    maps = [torch.rand(2, c, s, s + 1) for c, s in zip((3, 4, 5, 6), sides, strict=True)]
    levels = pyramid(maps)
    last = (2, 8, -(-sides[-1] // 2), -(-(sides[-1] + 1) // 2))
    assert [each.shape for each in levels] == [(2, 8, s, s + 1) for s in sides] + [last]
    assert torch.equal(levels[-1], levels[-2][..., ::2, ::2])


def test_fine_levels_see_coarse_maps_and_not_the_other_way_round() -> None:
    pyramid = FeaturePyramid((2, 2, 2), 4).double()
    maps = [torch.rand(1, 2, s, s, dtype=torch.float64, requires_grad=True) for s in (8, 4, 2)]
    levels = pyramid(maps)
    by_fine = torch.autograd.grad(levels[0].sum(), maps, retain_graph=True)
    assert all(float(gradient.abs().max()) > 0 for gradient in by_fine)
    by_coarse = torch.autograd.grad(levels[2].sum(), maps, allow_unused=True)
    assert by_coarse[0] is None
    assert by_coarse[1] is None


def test_a_level_is_the_formula() -> None:
    pyramid = FeaturePyramid((2, 3), 4).double()
    fine, coarse = torch.rand(1, 2, 4, 4, dtype=torch.float64), torch.rand(1, 3, 2, 2, dtype=torch.float64)
    for layer in pyramid.modules():
        if isinstance(layer, nn.Conv2d):
            nn.init.uniform_(layer.bias)
    lateral, output = pyramid.lateral, pyramid.output
    nearest = lateral[1](coarse).repeat_interleave(2, 2).repeat_interleave(2, 3)
    assert_close(pyramid([fine, coarse])[0], output[0](lateral[0](fine) + nearest), atol=1e-12)
    assert_close(pyramid([fine, coarse])[1], F.conv2d(
        lateral[1](coarse), output[1][0].weight, output[1][0].bias, padding=1), atol=1e-12)  # fmt: skip
