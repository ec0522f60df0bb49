"""Depth of pictures: limits, forms, sizes."""

import pytest
import torch
from assertions import assert_close

from rendra_lab.errors import UserError
from rendra_lab.networks.depth_unet import DepthUNet


def test_the_published_size() -> None:
    network = DepthUNet()
    assert sum(parameter.numel() for parameter in network.parameters()) == 9_795_137
    shapes = [tuple(level.conv.weight.shape) for level in network.down]
    assert shapes == [
        (out, into, 4, 4)
        for into, out in zip((3, 32, 64, 128, 256, 256, 256, 256), (32, 64, 128, *[256] * 5), strict=True)
    ]
    shapes = [tuple(level.conv.weight.shape[:2]) for level in network.up]
    assert shapes == [(256, 256), *[(256, 512)] * 3, (128, 512), (64, 256), (32, 128), (1, 64)]
    norms = [isinstance(level.norm, torch.nn.BatchNorm2d) for level in (*network.down, *network.up)]
    assert norms == [False, *[True] * 6, False, *[True] * 7, False]


@pytest.mark.parametrize("inverse", [False, True])
def test_depth_stays_between_its_limits_and_reaches_them(inverse: bool) -> None:
    network = DepthUNet(2, 4, 0.5, 10.0, inverse)
    pictures = torch.rand(2, 3, 8, 12)
    depth = network(pictures).detach()
    assert depth.shape == (2, 1, 8, 12)
    assert float(depth.min()) > 0.5
    assert float(depth.max()) < 10
    for logit, end in ((-40.0, 10.0 if inverse else 0.5), (40.0, 0.5 if inverse else 10.0)):
        torch.nn.init.constant_(network.up[-1].conv.bias, logit)
        assert_close(network(pictures), torch.full_like(depth, end), rtol=1e-5)


def test_the_inverse_form_of_the_paper_is_one_of_ours() -> None:
    network = DepthUNet(2, 4, 1 / 10.01, 100.0, inverse=True).eval()
    outputs = []
    network.up[-1].register_forward_hook(lambda module, given, answer: outputs.append(answer))
    depth = network(torch.rand(1, 3, 8, 8))
    assert_close(depth, 1 / (10 * torch.sigmoid(outputs[0]) + 0.01), rtol=1e-5)


@pytest.mark.parametrize("inverse", [False, True])
def test_a_new_network_begins_at_the_depth_that_it_is_told(inverse: bool) -> None:
    network = DepthUNet(2, 4, 1.0, 50.0, inverse, start_z=8.0)
    bias = network.up[-1].conv.bias.sigmoid()  # without what the picture adds
    depth = 1 / (1 / 50 + bias * (1 - 1 / 50)) if inverse else 1 + 49 * bias
    assert_close(depth, torch.tensor([8.0]), rtol=1e-5)


def test_sides_that_cannot_be_halved_are_refused_with_what_would_fit() -> None:
    network = DepthUNet(6, 4)
    with pytest.raises(ValueError, match=r"6 levels .* multiples of 64 pixels, got 96 x 128: levels=5 would fit"):
        network(torch.zeros(1, 3, 96, 128))
    with pytest.raises(ValueError, match="both sides must be even"):
        network(torch.zeros(1, 3, 65, 64))


def test_limits_that_are_none_are_refused() -> None:
    for limits in ((5.0, 1.0, False, None), (1.0, 5.0, False, 6.0), (2.0, 2.0, True, None)):
        with pytest.raises(UserError, match="0 < min_z < max_z"):
            DepthUNet(2, 4, *limits)


def test_one_picture_of_the_smallest_size_trains_and_gradients_are_finite() -> None:
    network = DepthUNet(3, 4).double()
    pictures = torch.rand(1, 3, 8, 8, dtype=torch.float64, requires_grad=True)
    network(pictures).sum().backward()
    assert all(bool(parameter.grad.isfinite().all()) for parameter in (pictures, *network.parameters()))
    assert float(network.down[0].conv.parametrizations.weight.original.grad.abs().sum()) > 0


def test_no_pictures_have_no_depth_and_one_level_is_enough() -> None:
    assert DepthUNet(3, 4).eval()(torch.zeros(0, 3, 8, 8)).shape == (0, 1, 8, 8)
    assert DepthUNet(1, 4)(torch.rand(1, 3, 6, 2)).shape == (1, 1, 6, 2)


def test_weights_come_back_to_the_bit() -> None:
    pictures, network = torch.rand(1, 3, 8, 8), DepthUNet(3, 4)
    network(pictures)
    again = DepthUNet(3, 4)
    again.load_state_dict(network.state_dict())
    assert torch.equal(again(pictures), network(pictures))
    assert torch.equal(again.eval()(pictures), network.eval()(pictures))
