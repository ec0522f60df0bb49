"""The report of a detector's test: a detector that knows the truth gets all of it, and every file is there."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer
from PIL import Image

from rendra.io import IO
from rendra.structures import Meshes
from rendra.utils import ico_sphere
from rendra_lab.base_task import BaseTask
from rendra_lab.data.photo_data import PhotoData, PhotoSplits, joined
from rendra_lab.detection.average_precision import photo_precision
from rendra_lab.detection.coco_evaluation import coco_precision
from rendra_lab.detection.object_frames import depth_extents
from rendra_lab.detection.records import Detections, DetectorPrediction, Instances, PhotoBatch
from rendra_lab.detection.report import DetectionReport, class_name, results
from rendra_lab.frustums import Frustums
from rendra_lab.shape_records import Shapes

LENS = torch.tensor([[[60.0, 0, 24], [0, 60, 20], [0, 0, 1]]])
BOXES = torch.tensor([[4.0, 6, 20, 30], [24.0, 8, 44, 34]])
BALL = ico_sphere(2)


def photo(number: int, objects: int = 2, size: tuple[int, int] = (40, 48)) -> PhotoBatch:
    """A picture of balls that fill their frustums."""
    boxes = BOXES[:objects]
    height, width = size
    masks = torch.zeros(objects, height, width, dtype=torch.bool)
    for mask, (x0, y0, x1, y1) in zip(masks, boxes.int().tolist(), strict=True):
        mask[y0:y1, x0:x1] = True
    frustums = frustums_of(boxes)
    verts = frustums.to_camera(BALL.verts_packed().expand(objects, -1, -1))
    shapes = Shapes(
        verts[:, :16],
        torch.nn.functional.normalize(verts[:, :16], dim=-1),
        torch.zeros(objects, 2, 2, 2, dtype=torch.bool),
        torch.eye(4).repeat(objects, 1, 1),
        tuple(verts),
        (BALL.faces_packed(),) * objects,
    )
    picture = torch.zeros(objects, dtype=torch.int64)
    instances = Instances(picture, boxes, torch.arange(objects), masks, shapes)
    generator = torch.Generator().manual_seed(number)
    rgb = torch.rand(1, 3, height, width, generator=generator)
    return PhotoBatch(rgb, torch.tensor([size]), LENS, instances, [f"room {number}"])


def frustums_of(boxes: torch.Tensor) -> Frustums:
    return Frustums(boxes, torch.tensor([[1.8, 2.4]]).expand(len(boxes), 2), LENS.expand(len(boxes), 3, 3))


class Rooms(PhotoData):
    """Four pictures in batches of two; one shows nothing."""

    classes = ("chair", "desk/table")

    def load(self) -> PhotoSplits:
        photos = [photo(0), photo(1, size=(36, 46)), photo(2, objects=0), photo(3, objects=1)]
        return PhotoSplits(photos, photos, photos)


class Knowing(BaseTask[PhotoBatch, DetectorPrediction]):
    """Finds everything that is there, and one thing that is not."""

    def __init__(self, with_meshes: bool, **parts: Any) -> None:
        super().__init__(**parts)
        self.with_meshes = with_meshes

    def predict(self, batch: PhotoBatch) -> DetectorPrediction:
        true = batch.instances
        count = len(true.labels) + 1
        boxes = torch.cat([true.boxes, torch.tensor([[30.0, 0, 40, 6]])])
        found = Detections(
            torch.cat([true.picture, torch.tensor([0])]),
            boxes,
            torch.cat([true.labels, torch.tensor([1])]),
            torch.cat([torch.linspace(0.95, 0.6, count - 1), torch.tensor([0.72])]),
            torch.ones(count, 8, 8),
        )
        if self.with_meshes:
            balls = Meshes([BALL.verts_packed()] * count, [BALL.faces_packed()] * count)
            extents = depth_extents(frustums_of(boxes))
            found = replace(found, depth_extents=extents, meshes=balls)
        return DetectorPrediction(detections=found)


def scored(folder: Path, with_meshes: bool = True, **settings: Any) -> dict[str, float]:
    metrics = {
        "ap_box": photo_precision("box"),
        "ap_mask": photo_precision("mask"),
        "coco_box": coco_precision("box"),
    }
    if with_meshes:
        metrics["ap_mesh"] = photo_precision("mesh", samples=3000)
    report = DetectionReport(str(folder / "exports"), **settings)
    silent = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = Trainer(accelerator="cpu", callbacks=[report], enable_model_summary=False, **silent)
    trainer.test(Knowing(with_meshes, metrics=metrics), datamodule=Rooms(batch_size=2), verbose=False)
    return {name: float(value) for name, value in trainer.callback_metrics.items()}


def test_a_report_leaves_pictures_meshes_and_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = scored(tmp_path, pictures=4, on_sheet=3, most_meshes=2)
    assert [found[f"test/{name}"] for name in ("ap_box", "ap_mask", "ap_mesh")] == pytest.approx([100] * 3)
    assert 0 < found["test/coco_box"] < 100  # which counts what is found on nothing
    table = (tmp_path / "exports" / "results.md").read_text()
    assert table.startswith("# 5 annotated objects in 4 pictures\n")
    assert table in capsys.readouterr().out
    assert re.search(r"\| desk/table +\| +2 \| +100\.0 \| +100\.0 \| +\d+\.\d \| +100\.0 \|", table)
    assert re.search(r"\| mean of classes +\| +5 \| +100\.0 \|", table)
    pictures = sorted(path.name for path in (tmp_path / "exports" / "detections").iterdir())
    assert pictures == ["0000.png", "0001.png", "0002.png", "0003.png"]
    for name in ("detections", "meshes"):
        sheet = np.asarray(Image.open(tmp_path / "images" / f"{name}.png"))
        assert sheet.shape[0] > 3 * 192
        assert sheet.std() > 10
    meshes = tmp_path / "exports" / "meshes"
    assert {"0000_0_chair.obj", "0000_1_desk_table.png", "0003_0_chair.obj"} <= {
        path.name for path in meshes.iterdir()
    }


def test_meshes_are_left_where_they_were_seen_upright(tmp_path: Path) -> None:
    scored(tmp_path, pictures=1)
    mesh = IO().load_mesh(tmp_path / "exports" / "meshes" / "0000_0_chair.obj")
    seen = frustums_of(BOXES[:1]).to_camera(BALL.verts_packed()[None])[0] * torch.tensor([1.0, -1, -1])
    torch.testing.assert_close(mesh.verts_packed(), seen, atol=1e-3, rtol=0)


def test_detectors_without_meshes_have_a_report_too(tmp_path: Path) -> None:
    scored(tmp_path, with_meshes=False, pictures=2)
    assert not (tmp_path / "exports" / "meshes").exists()
    assert len(list((tmp_path / "exports" / "detections").iterdir())) == 2
    assert "ap_mesh" not in (tmp_path / "exports" / "results.md").read_text()


def test_what_is_hardly_sure_is_not_drawn_and_no_picture_need_be(tmp_path: Path) -> None:
    scored(tmp_path, pictures=0)
    assert not (tmp_path / "exports" / "detections").exists()
    scored(tmp_path, pictures=1, least_score=0.99)
    assert not (tmp_path / "exports" / "meshes").exists()


def test_classes_that_nobody_named() -> None:
    assert class_name((), 3) == "class 3"
    table = results({"ap_box": {0: 12.34}}, {0: 2, 1: 0}, ("bed",), 7)
    assert re.search(r"\| bed +\| +2 \| +12\.3 \|\n\| class 1 +\| +0 \| +- \|", table)


def test_batches_of_tests_are_as_here() -> None:
    assert joined([photo(0), photo(1, size=(36, 46))]).instances.shapes is not None
