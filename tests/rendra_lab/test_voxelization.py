"""Grids of solids: volumes, unions, thin things, holes, and points against the solid angle of the surface."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from rendra.utils import ico_sphere
from rendra_lab.synthesis.furniture import NAMES, draw
from rendra_lab.synthesis.solids import Solid, box, ellipsoid, weld
from rendra_lab.voxelization import voxels_of, windings_at

GREY = (0.5, 0.5, 0.5)


def mesh_of(*solids: Solid) -> tuple[Tensor, Tensor]:
    verts, faces, _ = weld(solids)
    return torch.from_numpy(verts), torch.from_numpy(faces)


def cube(low: tuple[float, float, float], high: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
    size = tuple(b - a for a, b in zip(low, high, strict=True))
    middle = tuple((a + b) / 2 for a, b in zip(low, high, strict=True))
    return mesh_of(box(size, middle, "wood", GREY))  # type: ignore[arg-type]


def joined(*meshes: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    counts = np.cumsum([0, *(len(verts) for verts, _ in meshes)])
    faces = [faces + int(first) for (_, faces), first in zip(meshes, counts, strict=False)]
    return torch.cat([verts for verts, _ in meshes]), torch.cat(faces)


def solid_angle_windings(points: Tensor, verts: Tensor, faces: Tensor) -> Tensor:
    """The slow twin: the solid angle of all faces over 4 pi (van Oosterom and Strackee 1983)."""
    rays = verts.double()[faces][None] - points.double()[:, None, None]
    a, b, c = rays.unbind(2)
    la, lb, lc = (ray.norm(dim=-1) for ray in (a, b, c))
    triple = (a * torch.linalg.cross(b, c)).sum(-1)
    flat = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return torch.atan2(triple, flat).sum(1) / (2 * math.pi)


def test_a_box_of_whole_cells_is_exactly_these() -> None:
    grid = voxels_of(*cube((-0.5, -0.25, 0.0), (0.25, 0.75, 1.0)), 8)
    expected = torch.zeros(8, 8, 8, dtype=torch.bool)
    expected[4:8, 3:7, 2:5] = True  # z, y, x
    assert torch.equal(grid, expected)


def test_a_ball_has_its_volume_between_those_of_its_middles_and_its_skin() -> None:
    ball = ico_sphere(4)
    side, radius = 40, 0.9
    grid = voxels_of(radius * ball.verts_packed(), ball.faces_packed(), side)
    volume = float(grid.sum()) * (2 / side) ** 3
    cell = 2 / side
    assert 4 / 3 * math.pi * radius**3 < volume < 4 / 3 * math.pi * (radius + math.sqrt(3) * cell) ** 3
    ticks = (torch.arange(side) + 0.5) * cell - 1
    far = (ticks[:, None, None] ** 2 + ticks[:, None] ** 2 + ticks**2).sqrt()
    assert bool(grid[far < 0.995 * radius].all())
    assert not bool(grid[far > radius + math.sqrt(3) / 2 * cell].any())


def test_solids_that_overlap_are_their_union_and_may_be_inside_out() -> None:
    one, other = cube((-1, -1, -1), (0.5, 0.5, 0.5)), cube((-0.5, -0.5, -0.5), (1, 1, 1))
    union = voxels_of(*joined(one, other), 16)
    assert torch.equal(union, voxels_of(*one, 16) | voxels_of(*other, 16))
    verts, faces = joined(one, other)
    assert torch.equal(union, voxels_of(verts, faces.flip(1), 16))


def test_turning_a_solid_turns_its_grid() -> None:
    verts, faces = mesh_of(ellipsoid((0.9, 0.4, 0.2), (0.03, 0.05, -0.07), "wood", GREY, 20))
    grid = voxels_of(verts, faces, 21)
    assert torch.equal(voxels_of(verts[:, [1, 2, 0]], faces, 21), grid.permute(2, 0, 1))  # x to z, y to x, z to y
    mirrored = verts * torch.tensor([1.0, 1.0, -1.0])
    assert torch.equal(voxels_of(mirrored, faces, 21), grid.flip(0))


def test_nothing_is_too_thin() -> None:
    needle = cube((-0.9, 0.31, 0.31), (0.9, 0.3101, 0.3101))
    grid = voxels_of(*needle, 10)
    assert torch.equal(grid.nonzero(), torch.tensor([[6, 6, x] for x in range(10)]))
    square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])  # between the layers of an even grid
    sheet = voxels_of(square, torch.tensor([[0, 1, 2], [0, 2, 3]]), 4)
    assert bool(sheet[1:3].all())
    assert not bool(sheet[0].any() | sheet[3].any())


def test_what_is_open_does_not_leak() -> None:
    verts, faces = cube((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7))
    corners = verts[faces]
    is_top = (corners[..., 2] > 0.6).all(1)
    grid = voxels_of(verts, faces[~is_top], 10)  # an open chest
    assert not bool(grid[:1].any() | grid[9:].any())
    assert bool(grid[1].any())


def test_parts_outside_of_the_cube_are_left_out_and_empty_meshes_are_empty() -> None:
    assert bool(voxels_of(*cube((-3, -3, -3), (3, 3, 3)), 5).all())
    assert not bool(voxels_of(*cube((2, 2, 2), (3, 3, 3)), 5).any())
    empty = torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long)
    assert not bool(voxels_of(*empty, 5).any())
    assert windings_at(torch.zeros(2, 3), *empty).tolist() == [0, 0]


@pytest.mark.parametrize("name", NAMES)
def test_points_of_furniture_are_wound_around_as_the_solid_angle_says(name: str) -> None:
    verts, faces = mesh_of(*draw(name, np.random.default_rng(5)).solids)
    low, high = verts.amin(0), verts.amax(0)
    points = low + (high - low) * torch.rand(60, 3, generator=torch.Generator().manual_seed(1))
    exact = solid_angle_windings(points, verts, faces)
    is_clear = (exact - exact.round()).abs() < 1e-3  # near the surface the sum of angles is rough
    assert is_clear.sum() > 50
    assert torch.equal(windings_at(points, verts, faces)[is_clear], exact.round().long()[is_clear])


def test_lines_through_corners_and_edges_of_a_mesh_are_counted_once() -> None:
    verts, faces = mesh_of(box((2, 2, 2), (0, 0, 0), "wood", GREY, cell=0.25))
    steps = torch.linspace(-1.5, 1.5, 25, dtype=torch.float64)
    points = torch.cartesian_prod(steps, steps, torch.tensor([-2.0, 0.1, 2.0], dtype=torch.float64))
    windings = windings_at(points, verts, faces)
    assert torch.equal(windings[points[:, 2].abs() > 1], torch.zeros(2 * 625, dtype=torch.long))
    middle = points[:, 2] == 0.1
    inside = (points[:, :2].abs() < 1).all(1)
    assert bool((windings[middle & inside] == 1).all())
    assert bool((windings[(points[:, :2].abs() > 1).any(1)] == 0).all())


def test_what_cannot_be_is_refused() -> None:
    verts, faces = cube((-1, -1, -1), (1, 1, 1))
    with pytest.raises(ValueError, match="at least 1 cell along each side, got 0"):
        voxels_of(verts, faces, 0)
    with pytest.raises(ValueError, match="faces name vertices 0 to 7, but there are 4"):
        voxels_of(verts[:4], faces, 3)
    verts[1, 2] = math.nan
    with pytest.raises(ValueError, match="vertices must be finite numbers, got 1 that are not"):
        windings_at(verts[:1], verts, faces)
