"""The report of rebuilt shapes: who knows the truth scores all of it, and every file is there."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import LightningDataModule, Trainer
from PIL import Image
from torch.utils.data import DataLoader

from rendra.io import IO
from rendra.structures import Meshes
from rendra.utils import ico_sphere, torus
from rendra_lab.base_task import BaseTask
from rendra_lab.mesh_scores import mesh_term, true_meshes
from rendra_lab.shape_records import ShapeBatch, Shapes
from rendra_lab.tasks.voxmesh.records import ShapePrediction
from rendra_lab.tasks.voxmesh.report import ShapeReport
from rendra_lab.tasks.voxmesh.shape_table import class_means_of, means_of, results

SIDE = 40
LENS = torch.tensor([[[50.0, 0, 20], [0, 50, 20], [0, 0, 1]]])


def shown(label: int, size: float = 0.5) -> ShapeBatch:
    """A ball (label 0) or a ring (label 1) two metres away, in a batch of one."""
    mesh = ico_sphere(2) if label == 0 else torus(0.3, 0.7, 12, 24)
    verts = mesh.verts_packed() * size + torch.tensor([0.0, 0, 2])
    grid = torch.zeros(1, 8, 8, 8, dtype=torch.bool)
    grid[:, 1:7, 1:7, 1:7] = True
    frame = torch.diag(torch.tensor([size, size, size, 1.0]))[None]
    frame[0, 2, 3] = 2
    points = verts[None, :100]
    shapes = Shapes(
        points, torch.nn.functional.normalize(points, dim=-1), grid, frame, (verts,), (mesh.faces_packed(),)
    )
    rgb = torch.full((1, 3, SIDE, SIDE), 0.3 + 0.4 * label)
    depths = torch.tensor([[1.4, 2.6]])
    return ShapeBatch(rgb, LENS, depths, torch.tensor([label]), shapes, [f"model {label} {size}"])


class Solids(LightningDataModule):
    """Three pictures, one by one."""

    classes = ("ball", "ring")

    def setup(self, stage: str) -> None:
        self.splits = SimpleNamespace(
            train=[shown(0, 0.45), shown(1, 0.55)], test=[shown(0), shown(1), shown(1, 0.4)]
        )

    def test_dataloader(self) -> DataLoader[Any]:
        return DataLoader(self.splits.test, batch_size=None)


class Scaling(BaseTask[ShapeBatch, ShapePrediction]):
    """Knows the truth, and begins with something a tenth larger."""

    def __init__(self, refines: bool = True, **parts: Any) -> None:
        super().__init__(**parts)
        self.refines = refines

    def predict(self, batch: ShapeBatch) -> ShapePrediction:
        truth = true_meshes(batch.shapes)
        center = torch.tensor([0.0, 0, 2])
        start = Meshes([(truth.verts_packed() - center) * 1.2 + center], [truth.faces_packed()])
        return ShapePrediction(truth if self.refines else start, start)


def scored(folder: Path, refines: bool = True, **settings: Any) -> dict[str, float]:
    report = ShapeReport(str(folder / "exports"), samples=2000, **settings)
    silent = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = Trainer(accelerator="cpu", callbacks=[report], enable_model_summary=False, **silent)
    task = Scaling(refines, metrics={"f1_30": mesh_term("f1", 0.3, samples=2000)})
    trainer.test(task, datamodule=Solids(), verbose=False)
    return {name: float(value) for name, value in trainer.callback_metrics.items()}


def cells(table: str, title: str) -> Sequence[str]:
    line = next(line for line in table.splitlines() if line.startswith(f"| {title} "))
    return [cell.strip() for cell in line.strip("|").split("|")][1:]


def test_a_report_leaves_tables_pictures_and_meshes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = scored(tmp_path, pictures=2, on_sheet=2)
    table = (tmp_path / "exports" / "results.md").read_text()
    assert table.startswith("# 3 pictures of objects\n")
    assert table in capsys.readouterr().out
    assert "| category" in table
    assert "| F1@0.1 | F1@0.3 | F1@0.5 |" in table
    assert [cells(table, title)[0] for title in ("ball", "ring", "mean of instances")] == ["1", "2", "3"]
    assert float(cells(table, "mean of instances")[4]) == pytest.approx(found["test/f1_30"], abs=0.01)
    assert found["test/f1_30"] > 85 > found["test/start_f1_30"] + 20
    assert found["test/start_chamfer"] > 0.1
    assert {"test/mean_shape_f1_30", "test/mean_view_normal", "test/class_mean_f1_30"} <= set(found)
    assert len(cells(table, "mean shape of the class, placed by the truth")) == 5
    with (tmp_path / "exports" / "shapes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["shape"] for row in rows] == ["model 0 0.5", "model 1 0.5", "model 1 0.4"]
    names = sorted(path.name for path in (tmp_path / "exports" / "shapes").iterdir())
    assert names == [f"{number:04d}{end}" for number in (0, 1) for end in (".png", "_mesh.obj", "_truth.obj")]
    assert np.asarray(Image.open(tmp_path / "images" / "shapes.png")).std() > 10


def test_meshes_are_left_upright(tmp_path: Path) -> None:
    scored(tmp_path, pictures=1, mean_of=0)
    mesh = IO().load_mesh(tmp_path / "exports" / "shapes" / "0000_truth.obj")
    expected = shown(0).shapes.verts[0] * torch.tensor([1.0, -1, -1])
    torch.testing.assert_close(mesh.verts_packed(), expected, atol=1e-4, rtol=0)


def test_who_does_not_refine_is_not_compared_with_the_start(tmp_path: Path) -> None:
    found = scored(tmp_path, refines=False, pictures=0, mean_of=0)
    assert not any("start" in name or "mean_shape" in name for name in found)
    assert not (tmp_path / "images").exists()


def test_the_older_protocol_has_thresholds_of_its_own(tmp_path: Path) -> None:
    found = scored(tmp_path, pictures=0, mean_of=0, protocol="p2m")
    assert "| F1@1e-4 | F1@2e-4 |" in (tmp_path / "exports" / "results.md").read_text()
    assert "test/class_mean_f1_1" in found


def test_means_over_classes_weigh_rare_ones_as_much() -> None:
    rows = [
        {"shape": "a", "label": label, "model_f1_30": value} for label, value in ((0, 10.0), (2, 20.0), (2, 60.0))
    ]
    assert means_of(rows) == pytest.approx({"model_f1_30": 30.0})
    assert class_means_of(rows) == pytest.approx({"model_f1_30": 25.0})
    numbers = {f"model_{name}": 1.0 for name in ("chamfer", "normal", "f1_10", "f1_50")}
    table = results([{**row, **numbers} for row in rows], ("bed",))
    assert re.search(r"\| class 2 +\| +2 \|", table)
    assert cells(table, "mean of categories")[4] == "25.00"
