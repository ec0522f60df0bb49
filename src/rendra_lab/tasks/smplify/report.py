"""What a fit of people leaves behind: numbers as NPZ and JSON, meshes, pictures, and what each term comes to."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from rendra.io import save_obj
from rendra_lab import report, visualization
from rendra_lab.callbacks import writers
from rendra_lab.durable import write_durably
from rendra_lab.settings import Count, Positive
from rendra_lab.tasks.smplify.portraits import Portraits
from rendra_lab.tasks.smplify.records import FitPrediction, PeopleBatch
from rendra_lab.tasks.smplify.task import SMPLify

_DIGITS = 6


class PeopleReport(Callback):
    """Writes down everybody when the test ends, and draws some.

    Leaves people.npz and people.json (`numbers_of`), which `scripts/render_body.py` reads; person_0000.obj and so on,
    y up and seen along -z as cameras of OpenGL see; people/person_0000.png and so on, and all of these on the sheet
    ../images/people.png. Logs `test/energy_NAME`, what each term of the objective comes to for a person at its last
    weight, and `test/loss_NAME`, the same without the weight: means over people.

    Args:
        folder: of the files.
        pictures: people that are drawn: half of them the first, the others those that fit worst; 0 draws none.
        meshes: people, of the drawn or else the first, whose meshes are written.
        size: pixels of a side of each picture.
    """

    def __init__(self, folder: str, pictures: Count = 12, meshes: Count = 4, size: Positive = 256) -> None:
        self.folder = Path(folder)
        self.pictures = pictures
        self.meshes = meshes
        self.size = size

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: Any
    ) -> None:
        """Measures, writes and draws."""
        if not (trainer.is_global_zero and isinstance(pl_module, SMPLify)):
            return
        prediction = pl_module.observe(batch)
        energies = pl_module.energies(prediction, batch)
        logged = {f"test/energy_{name}": weight * value.mean() for name, (value, weight) in energies.items()}
        logged |= {f"test/loss_{name}": value.mean() for name, (value, _) in energies.items()}
        pl_module.log_dict(logged, on_step=False, on_epoch=True, batch_size=1, rank_zero_only=True)
        numbers = numbers_of(prediction, batch, {name: weight * value for name, (value, weight) in energies.items()})
        self._write(numbers)
        shown = shown_people(torch.as_tensor(numbers["error_px"]), max(self.pictures, self.meshes))
        self._draw(trainer, pl_module, prediction, batch, shown[: self.pictures])
        for person in shown[: self.meshes]:
            self._write_mesh(pl_module, prediction, person)

    def _write(self, numbers: Mapping[str, Any]) -> None:
        arrays = {name: value for name, value in numbers.items() if isinstance(value, np.ndarray)}
        names = np.array(numbers["pictures"], dtype=np.str_)
        archive = io.BytesIO()
        np.savez(archive, pictures=names, **arrays)  # type: ignore[arg-type]
        write_durably(self.folder / "people.npz", lambda sink: sink.write(archive.getvalue()))
        report.write_text(self.folder / "people.json", json.dumps(_plain(numbers), allow_nan=False) + "\n")

    def _draw(
        self,
        trainer: Trainer,
        pl_module: SMPLify,
        prediction: FitPrediction,
        batch: PeopleBatch,
        people: list[int],
    ) -> None:
        portraits, rows = Portraits(pl_module.body.faces, self.size), []
        for person in people:
            row = portraits.row(prediction, batch, person)
            visualization.save_picture(self.folder / "people" / f"person_{person:04d}.png", row)
            rows.append(visualization.caption(row, f"{person}: {Path(batch.pictures[person]).name}"))
        if not rows:
            return
        sheet = visualization.tile(rows, columns=1 if len(rows) < 4 else 2)
        visualization.save_picture(self.folder.parent / "images" / "people.png", sheet)
        for writer in writers(trainer):
            writer.add_image("test/people", sheet, trainer.global_step, dataformats="HWC")

    def _write_mesh(self, pl_module: SMPLify, prediction: FitPrediction, person: int) -> None:
        assert prediction.verts is not None
        verts = prediction.verts[person].cpu() * torch.tensor([1.0, -1.0, -1.0])
        path = self.folder / f"person_{person:04d}.obj"
        save_obj(path, verts, pl_module.body.faces.cpu(), decimal_places=5)


def shown_people(error_px: Tensor, count: int) -> list[int]:
    """Which of B people to show: the first ones, and as many of those that fit worst, in their order."""
    first = list(range(min(count - count // 2, len(error_px))))
    worst = error_px.nan_to_num(-1.0).argsort(descending=True, stable=True).tolist()
    return first + sorted([person for person in worst if person not in first][: count - len(first)])


def numbers_of(
    prediction: FitPrediction, batch: PeopleBatch, energies: Mapping[str, Tensor] | None = None
) -> dict[str, Any]:
    """Fitted people as arrays, a row a person.

    Args:
        prediction: each person's best fit, with its joints.
        batch: the people.
        energies: what each term comes to (B,).

    Returns:
        `pictures`, names; `pose` (B, 3 J), radians, the first turn into the camera's axes; `betas` (B, C);
        `translation` (B, 3) and `joints` (B, J, 3), metres, in the camera's axes; `joints_px` (B, K, 2) projected, of
        `given_px` (B, K, 2) and `confidence` (B, K); `error_px` (B,), their mean distance; `focal_px` (B,),
        `center_px` (B, 2), `size_px` (B, 2); `is_flipped` (B,); and `energy_NAME` (B,).
    """
    assert prediction.joints is not None
    found = batch.confidence > 0
    apart = torch.where(found, (prediction.joints_px - batch.joints_px).norm(dim=-1), 0.0)
    tensors = {
        **{name: getattr(prediction, name) for name in ("pose", "betas", "translation", "joints", "joints_px")},
        "given_px": batch.joints_px,
        "error_px": apart.sum(1) / found.sum(1).clamp_min(1),
        **{name: getattr(batch, name) for name in ("confidence", "focal_px", "center_px", "size_px")},
        "is_flipped": prediction.is_flipped,
        **{f"energy_{name}": value for name, value in (energies or {}).items()},
    }
    arrays = {name: value.detach().cpu().numpy() for name, value in tensors.items()}
    return {"pictures": list(batch.pictures), **arrays}


def _plain(value: Any) -> Any:
    """Numbers for JSON, which knows no NaN; six digits after the point."""
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return round(value, _DIGITS) if math.isfinite(value) else None
    return value
