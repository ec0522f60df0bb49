"""COCO's layout: masks as its own tools have them, the right pictures and labels, complaints that name the place."""

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from coco_files import SIZE, blob, coco_folder, picture
from PIL import Image
from pycocotools import mask as coco_tools

from rendra_lab.data.coco import Coco
from rendra_lab.data.coco_masks import filled, lengths_of, mask_of, read_segmentation
from rendra_lab.errors import UserError


def made(folder: Path, **how: Any) -> Coco:
    plain = {"shortest_px": None, "longest_px": None, "batch_size": 1, "flip": False}
    data = Coco(folder, **{**plain, **how})
    data.setup("fit")
    return data


def test_what_the_files_say_is_what_is_shown(tmp_path: Path) -> None:
    data = made(coco_folder(tmp_path))
    assert data.classes == ("dog", "chair")  # by their ids
    batch = data.splits.train[1]
    torch.testing.assert_close(batch.rgb[0], torch.from_numpy(picture(2)).permute(2, 0, 1) / 255)
    seen = batch.instances
    assert seen.labels.tolist() == [1, 0, 1]  # without the crowd
    assert seen.boxes.tolist() == [[2, 3, 9, 8]] * 3
    expected = torch.zeros(SIZE, dtype=torch.bool)
    expected[3:8, 2:9] = True
    assert torch.equal(seen.masks[0], expected)
    for mask in seen.masks[1:]:
        np.testing.assert_array_equal(mask, blob(2))
    assert batch.intrinsics[0].tolist() == [[16, 0, 8], [0, 16, 6], [0, 0, 1]]
    assert batch.picture_ids == ["000000000002.png"]
    assert seen.shapes is None


@pytest.mark.parametrize("seed", range(4))
def test_runs_are_those_of_cocos_tools(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = (int(rng.integers(1, 300)), int(rng.integers(1, 300)))
    mask = rng.random(size) < rng.random()
    if seed == 3:
        mask[:] = True  # one long run
    text = coco_tools.encode(np.asfortranarray(mask.astype(np.uint8)))["counts"].decode()
    read = read_segmentation({"size": list(size), "counts": text}, size, "it")
    np.testing.assert_array_equal(mask_of(read, size, size), mask)
    assert sum(lengths_of(text, "it")) == mask.size


def test_polygons_are_filled_as_geometry_says() -> None:
    triangle = np.array([[0.0, 0.0], [8.0, 0.0], [0.0, 8.0]])
    x, y = np.meshgrid(np.arange(10) + 0.5, np.arange(9) + 0.5)
    np.testing.assert_array_equal(filled(triangle, (9, 10)), (x + y < 8))
    star = np.array([[5 + 4 * np.sin(2.4 * np.pi * k / 3), 5 - 4 * np.cos(2.4 * np.pi * k / 3)] for k in range(5)])
    turned = filled(star[:, ::-1].copy(), (11, 11))
    np.testing.assert_array_equal(filled(star, (11, 11)).T, turned)
    assert not filled(triangle + 100, (9, 10)).any()
    assert filled(np.array([[-1e5, -1e5], [1e5, -1e5], [1e5, 1e5], [-1e5, 1e5]]), (9, 10)).all()
    left, right = (
        filled(triangle + np.array([0.3, 0.2]), (9, 10)),
        filled(np.array([[8.3, 0.2], [8.3, 8.2], [0.3, 8.2]]), (9, 10)),
    )
    square = filled(np.array([[0.3, 0.2], [8.3, 0.2], [8.3, 8.2], [0.3, 8.2]]), (9, 10))
    np.testing.assert_array_equal(left ^ right, square)  # no gap along an edge, and nothing twice
    assert not (left & right).any()


def test_polygons_are_nearly_those_of_cocos_tools() -> None:
    rng = np.random.default_rng(0)
    size = (70, 90)
    for _ in range(5):
        angles = np.sort(rng.uniform(0, 2 * np.pi, 12))
        radius = rng.uniform(15, 32, 12)
        polygon = np.stack([45 + radius * np.cos(angles), 35 + radius * np.sin(angles)], 1)
        runs = coco_tools.merge(coco_tools.frPyObjects([polygon.reshape(-1).tolist()], *size))
        found = read_segmentation({"size": list(size), "counts": runs["counts"].decode()}, size, "it")
        theirs = mask_of(found, size, size)
        ours = filled(polygon, size)
        assert (ours ^ theirs).sum() < 0.04 * ours.sum()  # theirs rounds corners to a fifth of a pixel


def test_several_polygons_are_one_mask() -> None:
    parts = [[0, 0, 4, 0, 4, 4, 0, 4], [2, 2, 6, 2, 6, 6, 2, 6]]
    mask = mask_of(read_segmentation(parts, (8, 8), "it"), (8, 8), (8, 8))
    assert mask.sum() == 16 + 16 - 4
    half = mask_of(read_segmentation(parts, (8, 8), "it"), (8, 8), (4, 4))
    assert half.sum() == 4 + 4 - 1


def test_sizes(tmp_path: Path) -> None:
    batch = made(coco_folder(tmp_path), shortest_px=24).splits.train[0]
    assert batch.rgb.shape == (1, 3, 24, 32)
    assert batch.instances.boxes[0].tolist() == [4, 6, 18, 16]
    rows, columns = batch.instances.masks[0].nonzero().unbind(1)
    assert [int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1] == [4, 6, 18, 16]


def test_parts_and_classes(tmp_path: Path) -> None:
    data = made(coco_folder(tmp_path))
    assert [len(part) for part in (data.splits.train, data.splits.val, data.splits.test)] == [3, 1, 1]
    assert data.splits.test[0].picture_ids == ["000000000004.png"]
    dogs = made(tmp_path, names=["dog"], class_count=1)
    assert dogs.classes == ("dog",)
    assert dogs.splits.val[0].instances.labels.tolist() == [0]
    with pytest.raises(UserError, match=r"has 2 classes, but the network 9: give network.classes=2, or data.names"):
        made(tmp_path, class_count=9)
    with pytest.raises(UserError, match=r"instances_train2017.json: no category is called 'cat'; it has dog, chair"):
        made(tmp_path, names=["cat"])
    with pytest.raises(UserError, match=r"data.names must be different"):
        made(tmp_path, names=["dog", "dog"])
    swapped = made(
        tmp_path, train="instances_val2017.json", val="instances_train2017.json", test="instances_val2017.json"
    )
    assert [len(part) for part in (swapped.splits.train, swapped.splits.val, swapped.splits.test)] == [1, 3, 1]


@pytest.mark.parametrize("place", ["images/train", "images", "."])
def test_pictures_may_lie_elsewhere(place: str, tmp_path: Path) -> None:
    coco_folder(tmp_path, {"train": [1], "val": [2], "test": [3]})
    for part in ("train", "val", "test"):
        to = tmp_path / place.replace("train", part)
        to.mkdir(parents=True, exist_ok=True)
        for file in (tmp_path / part).iterdir():
            file.rename(to / file.name)
    data = made(tmp_path)
    torch.testing.assert_close(data.splits.test[0].rgb[0], torch.from_numpy(picture(3)).permute(2, 0, 1) / 255)


def test_pictures_without_objects(tmp_path: Path) -> None:
    coco_folder(tmp_path)
    for part, number in (("train2017", 2), ("val2017", 4)):
        file = tmp_path / "annotations" / f"instances_{part}.json"
        tree = json.loads(file.read_text())
        tree["annotations"] = [one for one in tree["annotations"] if one["image_id"] != number]
        if part == "train2017":
            tree["annotations"][0]["bbox"] = [3, 3, 0, 5]
            tree["annotations"][1]["bbox"] = [16, 3, 5, 5]
        file.write_text(json.dumps(tree))
    data = made(tmp_path, batch_size=2)
    assert [photo.name for photo in data.splits.train.photos] == ["000000000001.png", "000000000003.png"]
    assert len(data.splits.train[0].instances.boxes) == 1  # boxes that hold nothing are left out
    (batch,) = data.val_dataloader()
    assert batch.instances.masks.shape == (0, *SIZE)
    (joined,) = data.train_dataloader()
    assert sorted(joined.instances.picture.tolist()) in ([0, 0, 0, 1], [0, 1, 1, 1])


def test_workers_get_all_of_it(tmp_path: Path) -> None:
    train = pickle.loads(pickle.dumps(made(coco_folder(tmp_path)).splits.train))
    assert train[0].rgb.shape == (1, 3, *SIZE)


def _set(key: str, field: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(tree: dict[str, Any]) -> None:
        tree[key][0][field] = value

    return change


def _cut(tree: dict[str, Any]) -> None:
    del tree["annotations"][0]["segmentation"]


def _twice(tree: dict[str, Any]) -> None:
    tree["images"].append(tree["images"][0])


_SMALL = {"size": [12, 16], "counts": [191]}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_set("images", "id", "a"), r"instances_train2017.json, image 0: 'id' is 'a'; expected a whole number"),
        (_set("images", "width", -4), "image 0: 'width' is -4"),
        (_set("images", "file_name", "../x.png"), r"image 0, 'file_name': .*expected a file within"),
        (_set("images", "file_name", "x.png"), r"image 0: there is no picture 'x.png' in .*train2017"),
        (_twice, "image 3: the id 1 is there twice"),
        (_set("annotations", "image_id", 99), "annotation 0: 'image_id' is 99; expected the id of one of the images"),
        (_set("annotations", "category_id", 99), "annotation 0: 'category_id' is 99"),
        (_set("annotations", "bbox", [1, 2]), r"annotation 0: 'bbox' is \[1, 2\]; expected a list of 4"),
        (_cut, "annotation 0: 'segmentation' is None; expected polygons"),
        (_set("annotations", "segmentation", []), r"annotation 0: 'segmentation' is \[\]"),
        (_set("annotations", "segmentation", [[1, 2, 3, 4]]), r"annotation 0: a polygon is \[1, 2, 3, 4\]; expected"),
        (_set("annotations", "segmentation", [[1, 2, 3, 4, 5, "x"]]), "annotation 0: a polygon is"),
        (
            _set("annotations", "segmentation", [[1, 2, 3, 4, 5, 1e99]]),
            r"annotation 0: a polygon has a corner at 1e\+99",
        ),
        (
            _set("annotations", "segmentation", _SMALL),
            "annotation 0: the runs of the mask have 191 pixels; its picture",
        ),
        (
            _set("annotations", "segmentation", {**_SMALL, "size": [3, 4]}),
            r"annotation 0: the mask's 'size' is \[3, 4\]",
        ),
        (_set("annotations", "segmentation", {**_SMALL, "counts": [-1]}), r"the mask's 'counts' are \[-1\]"),
        (_set("annotations", "segmentation", {**_SMALL, "counts": "a\n"}), r"'counts' holds '\\n' where no digit"),
        (
            _set("annotations", "segmentation", {**_SMALL, "counts": "oooo"}),
            "'counts' ends in the middle of a number",
        ),
        (_set("annotations", "segmentation", {**_SMALL, "counts": "o" * 99}), "'counts' holds 'o' where no digit"),
        (_set("categories", "name", ""), "category 0: 'name' is ''; expected a text"),
        (lambda tree: tree.pop("images") and None, "instances_train2017.json: 'images' is missing"),
    ],
)
def test_broken_annotations_are_named(change: Callable[[dict[str, Any]], None], said: str, tmp_path: Path) -> None:
    file = coco_folder(tmp_path) / "annotations" / "instances_train2017.json"
    tree = json.loads(file.read_text())
    change(tree)
    file.write_text(json.dumps(tree))
    with pytest.raises(UserError, match=said):
        made(tmp_path)


def test_broken_pictures_and_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"there is no folder .*none"):
        made(tmp_path / "none")
    with pytest.raises(UserError, match=r"annotations has no file for training or for validation"):
        made(tmp_path)
    coco_folder(tmp_path)
    with pytest.raises(UserError, match=r"data.val=some.json: there is no file .*annotations/some.json"):
        made(tmp_path, val="some.json")
    with pytest.raises(UserError, match=r"data.val: .*expected a file within"):
        made(tmp_path, val="../../some.json")
    Image.fromarray(picture(1)[:5]).save(tmp_path / "train2017" / "000000000001.png")
    with pytest.raises(UserError, match=r"train2017.json, image 0: .*000000000001.png is 16 x 5 pixels large"):
        _ = made(tmp_path).splits.train[0]
    (tmp_path / "annotations" / "instances_train2017.json").write_text("[]")
    with pytest.raises(UserError, match=r"instances_train2017.json holds a list; expected an object"):
        made(tmp_path)
