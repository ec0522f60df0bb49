"""Rooms: the same for a seed and other for others, of one piece in all views, and nobody stands in a wall."""

import math

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.synthesis.posed_views import PosedViews, seen_by, to_other_view
from rendra_lab.synthesis.rooms import CLEARANCE_M, Room, RoomWorld, build_room, has_clearance
from rendra_lab.synthesis.rooms_furnishing import furnish
from rendra_lab.synthesis.rooms_shell import draw_openings
from rendra_lab.synthesis.rooms_surfaces import SIDE, SURFACES, paint_surfaces

SIZE = (64, 64)
SEEDS = (1, 5)


@pytest.fixture(scope="module")
def rooms() -> list[Room]:
    return [build_room(seed) for seed in SEEDS]


@pytest.fixture(scope="module")
def views() -> list[PosedViews]:
    return [RoomWorld().views(seed, 2, SIZE) for seed in SEEDS]


def error(views: PosedViews, scale: float = 1.0) -> tuple[float, float, float]:
    """Of the first view brought to the second by the depth, where both see: its error, that of a copy, the share."""
    to_first = views.world_to_camera[[0]] @ torch.linalg.inv(views.world_to_camera[[1]])
    depth, K = views.depth[[1]], views.intrinsics[[1]]
    visible = seen_by(depth, K, to_first, views.depth[[0]], views.intrinsics[[0]])[0, 0]
    pixels, _ = to_other_view(depth * scale, K, to_first, K)
    there = F.grid_sample(views.rgb[[0]] / 255, 2 * pixels / SIZE[0] - 1, align_corners=False, padding_mode="border")
    warped = (there[0] - views.rgb[1] / 255).abs().mean(0)[visible].mean()
    copied = (views.rgb[0] / 255 - views.rgb[1] / 255).abs().mean(0)[visible].mean()
    return float(warped), float(copied), float(visible.float().mean())


def test_views_agree_with_each_other_through_depth_and_cameras(views: list[PosedViews]) -> None:
    for one in views:
        warped, copied, share = error(one)
        assert 0.5 < share <= 1
        assert warped < 0.05
        assert warped < 0.6 * copied
        assert warped < min(error(one, 0.7)[0], error(one, 1.4)[0])


def test_the_same_seed_is_the_same_room_and_another_one_is_not(views: list[PosedViews]) -> None:
    again = RoomWorld().views(SEEDS[0], 2, SIZE)
    assert torch.equal(again.rgb, views[0].rgb)
    assert torch.equal(again.depth, views[0].depth)
    assert torch.equal(again.world_to_camera, views[0].world_to_camera)
    change = (views[0].rgb.float() - views[1].rgb.float()).abs().mean()
    assert float(change) > 15


def test_depth_is_that_of_walls_at_most(rooms: list[Room], views: list[PosedViews]) -> None:
    for room, one in zip(rooms, views, strict=True):
        points = room.surfaces.verts
        reach = float((points.amax(0) - points.amin(0)).norm())
        assert bool(torch.isfinite(one.depth).all())
        assert 0.1 < float(one.depth.min()) < float(one.depth.max()) < reach
        assert reach < 14


def test_pictures_are_neither_dark_nor_white_nor_flat(views: list[PosedViews]) -> None:
    for one in views:
        grey = one.rgb.float().mean(1)
        assert 60 < float(grey.mean()) < 215
        assert float((grey > 250).float().mean()) < 0.4
        assert float(grey.std()) > 20


def test_nobody_stands_in_a_wall_or_in_furniture(rooms: list[Room]) -> None:
    world = RoomWorld(max_move_m=1.0)
    for seed, room in zip(SEEDS, rooms, strict=True):
        poses = world.poses(room, seed, 40).double()
        eyes = -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0].numpy()
        assert bool(has_clearance(room, eyes, CLEARANCE_M - 1e-4).all())
        assert bool((eyes > CLEARANCE_M - 1e-4).all() & (eyes < np.array(room.extent) - CLEARANCE_M + 1e-4).all())
        assert np.ptp(eyes, 0).min() > 0.2
        corners = np.concatenate([solid.points for one in room.placed for solid in one.in_room()])
        assert np.abs(eyes[:, None] - corners).max(-1).min() > 0.6 * CLEARANCE_M  # a turned box's axes are not ours


def test_views_turn_and_move_within_their_limits(rooms: list[Room]) -> None:
    poses = RoomWorld(max_turn_deg=10.0, max_move_m=0.3).poses(rooms[0], SEEDS[0], 40).double()
    torch.testing.assert_close(
        poses[:, :3, :3] @ poses[:, :3, :3].mT, torch.eye(3).double().expand(40, 3, 3), atol=1e-6, rtol=0
    )
    assert bool((torch.linalg.det(poses[:, :3, :3]) > 0).all())
    eyes = -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0]
    assert 0.2 < float((eyes[:, None] - eyes).abs().max()) < 0.3001
    ahead = poses[:, 2, :3]
    heading = torch.atan2(ahead[:, 0], ahead[:, 2])
    apart = torch.remainder(heading[:, None] - heading + math.pi, 2 * math.pi) - math.pi
    assert 7 < math.degrees(float(apart.abs().max())) < 10.01
    assert 2 < math.degrees(float(ahead[:, 1].asin().max() - ahead[:, 1].asin().min())) < 5.01
    assert bool((-poses[:, 1, 1] < -0.9).logical_not().all())  # heads stay up
    still = RoomWorld(max_turn_deg=0.0, max_move_m=0.0).poses(rooms[0], SEEDS[0], 3)
    assert torch.equal(still[0], still[2])


def test_the_field_of_view_is_that_of_the_settings() -> None:
    one = RoomWorld(hfov_deg=60.0).views(SEEDS[0], 1, (24, 32))
    assert one.rgb.shape == (1, 3, 24, 32)
    assert one.rgb.dtype == torch.uint8
    assert 2 * math.degrees(math.atan(16 / float(one.intrinsics[0, 0, 0]))) == pytest.approx(60)
    assert one.intrinsics[0, :2, 2].tolist() == [16, 12]


def test_furniture_stands_within_the_walls_and_not_in_door_ways() -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        extent = (rng.uniform(3, 6), 2.6, rng.uniform(3, 6))
        openings = draw_openings(extent, rng)
        assert sum(one.kind != "window" for one in openings) == 1
        furnishing = furnish(extent, openings, rng)
        for one in furnishing.placed:
            low, high = one.footprint()
            assert (low > -0.01).all()
            assert high[0] < extent[0] + 0.01
            assert high[1] < extent[2] + 0.01
            assert one.height() < extent[1] + 1e-3


def test_materials_repeat_and_are_colours() -> None:
    pyramid = paint_surfaces(np.random.default_rng(3))
    assert pyramid.side == SIDE
    assert 0 <= float(pyramid.texels.min()) < float(pyramid.texels.max()) <= 1
    which = torch.arange(len(SURFACES)).repeat_interleave(5)
    places = torch.rand(len(which), 2, generator=torch.Generator().manual_seed(0))
    extent = torch.full((len(which),), 2.0 / SIDE)
    torch.testing.assert_close(
        pyramid.look_up(which, places, extent), pyramid.look_up(which, places + 3, extent), atol=2e-3, rtol=0
    )


def test_settings_name_the_pictures_and_bad_ones_are_refused() -> None:
    assert RoomWorld().settings() == RoomWorld(90.0).settings()
    assert RoomWorld().settings() != RoomWorld(max_move_m=0.2).settings()
    with pytest.raises(UserError, match=r"data.world.hfov_deg must be a number from 20 to 140, got 180"):
        RoomWorld(hfov_deg=180.0)
    with pytest.raises(UserError, match=r"data.world.max_turn_deg"):
        RoomWorld(max_turn_deg=-1.0)
    with pytest.raises(UserError, match=r"data.world.max_move_m"):
        RoomWorld(max_move_m=float("nan"))
    with pytest.raises(UserError, match="a count and a size of at least 1"):
        RoomWorld().views(0, 0, SIZE)
