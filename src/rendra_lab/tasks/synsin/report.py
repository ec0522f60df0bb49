"""What a test of new views leaves behind: pictures, every pair's numbers, and a table beside three baselines."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from rendra_lab import report, visualization
from rendra_lab.base_task import BaseTask
from rendra_lab.callbacks import writers
from rendra_lab.settings import Count, Size
from rendra_lab.tasks.synsin.baselines import baselines
from rendra_lab.tasks.synsin.pair_data import PairData
from rendra_lab.tasks.synsin.pair_table import TITLES, Row, column_name, formatted, means_of, numbers_of, results
from rendra_lab.tasks.synsin.records import PairBatch, ViewPrediction
from rendra_lab.visualization import Picture

_ROW_PX = 128  # least height of the pictures of a pair in their row
_GREY = 0.5


class PairReport(Callback):
    """Writes down every pair when the test ends, draws some, and compares the model with what needs no learning.

    The baselines, on the same pairs: the input copied; the input warped by its true depth, with holes; the input
    warped as if all of it had one depth. Those are left out whose depth nobody knows, as are regions where nobody
    knows what is visible.

    Leaves pairs.csv, a row a pair; results.md, the table of means, which is printed too; pairs/0000.png and so on,
    all pictures of a pair in a row, and each by itself as pairs/0000_input.png, 0000_target.png, 0000_output.png ...;
    and some of the rows on the sheet ../images/pairs.png. Logs `test/copy_psnr`, `test/true_warp_ssim_visible`,
    `test/constant_warp_psnr` and so on.

    Args:
        folder: of the files.
        pictures: pairs that are drawn, evenly spread over the test; 0 draws none.
        on_sheet: of these, on the sheet.
        constant_depth: of the baseline with one depth, metres; None takes the median of the training places where
            it is known.
    """

    def __init__(
        self, folder: str, pictures: Count = 24, on_sheet: Count = 8, constant_depth: Size | None = None
    ) -> None:
        self.folder = Path(folder)
        self.pictures = pictures
        self.on_sheet = on_sheet
        self.constant_depth = constant_depth
        self._depth: float | None = None
        self._due: set[int] = set()
        self._rows: list[Row] = []
        self._drawn: list[Picture] = []

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Looks at what there is to test."""
        data = trainer.datamodule  # type: ignore[attr-defined]
        self._depth, self._rows, self._drawn = self.constant_depth, [], []
        self._due = set(range(self.pictures))
        if trainer.is_global_zero and isinstance(data, PairData):
            most = int(trainer.num_test_batches[0]) * data.eval_batch_size
            self._due = _spread(min(most, len(data.splits.test)), self.pictures)
            self._depth = self._depth or data.typical_depth()

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: Any
    ) -> None:
        """Scores the pairs of a batch, and draws those that are due."""
        if not (trainer.is_global_zero and isinstance(pl_module, BaseTask) and isinstance(batch, PairBatch)):
            return
        prediction = pl_module.observe(batch)
        views = {"model": prediction.rgb, **baselines(batch, self._depth)}
        first = len(self._rows)
        self._rows += numbers_of(views, prediction, batch)
        for i in range(len(batch.input)):
            if first + i in self._due:
                self._draw(first + i, pictures_of(views, prediction, batch, i))

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Logs what the baselines come to."""
        others = tuple(f"{method}_" for method in TITLES if method != "model")
        for name, value in means_of(self._rows).items():
            if name.startswith(others):
                pl_module.log(f"test/{name}", value, rank_zero_only=True)

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Writes the files and prints the table."""
        if not self._rows:
            return
        report.write_csv(self.folder / "pairs.csv", [{"pair": i, **row} for i, row in enumerate(self._rows)])
        text = results(self._rows, self._depth)
        report.write_text(self.folder / "results.md", text)
        report.say(text)
        if rows := [self._drawn[i] for i in sorted(_spread(len(self._drawn), self.on_sheet))]:
            sheet = visualization.tile(rows, columns=1)
            visualization.save_picture(self.folder.parent / "images" / "pairs.png", sheet)
            for writer in writers(trainer):
                writer.add_image("test/pairs", sheet, trainer.global_step, dataformats="HWC")
        self._rows, self._drawn = [], []

    def _draw(self, pair: int, pictures: Mapping[str, Picture]) -> None:
        for name, picture in pictures.items():
            visualization.save_picture(self.folder / "pairs" / f"{pair:04d}_{name}.png", picture)
        height = max(_ROW_PX, *(len(picture) for picture in pictures.values()))
        named = {name.replace("_", " "): picture for name, picture in pictures.items()}
        row = visualization.caption(visualization.captioned_row(named, height), _headline(pair, self._rows[pair]))
        visualization.save_picture(self.folder / "pairs" / f"{pair:04d}.png", row)
        self._drawn.append(row)


def pictures_of(
    views: Mapping[str, Tensor], prediction: ViewPrediction, batch: PairBatch, index: int
) -> dict[str, Picture]:
    """The pictures of one pair of a batch, by the names of their files.

    Args:
        views: (B, 3, H, W) by the name of the method that made them.
        prediction: of the model, for its depth.
        batch: the pairs.
        index: of the pair.

    Returns:
        `input`, `target`, `output`, the warps, and `depth`, coloured by its logarithm: near yellow, far violet, sky
        white. With a truth also `true_depth` in the same colours, and `visible`: the target where the input shows it
        too, and grey elsewhere.
    """
    images = {"input": batch.input, "target": batch.target, "output": views["model"]}
    images |= {name: rgb for name, rgb in views.items() if name not in ("model", "copy")}
    shown = {name: rgb[index].movedim(0, -1) for name, rgb in images.items()}
    depth, truth = prediction.depth[index, 0], batch.truth
    if truth is None:
        shown["depth"] = log_depth_image(depth)
    else:
        true_depth = truth.depth[index, 0]
        limits = visualization.depth_limits(true_depth.log(), torch.ones_like(true_depth))
        shown |= {"depth": log_depth_image(depth, limits), "true_depth": log_depth_image(true_depth, limits)}
        shown["visible"] = torch.where(truth.visible[index, 0, :, :, None], shown["target"], _GREY)
    return {name: visualization.to_picture(image) for name, image in shown.items()}


def log_depth_image(depth: Tensor, limits: tuple[float, float] | None = None) -> Tensor:
    """Depth (..., H, W) in colours (..., H, W, 3) by its logarithm: near yellow, far violet, inf white."""
    there = depth.isfinite()
    return visualization.depth_image(torch.where(there, depth, 1.0).log(), there.to(depth), limits)


def _headline(pair: int, row: Row) -> str:
    visible = row.get("visible")
    shown = "" if visible is None else f", {100 * visible:.0f} % visible"
    scores = [
        f"{title} {formatted('psnr', row[column_name(method, 'psnr')])}"
        for method, title in TITLES.items()
        if column_name(method, "psnr") in row
    ]
    return f"pair {pair}{shown}; psnr in dB: {', '.join(scores)}"


def _spread(total: int, count: int) -> set[int]:
    """At most `count` of the numbers below `total`, evenly spread, 0 among them."""
    return {i * total // count for i in range(count)} if total > count else set(range(total))
