"""Generated rooms as a data set: exact, in parts that share what they should, and written so that others read it."""

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rendra_lab.data import furniture_rooms
from rendra_lab.data.furniture_rooms import FurnitureRooms, RoomPhotos, boxes_about
from rendra_lab.data.pix3d import Pix3D
from rendra_lab.errors import UserError
from rendra_lab.frustums import Frustums
from rendra_lab.synthesis.furnished_rooms import RoomPhoto
from rendra_lab.synthesis.furniture import CLASSES

SMALL: dict[str, Any] = {
    "image_size": [48, 64], "counts": (4, 1, 1), "models_per_name": 3, "points": 50, "voxels": 16, "batch_size": 2,
}  # fmt: skip


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> FurnitureRooms:
    data = FurnitureRooms(**SMALL, cache=tmp_path_factory.mktemp("rooms"))
    data.setup("fit")
    return data


def photos_of(data: FurnitureRooms, part: str) -> list[RoomPhoto]:
    photos = getattr(data.splits, part)
    assert isinstance(photos, RoomPhotos)
    return list(photos.photos)


def test_boxes_are_about_masks_and_shapes_are_where_they_are_seen(rooms: FurnitureRooms) -> None:
    for index in range(len(rooms.splits.train)):
        photo = rooms.splits.train[index]
        seen = photo.instances
        assert seen.shapes is not None
        for mask, box in zip(seen.masks, seen.boxes.long().tolist(), strict=True):
            x0, y0, x1, y1 = box
            assert mask[y0:y1, x0:x1].sum() == mask.sum() > 0
            assert mask[y0].any() and mask[y1 - 1].any() and mask[:, x0].any() and mask[:, x1 - 1].any()  # noqa: PT018
        lens = photo.intrinsics.expand(len(seen.boxes), 3, 3)
        near, far = seen.shapes.points[..., 2].aminmax(dim=1)
        frustums = Frustums(seen.boxes, torch.stack([near.clamp_min(0.05), far], 1), lens)
        assert frustums.voxels_of(seen.shapes, 8).flatten(1).any(1).all(), "something stands behind every box"
        # what is seen of an object reaches no farther than its vertices do
        for verts, box, matrix in zip(seen.shapes.verts, seen.boxes, lens, strict=True):
            if bool((verts[:, 2] > 0.05).all()):
                flat = verts @ matrix.T
                pixels = flat[:, :2] / flat[:, 2:]
                assert (pixels.amin(0) < box[:2] + 1).all()
                assert (pixels.amax(0) > box[2:] - 1).all()


def test_batches_join_pictures_with_all_that_is_in_them(rooms: FurnitureRooms) -> None:
    batches = list(rooms.train_dataloader())
    assert [batch.rgb.shape for batch in batches] == [(2, 3, 48, 64)] * 2
    assert sorted(name for batch in batches for name in batch.picture_ids) == [f"train_{i:05d}" for i in range(4)]
    assert rooms.classes == CLASSES


def test_training_draws_points_anew_and_evaluation_does_not(rooms: FurnitureRooms) -> None:
    def points(part: str) -> torch.Tensor:
        shapes = getattr(rooms.splits, part)[0].instances.shapes
        assert shapes is not None
        return shapes.points

    assert torch.equal(points("val"), points("val"))
    assert not torch.equal(points("train"), points("train"))


def test_a_cache_is_what_was_made(rooms: FurnitureRooms, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> list[RoomPhoto]:
        raise AssertionError("rendered though it was kept")

    monkeypatch.setattr(furniture_rooms, "room_photos", refuse)
    again = FurnitureRooms(**SMALL, cache=rooms.cache)
    again.prepare_data()
    for part in ("train", "val", "test"):
        for one, other in zip(photos_of(rooms, part), photos_of(again, part), strict=True):
            for name in RoomPhoto.names():
                assert torch.equal(getattr(one, name), getattr(other, name))
    with pytest.raises(AssertionError, match="rendered"):
        FurnitureRooms(**{**SMALL, "image_size": 48}, cache=rooms.cache).setup("fit")


def blank(seed: int, wanted: list[str], stock: Any, size: tuple[int, int]) -> list[RoomPhoto]:
    """What a room's pictures say of what was asked for."""
    return [
        RoomPhoto(
            rgb=torch.zeros(3, *size, dtype=torch.uint8),
            owner=torch.zeros(size, dtype=torch.uint8),
            intrinsics=torch.eye(3),
            models=torch.tensor([[seed % 10007, stock.numbers.start], [seed % 10007, stock.numbers.stop]]),
            labels=torch.tensor([CLASSES.index(kind)] * 2),
            model_to_camera=torch.eye(4).repeat(2, 1, 1),
            free=torch.ones(2),
            inside=torch.ones(2),
        )
        for kind in wanted
    ]


def test_classes_come_up_in_turn_and_rooms_belong_to_one_part(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(furniture_rooms, "room_photos", blank)
    data = FurnitureRooms(**{**SMALL, "counts": (27, 9, 10)})
    data.setup("fit")
    for part, times in (("train", 3), ("val", 1)):
        kinds = Counter(int(photo.labels[0]) for photo in photos_of(data, part))
        assert kinds == dict.fromkeys(range(9), times)
    seeds = {part: {int(photo.models[0, 0]) for photo in photos_of(data, part)} for part in ("train", "val", "test")}
    assert [len(some) for some in seeds.values()] == [9, 3, 4]
    assert len(set.union(*seeds.values())) == 16
    more = FurnitureRooms(**{**SMALL, "counts": (30, 9, 10)})
    more.setup("fit")
    assert len(photos_of(more, "train")) == 30
    for one, other in zip(photos_of(data, "test"), photos_of(more, "test"), strict=True):
        assert torch.equal(one.models, other.models)


@pytest.mark.parametrize("models", [3, 4, 16])
def test_parts_of_s2_share_no_models(models: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(furniture_rooms, "room_photos", blank)
    data = FurnitureRooms(**{**SMALL, "split": "s2", "models_per_name": models})
    parts = [set(data.numbers(part)) for part in ("train", "val", "test")]
    assert all(parts)
    assert set.union(*parts) == set(range(models))
    assert sum(map(len, parts)) == models
    data.setup("fit")
    test = photos_of(data, "test")[0].models[:, 1].tolist()
    assert test == [min(parts[2]), models]
    alike = FurnitureRooms(**SMALL)
    assert alike.numbers("train") == alike.numbers("test") == range(3)


def test_a_folder_of_pix3ds_layout_is_read_back_to_the_digit(
    rooms: FurnitureRooms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = rooms.write(tmp_path / "out")
    read = Pix3D(folder, shortest_px=None, longest_px=None, voxels=16, points=50)
    read.setup("fit")
    for part in ("train", "val", "test"):
        ours, theirs = getattr(rooms.splits, part), getattr(read.splits, part)
        assert len(ours) == len(theirs)
        for i in range(len(ours)):
            one, other = ours[i], theirs[i]
            assert torch.equal(one.rgb, other.rgb)
            assert torch.equal(one.intrinsics, other.intrinsics)
            for name in ("boxes", "masks", "labels"):
                assert torch.equal(getattr(one.instances, name), getattr(other.instances, name)), name
            mine, yours = one.instances.shapes, other.instances.shapes
            assert torch.equal(mine.voxels, yours.voxels)
            torch.testing.assert_close(mine.voxels_to_camera, yours.voxels_to_camera)
            for verts, found in zip(mine.verts, yours.verts, strict=True):
                torch.testing.assert_close(verts, found, atol=1e-5, rtol=1e-5)
    with pytest.raises(UserError, match="is not empty"):
        rooms.write(folder)
    rooms.write(folder, overwrite=True)
    (folder / "diary.txt").write_text("mine")
    with pytest.raises(UserError, match=r"'diary\.txt', which no folder of Pix3D's layout has"):
        rooms.write(folder, overwrite=True)
    monkeypatch.setattr(rooms, "setup", lambda stage: pytest.fail("a folder is refused before anything is made"))
    with pytest.raises(UserError, match="is not empty"):
        rooms.write(folder)


def test_cocos_annotations_hold_the_masks(rooms: FurnitureRooms, tmp_path: Path) -> None:
    folder = rooms.write(tmp_path / "out")
    tree = json.loads((folder / "annotations" / "instances_train.json").read_text())
    assert [category["name"] for category in tree["categories"]] == list(CLASSES)
    masks = [mask for i in range(4) for mask in rooms.splits.train[i].instances.masks]
    assert len(tree["annotations"]) == len(masks)
    for one, mask in zip(tree["annotations"], masks, strict=True):
        runs = one["segmentation"]
        flat = np.repeat(np.arange(len(runs["counts"])) % 2, runs["counts"])
        found = flat.reshape(runs["size"][::-1]).T.astype(bool)
        assert np.array_equal(found, mask.numpy())
        assert one["area"] == mask.sum()
        x, y, width, height = one["bbox"]
        assert [[x, y, x + width, y + height]] == boxes_about(mask[None]).tolist()
    assert all((folder / image["file_name"]).is_file() for image in tree["images"])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"image_size": 16}, r"32 to 4096 pixels, got 16"),
        ({"counts": (0, 1, 1)}, r"data\.counts are three"),
        ({"split": "s2", "models_per_name": 2}, r"models_per_name of at least 3, got 2"),
        ({"points": 0}, r"data\.points must be"),
        ({"batch_size": 0}, r"data\.batch_size must be"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError, match=words):
        FurnitureRooms(**{**SMALL, **settings})


def test_the_configuration_is_a_data_set(compose: Callable[..., Any], tmp_path: Path) -> None:
    from hydra.utils import instantiate

    cfg = compose(tmp_path / "run", "task=mask_rcnn", "data=furniture_rooms")
    data = instantiate(cfg.data, _convert_="all")
    assert isinstance(data, FurnitureRooms)
    assert data.counts == {"train": 600, "val": 60, "test": 150}
