"""Pixels that are lifted to points, move as geometry says, hide each other, and learn where they are."""

import math

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from rendra.kernels.splat_features import ACCUMULATIONS
from rendra_lab.benchmarks.scene import ROOT
from rendra_lab.errors import UserError
from rendra_lab.targets import check_targets
from rendra_lab.tasks.synsin.splatting import PointSplatter, lift

FOCAL = 20.0


def camera(focal=FOCAL, size=(12, 16), batch=1, dtype=torch.float32):
    height, width = size
    matrix = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=dtype)
    return matrix.repeat(batch, 1, 1)


def motion(x=0.0, y=0.0, z=0.0, yaw=0.0, dtype=torch.float32):
    c, s = math.cos(yaw), math.sin(yaw)
    return torch.tensor([[[c, 0, s, x], [0, 1, 0, y], [-s, 0, c, z], [0, 0, 0, 1]]], dtype=dtype)


def view(depth, features=None, **moved):
    """A splatter's arguments: one picture of 12 x 16 pixels and where the camera goes."""
    features = torch.rand(1, 3, 12, 16).to(depth) if features is None else features
    cameras = camera(dtype=depth.dtype)
    return features, depth, cameras, cameras, motion(**moved, dtype=depth.dtype)


@pytest.mark.parametrize("accumulation", ["wsumnorm", "naive"])
def test_without_a_motion_tiny_discs_are_the_picture(accumulation):
    given = view(1 + 5 * torch.rand(1, 1, 12, 16))
    features, opacity = PointSplatter(accumulation, radius_px=0.4)(*given)
    assert_close(features, given[0], atol=1e-5)
    assert (opacity > 0.9).all()


def test_without_a_motion_the_nearest_layer_counts_most():
    """A disc at its own middle weighs 1 - sqrt(1e-3)."""
    given = view(torch.full((1, 1, 12, 16), 2.0))
    features, opacity = PointSplatter(radius_px=0.4)(*given)
    assert_close(features, (1 - math.sqrt(1e-3)) * given[0], atol=1e-5)
    assert_close(opacity, torch.full_like(opacity, 1 - math.sqrt(1e-3)))


@pytest.mark.parametrize(("depth", "step"), [(4.0, 5), (10.0, 2), (20.0, 1)])
def test_a_step_aside_moves_by_focal_length_over_depth(depth, step):
    """Everything moves left by f t / z pixels; what comes in from the right is empty."""
    given = view(torch.full((1, 1, 12, 16), depth), x=-1.0)
    features, opacity = PointSplatter("naive", radius_px=0.4)(*given)
    assert_close(features[..., :-step], given[0][..., step:])
    assert (opacity[..., -step:] == 0).all()


def test_a_step_forward_is_a_zoom():
    points = lift(torch.full((1, 1, 12, 16), 4.0), camera(), camera(), motion(z=-2.0))
    before = lift(torch.full((1, 1, 12, 16), 4.0), camera(), camera(), motion())
    centre = torch.tensor([8.0, 6.0])
    assert_close(points.pixels - centre, 2 * (before.pixels - centre), atol=1e-4)
    assert_close(points.depth, torch.full_like(points.depth, 2.0))


def test_points_are_the_middles_of_pixels_in_the_targets_own_intrinsics():
    points = lift(torch.full((1, 1, 12, 16), 3.0), camera(), camera(2 * FOCAL, (24, 32)), motion())
    x, y = torch.arange(16) + 0.5, torch.arange(12) + 0.5
    assert_close(points.pixels.view(12, 16, 2)[..., 0], 2 * x.expand(12, 16), atol=1e-4)
    assert_close(points.pixels.view(12, 16, 2)[..., 1], 2 * y[:, None].expand(12, 16), atol=1e-4)


def test_nearer_points_hide_farther_ones():
    """A post in front of a wall, as it covers what it did not cover before."""
    depth = torch.full((1, 1, 12, 16), 20.0)
    depth[..., 8] = 4.0
    picture = torch.zeros(1, 3, 12, 16)
    picture[..., 8] = 1.0
    features, _ = PointSplatter("naive", radius_px=0.4)(*view(depth, picture, x=-1.0))
    assert (features[..., 3] == 1).all()  # the post moved by 5 pixels, the wall by 1
    assert features.sum() == features[..., 3].sum()


def test_sky_turns_with_the_camera_but_never_moves_and_is_behind_all():
    depth = torch.full((1, 1, 12, 16), math.inf)
    still, turned = (lift(depth, camera(), camera(), motion(x=5.0, z=-3.0, yaw=yaw)) for yaw in (0.0, 0.1))
    x = torch.arange(16) + 0.5
    assert_close(still.pixels.view(12, 16, 2)[..., 0], x.expand(12, 16), atol=1e-4)
    assert (turned.pixels[..., 0] > still.pixels[..., 0]).all()
    depth[..., :6, :] = 50.0
    features, opacity = PointSplatter("naive", radius_px=1.2)(*view(depth))
    assert (opacity == 1).all()
    behind_first = lift(depth, camera(), camera(), motion()).depth
    assert behind_first.isfinite().all()
    assert behind_first[0, -1] > behind_first[0, 0]


@pytest.mark.parametrize("accumulation", ACCUMULATIONS)
@pytest.mark.parametrize("wrong", [0.0, -2.0, math.nan, -math.inf])
def test_what_has_no_depth_has_no_place(accumulation, wrong):
    depth = torch.full((1, 1, 12, 16), 2.0)
    depth[..., 4:7] = wrong
    given = view(depth)
    for leaf in given[:2]:
        leaf.requires_grad_()
    features, opacity = PointSplatter(accumulation, radius_px=0.4)(*given)
    assert (opacity[..., 4:7] == 0).all()
    (features.square().sum() + opacity.sum()).backward()
    assert_finite(given[0].grad)
    assert given[1].grad is None or (given[1].grad[..., 4:7] == 0).all()


def test_what_is_behind_the_target_is_not_seen():
    features, opacity = PointSplatter()(*view(torch.full((1, 1, 12, 16), 2.0), z=-3.0))
    assert (features == 0).all()
    assert (opacity == 0).all()
    depth = torch.full((1, 1, 12, 16), 3.0, requires_grad=True)  # in the very plane of the camera
    features, _ = PointSplatter()(*view(depth, z=-3.0))
    features.sum().backward()
    assert_finite(depth.grad)


@pytest.mark.parametrize("accumulation", ["alphacomposite", "wsum", "wsumnorm"])
def test_gradients_are_finite_differences(accumulation):
    splatter = PointSplatter(accumulation, radius_px=1.7)
    cameras = camera(4.0, (3, 4), dtype=torch.float64)
    depth = (2 + torch.rand(1, 1, 3, 4, dtype=torch.float64)).requires_grad_()
    features = torch.rand(1, 2, 3, 4, dtype=torch.float64, requires_grad=True)
    move = motion(0.13, -0.07, 0.05, 0.04, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda f, d: splatter(f, d, cameras, cameras, move), (features, depth))


def test_depth_is_learned_from_a_second_view():
    """A wall at a depth of 4, seen from one step aside; the fit begins at 5."""
    smooth = torch.sin(torch.arange(16.0) / 2)[None, None, None] * torch.ones(1, 3, 12, 1)
    splatter = PointSplatter("wsumnorm", radius_px=2.0)
    with torch.no_grad():
        target, _ = splatter(*view(torch.full((1, 1, 12, 16), 4.0), smooth, x=-0.5))
    inverse = torch.tensor(1 / 5, requires_grad=True)
    optimizer = torch.optim.Adam([inverse], lr=0.005)
    for _ in range(40):
        seen, _ = splatter(*view((1 / inverse).expand(1, 1, 12, 16), smooth, x=-0.5))
        optimizer.zero_grad()
        (seen - target)[..., :12].abs().mean().backward()
        optimizer.step()
    assert float(inverse.detach()) == pytest.approx(1 / 4, abs=0.01)


def test_pairs_of_a_batch_move_each_for_itself():
    depth, features = 2 + torch.rand(2, 1, 12, 16), torch.rand(2, 3, 12, 16)
    moves = torch.cat((motion(x=0.3), motion(z=-0.4, yaw=0.1)))
    splatter = PointSplatter()
    together = splatter(features, depth, camera(batch=2), camera(batch=2), moves)
    for i in range(2):
        one = slice(i, i + 1)
        alone = splatter(features[one], depth[one], camera(), camera(), moves[one])
        assert_close(together[0][one], alone[0])
        assert_close(together[1][one], alone[1])


def test_bad_settings_are_named():
    for wrong, message in (
        ({"radius_px": 0.0}, r"renderer\.radius_px"),
        ({"points_per_pixel": 0}, r"renderer\.points_per_pixel"),
        ({"tau": -1.0}, r"renderer\.tau"),
        ({"near": -1.0}, r"renderer\.near"),
    ):
        with pytest.raises(UserError, match=message):
            PointSplatter(**wrong)
    with pytest.raises(UserError, match=r"accumulation.*wsumnorm"):
        check_targets({"_target_": "rendra_lab.tasks.synsin.splatting.PointSplatter", "accumulation": "sum"})


@pytest.mark.parametrize(("name", "radius"), [("splat", 4.0), ("splat_small", 1.5)])
@pytest.mark.parametrize("accumulation", ACCUMULATIONS)
def test_configurations_make_splatters(name, radius, accumulation):
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        made = compose(overrides=[f"+renderer={name}", f"renderer.accumulation={accumulation}"])
    splatter = instantiate(made.renderer)
    assert isinstance(splatter, PointSplatter)
    assert (splatter.accumulation, splatter.radius_px) == (accumulation, radius)


def test_other_devices(far):  # noqa: F811
    given = view(2 + torch.rand(1, 1, 12, 16), x=0.2)
    there = PointSplatter().to(far)(*(x.to(far) for x in given))
    for a, b in zip(there, PointSplatter()(*given), strict=True):
        assert isinstance(a, Far)
        assert_close(a.cpu(), b, atol=1e-5)
