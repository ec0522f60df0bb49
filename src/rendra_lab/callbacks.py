"""What accompanies a run: timing, images, animations and meshes. The only writers of such files."""

from __future__ import annotations

import math
import statistics
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from rendra.io import IO
from rendra_lab import report, visualization
from rendra_lab.base_task import BaseTask
from rendra_lab.errors import UserError
from rendra_lab.loggers import TensorBoard
from rendra_lab.settings import Amount, Count, Positive, Size


def every(step: int, interval: int) -> bool:
    """Whether a step, counted from 0, is due; an interval of 0 is never."""
    return interval > 0 and step % interval == 0


class StepTimer(Callback):
    """Measures training steps, from their start to their end; the first one, which compiles, is left out."""

    def __init__(self) -> None:
        self._seconds: deque[float] = deque(maxlen=10_000)
        self._start: float | None = None
        self._warm = False

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Starts the clock."""
        self._start = _now(pl_module.device)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Stops the clock."""
        if self._warm and self._start is not None:
            self._seconds.append(_now(pl_module.device) - self._start)
        self._warm = True

    def median_ms(self) -> float | None:
        """The median of the last ten thousand steps in milliseconds; None before the second step."""
        return round(1000 * statistics.median(self._seconds), 3) if self._seconds else None


def _now(device: torch.device) -> float:
    """The time when all work on the device is done, in seconds."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


class ImageLogger(Callback):
    """Writes the panels of a fit, side by side, as PNG files and to TensorBoard.

    The fit leaves `step_000050.png` at intervals, `final.png`, and `story.png`, which shows beginning, middle
    and end in rows. Validation leaves its first batch.

    Args:
        folder: of the PNG files.
        every_n_steps: interval during the fit; 0 shows the end alone.
        max_files: when reached, every second file goes and the interval doubles.
    """

    def __init__(self, folder: str, every_n_steps: Count = 50, max_files: Positive = 64) -> None:
        self.folder = Path(folder)
        self.every_n_steps = every_n_steps
        self.max_files = max_files
        self._batch: Any = None
        self._shown: list[tuple[int, dict[str, np.ndarray]]] = []

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Shows the state before a step that is due: the start of the fit first of all."""
        self._batch = batch
        if _shows(trainer, pl_module, "panels") and every(trainer.global_step, self.every_n_steps):
            self._write(trainer, pl_module, f"step_{trainer.global_step:06d}.png")
            self._thin_out()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Shows the end, and the way to it."""
        if not _shows(trainer, pl_module, "panels") or self._batch is None:
            return
        self._write(trainer, pl_module, "final.png")
        if self._shown:
            sheet = visualization.story([(f"step {step}", pictures) for step, pictures in _spread(self._shown, 4)])
            visualization.save_picture(self.folder / "story.png", sheet)
        self._batch, self._shown = None, []

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: Any
    ) -> None:
        """Shows the first batch of a validation."""
        if batch_idx == 0 and not trainer.sanity_checking and _shows(trainer, pl_module, "panels"):
            _publish(trainer, _pictures(pl_module, batch), "val", self.folder / f"val_{trainer.global_step:06d}.png")

    def _write(self, trainer: Trainer, pl_module: LightningModule, name: str) -> None:
        pictures = _pictures(pl_module, self._batch)
        if pictures:
            self._shown.append((trainer.global_step, pictures))
            _publish(trainer, pictures, "train", self.folder / name)

    def _thin_out(self) -> None:
        if len(self._shown) >= self.max_files:
            for step, _ in self._shown[1::2]:
                (self.folder / f"step_{step:06d}.png").unlink(missing_ok=True)
            self._shown = self._shown[::2]
            self.every_n_steps *= 2


class AnimationWriter(Callback):
    """Turns the panels of a fit into an animation.

    Args:
        path: of the file, .gif or .mp4 (extra [view]).
        every_n_steps: interval between frames; 0 writes no animation.
        max_frames: when reached, every second frame goes and the interval doubles.
        fps: frames a second.
        height_px: of the panels in a frame.
    """

    def __init__(
        self,
        path: str,
        every_n_steps: Count = 5,
        max_frames: Positive = 48,
        fps: Size = 12.0,
        height_px: Positive = 192,
    ) -> None:
        self.path = Path(path)
        self.every_n_steps = every_n_steps
        self.max_frames = max_frames
        self.fps = fps
        self.height_px = height_px
        self._batch: Any = None
        self._frames: list[np.ndarray] = []

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Keeps a frame of the state before a step that is due."""
        self._batch = batch
        if _shows(trainer, pl_module, "panels") and every(trainer.global_step, self.every_n_steps):
            if len(self._frames) >= self.max_frames:
                self._frames = self._frames[::2]
                self.every_n_steps *= 2
            if every(trainer.global_step, self.every_n_steps):
                self._keep(pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Writes the file."""
        if self._frames and self._batch is not None:
            self._keep(pl_module)
            visualization.save_animation(self.path, self._frames, self.fps)
        self._frames, self._batch = [], None

    def _keep(self, pl_module: LightningModule) -> None:
        pictures = _pictures(pl_module, self._batch)
        if pictures:
            self._frames.append(visualization.captioned_row(pictures, self.height_px))


class MeshLogger(Callback):
    """Shows the meshes of a task in TensorBoard at intervals, and leaves the final ones as files.

    Args:
        folder: of the files.
        every_n_steps: interval during the fit; 0 shows the end alone.
        formats: of the files, each an ending that `rendra.io.IO` writes, such as ply.

    Raises:
        UserError: an ending that no format has.
    """

    def __init__(self, folder: str, every_n_steps: Count = 200, formats: Sequence[str] = ("ply",)) -> None:
        self.folder = Path(folder)
        self.every_n_steps = every_n_steps
        self.formats = [ending.lower().lstrip(".") for ending in formats]
        writers = IO().mesh_interpreters
        known = {suffix.lstrip(".") for each in writers for suffix in getattr(each, "known_suffixes", ())}
        if unknown := ", ".join(sorted({*self.formats} - known)):
            known_too = ", ".join(sorted(known))
            raise UserError(f"callbacks.meshes.formats: no mesh format ends in {unknown}; known: {known_too}")
        self._batch: Any = None

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Shows the state before a step that is due."""
        self._batch = batch
        if _shows(trainer, pl_module, "meshes") and every(trainer.global_step, self.every_n_steps):
            self._show(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Shows the end and writes the files."""
        if not _shows(trainer, pl_module, "meshes") or self._batch is None:
            return
        for name, meshes in self._show(trainer, pl_module).items():
            self.folder.mkdir(parents=True, exist_ok=True)
            for index in range(len(meshes)):
                suffix = f"_{index}" if len(meshes) > 1 else ""
                for ending in self.formats:
                    IO().save_mesh(meshes[index].detach().cpu(), self.folder / f"{name}{suffix}.{ending}")
        self._batch = None

    def _show(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        assert isinstance(pl_module, BaseTask)
        shown = pl_module.show_meshes(self._batch)
        for writer in writers(trainer):
            for name, meshes in shown.items():
                add_mesh(writer, name, meshes, trainer.global_step)
        return shown


class FactWriter(Callback):
    """Leaves the facts of a task as JSON files when the fit ends.

    Args:
        folder: of the files.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)
        self._batch: Any = None

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Remembers what the fit sees."""
        self._batch = batch

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Writes the files."""
        if self._batch is not None and _shows(trainer, pl_module, "facts"):
            assert isinstance(pl_module, BaseTask)
            for name, fact in pl_module.show_facts(self._batch).items():
                report.write_json(self.folder / f"{name}.json", fact)
        self._batch = None


class BatchReport(Callback):
    """Shows a test batch by batch: a table of its metrics, and its panels as an animation or single pictures.

    Args:
        table: path of the CSV file: a row a batch, which begins with its number as `frame`, or with its name as
            `view` where the data module has `test_labels`.
        animation: path of a .gif or .mp4 of the panels, a frame a batch; None leaves it out.
        pictures: folder for the panels as `test_000.png` and so on, also shown in TensorBoard; None: nowhere.
        max_pictures: of these, evenly spread over the batches.
        fps: frames a second.
        height_px: of the panels in a frame.
    """

    def __init__(
        self,
        table: str,
        animation: str | None = None,
        pictures: str | None = None,
        max_pictures: Count = 24,
        fps: Size = 8.0,
        height_px: Positive = 192,
    ) -> None:
        self.table = Path(table)
        self.animation = None if animation is None else Path(animation)
        self.pictures = None if pictures is None else Path(pictures)
        self.max_pictures = max_pictures
        self.fps = fps
        self.height_px = height_px
        self._frames: list[np.ndarray] = []
        self._rows: list[dict[str, Any]] = []

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: Any
    ) -> None:
        """Keeps one frame and its numbers."""
        if not trainer.is_global_zero or not isinstance(pl_module, BaseTask):
            return
        labels = getattr(trainer.datamodule, "test_labels", None)  # type: ignore[attr-defined]
        name = {"frame": batch_idx} if labels is None else {"view": labels[batch_idx]}
        numbers = {key: float(value) for key, value in outputs.items() if isinstance(value, torch.Tensor)}
        self._rows.append({**name, **numbers})
        if self.animation is None and not self._is_chosen(trainer, batch_idx):
            return
        shown = _pictures(pl_module, batch)
        if shown and self.animation is not None:
            self._frames.append(visualization.captioned_row(shown, self.height_px))
        if self.pictures is not None and self._is_chosen(trainer, batch_idx):
            _publish(trainer, shown, f"test/{batch_idx:03d}", self.pictures / f"test_{batch_idx:03d}.png")

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Writes the files."""
        if self._frames and self.animation is not None:
            visualization.save_animation(self.animation, self._frames, self.fps)
        if self._rows:
            report.write_csv(self.table, self._rows)
        self._frames, self._rows = [], []

    def _is_chosen(self, trainer: Trainer, batch_idx: int) -> bool:
        if self.pictures is None:
            return False
        total = int(trainer.num_test_batches[0])
        return batch_idx in _spread(list(range(total)), self.max_pictures)


_HARDLY = 0.8  # of the first loss: a fit that ends above it has hardly begun


class StopWhenSettled(Callback):
    """Ends a fit whose loss is low enough, or has not improved for a while, which it says, and what came of it.

    Processes judge the mean of their losses.

    Args:
        monitor: what Lightning logs, such as `train/loss`.
        below: the fit ends as soon as the value is smaller; None waits for nothing.
        patience: steps without a new best by the share `improvement`; None waits for ever.
        improvement: smallest gain that counts, as a share of the new value.
    """

    def __init__(
        self,
        monitor: str = "train/loss",
        below: float | None = None,
        patience: Positive | None = None,
        improvement: Amount = 1e-3,
    ) -> None:
        self.monitor = monitor
        self.below = below
        self.patience = patience
        self.improvement = improvement
        self._first = float("nan")
        self._best = float("inf")
        self._waited = 0

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Looks at the newest value; UserError where nothing of that name is logged."""
        known = trainer.callback_metrics
        if self.monitor not in known:
            raise UserError(f"StopWhenSettled.monitor: there is no {self.monitor!r}; there are: {', '.join(known)}")
        value = float(trainer.strategy.reduce(known[self.monitor], reduce_op="mean"))
        self._first = value if math.isinf(self._best) else self._first
        improved = self._best - value > self.improvement * abs(value)
        self._waited = 0 if improved else self._waited + 1
        self._best = min(self._best, value)
        low = self.below is not None and value < self.below
        settled = self.patience is not None and self._waited >= self.patience
        if settled and trainer.is_global_zero and not trainer.should_stop:
            said = f"step {trainer.global_step}: {self.monitor} has settled, {self._first:.4g} to {self._best:.4g}"
            nowhere = self._best > _HARDLY * self._first > 0
            report.say(f"{said}; it hardly fell: the fit may have gone nowhere" if nowhere else said)
        if low or settled:
            trainer.should_stop = True

    def state_dict(self) -> dict[str, Any]:
        """For the checkpoint."""
        return {"first": self._first, "best": self._best, "waited": self._waited}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """From a checkpoint."""
        self._best, self._waited = state_dict["best"], state_dict["waited"]
        self._first = state_dict.get("first", self._first)


def _publish(trainer: Trainer, pictures: dict[str, np.ndarray], tag: str, path: Path) -> None:
    """Pictures in a row as a file, and by their names in TensorBoard."""
    if not pictures:
        return
    visualization.save_picture(path, visualization.captioned_row(pictures))
    for writer in writers(trainer):
        for name, picture in pictures.items():
            writer.add_image(f"{tag}/{name}", picture, trainer.global_step, dataformats="HWC")


def add_mesh(writer: Any, name: str, meshes: Any, step: int) -> None:
    """Shows meshes in TensorBoard, with their colours where they are at the vertices."""
    colors = None
    if meshes.textures is not None and hasattr(meshes.textures, "verts_features_padded"):
        colors = (meshes.textures.verts_features_padded()[..., :3].detach().clamp(0, 1) * 255).round().int()
    writer.add_mesh(
        name,
        vertices=meshes.verts_padded().detach().cpu(),
        faces=meshes.faces_padded().clamp_min(0).cpu(),
        colors=None if colors is None else colors.cpu(),
        global_step=step,
    )


def _shows(trainer: Trainer, pl_module: LightningModule, what: str) -> bool:
    """Whether the task draws such things at all, and this process is the one that writes."""
    if not isinstance(pl_module, BaseTask) or not trainer.is_global_zero:
        return False
    return getattr(type(pl_module), what) is not getattr(BaseTask, what)


def _pictures(pl_module: LightningModule, batch: Any) -> dict[str, np.ndarray]:
    assert isinstance(pl_module, BaseTask)
    return {name: visualization.to_picture(torch.as_tensor(image)) for name, image in pl_module.show(batch).items()}


def writers(trainer: Trainer) -> list[Any]:
    """Those of TensorBoard's event files."""
    return [logger.experiment for logger in trainer.loggers if isinstance(logger, TensorBoard)]


def _spread(items: list[Any], count: int) -> list[Any]:
    """At most `count` items, evenly spread, first and last among them."""
    if len(items) <= count:
        return items
    if count < 2:
        return items[:count]
    return [items[round(index * (len(items) - 1) / (count - 1))] for index in range(count)]
