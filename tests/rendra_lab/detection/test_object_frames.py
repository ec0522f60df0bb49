"""Depth extents: there and back, what scales leave alone; meshes come back to where they were seen."""

from __future__ import annotations

import pytest
import torch

from rendra.structures import Meshes
from rendra.utils import ico_sphere
from rendra_lab.detection.object_frames import (
    depth_extents,
    depth_ranges,
    frustums_of,
    meshes_in_camera,
    rebuilt_in_camera,
)
from rendra_lab.detection.records import Detections
from rendra_lab.frustums import Frustums

BOX = torch.tensor([[10.0, 20.0, 40.0, 80.0]], dtype=torch.float64)
LENS = torch.tensor([[[100.0, 0, 50], [0, 120, 40], [0, 0, 1]]], dtype=torch.float64)


def frustum(near: float, far: float, scale: float = 1.0) -> Frustums:
    lens = LENS * torch.tensor([[[scale], [scale], [1.0]]])
    return Frustums(BOX * scale, torch.tensor([[near, far]], dtype=torch.float64), lens)


def test_an_extent_is_what_its_formula_says() -> None:
    assert depth_extents(frustum(2.0, 3.0)).item() == pytest.approx(1.0 / 2.5 * 120 / 60)


def test_extents_know_neither_pixels_nor_metres() -> None:
    expected = depth_extents(frustum(2.0, 3.0))
    torch.testing.assert_close(depth_extents(frustum(2.0, 3.0, scale=4.0)), expected)
    torch.testing.assert_close(depth_extents(frustum(20.0, 30.0)), expected)


def test_extents_there_and_back() -> None:
    known = frustum(2.0, 3.0)
    back = frustums_of(depth_extents(known), BOX, LENS, torch.tensor([2.5], dtype=torch.float64))
    torch.testing.assert_close(back.depth_range, known.depth_range)


def test_absurd_extents_stay_before_the_camera() -> None:
    for extent in (0.0, 1e9):
        made = frustums_of(torch.tensor([extent], dtype=torch.float64), BOX, LENS, torch.ones(1, dtype=torch.float64))
        near, far = made.depth_range[0].tolist()
        assert 0 < near < far < 2


def test_ranges_of_objects() -> None:
    body = torch.tensor([[0.0, 0, 2], [1, 0, 5], [0, 1, 3]])
    flat = torch.tensor([[0.0, 0, 2], [1, 0, 2]])
    behind = torch.tensor([[0.0, 0, -2], [1, 0, 3]])
    ranges = depth_ranges([body, flat, behind])
    assert ranges[0].tolist() == pytest.approx([2.0, 5.0])
    assert ranges[1, 1].item() == 2.0
    assert 1.9 < ranges[1, 0].item() < 2.0
    assert ranges[2].tolist() == pytest.approx([3 * 0.1 / 1.9, 3.0])
    assert depth_ranges([]).shape == (0, 2)


def test_a_rebuilt_object_lies_where_it_was() -> None:
    sphere = ico_sphere(1)
    verts = 0.4 * sphere.verts_packed().double() + torch.tensor([0.1, -0.2, 2.5], dtype=torch.float64)
    frames = Frustums(BOX, depth_ranges([verts]), LENS)
    mesh = Meshes(list(frames.from_camera(verts[None])), sphere.faces_list())
    found = Detections(
        torch.zeros(1, dtype=torch.long), BOX, torch.zeros(1, dtype=torch.long), torch.ones(1),
        depth_extents=depth_extents(frames), meshes=mesh,
    )  # fmt: skip
    center = frames.depth_range.mean(1)
    torch.testing.assert_close(rebuilt_in_camera(found, LENS, center).verts_packed(), verts)
    torch.testing.assert_close(rebuilt_in_camera(found, LENS, 3 * center).verts_packed(), 3 * verts)


def test_what_lies_far_behind_a_frustum_stays_finite_and_in_front() -> None:
    verts = torch.tensor([[0.0, 0, -1], [0, 0, 1], [0, 0, 1.9], [0, 0, 50]], dtype=torch.float64)
    mesh = Meshes([verts], [torch.tensor([[0, 1, 2], [1, 2, 3]])])
    depths = meshes_in_camera(mesh, frustum(1.0, 2.0)).verts_packed()[:, 2]
    assert depths.tolist() == pytest.approx([1.0, 2.0, 1 / (1 - 1.45 / 2), 4.0])


def test_no_object_at_all() -> None:
    none = torch.zeros(0)
    frames = frustums_of(none, torch.zeros(0, 4), torch.zeros(0, 3, 3), none)
    assert depth_extents(frames).shape == (0,)
    assert len(meshes_in_camera(Meshes([], []), frames)) == 0


def test_detections_without_meshes_are_refused() -> None:
    index = torch.zeros(1, dtype=torch.long)
    with pytest.raises(ValueError, match="without heads for shapes"):
        rebuilt_in_camera(Detections(index, BOX, index, torch.ones(1)), LENS, torch.ones(1))
