"""Views without learning: where their depth is true, or the world is a wall, they are exact."""

import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401
from torch import Tensor

from rendra_lab.tasks.synsin.baselines import copied, warped_by_depth, warped_by_plane
from rendra_lab.tasks.synsin.records import PairBatch

_H, _W, _F = 12, 16, 8.0


def camera(focal: float = _F) -> Tensor:
    return torch.tensor([[[focal, 0, _W / 2], [0, focal, _H / 2], [0, 0, 1]]])


def pair(shift: tuple[float, float, float], turn: Tensor | None = None, focal: float = _F, dtype=torch.float32):
    """A picture of noise and a camera that moves: points shift by so much in its axes."""
    move = torch.eye(4)[None].clone()
    move[0, :3, 3] = torch.tensor(shift)
    if turn is not None:
        move[0, :3, :3] = turn
    picture = torch.rand(1, 3, _H, _W)
    return PairBatch(picture, picture, camera(), camera(focal), move).to(dtype)


def test_the_copy_is_the_input() -> None:
    batch = pair((1.0, 0, 0))
    assert copied(batch) is batch.input


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("columns", "rows"), [(3, 0), (-2, 4), (0, 0)])
def test_a_wall_that_moves_by_whole_pixels_is_moved_exactly(columns: int, rows: int, dtype: torch.dtype) -> None:
    depth = 4.0
    batch = pair((columns * depth / _F, rows * depth / _F, 0.0), dtype=dtype)
    expected = torch.roll(batch.input, (rows, columns), (2, 3))
    inside = torch.zeros(1, 1, _H, _W, dtype=torch.bool)
    inside[..., max(rows, 0) : _H + min(rows, 0), max(columns, 0) : _W + min(columns, 0)] = True
    for warped, rim in (
        (warped_by_plane(batch, depth), 0),
        (warped_by_depth(batch, torch.full((1, 1, _H, _W), depth, dtype=dtype)), 1),  # holes beside hits are cracks
    ):
        assert warped.rgb.dtype == dtype
        assert_close(warped.rgb[inside.expand_as(expected)], expected[inside.expand_as(expected)], atol=1e-5)
        assert warped.covered[inside].all()
        wider = torch.nn.functional.max_pool2d(inside.float(), 2 * rim + 1, 1, rim) > 0
        assert_close(warped.covered.float(), wider.float())
        if not rim:
            hole = warped.rgb[..., ~inside[0, 0]]
            assert_close(hole, expected[..., inside[0, 0]].mean(-1, keepdim=True).expand_as(hole))


def test_a_wall_that_comes_nearer_is_enlarged_without_holes() -> None:
    batch = pair((0.0, 0.0, -2.0))
    ramp = (torch.arange(_W) + 0.5) / _W
    batch = PairBatch(ramp.expand(1, 3, _H, _W).contiguous(), *(getattr(batch, n) for n in PairBatch.names()[1:5]))
    expected = (ramp - 0.5) / 2 + 0.5
    by_plane = warped_by_plane(batch, 4.0)
    assert by_plane.covered.all()
    assert_close(by_plane.rgb, expected.expand(1, 3, _H, _W), atol=1e-5)
    by_depth = warped_by_depth(batch, torch.full((1, 1, _H, _W), 4.0))
    assert by_depth.covered.all()
    assert float((by_depth.rgb - expected).abs().max()) <= 0.75 / _W + 1e-6  # half an input pixel, and a crack's mean


def test_planes_are_right_for_turned_cameras_with_another_lens() -> None:
    angle = torch.tensor(0.1)
    turn = torch.tensor([[angle.cos(), 0, angle.sin()], [0, 1, 0], [-angle.sin(), 0, angle.cos()]])
    batch = pair((0.3, -0.2, 0.1), turn, focal=6.0, dtype=torch.float64)
    y, x = torch.meshgrid(torch.arange(_H) + 0.5, torch.arange(_W) + 0.5, indexing="ij")
    place = torch.stack([x, y], 0)[None].double() / 20
    batch = PairBatch(torch.cat([place, place[:, :1]], 1), *(getattr(batch, n) for n in PairBatch.names()[1:5]))
    found = warped_by_plane(batch, 5.0)
    point = torch.tensor([1.0, -0.5, 5.0, 1.0], dtype=torch.float64)  # on the wall
    here = (batch.intrinsics[0] @ point[:3])[:2] / point[2] / 20
    there = batch.target_intrinsics[0] @ (batch.input_to_target[0] @ point)[:3]
    column, row = there[:2] / there[2] - 0.5
    sample = torch.tensor([[[[2 * (column + 0.5) / _W - 1, 2 * (row + 0.5) / _H - 1]]]], dtype=torch.float64)
    seen = torch.nn.functional.grid_sample(found.rgb, sample, align_corners=False)[0, :2, 0, 0]
    assert_close(seen, here, atol=2e-3)  # the wall is bent a little by the picture of a turned camera


def test_the_nearest_of_two_points_wins_and_the_hole_behind_it_stays() -> None:
    batch = pair((1.0, 0.0, 0.0))
    depth = torch.full((1, 1, _H, _W), 8.0)  # moves by 1 pixel
    depth[..., 3:9, 2:8] = 2.0  # moves by 4
    found = warped_by_depth(batch, depth)
    assert_close(found.rgb[..., 3:9, 6:12], batch.input[..., 3:9, 2:8], atol=0)
    assert_close(found.rgb[..., :3, 1:], batch.input[..., :3, :-1], atol=0)
    assert not found.covered[..., 4:8, 4].any()  # what has no hit beside it
    assert found.covered[..., 3:9, 6:].all()


def test_sky_turns_with_the_camera_alone_and_stands_behind_everything() -> None:
    batch = pair((1.0, 0.0, 0.0))
    depth = torch.full((1, 1, _H, _W), torch.inf)
    assert_close(warped_by_depth(batch, depth).rgb, batch.input, atol=0)
    depth[..., 5, 5] = 1e6
    depth[..., 5, 8] = 4.0  # by 2 pixels, before the sky
    found = warped_by_depth(batch, depth).rgb
    assert_close(found[..., 5, 10], batch.input[..., 5, 8], atol=0)
    assert_close(found[..., 5, 5], batch.input[..., 5, 5], atol=0)


def test_what_lies_behind_the_camera_is_not_seen() -> None:
    batch = pair((0.0, 0.0, -6.0))
    for found in (warped_by_plane(batch, 4.0), warped_by_depth(batch, torch.full((1, 1, _H, _W), 4.0))):
        assert not found.covered.any()
        assert_close(found.rgb, batch.input.mean((2, 3), keepdim=True).expand_as(found.rgb))


def test_no_pairs_have_no_views() -> None:
    empty = PairBatch(*(getattr(pair((1.0, 0, 0)), name)[:0] for name in PairBatch.names()[:5]))
    assert warped_by_plane(empty, 2.0).rgb.shape == (0, 3, _H, _W)
    assert warped_by_depth(empty, torch.zeros(0, 1, _H, _W)).rgb.shape == (0, 3, _H, _W)


def test_warps_stay_on_the_device(far: torch.device) -> None:  # noqa: F811
    batch = pair((1.0, 0.0, -1.0)).to(far)
    found = (*warped_by_plane(batch, 4.0), *warped_by_depth(batch, torch.full((1, 1, _H, _W), 4.0).to(far)))
    assert all(isinstance(part, Far) for part in found)
