"""Pictures of single pieces: the published camera, shapes where they are seen, the same for the same seed."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from rendra.structures import Meshes
from rendra_lab.frustums import Frustums
from rendra_lab.synthesis.furniture import CLASSES, NAMES
from rendra_lab.synthesis.lit_solids import lit_surfaces
from rendra_lab.synthesis.single_furniture import DEPTH_RANGE, FurnitureStudio, names_of
from rendra_lab.synthesis.solids import box
from rendra_lab.synthesis.surface_pictures import faces_seen

SIZE = (48, 48)


@pytest.fixture(scope="module")
def studio() -> FurnitureStudio:
    return FurnitureStudio(SIZE, cells=12, points=200)


def test_the_camera_is_r2n2s() -> None:
    lens = FurnitureStudio((137, 137), 4, 1).intrinsics()
    assert lens[0, 0] == lens[1, 1] == pytest.approx(149.84, abs=0.01)
    assert lens[:2, 2].tolist() == [68.5, 68.5]


@pytest.mark.parametrize("kind", CLASSES)
def test_every_class_is_seen_whole_within_the_depths(kind: str, studio: FurnitureStudio) -> None:
    views = studio.views(7, kind, 2)
    assert int(views.label) == CLASSES.index(kind)
    for matrix in views.own_to_camera:
        shapes = views.shape.seen(matrix)
        verts = shapes.verts[0]
        assert DEPTH_RANGE[0] < float(verts[:, 2].min()) < float(verts[:, 2].max()) < DEPTH_RANGE[1]
        pixels = verts @ views.intrinsics.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        assert 0 < float(pixels.min()) < float(pixels.max()) < SIZE[0]
        assert torch.linalg.det(matrix[:3, :3]) > 0
        up = matrix[:3, 1] / matrix[:3, 1].norm()
        elevation = math.degrees(math.asin(float(-up[2])))  # the camera looks down along +z
        assert 25 <= elevation <= 30
        assert up[1] < 0  # y of the camera points down


def test_the_diagonal_of_a_piece_is_one_and_the_camera_looks_at_its_middle(studio: FurnitureStudio) -> None:
    low, high = torch.from_numpy(studio.piece(3, "desk").bounds())
    corners = torch.stack([low, high, (low + high) / 2])
    for matrix in studio.views(3, "desk", 2).own_to_camera:
        one, other, middle = corners @ matrix[:3, :3].T + matrix[:3, 3]
        assert float((one - other).norm()) == pytest.approx(1, abs=1e-5)
        torch.testing.assert_close(middle[:2], torch.zeros(2), atol=1e-5, rtol=0)
        assert 1.3 <= float(middle[2]) <= 1.75


def test_what_is_painted_is_where_the_shape_is(studio: FurnitureStudio) -> None:
    views = studio.views(2, "sofa", 3)
    for picture, matrix in zip(views.rgb, views.own_to_camera, strict=True):
        shapes = views.shape.seen(matrix)
        mesh = Meshes([shapes.verts[0]], [shapes.faces[0]])
        is_there = faces_seen(mesh, views.intrinsics, torch.eye(4), SIZE)[0] >= 0
        ground = picture[:, :2, :2].float().mean((1, 2), keepdim=True)
        is_painted = ((picture - ground).abs() > 24).any(0)
        assert is_there.sum() > 300
        assert (is_there & ~is_painted).sum() < 0.15 * is_there.sum()
        assert (is_painted & ~is_there).sum() < 0.1 * is_there.sum()


def test_voxels_of_the_picture_lie_where_the_shape_is(studio: FurnitureStudio) -> None:
    views = studio.views(4, "bed", 1)
    shapes = views.shape.seen(views.own_to_camera[0])
    frustum = Frustums(
        torch.tensor([[0.0, 0, SIZE[1], SIZE[0]]]), torch.tensor([DEPTH_RANGE]), views.intrinsics[None]
    )
    grid = frustum.voxels_of(shapes, 16)[0]
    cells = ((frustum.from_camera(shapes.points)[0] + 1) * 8).floor().long()
    assert bool(((cells >= 0) & (cells < 16)).all())
    assert grid[cells[:, 2], cells[:, 1], cells[:, 0]].float().mean() > 0.9


def test_a_seed_is_a_piece_and_more_views_begin_with_the_same(studio: FurnitureStudio) -> None:
    one, more, other = (studio.views(*key) for key in ((5, "tool", 1), (5, "tool", 2), (6, "tool", 1)))
    assert torch.equal(one.rgb[0], more.rgb[0])
    assert torch.equal(one.shape.points, more.shape.points)
    assert not torch.equal(one.rgb, other.rgb)
    assert studio.views(5, "tool", 0).rgb.shape == (0, 3, *SIZE)
    studio.clear()
    assert torch.equal(studio.views(5, "tool", 1).rgb, one.rgb)


def test_classes_share_all_names_among_them() -> None:
    assert sorted(name for kind in CLASSES for name in names_of(kind)) == sorted(NAMES)
    assert all(names_of(kind) for kind in CLASSES)


def test_what_there_is_not_is_refused(studio: FurnitureStudio) -> None:
    with pytest.raises(ValueError, match="no furniture is of the class 'piano'; there are: bed, bookcase"):
        studio.piece(0, "piano")
    with pytest.raises(ValueError, match="solids have 24 corners, got light for 3"):
        lit_surfaces([box((1, 1, 1), (0, 0, 0), "wood", (1.0, 1.0, 1.0))], np.ones((3, 3), np.float32))
