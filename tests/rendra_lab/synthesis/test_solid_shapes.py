"""Outer surfaces of solids that overlap: their areas, points and grids, and where cameras see them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from rendra.structures import Meshes
from rendra_lab.synthesis.furniture import draw
from rendra_lab.synthesis.solid_shapes import SolidShape, is_hidden, shape_of
from rendra_lab.synthesis.solids import Solid, box, ellipsoid, weld
from rendra_lab.voxelization import windings_at

GREY = (0.5, 0.5, 0.5)


def shape(*solids: Solid, side: int = 16, count: int = 2000) -> SolidShape:
    verts, faces, _ = weld(solids)
    generator = torch.Generator().manual_seed(0)
    return shape_of(torch.from_numpy(verts), torch.from_numpy(faces), side, count, generator)


def area(shape: SolidShape) -> float:
    return float(Meshes([shape.verts], [shape.faces]).faces_areas_packed().sum())


def test_a_solid_within_another_one_is_no_part_of_its_surface() -> None:
    found = shape(box((2, 2, 2), (0, 0, 0), "wood", GREY), ellipsoid((0.5, 0.5, 0.5), (0, 0, 0), "wood", GREY))
    assert len(found.faces) == 12
    assert area(found) == pytest.approx(24, rel=1e-5)
    assert bool((found.points.abs().amax(1) > 0.999).all())
    assert bool(found.voxels.all())


def test_boxes_that_touch_have_the_surface_of_one() -> None:
    halves = [box((1, 1, 1), (x, 0, 0), "wood", GREY, cell=0.25) for x in (-0.5, 0.5)]
    found = shape(*halves)
    assert area(found) == pytest.approx(10, rel=1e-4)  # of half of 2 x 1 x 1, whose half longest side is 1
    assert not bool(((found.points[:, 0].abs() < 0.01) & (found.points[:, 1:].abs().amax(1) < 0.49)).any())


def test_what_is_hidden_in_part_is_cut() -> None:
    plate, post = box((2, 0.1, 2), (0, 0, 0), "wood", GREY), box((1, 1, 1), (0, 0.5, 0), "wood", GREY)
    found = shape(plate, post, count=4000)
    true = 2 * 4 - 1 + 4 * 0.2 + 1 + 4 * 0.95  # both sides of the plate but where the post stands, and the post
    assert area(found) == pytest.approx(true, rel=0.04)
    middle = found.cube_to_own[:3, 3]
    beneath = ((found.points + middle)[:, 1] - 0.05).abs() < 1e-3
    assert not bool((beneath & ((found.points + middle)[:, [0, 2]].abs().amax(1) < 0.49)).any())


def test_points_lie_on_the_surface_and_normals_point_outwards() -> None:
    piece = draw("bed", np.random.default_rng(2))
    verts, faces, _ = weld(piece.solids)
    found = shape(*piece.solids)
    own = (torch.from_numpy(verts) - found.cube_to_own[:3, 3]) / found.cube_to_own[0, 0]
    rows = torch.from_numpy(faces)
    inside, outside = (windings_at(found.points + step * found.normals, own, rows) for step in (-1e-3, 4e-3))
    assert (inside > 0).float().mean() > 0.99
    assert bool((outside == 0).all())
    torch.testing.assert_close(found.normals.norm(dim=1), torch.ones(len(found.normals)))
    assert not bool(is_hidden(found.points, found.normals, own, rows, 4e-3).any())


def test_the_longest_side_fills_the_cube_and_the_matrix_leads_back() -> None:
    found = shape(box((0.4, 3, 1), (5, 6, 7), "wood", GREY))
    torch.testing.assert_close(found.verts.amax(0), torch.tensor([0.4 / 3, 1, 1 / 3]))
    torch.testing.assert_close(found.cube_to_own[:3, 3], torch.tensor([5.0, 6, 7]))
    torch.testing.assert_close(found.cube_to_own[:3, :3], 1.5 * torch.eye(3))


def test_a_camera_sees_the_shape_where_it_is_put() -> None:
    found = shape(box((1, 2, 1), (0, 1, 0), "wood", GREY))
    turn = torch.tensor([[0.0, 0, 1, 0.5], [0, -1, 0, 1], [1, 0, 0, 4], [0, 0, 0, 1]])
    turn[:3, :3] *= 2
    seen = found.seen(turn)
    torch.testing.assert_close(seen.verts[0].amin(0), torch.tensor([-0.5, -3, 3]))
    torch.testing.assert_close(seen.verts[0].amax(0), torch.tensor([1.5, 1, 5]))
    torch.testing.assert_close(seen.voxels_to_camera[0], turn @ found.cube_to_own)
    torch.testing.assert_close(seen.normals[0].norm(dim=1), torch.ones(2000))
    center = torch.tensor([0.5, -1.0, 4.0])
    outwards: Tensor = ((seen.points[0] - center) * seen.normals[0]).sum(1)
    assert bool((outwards > 0).all())


def test_the_same_generator_draws_the_same_points_and_no_faces_are_refused() -> None:
    first, second = (shape(box((1, 1, 1), (0, 0, 0), "wood", GREY)) for _ in range(2))
    assert torch.equal(first.points, second.points)
    with pytest.raises(ValueError, match="at least one face, got 3 vertices and none"):
        shape_of(torch.eye(3), torch.zeros(0, 3, dtype=torch.long), 4, 5)
