"""What is drawn is where it was found."""

from __future__ import annotations

import numpy as np
import torch

from rendra.structures import Meshes
from rendra.utils import ico_sphere
from rendra_lab.detection.drawing import (
    SIDES,
    color_of,
    draw_meshes,
    draw_objects,
    panels_of,
    phong_view,
    silhouette_view,
    upright,
)
from rendra_lab.detection.records import Detections, Instances, PhotoBatch

GREY = np.full((60, 80, 3), 128, np.uint8)
LENS = torch.tensor([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]])


def sphere_at(x: float, y: float, z: float, radius: float = 0.2) -> Meshes:
    ball = ico_sphere(2)
    return Meshes([radius * ball.verts_packed() + torch.tensor([x, y, z])], ball.faces_list())


def test_boxes_masks_and_names_change_what_they_should() -> None:
    mask = torch.zeros(1, 60, 80, dtype=torch.bool)
    mask[0, 40:50, 20:40] = True
    drawn = draw_objects(GREY, torch.tensor([[15.0, 35, 45, 55]]), ["chair 0.99"], mask)
    color = 255 * np.asarray(color_of(0))
    np.testing.assert_allclose(drawn[45, 30], 0.55 * 128 + 0.45 * color, atol=1)
    np.testing.assert_allclose(drawn[54, 30], color, atol=1)  # the last row within the box
    assert (drawn[56:] == 128).all()
    assert (drawn[:20] == 128).all()
    assert (GREY == 128).all()


def test_boxes_that_leave_the_picture_are_drawn_as_far_as_it_goes() -> None:
    boxes = torch.tensor([[-50.0, -50, 500, 500], [10.0, 10, 10, 10]])
    drawn = draw_objects(GREY, boxes, ["a very long name that is wider than the picture", "b"])
    assert drawn.shape == GREY.shape
    assert (draw_objects(GREY, torch.zeros(0, 4), []) == GREY).all()


def test_colours_differ() -> None:
    colors = torch.tensor([color_of(number) for number in range(9)])
    assert float(torch.pdist(colors).min()) > 0.15


def test_meshes_stand_where_the_camera_sees_them() -> None:
    drawn = draw_meshes(GREY, sphere_at(0.5, -0.25, 2.0), LENS)
    changed = torch.from_numpy((drawn != 128).any(-1)).nonzero().float() + 0.5
    center = changed.mean(0)
    assert abs(float(center[1]) - (40 + 80 * 0.25)) < 0.6
    assert abs(float(center[0]) - (30 - 80 * 0.125)) < 0.6
    assert abs(float(len(changed)) - np.pi * 8**2) < 40
    assert (draw_meshes(GREY, Meshes([], []), LENS) == GREY).all()


def test_the_nearer_mesh_hides_the_other() -> None:
    both = Meshes(
        [*sphere_at(0, 0, 2.0).verts_list(), *sphere_at(0, 0, 1.0, 0.05).verts_list()],
        2 * ico_sphere(2).faces_list(),
    )
    drawn = draw_meshes(GREY, both, LENS, [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
    middle, aside = drawn[30, 40].tolist(), drawn[30, 46].tolist()
    assert middle[1] > middle[0]
    assert aside[0] > aside[1]


def test_upright_meshes_are_turned_and_not_mirrored() -> None:
    mesh = sphere_at(0.1, 0.2, 2.0)
    turned = upright(mesh)
    torch.testing.assert_close(turned.verts_packed()[:, 1], -mesh.verts_packed()[:, 1])
    outwards = turned.verts_normals_packed() * (turned.verts_packed() - turned.verts_packed().mean(0))
    assert float(outwards.sum(1).min()) > 0


def test_views_from_all_sides() -> None:
    mesh = sphere_at(0.3, 0.1, 2.0)
    for camera in SIDES.values():
        lit = phong_view(mesh, camera, (0.2, 0.4, 0.9), size=32)
        outline = silhouette_view(mesh, camera, size=32)
        assert lit.shape == outline.shape == (32, 32, 3)
        assert (lit[0, 0] == 255).all()
        assert (outline[0, 0] == 0).all()
        assert (outline[16, 16] >= 250).all()
        assert lit[16, 16, 2] > lit[16, 16, 0]


def test_panels_show_what_is_sure_and_what_is_true() -> None:
    none = torch.zeros(0, dtype=torch.long)
    true = Instances(none, torch.zeros(0, 4), none, torch.zeros(0, 60, 80, dtype=torch.bool))
    batch = PhotoBatch(
        torch.full((2, 3, 60, 80), 0.5), torch.tensor([[60, 80]] * 2), LENS.repeat(2, 1, 1), true, ["a", "b"]
    )
    boxes = torch.tensor([[20.0, 20, 60, 50], [20.0, 20, 60, 50]])
    found = Detections(
        torch.tensor([0, 1]), boxes, torch.tensor([2, 3]), torch.tensor([0.9, 0.2]), torch.ones(2, 4, 4)
    )
    panels = panels_of(batch, found)
    assert panels["found"].shape == panels["annotated"].shape == (2, 60, 80, 3)
    changed = (panels["found"] - 0.5).abs().amax(-1) > 0.01
    assert bool(changed[0, 25:45, 25:55].all())
    assert not bool(changed[1].any())
    assert float((panels["annotated"] - 0.5).abs().max()) < 0.01
