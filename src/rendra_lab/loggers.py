"""Where numbers go while a run lasts: TensorBoard events and one CSV table, both in the run's own folder."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers.logger import Logger, rank_zero_experiment
from lightning.pytorch.utilities.rank_zero import rank_zero_only


class TensorBoard(Logger):
    """Writes scalars as TensorBoard events straight into a folder.

    Args:
        folder: of the events; made when the first number comes.
    """

    def __init__(self, folder: str) -> None:
        super().__init__()
        self.folder = folder
        self._writer: Any = None

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
        """The `SummaryWriter`, opened at the first use."""
        if self._writer is None:
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(self.folder)
        return self._writer

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Adds one scalar a name."""
        for name, value in metrics.items():
            self.experiment.add_scalar(name, value, step)

    @rank_zero_only
    def log_hyperparams(self, params: Any, metrics: Mapping[str, float] | None = None, *_: Any, **__: Any) -> None:
        """Fills a row of TensorBoard's HPARAMS tab; the metrics must stand among the scalars already."""
        from torch.utils.tensorboard.summary import hparams

        for summary in hparams(dict(params), dict(metrics or {})):
            self.experiment.file_writer.add_summary(summary)

    @rank_zero_only
    def log_gif(self, tag: str, path: Path, step: int) -> None:
        """Shows a GIF file among the images, where it moves."""
        from PIL import Image
        from tensorboard.compat.proto.summary_pb2 import Summary

        with Image.open(path) as image:
            width, height = image.size
        content = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=path.read_bytes())
        summary = Summary(value=[Summary.Value(tag=tag, image=content)])
        self.experiment.file_writer.add_summary(summary, step)

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Brings everything to disk; writing may go on."""
        if self._writer is not None:
            self._writer.flush()

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
    """

    def __init__(self, path: str, flush_every_rows: int = 100) -> None:
        super().__init__()
        self.path = Path(path)
        self.flush_every_rows = flush_every_rows
        self._rows: list[dict[str, Any]] = []
        self._columns: list[str] | None = None

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
        if len(self._rows) >= self.flush_every_rows:
            self.save()

    @rank_zero_only
    def log_hyperparams(self, *args: Any, **kwargs: Any) -> None:
        """Nothing: `.hydra/config.yaml` beside the table has them."""

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Brings everything to disk; writing may go on."""
        self.save()

    @rank_zero_only
    def save(self) -> None:
        """Appends the waiting rows; new columns rewrite the table under a longer header."""
        if not self._rows:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        columns = self._read_header() if self._columns is None else self._columns
        names = dict.fromkeys(name for row in self._rows for name in row)
        missing = [name for name in names if name not in columns]
        if missing:
            self._widen(columns + missing)
        with self.path.open("a", newline="") as file:
            csv.DictWriter(file, columns + missing).writerows(self._rows)
        self._columns = columns + missing
        self._rows = []

    def _read_header(self) -> list[str]:
        if not self.path.exists():
            return []
        with self.path.open(newline="") as file:
            return next(csv.reader(file), [])

    def _widen(self, columns: list[str]) -> None:
        rows: list[dict[str, Any]] = []
        if self.path.exists():
            with self.path.open(newline="") as file:
                rows = list(csv.DictReader(file))
        with self.path.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            writer.writerows(rows)
