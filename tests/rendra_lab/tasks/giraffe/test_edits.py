"""What is replaced by hand is replaced, and nothing else; cameras keep what they look at."""

from __future__ import annotations

import math

import pytest
import torch
from assertions import assert_close
from scenes_of_discs import Discs

from rendra_lab.tasks.giraffe import edits
from rendra_lab.tasks.giraffe.records import Scenes


@pytest.fixture
def scenes() -> Scenes:
    return Discs(objects=2).sample(3, torch.Generator().manual_seed(0))


def differing(one: Scenes, other: Scenes) -> set[str]:
    return {
        name
        for part in ("codes", "boxes", "cameras")
        for name in getattr(one, part).names()
        if not torch.equal(getattr(getattr(one, part), name), getattr(getattr(other, part), name))
    }


def test_only_what_is_named_changes(scenes: Scenes) -> None:
    code = torch.ones(3, 4)
    assert differing(scenes, edits.with_codes(scenes, 1, shape=code)) == {"shape"}
    assert differing(scenes, edits.with_codes(scenes, 1, appearance=code)) == {"appearance"}
    assert differing(scenes, edits.with_background(scenes, appearance=code)) == {"background_appearance"}
    assert differing(scenes, edits.with_background(scenes, shape=code)) == {"background_shape"}
    assert differing(scenes, edits.without(scenes, 1)) == {"exists"}
    assert differing(scenes, edits.turned(scenes, 1, 1.0)) == {"rotation"}
    assert differing(scenes, edits.tilted(scenes, torch.full((3,), 0.1))) == {"camera_to_world"}
    assert differing(scenes, scenes) == set()
    changed = edits.with_codes(scenes, 1, shape=code).codes.shape
    assert torch.equal(changed[:, 0], scenes.codes.shape[:, 0])
    assert torch.equal(changed[:, 1], code)


def test_what_is_taken_away_comes_back(scenes: Scenes) -> None:
    empty = edits.without(scenes, 0)
    assert empty.boxes.exists.tolist() == [[False, True]] * 3
    assert differing(edits.present(empty, 0), scenes) == set()


def test_turns_add_up_and_headings_do_not_look_back(scenes: Scenes) -> None:
    twice = edits.turned(edits.turned(scenes, 0, 0.4), 0, 0.5)
    assert_close(twice.boxes.rotation, edits.turned(scenes, 0, 0.9).boxes.rotation, atol=1e-6)
    assert_close(edits.turned(scenes, 0, math.tau).boxes.rotation, scenes.boxes.rotation, atol=1e-6)
    headed = edits.heading(scenes, 0, math.pi / 2).boxes.rotation[:, 0]
    assert_close(headed @ torch.tensor([1.0, 0.0, 0.0]), torch.tensor([[0.0, 1.0, 0.0]]).expand(3, 3), atol=1e-6)


def test_moving_along_a_direction_leaves_the_others(scenes: Scenes) -> None:
    right, back = edits.rightwards(scenes), edits.backwards(scenes)
    assert_close(right, torch.tensor([[0.0, 1.0, 0.0]]).expand(3, 3), atol=1e-6)  # the camera stands at +x
    assert_close(back, torch.tensor([[1.0, 0.0, 0.0]]).expand(3, 3), atol=1e-6)
    moved = edits.placed_along(scenes, 0, right, torch.full((3,), 0.7)).boxes.translation
    assert_close(moved[:, 0, 1], torch.full((3,), 0.7))
    assert torch.equal(moved[:, 0, 0::2], scenes.boxes.translation[:, 0, 0::2])
    assert torch.equal(moved[:, 1], scenes.boxes.translation[:, 1])


def test_a_tilted_camera_keeps_its_distance_and_looks_at_the_middle(scenes: Scenes) -> None:
    before = scenes.cameras.camera_to_world
    after = edits.tilted(scenes, torch.tensor([0.2, -0.1, 0.0])).cameras.camera_to_world
    eye, was = after[:, :3, 3], before[:, :3, 3]
    assert_close(eye.norm(dim=-1), was.norm(dim=-1))
    assert_close(after[:, :3, 2], eye / eye.norm(dim=-1, keepdim=True), atol=1e-6)
    polar, former = ((each[:, 2] / each.norm(dim=-1)).acos() for each in (eye, was))
    assert_close(polar - former, torch.tensor([0.2, -0.1, 0.0]), atol=1e-5)  # down where it is positive


def test_slerp_keeps_to_the_great_circle() -> None:
    first, second = torch.randn(2, 5, 8, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert_close(edits.slerp(first, second, 0.0), first)
    assert_close(edits.slerp(first, second, 1.0), second)
    assert_close(edits.slerp(first, second, 0.3), edits.slerp(second, first, 0.7))
    one, other = (each / each.norm(dim=-1, keepdim=True) for each in (first, second))
    middle = edits.slerp(one, other, 0.25)
    assert_close(middle.norm(dim=-1), torch.ones(5, dtype=torch.float64))
    angle, whole = ((one * each).sum(-1).acos() for each in (middle, other))
    assert_close(angle, whole / 4)
    assert_close(edits.slerp(first, 2 * first, 0.5), 1.5 * first)  # along a line, where there is no circle
    assert edits.slerp(first, torch.zeros_like(first), 0.5).isfinite().all()
