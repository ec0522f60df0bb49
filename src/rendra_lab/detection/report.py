"""What a test of a detector leaves behind: pictures of what it found, meshes as files, and a table of every class."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from rendra.io import IO
from rendra.structures import Meshes, join_meshes_as_batch
from rendra_lab import report, visualization
from rendra_lab.base_task import BaseTask
from rendra_lab.callbacks import writers
from rendra_lab.detection.drawing import SIDES, color_of, draw_meshes, draw_objects, phong_view, upright
from rendra_lab.detection.mask_pasting import pasted_masks
from rendra_lab.detection.object_frames import depth_ranges, rebuilt_in_camera
from rendra_lab.detection.overlaps import nearest_truths
from rendra_lab.detection.records import Detections, Instances, PhotoBatch
from rendra_lab.mesh_scores import true_meshes
from rendra_lab.settings import Count, Fraction
from rendra_lab.visualization import Picture

_ROW_PX = 256  # height that small pictures are about enlarged to, so that their captions can be read
_SIDE_PX = 192  # of a view of a mesh
_UNKNOWN_DEPTH = 2.0  # where nobody can say how far an object is: of its size alone
_TWO_SIDES = ("as photographed", "from the left")


class DetectionReport(Callback):
    """Draws what a detector finds in some of the test pictures, and says how good it is at every class.

    Leaves results.md, a row a class with every average precision among the metrics, which is printed too; for some
    pictures detections/0000.png, what is annotated beside what is found, and, of detectors that rebuild meshes,
    their meshes in front of the picture, meshes/0000_0_chair.png, each mesh beside the truth from two sides, and
    meshes/0000_0_chair.obj (x right, y up, z towards the viewer; as deep as the true object stands, or two metres
    away). Rows of both are on the sheets ../images/detections.png and ../images/meshes.png.

    Args:
        folder: of the files.
        pictures: that are drawn, evenly spread over the test; 0 draws none.
        on_sheet: rows on each sheet.
        least_score: of objects that are drawn.
        most_meshes: of a picture, the surest ones.
    """

    _classes: tuple[str, ...]
    _due: set[int]
    _seen: int  # test pictures so far
    _counts: Counter[int]
    _columns: dict[str, dict[int, float]]
    _rows: list[Picture]
    _mesh_rows: list[Picture]

    def __init__(
        self,
        folder: str,
        pictures: Count = 24,
        on_sheet: Count = 6,
        least_score: Fraction = 0.5,
        most_meshes: Count = 4,
    ) -> None:
        self.folder = Path(folder)
        self.pictures = pictures
        self.on_sheet = on_sheet
        self.least_score = least_score
        self.most_meshes = most_meshes
        self._start()

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Looks at what there is to test."""
        self._start()
        data = trainer.datamodule  # type: ignore[attr-defined]
        self._classes = tuple(getattr(data, "classes", ()))
        splits = getattr(data, "splits", None)
        self._due = set(range(self.pictures)) if splits is None else _spread(len(splits.test), self.pictures)

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: Any
    ) -> None:
        """Counts the objects of a batch, and draws the pictures that are due."""
        if not (trainer.is_global_zero and isinstance(pl_module, BaseTask) and isinstance(batch, PhotoBatch)):
            return
        first, self._seen = self._seen, self._seen + len(batch.rgb)
        self._counts.update(batch.instances.labels.tolist())
        due = [i for i in range(len(batch.rgb)) if first + i in self._due]
        if due:
            found = pl_module.observe(batch).detections.to("cpu")
            batch = batch.to("cpu")
            for i in due:
                self._draw(first + i, _of_picture(found, batch, i, self.least_score))

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Asks the metrics for what they know of each class, before they forget it."""
        if isinstance(pl_module, BaseTask):
            metrics: dict[str, Any] = {name: getattr(term, "fn", None) for name, term in pl_module.metrics.items()}
            known = {name: metric for name, metric in metrics.items() if hasattr(metric, "per_class")}
            self._columns = {name: metric.per_class() for name, metric in known.items()}

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Writes the files and prints the table."""
        if not (trainer.is_global_zero and self._seen):
            return
        text = results(self._columns, self._counts, self._classes, self._seen)
        report.write_text(self.folder / "results.md", text)
        report.say(text)
        for name, rows in (("detections", self._rows), ("meshes", self._mesh_rows)):
            if chosen := [rows[i] for i in sorted(_spread(len(rows), self.on_sheet))]:
                sheet = visualization.tile(chosen, columns=1)
                visualization.save_picture(self.folder.parent / "images" / f"{name}.png", sheet)
                for writer in writers(trainer):
                    writer.add_image(f"test/{name}", sheet, trainer.global_step, dataformats="HWC")
        self._rows, self._mesh_rows = [], []

    def _start(self) -> None:
        self._classes, self._due, self._seen = (), set(), 0
        self._counts, self._columns = Counter(), {}
        self._rows, self._mesh_rows = [], []

    def _draw(self, number: int, scene: _Scene) -> None:
        shown = scene.pictures(self._classes)
        row = visualization.captioned_row(shown, max(len(picture) for picture in shown.values()))
        visualization.save_picture(self.folder / "detections" / f"{number:04d}.png", row)
        self._rows.append(row)
        for i in range(min(scene.num_meshes, self.most_meshes)):
            if not len(scene.meshes[i].faces_packed()):
                continue
            name = class_name(self._classes, int(scene.found.labels[i]))
            path = self.folder / "meshes" / f"{number:04d}_{i}_{name.replace('/', '_')}"
            row = visualization.captioned_row(scene.mesh_pictures(i), _SIDE_PX)
            row = visualization.caption(row, f"picture {number}: {scene.caption(self._classes, i)}")
            visualization.save_picture(path.with_suffix(".png"), row)
            IO().save_mesh(upright(scene.meshes[i]), path.with_suffix(".obj"))
            self._mesh_rows.append(row)


def results(
    columns: Mapping[str, Mapping[int, float]], counts: Mapping[int, int], classes: Sequence[str], pictures: int
) -> str:
    """Scores of every class as a table in Markdown, and their means.

    Args:
        columns: by the name of the score, for each label that has one, percent.
        counts: annotated objects of each label.
        classes: their names.
        pictures: how many there were.
    """
    total = sum(counts.values())
    table = [["class", "#instances", *columns]]
    for label in sorted(counts):
        cells = [_cell(column.get(label)) for column in columns.values()]
        table.append([class_name(classes, label), str(counts[label]), *cells])
    means = [_cell(sum(column.values()) / len(column) if column else None) for column in columns.values()]
    table.append(["mean of classes", str(total), *means])
    title = f"# {total} annotated objects in {pictures} pictures"
    note = "Average precision, percent: more is better."
    return "\n".join([title, "", *report.markdown_table(table), "", note]) + "\n"


def class_name(classes: Sequence[str], label: int) -> str:
    """What a label is called; `class 3` where nobody knows."""
    return classes[label] if 0 <= label < len(classes) else f"class {label}"


class _Scene:
    """One picture: what is found in it with at least some score, and what is annotated, on the CPU.

    Attributes:
        picture: (H, W, 3), without what was filled up.
        found: the surest first.
        truth: what is annotated.
        colors: of what is found: those of the annotated objects that it is on.
        num_meshes: that were rebuilt, one of each found object; 0 of detectors without.
        meshes: those, in the axes of the camera.
    """

    def __init__(self, rgb: Tensor, found: Detections, truth: Instances, lens: Tensor) -> None:
        self.picture = visualization.to_picture(rgb.movedim(0, -1))
        self.found, self.truth, self.lens = found, truth, lens
        self.true_meshes = None if truth.shapes is None or not len(truth.labels) else true_meshes(truth.shapes)
        self.partners = nearest_truths(found, truth)[0].tolist()
        others = len(truth.labels)
        self.colors = [color_of(true if true >= 0 else others + i) for i, true in enumerate(self.partners)]
        self.num_meshes = 0 if found.meshes is None else len(found.meshes)
        if self.num_meshes:
            self.meshes = rebuilt_in_camera(found, lens[None].expand(1, 3, 3), self._depths())

    def caption(self, classes: Sequence[str], index: int) -> str:
        """Class and score of what is found."""
        return f"{class_name(classes, int(self.found.labels[index]))} {float(self.found.scores[index]):.2f}"

    def pictures(self, classes: Sequence[str]) -> dict[str, Picture]:
        """What is annotated, what is found, and its meshes where they are seen."""
        height, width = self.picture.shape[:2]
        zoom = max(1, round(_ROW_PX / height))
        picture = visualization.resize(self.picture, zoom * height)
        squares, boxes = self.found.masks, zoom * self.found.boxes
        masks = None if squares is None else pasted_masks(squares, boxes, zoom * height, zoom * width)
        true_masks = self.truth.masks.repeat_interleave(zoom, 1).repeat_interleave(zoom, 2)
        names = [class_name(classes, label) for label in self.truth.labels.tolist()]
        said = [self.caption(classes, i) for i in range(len(self.found.labels))]
        shown = {
            "annotated": draw_objects(picture, zoom * self.truth.boxes, names, true_masks),
            "found": draw_objects(picture, boxes, said, masks, self.colors),
        }
        if self.num_meshes:
            zoomed = self.lens * self.lens.new_tensor([[zoom], [zoom], [1]])
            shown["rebuilt"] = draw_meshes(picture, self.meshes, zoomed, self.colors)
        return shown

    def mesh_pictures(self, index: int) -> dict[str, Picture]:
        """One mesh beside its part of the picture, from two sides, and the truth from the same ones."""
        color = self.colors[index]
        shown = {"photograph": _crop(self.picture, self.found.boxes[index])}
        shown |= {f"mesh {side}": phong_view(self.meshes[index], SIDES[side], color, _SIDE_PX) for side in _TWO_SIDES}
        if self.true_meshes is not None and self.partners[index] >= 0:
            truth = self.true_meshes[self.partners[index]]
            grey = (0.72, 0.72, 0.72)
            shown |= {f"truth {side}": phong_view(truth, SIDES[side], grey, _SIDE_PX) for side in _TWO_SIDES}
        return shown

    def _depths(self) -> Tensor:
        """Of the middle of each found object: that of the true one; of others that of any in the picture."""
        if self.truth.shapes is None or not len(self.truth.labels):
            return self.found.scores.new_full(self.found.scores.shape, _UNKNOWN_DEPTH)
        depths = depth_ranges(self.truth.shapes.verts).mean(1)
        partners = torch.tensor(self.partners, dtype=torch.int64)
        return torch.where(partners >= 0, depths.index_select(0, partners.clamp_min(0)), depths.median())


def _of_picture(found: Detections, batch: PhotoBatch, index: int, least_score: float) -> _Scene:
    height, width = batch.sizes[index].tolist()
    of_it = (found.picture == index) & (found.scores >= least_score)
    truth = _annotated(batch.instances, (batch.instances.picture == index).nonzero()[:, 0])
    return _Scene(
        batch.rgb[index, :, :height, :width],
        _chosen(found, of_it.nonzero()[:, 0]),
        replace(truth, masks=truth.masks[:, :height, :width]),
        batch.intrinsics[index],
    )


def _chosen(found: Detections, rows: Tensor) -> Detections:
    """Some of the found objects, of one picture, which becomes the first of a batch."""
    values = {name: getattr(found, name) for name in Detections.names()}
    kept = {name: value.index_select(0, rows) for name, value in values.items() if isinstance(value, Tensor)}
    kept["picture"] = torch.zeros_like(kept["picture"])
    meshes = found.meshes
    if meshes is not None:
        meshes = join_meshes_as_batch([_at_home(meshes[row]) for row in rows.tolist()]) if len(rows) else None
    return replace(found, **kept, meshes=meshes)


def _at_home(mesh: Meshes) -> Meshes:
    return Meshes([mesh.verts_packed()], [mesh.faces_packed()])


def _annotated(instances: Instances, rows: Tensor) -> Instances:
    """Some of the annotated objects, of one picture, which becomes the first of a batch."""
    shapes = instances.shapes
    if shapes is not None:
        tensors = ("points", "normals", "voxels", "voxels_to_camera")
        shapes = replace(
            shapes,
            **{name: getattr(shapes, name).index_select(0, rows) for name in tensors},
            verts=tuple(shapes.verts[row] for row in rows.tolist()),
            faces=tuple(shapes.faces[row] for row in rows.tolist()),
        )
    picture, boxes, labels, masks = (
        getattr(instances, name).index_select(0, rows) for name in ("picture", "boxes", "labels", "masks")
    )
    return Instances(torch.zeros_like(picture), boxes, labels, masks, shapes)


def _crop(picture: Picture, box: Tensor) -> Picture:
    """A box of a picture with a seventh around it, at least a pixel."""
    height, width = picture.shape[:2]
    x0, y0, x1, y1 = box.tolist()
    margin = max(x1 - x0, y1 - y0) / 7
    left, top = (int(min(max(low - margin, 0), size - 1)) for low, size in ((x0, width), (y0, height)))
    right, bottom = (int(min(max(high + margin, 0), size)) for high, size in ((x1, width), (y1, height)))
    return picture[top : max(bottom, top + 1), left : max(right, left + 1)]


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _spread(total: int, count: int) -> set[int]:
    """At most `count` of the numbers below `total`, evenly spread, 0 among them."""
    return {i * total // count for i in range(count)} if total > count else set(range(total))
