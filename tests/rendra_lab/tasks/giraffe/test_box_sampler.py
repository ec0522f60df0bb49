"""Boxes at random: ranges, numbers, collisions, layouts of files."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from assertions import assert_close

from rendra_lab.errors import UserError
from rendra_lab.tasks.giraffe import box_sampler
from rendra_lab.tasks.giraffe.box_sampler import BoxSampler, rotation_about_z

FIVE: dict[str, Any] = {
    "objects": 5,
    "scale": ([0.17, 0.1, 0.17], [0.17, 0.1, 0.17]),
    "translation": ([-0.8, -0.8, 0.0], [0.8, 0.8, 0.0]),
    "spacing": 0.05,
}


def drawn(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_boxes_fill_their_ranges_and_keep_their_proportions() -> None:
    sampler = BoxSampler(2, ([0.2, 0.1, 0.1], [0.4, 0.2, 0.3]), ([-1.0, 0.0, 0.5], [1.0, 0.2, 0.5]), (0.0, 0.25))
    boxes = sampler.sample(2000, drawn())
    assert boxes.scale.shape == boxes.translation.shape == (2000, 2, 3)
    assert bool(boxes.exists.all())
    parts = (boxes.scale - sampler.scale[0]) / (sampler.scale[1] - sampler.scale[0])
    assert_close(parts[..., :1].expand_as(parts), parts)
    assert 0 <= float(parts.min()) < 0.01 < 0.99 < float(parts.max()) <= 1
    assert abs(float(parts.mean()) - 0.5) < 0.02
    assert_close(boxes.translation[..., 2], torch.full((2000, 2), 0.5))
    assert_close(boxes.translation[..., :2].mean((0, 1)), [0.0, 0.1], atol=0.03)
    angle = torch.atan2(boxes.rotation[..., 1, 0], boxes.rotation[..., 0, 0])
    assert -1e-6 <= float(angle.min()) < 0.02 < math.pi / 2 - 0.02 < float(angle.max()) <= math.pi / 2 + 1e-6
    free = BoxSampler(1, ([0.1] * 3, [0.2] * 3), one_size=False).sample(50, drawn()).scale
    assert float((free[..., 0] - free[..., 1]).abs().mean()) > 0.01


def test_the_same_generator_the_same_boxes_and_another_others() -> None:
    sampler = BoxSampler(**FIVE)
    first, again, other = (sampler.sample(3, drawn(seed)) for seed in (0, 0, 1))
    assert torch.equal(first.translation, again.translation)
    assert not torch.equal(first.translation, other.translation)


def test_numbers_of_objects_come_as_often_as_said() -> None:
    exists = BoxSampler(3, counts=[1.0, 0.0, 2.0, 1.0]).sample(4000, drawn()).exists
    assert_close(exists.sum(1).bincount(minlength=4) / 4000, [0.25, 0.0, 0.5, 0.25], atol=0.03)
    assert bool((exists.int().diff(dim=1) <= 0).all())  # the first ones exist
    assert BoxSampler(3, counts=[1.0, 0.0, 2.0, 1.0]).sample(0, drawn()).exists.shape == (0, 3)


@pytest.mark.parametrize("settings", [{}, {"redraw": "scene", "objects": 3}, {"turned_extents": False}])
def test_boxes_keep_apart_along_some_axis(settings: dict[str, Any]) -> None:
    sampler = BoxSampler(**{**FIVE, **settings})
    boxes = sampler.sample(20, drawn())
    assert not bool(sampler.collide(boxes).any())
    extents = boxes.scale
    if sampler.turned_extents:  # of the corners, for themselves
        corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
        extents = (boxes.rotation.mT[:, :, None] @ (corners * boxes.scale[:, :, None])[..., None])[..., 0].amax(2)
    for i in range(sampler.objects):
        for j in range(i):
            gap = (boxes.translation[:, i] - boxes.translation[:, j]).abs() - extents[:, i] - extents[:, j]
            assert float(gap.amax(-1).min()) >= 0.05 - 1e-5


def test_boxes_that_do_not_exist_are_in_nobodys_way() -> None:
    sampler = BoxSampler(**{**FIVE, "counts": [0.0, 0.0, 1.0, 0.0, 0.0, 0.0], "spacing": 0.6})
    assert sampler.sample(10, drawn()).exists.sum() == 20


def test_boxes_without_room_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(box_sampler, "_TRIES", 5)
    with pytest.raises(UserError, match=r"5 boxes .* do not fit 3 apart into boxes.translation from \[-0.8"):
        BoxSampler(**{**FIVE, "spacing": 3.0}).sample(2, drawn())


def test_parts_of_ranges_by_hand() -> None:
    sampler = BoxSampler(1, ([0.1] * 3, [0.3] * 3), ([-1.0] * 3, [3.0] * 3), (0.0, 0.5))
    boxes = sampler.place(torch.full((2, 1, 3), 0.5), torch.full((2, 1, 3), 0.25), torch.tensor([[0.0], [0.5]]))
    assert_close(boxes.scale, torch.full((2, 1, 3), 0.2))
    assert_close(boxes.translation, torch.zeros(2, 1, 3), atol=1e-6)
    assert_close(boxes.rotation[1, 0] @ torch.tensor([1.0, 0.0, 0.0]), [0.0, 1.0, 0.0], atol=1e-6)
    assert_close(rotation_about_z(torch.tensor(0.3)) @ rotation_about_z(torch.tensor(-0.3)), torch.eye(3))


def test_layouts_of_a_file_and_a_plane(tmp_path: Path) -> None:
    places = np.arange(12.0).reshape(2, 2, 3)
    np.savez(tmp_path / "places.npz", coordinates=places)
    sampler = BoxSampler(2, layouts=tmp_path / "places.npz", layout_scale=0.1, plane=7.0, spacing=9.0)
    found = sampler.sample(40, drawn()).translation
    kinds = found.flatten(1).unique(dim=0)
    assert_close(kinds, 0.1 * torch.from_numpy(places).flatten(1))
    assert_close(BoxSampler(1, plane=0.2).sample(3, drawn()).translation[..., 2], torch.full((3, 1), 0.2))


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((2, 3, 3)), r"expected 'coordinates' of shape \(L, 2, 3\).*got float64 of \(2, 3, 3\)"),
        (np.array([None]), "expected an .npz file with an array 'coordinates'"),
        (np.full((1, 2, 3), np.nan), "not finite"),
    ],
)
def test_layouts_that_are_none(tmp_path: Path, array: np.ndarray, message: str) -> None:
    np.savez(tmp_path / "places.npz", coordinates=array)
    with pytest.raises(UserError, match=message):
        BoxSampler(2, layouts=tmp_path / "places.npz")
    with pytest.raises(UserError, match=r"boxes.layouts=.*none.npz"):
        BoxSampler(2, layouts=tmp_path / "none.npz")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"objects": 0}, "at least 1, got 0"),
        ({"scale": ([0.2, 0.2], [0.3, 0.3])}, "boxes.scale must be two lists of x, y, z above 0"),
        ({"scale": ([0.0] * 3, [0.3] * 3)}, "above 0"),
        ({"translation": ([0.1] * 3, [0.0] * 3)}, "the least and the greatest"),
        ({"counts": [1.0]}, "0 to 1 objects, 2 numbers"),
        ({"counts": [0.0, 0.0]}, "not all 0"),
    ],
)
def test_settings_that_cannot_be(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        BoxSampler(**settings)
