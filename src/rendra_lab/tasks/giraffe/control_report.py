"""What a test of a generator says about its controls: a table, every scene's numbers, and a sheet of pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from rendra_lab import random_state, report, visualization
from rendra_lab.callbacks import writers
from rendra_lab.settings import Count, Positive, Range, Size
from rendra_lab.tasks.giraffe.control_table import TITLES, results
from rendra_lab.tasks.giraffe.disentanglement import Findings, Probe, Views, means_of, measure
from rendra_lab.tasks.giraffe.records import PictureBatch
from rendra_lab.tasks.giraffe.scene_maker import SceneMaker
from rendra_lab.visualization import Picture

_FRAMES = 6


class ControlReport(Callback):
    """Measures, when the test ends, what controls of one object change, with the averaged generator: `measure`.

    Leaves controls.csv, a row a scene; controls.md, the table, which is printed too; and ../images/controls.png, some
    scenes under each control. Logs the means, `test/turn_background_change`, `test/move_correlation` and so on, and
    `test/seen`, the share of scenes in which the object is seen, of which they are the means; beside
    `test/mask_share` also `test/true_mask_share`, what objects of real pictures cover, where the data know it.

    Args:
        folder: of the files.
        scenes: that are measured.
        on_sheet: of these, on the sheet; 0 leaves it out.
        turns: headings, of a full turn.
        temperature: of the codes.
        object: which object is controlled.
        threshold: of a change that shows the object, of a range of 1.
        seed: of the scenes.
    """

    def __init__(
        self,
        folder: str,
        scenes: Positive = 64,
        on_sheet: Count = 4,
        turns: Annotated[int, Range(2)] = 12,
        temperature: Size = 0.65,
        object: Count = 0,
        threshold: Size = 0.1,
        seed: Count = 0,
    ) -> None:
        self.folder = Path(folder)
        self.probe = Probe(
            scenes, turns, temperature=temperature, object=object, threshold=threshold, seed=seed, kept=on_sheet
        )
        self._findings: Findings | None = None
        self._true_shares: list[float] = []

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forgets other tests."""
        self._findings, self._true_shares = None, []

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: Any
    ) -> None:
        """Looks at how large real objects are, where that is known."""
        if isinstance(batch, PictureBatch) and batch.truth is not None:
            shares = batch.truth.masks.float().mean((-2, -1))
            self._true_shares += shares[batch.truth.kind >= 0].tolist()

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Measures, and logs the means."""
        maker = getattr(pl_module, "averaged", None)
        if not (trainer.is_global_zero and isinstance(maker, SceneMaker)):
            return
        with random_state.untouched():
            self._findings = measure(maker, self.probe)
        means = means_of(self._findings.rows)
        if self._true_shares:
            means["true_mask_share"] = sum(self._true_shares) / len(self._true_shares)
        for name, value in means.items():
            pl_module.log(f"test/{name}", value, rank_zero_only=True)

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Writes the files and prints the table."""
        if self._findings is None:
            return
        rows = self._findings.rows
        report.write_csv(self.folder / "controls.csv", [{"scene": i, **row} for i, row in enumerate(rows)])
        true_share = sum(self._true_shares) / len(self._true_shares) if self._true_shares else None
        text = results(rows, self.probe, true_share)
        report.write_text(self.folder / "controls.md", text)
        report.say(text)
        if self.probe.kept:
            drawn = sheet(self._findings.views)
            visualization.save_picture(self.folder.parent / "images" / "controls.png", drawn)
            for writer in writers(trainer):
                writer.add_image("test/controls", drawn, trainer.global_step, dataformats="HWC")
        self._findings = None


def sheet(views: dict[str, Views]) -> Picture:
    """Scenes under each control: a block a control, in which a row is a scene."""
    blocks = [visualization.caption(_block(view.rgb), TITLES[name]) for name, view in views.items()]
    return visualization.tile(blocks, columns=2)


def _block(rgb: Tensor) -> Picture:
    """(K, B, 3, S, S), of which at most six of the K are drawn."""
    total = len(rgb)
    chosen = [step * total // _FRAMES for step in range(_FRAMES)] if total > _FRAMES else list(range(total))
    pictures = [
        visualization.to_picture(rgb[i, scene].movedim(0, -1)) for scene in range(rgb.shape[1]) for i in chosen
    ]
    return visualization.tile(pictures, columns=len(chosen))
