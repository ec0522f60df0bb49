"""Where numbers go while a run lasts: TensorBoard events and one CSV table, both in the run's own folder."""

from __future__ import annotations

import csv
import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loggers.logger import Logger, rank_zero_experiment
from lightning.pytorch.utilities.rank_zero import rank_zero_only

log = logging.getLogger(__name__)


class LogKeeper(Callback):
    """Keeps the logs of a run in step with its checkpoints, so that a resumed run goes on where it was cut off.

    A checkpoint brings to disk whatever was logged before. The first step of a fit cuts from the logs that lie in
    the run's folder what an ended process logged from that step on. Every run that has loggers has it, before all
    callbacks that show something.
    """

    def __init__(self) -> None:
        self._is_cut = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """A fit begins."""
        self._is_cut = False

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Cuts the logs before the first step."""
        if not self._is_cut:
            self._is_cut = True
            step = trainer.fit_loop.epoch_loop._batches_that_stepped  # what Lightning gives loggers as their step
            for logger in trainer.loggers:
                if isinstance(logger, TensorBoard | CsvTable):
                    logger.cut(step)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Brings the logs to disk."""
        for logger in trainer.loggers:
            logger.save()


class TensorBoard(Logger):
    """Writes scalars as TensorBoard events straight into a folder.

    Args:
        folder: of the events; made when the first number comes.
    """

    def __init__(self, folder: str) -> None:
        super().__init__()
        self.folder = folder
        self._writer: Any = None
        self._is_owed = False

    @property
    def name(self) -> str:
        """Empty: the folder says it all."""
        return ""

    @property
    def version(self) -> str:
        """Empty: the folder says it all."""
        return ""

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        """The `EventWriter`, a `SummaryWriter`, opened at the first use."""
        if self._writer is None:
            from rendra_lab.event_files import EventWriter

            self._writer = EventWriter(self.folder)
        return self._writer

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Adds one scalar a name."""
        for name, value in metrics.items():
            self.experiment.add_scalar(name, value, step)
        if self._is_owed:
            self.experiment.flush()
            self._is_owed = False

    @rank_zero_only
    def log_hyperparams(self, params: Any, *_: Any, name: str = "", **__: Any) -> None:
        """Fills the run's row of TensorBoard's HPARAMS tab.

        The tab makes one table of all runs: their settings, and the last value of each scalar. A list of columns,
        which torch's `add_hparams` adds, would be the first run's for all of them.

        Args:
            params: numbers, words and switches by name.
            name: of the row; rows of the same name are shown as one, by their mean.
        """
        from tensorboard.plugins.hparams.summary_v2 import hparams_pb  # its neighbour `summary` wants TensorFlow
        from torch.utils.tensorboard.summary import hparams

        *_, success = hparams({}, {})
        self.experiment.add_summary(hparams_pb(dict(params), trial_id=name))
        self.experiment.add_summary(success)

    @rank_zero_only
    def cut(self, step: int) -> None:
        """Drops what event files of the folder say about this step and later ones."""
        from rendra_lab.event_files import cut_events

        cut_events(Path(self.folder), step)

    @rank_zero_only
    def save(self) -> None:
        """Brings everything to disk, and what is logged next at once: a step is logged after its checkpoint."""
        if self._writer is not None:
            self._writer.flush()
            self._is_owed = True

    @rank_zero_only
    def log_gif(self, tag: str, path: Path, step: int) -> None:
        """Shows a GIF file among the images, where it moves."""
        from PIL import Image
        from tensorboard.compat.proto.summary_pb2 import Summary

        with Image.open(path) as image:
            width, height = image.size
        content = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=path.read_bytes())
        summary = Summary(value=[Summary.Value(tag=tag, image=content)])
        self.experiment.add_summary(summary, step)

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Brings everything to disk; writing may go on, but after a failure in a new file."""
        if self._writer is not None:
            self._writer.flush()
        if status == "failed":
            self.close()

    @rank_zero_only
    def close(self) -> None:
        """Ends the events file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


class CsvTable(Logger):
    """Writes all numbers into one table: a row for every time that something was logged, a column a name.

    Args:
        path: of the table. An existing one is continued.
        flush_every_rows: how many rows may wait in memory.

    A disk that takes no more is said once; the rows wait until it does.
    """

    def __init__(self, path: str, flush_every_rows: int = 100) -> None:
        super().__init__()
        self.path = Path(path)
        self.flush_every_rows = flush_every_rows
        self._rows: list[dict[str, Any]] = []
        self._columns: list[str] | None = None
        self._is_owed = False
        self._is_full = False

    @property
    def name(self) -> str:
        """Empty: the path says it all."""
        return ""

    @property
    def version(self) -> str:
        """Empty: the path says it all."""
        return ""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Adds one row."""
        self._rows.append({"step": step, **metrics})
        if self._is_owed or len(self._rows) >= self.flush_every_rows:
            self._write()
            self._is_owed = False

    @rank_zero_only
    def log_hyperparams(self, *args: Any, **kwargs: Any) -> None:
        """Nothing: `.hydra/config.yaml` beside the table has them."""

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Brings everything to disk; writing may go on."""
        self._write()

    @rank_zero_only
    def save(self) -> None:
        """Brings everything to disk, and the next row at once: a step is logged after its checkpoint."""
        self._write()
        self._is_owed = True

    @rank_zero_only
    def cut(self, step: int) -> None:
        """Drops the rows of this step and later ones."""
        columns, rows = self._read()
        if columns:
            self._replace(columns, [row for row in rows if row["step"].isdecimal() and int(row["step"]) < step])

    def _write(self) -> None:
        """Appends the waiting rows; new columns rewrite the table under a longer header."""
        if not self._rows:
            return
        try:
            self._append()
        except OSError as problem:
            if not self._is_full:
                log.warning("%s takes no more rows, the run goes on: %s", self.path, problem)
            self._is_full = True

    def _append(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        columns = self._read()[0] if self._columns is None else self._columns
        names = dict.fromkeys(name for row in self._rows for name in row)
        missing = [name for name in names if name not in columns]
        if missing:
            self._replace(columns + missing, [*self._read()[1], *self._rows])
        else:
            self._extend(columns)
        self._columns = columns + missing
        self._rows = []

    def _extend(self, columns: Sequence[str]) -> None:
        size = self.path.stat().st_size
        try:
            with self.path.open("a", newline="") as file:
                csv.DictWriter(file, columns).writerows(self._rows)
        except OSError:
            os.truncate(self.path, size)
            raise

    def _read(self) -> tuple[list[str], list[dict[str, Any]]]:
        """Header and rows, without a last line that was cut off."""
        if not self.path.exists():
            return [], []
        lines = self.path.read_bytes().decode().splitlines(keepends=True)
        table = csv.DictReader(line for line in lines if line.endswith("\n"))
        return list(table.fieldnames or []), list(table)

    def _replace(self, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
        partial = self.path.with_name(f".{self.path.name}.{os.getpid()}.tmp")
        try:
            with partial.open("w", newline="") as file:
                table = csv.DictWriter(file, columns, extrasaction="ignore")
                table.writeheader()
                table.writerows(rows)
            partial.replace(self.path)
        finally:
            partial.unlink(missing_ok=True)
