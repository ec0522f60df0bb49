"""Splatting of features against its reference, against closed forms, and its gradients."""

import math

import numpy as np
import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.kernels.splat_features import ACCUMULATIONS, numba_cpu, reference, splat_features

SOFT = ACCUMULATIONS[:3]


def clouds(count=400, channels=5, size=(33, 41), depths=100):
    """Points, depths (some equal, some behind the camera) and features of two clouds, about a picture and beyond."""
    height, width = size
    points = torch.rand(2, count, 2) * torch.tensor([width + 16.0, height + 16.0]) - 8
    return points, torch.randint(-5, depths, (2, count)) / 10, torch.randn(2, count, channels)


def with_monsters(points, depths, features):
    """The same, and points with numbers that are none: those are not drawn."""
    nan, inf = math.nan, math.inf
    wrong = torch.tensor(
        [[nan, 3, 1], [3, -inf, 1], [1e30, 3, 1], [-3e38, 4, 1], [3, 3, inf], [3, 3, nan], [3, 3, -inf]]
    )
    wrong = wrong.expand(2, -1, -1)
    points, depths = torch.cat((points, wrong[..., :2]), 1), torch.cat((depths, wrong[..., 2]), 1)
    return points, depths, torch.cat((features, torch.ones(2, wrong.shape[1], features.shape[2])), 1)


def splat(cloud, mode="alphacomposite", size=(33, 41), radius=4.0, most=128, **settings):
    return splat_features(*cloud, size, radius, most, mode, **settings)


def values_and_gradients(cloud, dtype=torch.float32, **settings):
    points, depths, features = (x.to(dtype) for x in cloud)
    leaves = [points.clone().requires_grad_(), features.clone().requires_grad_()]
    results = splat((leaves[0], depths, leaves[1]), **settings)
    generator = torch.Generator().manual_seed(3)
    loss = sum((x * torch.randn(x.shape, generator=generator).to(x)).sum() for x in results)
    return [*(x.detach() for x in results), *torch.autograd.grad(loss, leaves, materialize_grads=True)]


def assert_alike(fast, slow, tolerance=2e-5):
    for a, b in zip(fast, slow, strict=True):
        assert a.shape == b.shape
        assert_finite(a)
        assert not b.numel() or (a - b).abs().max() <= tolerance * (b.abs().max() + 1)


@pytest.mark.parametrize("mode", ACCUMULATIONS)
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"size": (1, 1)},
        {"size": (7, 70)},
        {"radius": 0.4},
        {"radius": 15.3, "most": 500},
        {"most": 3, "stop_below": 0.0},
        {"tau": 2.0, "near": 4.0},
    ],
)
def test_value_and_gradient_agree_with_the_reference_in_float64(mode, settings):
    cloud = with_monsters(*clouds(size=settings.get("size", (33, 41))))
    fast, slow = (
        values_and_gradients(cloud, dtype, mode=mode, **settings) for dtype in (torch.float32, torch.float64)
    )
    assert_alike(fast, slow)


@pytest.mark.parametrize("channels", [0, 1, 3, 16, 64, 83, 150])
def test_any_number_of_channels(channels):
    cloud = clouds(150, channels, (17, 18))
    fast, slow = (values_and_gradients(cloud, dtype, size=(17, 18)) for dtype in (torch.float32, torch.float64))
    assert_alike(fast, slow)


@pytest.mark.parametrize("mode", SOFT)
def test_blunt_discs_are_steep_at_their_edge(mode):
    """With tau < 1 the slope is infinite there: values agree, gradients but for a few places."""
    cloud = clouds()
    fast, slow = (values_and_gradients(cloud, dtype, mode=mode, tau=0.5) for dtype in (torch.float32, torch.float64))
    assert_alike(fast[:2], slow[:2])
    off = (fast[2] - slow[2]).abs().amax(-1) > 1e-3 * slow[2].abs().max()
    assert_finite(fast[2])
    assert off.sum() <= 3  # a counted allowance, of 800 points


@pytest.mark.parametrize("mode", SOFT)
@pytest.mark.parametrize("tau", [1.0, 2.0])
def test_reference_gradients_are_finite_differences(mode, tau):
    """Points away from the places where the weight has a kink: the middles of pixels and the edges of discs."""
    offsets = torch.tensor([[0.3, 0.2], [-0.35, 0.1], [0.1, -0.4], [0.25, 0.33], [-0.2, -0.27]], dtype=torch.float64)
    points = (torch.tensor([2.5, 2.5], dtype=torch.float64) + offsets)[None].requires_grad_()
    features = torch.randn(1, 5, 2, dtype=torch.float64, requires_grad=True)
    depths = torch.tensor([[3.0, 1, 2, 5, 4]], dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda p, f: tuple(splat((p, depths, f), mode, (5, 6), 1.9, tau=tau, stop_below=0.0)), (points, features)
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("tau", [1.0, 0.5, 2.0])
def test_a_single_point_is_a_cone(dtype, tau):
    point = torch.tensor([[[4.2, 3.9]]], dtype=dtype)
    one = torch.ones(1, 1, 1, dtype=dtype)
    y, x = torch.meshgrid(torch.arange(8) + 0.5, torch.arange(9) + 0.5, indexing="ij")
    cone = (1 - torch.hypot(x - 4.2, y - 3.9) / 3).clamp(0, 1 - math.sqrt(1e-3)) ** tau
    for mode in ("alphacomposite", "wsum"):
        image, opacity = splat((point, one[..., 0], one), mode, (8, 9), 3.0, tau=tau)
        assert_close(image[0, 0], cone.to(dtype), atol=2e-6)
        assert_close(opacity, image)
    image, opacity = splat((point, one[..., 0], one), "wsumnorm", (8, 9), 3.0, tau=tau)
    inside = cone > 1e-4
    assert_close(image[0, 0][inside], torch.ones_like(cone, dtype=dtype)[inside])
    image, opacity = splat((point, one[..., 0], one), "naive", (8, 9), 3.0)
    assert torch.equal(image[0, 0] > 0, torch.hypot(x - 4.2, y - 3.9) < 3)
    assert torch.equal(image, opacity)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nearer_points_hide_farther_ones(dtype):
    """Ten points at one place: 0.5, then half of the rest, and so on; of equal depth the lower index first."""
    points = torch.full((1, 10, 2), 0.5, dtype=dtype)
    points[..., 0] += 1.0
    depths = torch.tensor([[9.0, 8, 7, 6, 5, 1, 1, 2, 3, 4]], dtype=dtype)
    features = torch.eye(10, dtype=dtype)[None]
    order, halves = [5, 6, 7, 8, 9, 4, 3, 2, 1, 0], 0.5 ** torch.arange(1, 11, dtype=dtype)
    image, opacity = splat((points, depths, features), size=(1, 1), radius=2.0)
    assert_close(image[0, order, 0, 0], halves)
    assert_close(opacity[0, 0, 0, 0], 1 - 0.5**10)
    image, opacity = splat((points, depths, features), size=(1, 1), radius=2.0, most=2)
    assert_close(image[0, order, 0, 0], torch.where(torch.arange(10) < 2, halves, 0.0))
    image, opacity = splat((points, depths, features), size=(1, 1), radius=2.0, stop_below=0.2)
    assert_close(image[0, order, 0, 0], torch.where(torch.arange(10) < 3, halves, 0.0))
    image, opacity = splat((points, depths, features), "wsum", (1, 1), 2.0, 3)
    assert_close(image[0, order, 0, 0], torch.where(torch.arange(10) < 3, 0.5, 0.0))
    assert_close(opacity, torch.ones_like(opacity))
    image, _ = splat((points, depths, features), "wsumnorm", (1, 1), 2.0, 4)
    assert_close(image[0, order, 0, 0], torch.where(torch.arange(10) < 4, 0.25, 0.0))
    image, _ = splat((points, depths, features), "naive", (1, 1), 2.0)
    assert image[0, :, 0, 0].tolist() == [0, 0, 0, 0, 0, 1, 0, 0, 0, 0]


def test_what_is_left_out_for_want_of_light_is_as_little_as_promised():
    cloud = clouds(8000)
    whole, largest = splat(cloud, stop_below=0.0), cloud[2].abs().max()
    for limit in (1e-2, 1e-5):
        stopped = splat(cloud, stop_below=limit)
        assert (stopped.image - whole.image).abs().max() <= limit * largest + 1e-6
        assert (stopped.opacity - whole.opacity).abs().max() <= limit + 1e-6
    assert not torch.equal(splat(cloud, stop_below=1e-2).image, whole.image)


def test_pictures_move_with_their_points():
    """By whole pixels: to the bit."""
    points, depths, features = clouds()
    points = (points * 64).round() / 64
    moved = splat((points + torch.tensor([3.0, -2.0]), depths, features), size=(40, 50)).image
    assert torch.equal(moved[..., :38, 3:], splat((points, depths, features), size=(40, 50)).image[..., 2:, :-3])


def test_depths_have_no_slope_and_the_nearest_point_no_place():
    points, depths, features = clouds()
    image, opacity = splat((points, depths.requires_grad_(), features.requires_grad_()))
    (image.sum() + opacity.sum()).backward()
    assert depths.grad is None
    image, _ = splat((points.requires_grad_(), depths, features), "naive")
    image.square().sum().backward()
    assert (points.grad == 0).all()


@pytest.mark.parametrize("mode", ACCUMULATIONS)
def test_discs_far_larger_than_any_picture(mode):
    """All points weigh about the same at every pixel."""
    points, depths, features = clouds(20)
    image, opacity = splat((points, 1 + depths.abs(), features), mode, radius=1e30, stop_below=0.0)
    assert_close(image, image[..., :1, :1].expand_as(image))
    assert_close(opacity, torch.ones_like(opacity))


def test_features_alone_ask_for_the_same():
    points, depths, features = clouds()
    both, alone = features.clone().requires_grad_(), features.clone().requires_grad_()
    for leaf, place in ((both, points.requires_grad_()), (alone, points.detach())):
        splat((place, depths, leaf)).image.square().sum().backward()
    assert torch.equal(both.grad, alone.grad)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("mode", ACCUMULATIONS)
def test_empty_clouds_are_empty_pictures(dtype, mode):
    for batch, count in ((2, 0), (0, 3), (1, 3)):
        points = torch.full((batch, count, 2), -50.0, dtype=dtype, requires_grad=True)
        features = torch.ones(batch, count, 3, dtype=dtype, requires_grad=True)
        image, opacity = splat((points, torch.ones(batch, count, dtype=dtype), features), mode, (4, 5))
        assert image.shape == (batch, 3, 4, 5)
        assert opacity.shape == (batch, 1, 4, 5)
        assert (image == 0).all()
        assert (opacity == 0).all()
        grads = torch.autograd.grad(image.sum() + opacity.sum(), (points, features), materialize_grads=True)
        assert all((grad == 0).all() for grad in grads)


def test_every_element_is_written():
    points, depths, features = clouds()
    order = torch.arange(800, dtype=torch.int32).view(2, 400)
    settings = numba_cpu.settings_of(33, 41, 4.0, 128, 0, 1.0, 1e-5)
    image, opacity = np.full((2, 33, 41, 5), np.nan, np.float32), np.full((2, 33, 41), np.nan, np.float32)
    inputs = points.view(-1, 2).numpy(), order.numpy(), features.view(-1, 5).numpy()
    numba_cpu.forward(*inputs, settings, image, opacity)
    assert np.isfinite(image).all()
    assert np.isfinite(opacity).all()


@pytest.mark.parametrize("mode", SOFT)
@pytest.mark.parametrize("radius", [3.0, 4.0, 4.5, 13.0])
def test_results_do_not_depend_on_threads(mode, radius):
    cloud, threads, results = clouds(3000, size=(100, 50)), torch.get_num_threads(), []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        results.append(values_and_gradients(cloud, mode=mode, size=(100, 50), radius=radius))
    torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_the_reference_cuts_crowded_blocks_to_bounded_memory(monkeypatch):
    cloud = [x.double() for x in clouds()]
    whole = splat(cloud)
    monkeypatch.setattr(reference, "_PAIRS_AT_ONCE", 1000)
    for a, b in zip(splat(cloud), whole, strict=True):
        assert_close(a, b)


def test_strides_do_not_matter():
    points, depths, features = clouds()
    turned = points.mT.contiguous().mT, depths.T.contiguous().T, features.mT.contiguous().mT
    for a, b in zip(splat(turned), splat((points, depths, features)), strict=True):
        assert torch.equal(a, b)


def test_far_devices_take_the_reference(far):  # noqa: F811
    cloud = with_monsters(*clouds(60))
    for mode in ACCUMULATIONS:
        there = splat([x.to(far) for x in cloud], mode)
        assert all(isinstance(x, Far) for x in there)
        assert_alike([x.cpu() for x in there], splat(cloud, mode))


def test_the_operator_is_well_registered():
    points, _, features = clouds(20)
    order = torch.arange(40, dtype=torch.int32).view(2, 20)
    arguments = (points.requires_grad_(), order, features.requires_grad_(), 6, 5, 3.0, 4, 0, 1.0, 0.0)
    torch.library.opcheck(torch.ops.rendra.splat_features.default, arguments)


def test_bad_input_is_named():
    points, depths, features = clouds(9)
    for change, message in (
        ({"points": points[0]}, r"points must be floats of shape \(B, P, 2\)"),
        ({"points": points.int()}, "points must be floats"),
        ({"depths": depths[:, 1:]}, r"depths must have shape \(2, 9\)"),
        ({"features": features.double()}, r"features must have shape \(2, 9, C\) and be torch.float32"),
        ({"features": features[..., 0]}, "features must have shape"),
        ({"image_size": (0, 4)}, "image_size must be"),
        ({"radius": 0.0}, "radius must be positive and finite, got 0.0"),
        ({"radius": math.inf}, "radius must be positive and finite"),
        ({"tau": -1.0}, "tau must be positive"),
        ({"points_per_pixel": 0}, "points_per_pixel must be 1 or more, got 0"),
        ({"accumulation": "sum"}, "accumulation must be one of alphacomposite, wsum, wsumnorm, naive, got 'sum'"),
        ({"stop_below": 2.0}, "stop_below must be a transmittance"),
    ):
        given = {"points": points, "depths": depths, "features": features, "image_size": (4, 5), "radius": 2.0}
        with pytest.raises(ValueError, match=message):
            splat_features(**{**given, "points_per_pixel": 8, **change})


@pytest.mark.gpu
def test_cuda_takes_the_reference():
    cloud = with_monsters(*clouds())
    cuda = values_and_gradients([x.cuda() for x in cloud])
    assert_alike([x.cpu() for x in cuda], values_and_gradients(cloud))
