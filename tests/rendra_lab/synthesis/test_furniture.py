"""Furniture: closed solids that stand on the floor over the origin, of all classes, no two pieces alike."""

import math

import numpy as np
import pytest
import torch
import trimesh

from rendra_lab.synthesis.furniture import CLASSES, NAMES, draw
from rendra_lab.synthesis.solids import box, ellipsoid, grid_lines, lathe, rotation, rounded_box, sheet, weld

GREY = (0.5, 0.5, 0.5)


def as_trimesh(solid: object) -> trimesh.Trimesh:
    verts, faces, _ = weld([solid])  # type: ignore[list-item]
    return trimesh.Trimesh(verts, faces, process=False)


@pytest.mark.parametrize("name", NAMES)
def test_a_piece_consists_of_closed_solids_and_stands_on_the_floor(name: str) -> None:
    for seed in (0, 7):
        piece = draw(name, np.random.default_rng(seed))
        for solid in piece.solids:
            mesh = as_trimesh(solid)
            assert mesh.is_watertight
            assert mesh.volume > 0
            np.testing.assert_allclose(np.linalg.norm(solid.normals, axis=1), 1, atol=1e-5)
        low, high = piece.bounds()
        assert abs(low[1]) < 0.021
        assert abs(low[0] + high[0]) < 0.3
        assert (high - low).max() < 3
        assert piece.kind in CLASSES


def test_every_class_is_there_and_pieces_differ() -> None:
    assert {draw(name, np.random.default_rng(1)).kind for name in NAMES} == set(CLASSES)
    one, same, other = (draw("chair", np.random.default_rng(seed)).bounds() for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
    with pytest.raises(ValueError, match="no furniture is called 'piano'; there are: table"):
        draw("piano", np.random.default_rng(0))


def test_a_mesh_of_a_piece_has_the_colours_of_its_parts() -> None:
    piece = draw("sofa", np.random.default_rng(3))
    meshes = piece.meshes()
    colors = meshes.textures.verts_features_packed()
    assert meshes.verts_packed().shape == colors.shape
    assert len(torch.unique(colors, dim=0)) == len({solid.color for solid in piece.solids})
    torch.testing.assert_close(meshes.verts_packed().amax(0), torch.from_numpy(piece.bounds()[1]))


def test_solids_have_the_volumes_of_their_formulas() -> None:
    assert as_trimesh(box((1, 2, 3), (4, 5, 6), "wood", GREY, cell=0.7)).volume == pytest.approx(6, rel=1e-5)
    assert as_trimesh(lathe([(0, 0), (1, 0), (0, 2)], (0, 0, 0), "wood", GREY, 200)).volume == pytest.approx(
        2 * math.pi / 3, rel=1e-3
    )
    ball = as_trimesh(ellipsoid((1, 2, 3), (0, 0, 0), "wood", GREY, 64))
    assert ball.volume == pytest.approx(8 * math.pi, rel=1e-2)
    soft = as_trimesh(rounded_box((1, 1, 1), (0, 0, 0), 0.2, "fabric", GREY)).volume
    exact = 0.6**3 + 6 * 0.36 * 0.2 + 12 * 0.6 * math.pi * 0.04 / 4 + 4 / 3 * math.pi * 0.008
    assert soft == pytest.approx(exact, rel=0.02)


def test_normals_point_outwards_and_sheets_show_the_side_of_their_axes() -> None:
    for solid in (box((1, 2, 3), (0, 0, 0), "wood", GREY), rounded_box((1, 1, 2), (0, 0, 0), 0.3, "wood", GREY)):
        corners = solid.points[solid.faces]
        facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (facing * solid.normals[solid.faces].sum(1)).sum(1).min() > -1e-9
    floor = sheet((0, 0, 0), (0, 0, 1), (1, 0, 0), ([0, 1], [0, 1]), "floor", GREY)
    assert (floor.normals == np.array([0, 1, 0])).all()


def test_openings_of_a_sheet_are_left_out() -> None:
    lines = grid_lines(0.0, 3.0, 0.5, [1.1, 2.2]), grid_lines(0.0, 2.0, 0.5, [0.7, 1.9])
    wall = sheet((0, 0, 0), (1, 0, 0), (0, 1, 0), lines, "wall", GREY, [(1.1, 2.2, 0.7, 1.9)])
    assert as_trimesh(wall).area == pytest.approx(6 - 1.1 * 1.2, rel=1e-5)
    assert np.diff(lines[0]).max() <= 0.5 + 1e-9


def test_turns_go_from_one_axis_to_the_next() -> None:
    x, y, z = np.eye(3)
    for axis, start, end in (("x", y, z), ("y", z, x), ("z", x, y)):
        np.testing.assert_allclose(rotation(axis, math.pi / 2) @ start, end, atol=1e-6)
