"""What a test of rebuilt shapes leaves behind: tables by category and by method, pictures, and meshes as files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import radians, sin
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch import Callback, LightningModule, Trainer

from rendra.io import IO
from rendra.structures import Meshes
from rendra_lab import report, visualization
from rendra_lab.base_task import BaseTask
from rendra_lab.callbacks import writers
from rendra_lab.data.meshes import bounding_sphere
from rendra_lab.detection.drawing import Color, draw_meshes, phong_view, upright
from rendra_lab.mesh_scores import ProtocolName, true_meshes
from rendra_lab.pictures import OrbitCamera
from rendra_lab.settings import Count, Positive
from rendra_lab.shape_records import ShapeBatch
from rendra_lab.tasks.voxmesh.baselines import MeanShapes
from rendra_lab.tasks.voxmesh.records import ShapePrediction
from rendra_lab.tasks.voxmesh.shape_table import (
    LOGGED,
    TITLES,
    Row,
    class_means_of,
    means_of,
    numbers_of,
    results,
)
from rendra_lab.visualization import Picture

_PICTURE_PX = 192
_BLUE: Color = (0.25, 0.5, 0.85)
_GREY: Color = (0.72, 0.72, 0.72)
_OTHER_SIDE = "from behind"
_BEHIND = OrbitCamera(elev=50, azim=130, fov=30)  # cameras look down a little: less high would be from below


class ShapeReport(Callback):
    """Writes down every object when the test ends, draws some, and compares the model with what it began with and
    with the mean shape of each class.

    Leaves shapes.csv, a row an object; results.md, the tables, which are printed too; of some objects
    shapes/0000.png, the photograph, the mesh from its camera and from behind, and the truth from the same sides, and
    shapes/0000_mesh.obj and 0000_truth.obj (x right, y up, z towards the viewer); some of the rows on the sheet
    ../images/shapes.png. Logs the means of the others, `test/start_f1_30`, `test/mean_shape_chamfer` and so on, and
    the model's mean over classes, `test/class_mean_f1_30`.

    Args:
        folder: of the files.
        pictures: objects that are drawn, evenly spread over the test; 0 draws none.
        on_sheet: of these, on the sheet.
        mean_of: training pictures that the mean shapes are made of, evenly spread; 0 leaves them out.
        protocol: of the comparison, scaled or p2m.
        samples: points on each surface.
    """

    _classes: tuple[str, ...]
    _means: MeanShapes | None
    _due: set[int]
    _rows: list[Row]
    _drawn: list[Picture]

    def __init__(
        self,
        folder: str,
        pictures: Count = 24,
        on_sheet: Count = 8,
        mean_of: Count = 400,
        protocol: ProtocolName = "scaled",
        samples: Positive = 10_000,
    ) -> None:
        self.folder = Path(folder)
        self.pictures = pictures
        self.on_sheet = on_sheet
        self.mean_of = mean_of
        self.protocol = protocol
        self.samples = samples
        self._start()

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Looks at what there is to test, and at what the classes are on average."""
        self._start()
        data = trainer.datamodule  # type: ignore[attr-defined]
        splits = getattr(data, "splits", None)
        self._classes = tuple(getattr(data, "classes", ()))
        self._due = set(range(self.pictures)) if splits is None else _spread(len(splits.test), self.pictures)
        if trainer.is_global_zero and splits is not None and len(splits.train) and self.mean_of:
            chosen = sorted(_spread(len(splits.train), self.mean_of))
            self._means = MeanShapes(splits.train[i] for i in chosen)

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: Any
    ) -> None:
        """Scores the objects of a batch, and draws those that are due."""
        if not (trainer.is_global_zero and isinstance(pl_module, BaseTask) and isinstance(batch, ShapeBatch)):
            return
        prediction = pl_module.observe(batch)
        first = len(self._rows)
        self._rows += numbers_of(self._methods(prediction, batch), batch, self.protocol, self.samples)
        due = [i for i in range(len(batch.rgb)) if first + i in self._due]
        if due:
            meshes, batch = prediction.meshes.to("cpu"), batch.to("cpu")
            for i in due:
                self._draw(first + i, meshes[i], batch, i)

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Logs what the others come to, and the mean over classes."""
        means, class_means = means_of(self._rows), class_means_of(self._rows)
        for method in TITLES:
            for name in LOGGED[self.protocol]:
                if method != "model" and f"{method}_{name}" in means:
                    pl_module.log(f"test/{method}_{name}", means[f"{method}_{name}"], rank_zero_only=True)
        for name in LOGGED[self.protocol] if self._rows else ():
            pl_module.log(f"test/class_mean_{name}", class_means[f"model_{name}"], rank_zero_only=True)

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Writes the files and prints the tables."""
        if not self._rows:
            return
        report.write_csv(self.folder / "shapes.csv", [{"picture": i, **row} for i, row in enumerate(self._rows)])
        text = results(self._rows, self._classes, self.protocol)
        report.write_text(self.folder / "results.md", text)
        report.say(text)
        if rows := [self._drawn[i] for i in sorted(_spread(len(self._drawn), self.on_sheet))]:
            sheet = visualization.tile(rows, columns=1)
            visualization.save_picture(self.folder.parent / "images" / "shapes.png", sheet)
            for writer in writers(trainer):
                writer.add_image("test/shapes", sheet, trainer.global_step, dataformats="HWC")
        self._start()

    def _start(self) -> None:
        self._classes, self._means, self._due = (), None, set()
        self._rows, self._drawn = [], []

    def _methods(self, prediction: ShapePrediction, batch: ShapeBatch) -> dict[str, Meshes]:
        methods = {"model": prediction.meshes}
        if prediction.starts is not prediction.meshes:
            methods["start"] = prediction.starts
        if self._means is not None:
            methods |= {"mean_shape": self._means.posed(batch), "mean_view": self._means.unposed(batch)}
        return methods

    def _draw(self, number: int, mesh: Meshes, batch: ShapeBatch, index: int) -> None:
        truth = true_meshes(batch.shapes)[index]
        shown = pictures_of(mesh, truth, batch, index)
        row = visualization.captioned_row(shown, _PICTURE_PX)
        row = visualization.caption(row, _headline(number, self._rows[number], self._classes))
        visualization.save_picture(self.folder / "shapes" / f"{number:04d}.png", row)
        for name, each in (("mesh", mesh), ("truth", truth)):
            IO().save_mesh(upright(each), self.folder / "shapes" / f"{number:04d}_{name}.obj")
        self._drawn.append(row)


def pictures_of(mesh: Meshes, truth: Meshes, batch: ShapeBatch, index: int) -> dict[str, Picture]:
    """One object of a batch: the photograph, a mesh and the truth, from the photograph's camera and from behind.

    Args:
        mesh: a batch of one, in the camera's axes; without faces it is left white.
        truth: likewise.
        batch: the photographs.
        index: of the object.
    """
    photograph = visualization.to_picture(batch.rgb[index].movedim(0, -1))
    zoom = max(1, round(_PICTURE_PX / len(photograph)))
    paper = np.full_like(visualization.resize(photograph, zoom * len(photograph)), 255)
    lens = batch.intrinsics[index] * batch.intrinsics.new_tensor([[zoom], [zoom], [1]])
    center, radius = bounding_sphere(upright(truth))
    # both are seen from one place: as far as the truth fits with a little around it
    view = replace(_BEHIND, at=tuple(center.tolist()), dist=1.25 * radius / sin(radians(_BEHIND.fov) / 2))
    shown = {"photograph": photograph}
    for name, each, color in (("mesh", mesh, _BLUE), ("truth", truth, _GREY)):
        there = bool(len(each.faces_packed()))
        shown[name] = draw_meshes(paper, each, lens, [color])
        shown[f"{name}, {_OTHER_SIDE}"] = phong_view(each, view, color, _PICTURE_PX) if there else paper
    return shown


def _headline(number: int, row: Row, classes: Sequence[str]) -> str:
    name = classes[row["label"]] if row["label"] < len(classes) else f"class {row['label']}"
    scores = ", ".join(f"{key[6:]} {value:.3g}" for key, value in row.items() if key.startswith("model_"))
    return f"{number}: {name} {row['shape']}; {scores}"


def _spread(total: int, count: int) -> set[int]:
    """At most `count` of the numbers below `total`, evenly spread, 0 among them."""
    return {i * total // count for i in range(count)} if total > count else set(range(total))
