"""The frame of shapes: there and back, its corners, its normals and its voxels."""

from __future__ import annotations

import torch
from torch import Tensor

from rendra_lab.frustums import Frustums
from rendra_lab.shape_records import Shapes

GENERATOR = torch.Generator().manual_seed(0)


def frustums(count: int) -> Frustums:
    low = 100 * torch.rand(count, 2, generator=GENERATOR, dtype=torch.float64)
    size = 20 + 50 * torch.rand(count, 2, generator=GENERATOR, dtype=torch.float64)
    near = 1 + torch.rand(count, 1, generator=GENERATOR, dtype=torch.float64)
    intrinsics = torch.tensor([[120.0, 0, 64], [0, 110, 48], [0, 0, 1]], dtype=torch.float64).repeat(count, 1, 1)
    return Frustums(torch.cat([low, low + size], 1), torch.cat([near, near + 2], 1), intrinsics)


def test_there_and_back_is_nothing() -> None:
    frames = frustums(3)
    points = 2 * torch.rand(3, 50, 3, generator=GENERATOR, dtype=torch.float64) - 1
    torch.testing.assert_close(frames.from_camera(frames.to_camera(points)), points)


def test_corners_are_the_box_at_the_two_depths() -> None:
    frames = frustums(2)
    corners = frames.to_camera(torch.tensor([[-1.0, -1, -1], [1, 1, 1]], dtype=torch.float64).repeat(2, 1, 1))
    torch.testing.assert_close(corners[..., 2], frames.depth_range)
    seen = corners @ frames.intrinsics.transpose(1, 2)
    torch.testing.assert_close(seen[..., :2] / seen[..., 2:], frames.boxes.reshape(2, 2, 2))


def test_normals_stay_across_to_their_surface() -> None:
    frames = frustums(1)
    point = frames.to_camera(torch.zeros(1, 1, 3, dtype=torch.float64))
    first, second = torch.randn(2, 1, 1, 3, generator=GENERATOR, dtype=torch.float64)
    normal = torch.nn.functional.normalize(torch.linalg.cross(first, second), dim=-1)
    turned = frames.turned_from_camera(point, normal)
    slopes = torch.autograd.functional.jacobian(frames.from_camera, point).reshape(3, 3)
    for tangent in (first, second):
        assert abs(float((slopes @ tangent.reshape(3)) @ turned.reshape(3))) < 1e-9
    assert float((slopes @ normal.reshape(3)) @ turned.reshape(3)) > 0


def test_points_behind_the_camera_stay_finite() -> None:
    frames = frustums(1)
    behind = torch.tensor([[[0.3, 0.2, -1.0], [0.0, 0.0, 0.0]]], dtype=torch.float64)
    assert bool(frames.from_camera(behind).isfinite().all())


def cube_shapes(side: int, center: Tensor, half: float) -> Shapes:
    """A cube that fills the inner half of its own grid."""
    filled = torch.zeros(1, side, side, side, dtype=torch.bool)
    filled[:, side // 4 : -(side // 4), side // 4 : -(side // 4), side // 4 : -(side // 4)] = True
    matrix = torch.eye(4)
    matrix[:3, :3] *= 2 * half
    matrix[:3, 3] = center
    empty = torch.zeros(1, 0, 3)
    return Shapes(empty, empty, filled, matrix[None], (empty[0],), (empty[0].long(),))


def test_voxels_are_those_places_that_the_object_fills() -> None:
    center, half = torch.tensor([0.2, -0.1, 3.0]), 0.5
    intrinsics = torch.tensor([[[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]])
    frames = Frustums(torch.tensor([[0.0, 0, 100, 100]]), torch.tensor([[2.0, 4.0]]), intrinsics)
    cells = frames.voxels_of(cube_shapes(16, center, half), 20, samples=1)
    ticks = (torch.arange(20) + 0.5) / 10 - 1
    z, y, x = torch.meshgrid(ticks, ticks, ticks, indexing="ij")
    places = frames.to_camera(torch.stack([x, y, z], -1).reshape(1, -1, 3))[0]
    inside = ((places - center).abs() < half).all(-1).reshape(1, 20, 20, 20)
    assert 0 < int(inside.sum()) < inside.numel()
    assert torch.equal(cells, inside)


def test_more_samples_find_what_is_thin() -> None:
    shapes = cube_shapes(16, torch.tensor([0.0, 0.0, 3.0]), 0.02)
    frames = Frustums(
        torch.tensor([[0.0, 0, 100, 100]]), torch.tensor([[2.0, 4.0]]),
        torch.tensor([[[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]]),
    )  # fmt: skip
    assert int(frames.voxels_of(shapes, 8, samples=1).sum()) <= int(frames.voxels_of(shapes, 8, samples=16).sum())
    assert int(frames.voxels_of(shapes, 8, samples=16).sum()) > 0


def test_no_frustum_has_no_voxels() -> None:
    frames = frustums(0)
    none = torch.zeros(0, 0, 3)
    shapes = Shapes(none, none, torch.zeros(0, 4, 4, 4, dtype=torch.bool), torch.zeros(0, 4, 4), (), ())
    assert frames.voxels_of(shapes, 4).shape == (0, 4, 4, 4)
