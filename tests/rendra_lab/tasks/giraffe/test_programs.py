"""Every program changes what it names, as far as training went, and its films go round."""

from __future__ import annotations

import math

import pytest
import torch
from assertions import assert_close
from scenes_of_discs import Discs

from rendra_lab.errors import UserError
from rendra_lab.tasks.giraffe.programs import PROGRAMS, Frames, Order, Stage

ORDER = Order(samples=2, steps=8, anchors=3, add_up_to=4)
CHANGED = {
    "rotation_object": "rotation",
    "translation_object_depth": "translation",
    "translation_object_horizontal": "translation",
    "interpolate_app": "appearance",
    "interpolate_shape": "shape",
    "interpolate_bg_app": "background_appearance",
    "camera_elevation": "camera_to_world",
    "translation_circle": "translation",
    "add_objects": "exists",
}


def played(name: str, maker: Discs | None = None, order: Order = ORDER) -> Frames:
    return PROGRAMS[name](Stage.of(maker or Discs(objects=2), order))


def column(frames: Frames, name: str) -> torch.Tensor:
    parts = ("codes", "boxes", "cameras")
    return torch.stack(
        [getattr(getattr(scenes, part), name) for scenes in frames.scenes for part in parts
         if name in getattr(scenes, part).names()]
    )  # fmt: skip


def test_the_programs_are_those_of_the_book() -> None:
    assert list(PROGRAMS) == list(CHANGED)


@pytest.mark.parametrize("name", list(CHANGED))
def test_a_program_changes_one_thing_of_one_object(name: str) -> None:
    frames = played(name)
    for other in CHANGED.values():
        values = column(frames, other)
        is_same = bool((values == values[:1]).all())
        assert is_same == (other != CHANGED[name]), other
        if other == CHANGED[name] and name in ("rotation_object", "interpolate_app", "translation_circle"):
            assert bool((values[:, :, 1] == values[:1, :, 1]).all())  # the second object stays


@pytest.mark.parametrize("name", list(CHANGED))
def test_frames_follow_each_other_evenly(name: str) -> None:
    frames = played(name)
    lengths = {"rotation_object": 16, "translation_circle": 16, "add_objects": 10}
    lengths |= {each: 24 for each in CHANGED if each.startswith("interpolate")}
    assert len(frames.scenes) == lengths.get(name, 8)
    if frames.closed:  # from the last to the first as from any to the next
        values = column(frames, CHANGED[name]).flatten(1)
        steps = (values - values.roll(-1, 0)).norm(dim=1)
        assert float(steps[-1]) <= 1.5 * float(steps.max()) <= 15 * float(steps.min()) + 1e-9
    chosen = frames.spread(6)
    assert len(chosen) == 6
    assert chosen[0] == 0
    assert (chosen[-1] == len(frames.scenes) - 1) == (not frames.closed)


def test_objects_turn_round_or_as_far_as_they_were_seen() -> None:
    angles = torch.atan2(*column(played("rotation_object"), "rotation")[:, :, 0, :2, 0].flip(-1).unbind(-1))
    steps = (angles[1:] - angles[:-1]).remainder(math.tau)
    assert_close(steps, torch.full_like(steps, math.tau / 16), atol=1e-5)
    narrow = played("rotation_object", Discs(turns=(0.4, 0.6)))
    assert not narrow.closed
    angles = torch.atan2(*column(narrow, "rotation")[:, :, 0, :2, 0].flip(-1).unbind(-1)).remainder(math.tau)
    assert_close(angles[[0, -1], 0], math.tau * torch.tensor([0.4, 0.6]), atol=1e-5)


def test_objects_go_where_training_put_them() -> None:
    places = column(played("translation_object_horizontal"), "translation")[:, :, 0]
    assert_close(places[[0, -1], :, 1], torch.tensor([[-0.2, -0.2], [0.2, 0.2]]), atol=1e-6)
    places = column(played("translation_object_depth"), "translation")[:, :, 0]
    assert_close(places[[0, -1], :, 0], torch.tensor([[-0.2, -0.2], [0.2, 0.2]]), atol=1e-6)
    ring = column(played("translation_circle"), "translation")[:, :, 0]
    assert_close(ring[..., :2].norm(dim=-1), torch.full((16, 2), 0.2), atol=1e-6)
    maker = Discs(reach=0.0)  # which never moved them: as far as they are large
    scenes = Stage.of(maker, ORDER).scenes
    places = column(played("translation_object_horizontal", maker), "translation")[:, :, 0]
    assert_close(places[-1, :, 1], scenes.boxes.scale[:, 0].amax(-1), atol=1e-6)


def test_cameras_rise_as_far_as_training_had_them() -> None:
    eyes = column(played("camera_elevation"), "camera_to_world")[:, :, :3, 3]
    parts = (1 - eyes[..., 2] / eyes.norm(dim=-1)) / 2
    assert_close(parts[[0, -1]], torch.tensor([[0.33, 0.33], [0.45, 0.45]]), atol=1e-5)


def test_objects_are_added_one_by_one_where_there_is_room() -> None:
    frames = played("add_objects", Discs())  # which was trained with one
    counts = column(frames, "exists").sum(-1)[:, 0].tolist()
    assert counts == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    places = frames.scenes[0].boxes.translation
    assert places.shape == (2, 4, 3)
    apart = torch.cdist(places, places) + torch.eye(4)
    assert float(apart.min()) > 0.15
    assert torch.equal(places[:, 0], Stage.of(Discs(), ORDER).scenes.boxes.translation[:, 0])


def test_a_seed_is_all_that_is_random() -> None:
    for name in ("interpolate_shape", "add_objects"):
        one, other, another = (played(name, order=Order(2, 4, seed, anchors=3)) for seed in (5, 5, 6))
        assert torch.equal(column(one, "shape"), column(other, "shape"))
        assert not torch.equal(column(one, "shape"), column(another, "shape"))


def test_an_object_that_is_not_there_is_said() -> None:
    with pytest.raises(UserError, match="object must be below 2, the number of objects of a scene, got 2"):
        played("rotation_object", order=Order(samples=1, object=2))
