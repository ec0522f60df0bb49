"""Photographs of one's own: sizes, focal lengths, what is kept, and what is written."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from torch import nn

from rendra.io import load_obj
from rendra.structures import Meshes
from rendra.utils import ico_sphere
from rendra_lab.base_task import Task
from rendra_lab.detection.object_frames import depth_extents
from rendra_lab.detection.photo_search import (
    Habits,
    Search,
    exif_focal_px,
    find_objects,
    numbers_of,
    save_objects,
)
from rendra_lab.detection.records import Detections, DetectorPrediction, PhotoBatch
from rendra_lab.errors import UserError
from rendra_lab.frustums import Frustums
from rendra_lab.losses import mean_square
from rendra_lab.terms import LossTerm

HABITS = Habits(side_px=32, focal=0.5, classes=("bed", "chair"))


class Finder(Task[PhotoBatch, DetectorPrediction]):
    """Always finds two balls at the same places of whatever it sees."""

    def __init__(self, with_meshes: bool = True, most: int = 2) -> None:
        super().__init__({"none": LossTerm(mean_square, 1.0, "boxes", None)}, torch.optim.SGD)
        self.weight = nn.Parameter(torch.zeros(1))
        self.with_meshes, self.most = with_meshes, most
        self.seen: list[PhotoBatch] = []

    def predict(self, batch: PhotoBatch) -> DetectorPrediction:
        self.seen.append(batch)
        boxes = torch.tensor([[8.0, 4, 16, 12], [20.0, 8, 36, 24]])[: self.most]
        count = len(boxes)
        ball = ico_sphere(1)
        extents = depth_extents(
            Frustums(boxes, torch.tensor([[1.8, 2.2]]).repeat(count, 1), batch.intrinsics.expand(count, 3, 3))
        )
        meshes = Meshes([ball.verts_packed()] * count, ball.faces_list() * count)
        found = Detections(
            torch.zeros(count, dtype=torch.long), boxes, torch.arange(count), torch.tensor([0.9, 0.6])[:count],
            torch.ones(count, 4, 4), extents if self.with_meshes else None,
            None, meshes if self.with_meshes else None,
        )  # fmt: skip
        return DetectorPrediction(detections=found)


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    path = tmp_path / "photo.png"
    Image.new("RGB", (96, 64), (90, 120, 60)).save(path)
    return path


def test_pictures_are_resized_and_boxes_scaled_back(photo: Path) -> None:
    task = Finder()
    found = find_objects(task, photo, HABITS, Search())
    batch = task.seen[0]
    assert batch.rgb.shape == (1, 3, 32, 48)
    assert batch.sizes.tolist() == [[32, 48]]
    assert batch.intrinsics[0].tolist() == [[24.0, 0.0, 24.0], [0.0, 24.0, 16.0], [0.0, 0.0, 1.0]]
    assert found.intrinsics[0].tolist() == [48.0, 0.0, 48.0]  # half of the longer side
    assert found.detections.boxes.tolist() == [[16.0, 8.0, 32.0, 24.0], [40.0, 16.0, 72.0, 48.0]]
    assert found.names == ("bed", "chair")
    assert found.titles() == ["bed 0.90", "chair 0.60"]
    assert found.masks is not None
    assert found.masks.shape == (2, 64, 96)
    assert found.masks[0].nonzero().amin(0).tolist() == [8, 16]


def test_meshes_are_behind_their_boxes_at_the_given_depth(photo: Path) -> None:
    found = find_objects(Finder(), photo, HABITS, Search(depth=5.0))
    assert found.meshes is not None
    for box, verts in zip(found.detections.boxes, found.meshes.verts_list(), strict=True):
        seen = verts @ found.intrinsics.T
        pixels = seen[:, :2] / seen[:, 2:]
        torch.testing.assert_close(torch.cat([pixels.amin(0), pixels.amax(0)]), box, atol=0.9, rtol=0)
        near, far = verts[:, 2].aminmax()
        assert float(near) == pytest.approx(4.5, rel=0.02)
        assert float(far) == pytest.approx(5.5, rel=0.02)


def test_what_is_less_sure_is_left_out(photo: Path) -> None:
    assert find_objects(Finder(), photo, HABITS, Search(only_highest=True)).names == ("bed",)
    one = find_objects(Finder(), photo, HABITS, Search(least_score=0.7))
    assert one.names == ("bed",)
    assert one.surest == pytest.approx(0.6)
    assert one.meshes is not None
    assert len(one.meshes) == 1


def test_focal_lengths_come_from_the_caller_then_the_file_then_the_run(photo: Path, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 35
    told = tmp_path / "told.jpg"
    Image.new("RGB", (300, 200)).save(told, exif=exif)
    expected = 35 * math.hypot(300, 200) / math.hypot(36, 24)
    assert exif_focal_px(told, 200, 300) == pytest.approx(expected)
    assert exif_focal_px(photo, 64, 96) is None
    assert find_objects(Finder(), told, HABITS, Search()).intrinsics[0, 0].item() == pytest.approx(expected)
    assert find_objects(Finder(), told, HABITS, Search(focal_px=250.0)).intrinsics[1, 1].item() == 250.0


def test_what_is_written(photo: Path, tmp_path: Path) -> None:
    found = find_objects(Finder(), photo, HABITS, Search())
    written = save_objects(found, tmp_path / "out")
    stems = ("00_bed_0.900", "01_chair_0.600")
    endings = ("_mask.png", ".obj", ".glb", "_sides.png")
    each = {f"{stem}{ending}" for stem in stems for ending in endings}
    names = {"detections.png", "meshes.png", "scene.glb", "detections.json", *each}
    assert {path.name for path in written} == {path.name for path in (tmp_path / "out").iterdir()} == names
    verts, faces, _ = load_obj(tmp_path / "out" / "00_bed_0.900.obj")
    assert len(faces.verts_idx) == 80
    assert -2.3 < float(verts[:, 2].amin()) < float(verts[:, 2].amax()) < -1.7  # the viewer stands at the origin
    rows = json.loads((tmp_path / "out" / "detections.json").read_text())["objects"]
    assert rows[1]["class"] == "chair"
    assert rows[1]["box"] == [40.0, 16.0, 72.0, 48.0]
    assert rows == numbers_of(found)["objects"]


@pytest.mark.parametrize(("with_meshes", "most"), [(False, 2), (True, 0), (False, 0)])
def test_nothing_found_and_no_meshes_are_no_errors(photo: Path, tmp_path: Path, with_meshes: bool, most: int) -> None:
    found = find_objects(Finder(with_meshes, most), photo, HABITS, Search())
    assert len(found.names) == most
    names = {path.name for path in save_objects(found, tmp_path / "out")}
    masks = {"00_bed_0.900_mask.png", "01_chair_0.600_mask.png"} if most else set()
    assert names == {"detections.png", "detections.json", *masks}


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"depth": 0.0}, "depth must be a number above 0, got 0.0"),
        ({"focal_px": -3.0}, "focal_px must be a number above 0 or null, got -3.0"),
        ({"side_px": 0}, "side_px must be a whole number of at least 1 or null, got 0"),
        ({"least_score": 1.5}, "least_score must be a number from 0 to 1, got 1.5"),
        ({"only_highest": 3}, "only_highest must be true or false, got 3"),
    ],
)
def test_settings_that_cannot_be(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError, match=words):
        Search(**settings)


def test_files_that_are_no_photographs(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"image: there is no file .*nothing\.png"):
        find_objects(Finder(), tmp_path / "nothing.png", HABITS, Search())
