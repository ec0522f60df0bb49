"""Callbacks that keep their output bounded, and loggers that lose nothing."""

import csv
import itertools
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, Trainer
from PIL import Image
from rendra_lab_toy import ToyData, ToyTask
from torchmetrics import Metric

from rendra_lab import losses, metrics
from rendra_lab.base_task import BaseTask
from rendra_lab.callbacks import (
    AnimationWriter,
    BatchReport,
    ImageLogger,
    MeshLogger,
    StepTimer,
    StopWhenSettled,
)
from rendra_lab.errors import UserError
from rendra_lab.loggers import CsvTable, TensorBoard
from rendra_lab.terms import LossTerm, MetricTerm


def fit(*callbacks: Callback, steps: int, task: Any = None, **settings: Any) -> None:
    toy = task or ToyTask(
        losses={"texture": LossTerm(losses.SquaredError())}, optimizer=partial(torch.optim.SGD, lr=0.1)
    )
    trainer = Trainer(
        max_steps=steps, max_epochs=-1, accelerator="cpu", logger=False, enable_checkpointing=False,
        enable_model_summary=False, callbacks=list(callbacks),
        **{"enable_progress_bar": False, **settings},
    )  # fmt: skip
    trainer.fit(toy, datamodule=ToyData(steps=steps))


def test_animations_thin_out_instead_of_growing(tmp_path: Path) -> None:
    fit(AnimationWriter(str(tmp_path / "fit.gif"), every_n_steps=1, max_frames=8), steps=50)
    with Image.open(tmp_path / "fit.gif") as image:
        assert 4 < image.n_frames <= 9


def test_images_thin_out_instead_of_growing(tmp_path: Path) -> None:
    fit(ImageLogger(str(tmp_path), every_n_steps=1, max_files=8), steps=50)
    kept = sorted(int(path.stem.removeprefix("step_")) for path in tmp_path.glob("step_*.png"))
    assert kept[0] == 0
    assert len(kept) <= 8
    assert len({later - sooner for sooner, later in itertools.pairwise(kept)}) == 1
    assert (tmp_path / "final.png").exists()


def test_an_interval_of_zero_shows_the_end_alone(tmp_path: Path) -> None:
    fit(
        ImageLogger(str(tmp_path), every_n_steps=0),
        AnimationWriter(str(tmp_path / "fit.gif"), every_n_steps=0),
        steps=3,
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["final.png", "story.png", "val_000003.png"]


class Mute(ToyTask):
    """Draws nothing."""

    panels = BaseTask.panels


def test_a_task_that_draws_nothing_leaves_no_files(tmp_path: Path) -> None:
    mute = Mute(losses={"t": LossTerm(losses.SquaredError())}, optimizer=partial(torch.optim.SGD, lr=0.1))
    fit(ImageLogger(str(tmp_path)), AnimationWriter(str(tmp_path / "fit.gif")), steps=3, task=mute)
    assert list(tmp_path.iterdir()) == []


def test_the_table_grows_columns_and_continues(tmp_path: Path) -> None:
    path = tmp_path / "new" / "metrics.csv"
    table = CsvTable(str(path), flush_every_rows=1)
    table.log_metrics({"a": 1.0}, step=0)
    table.log_metrics({"b": 2.0}, step=1)
    table.save()
    again = CsvTable(str(path))
    again.log_metrics({"a": 3.0, "c": 4.0}, step=2)
    again.finalize("success")
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["step"] for row in rows] == ["0", "1", "2"]
    assert rows[0]["a"] == "1.0"
    assert rows[1] == {"step": "1", "a": "", "b": "2.0", "c": ""}
    assert rows[2]["c"] == "4.0"


def test_an_unused_events_file_is_never_made(tmp_path: Path) -> None:
    logger = TensorBoard(str(tmp_path / "run"))
    logger.finalize("success")
    logger.close()
    assert not (tmp_path / "run").exists()


class Shy(ToyTask):
    """Could draw, but has nothing to show."""

    def panels(self, prediction: Any, batch: Any) -> dict[str, torch.Tensor]:
        return {}


def test_a_task_without_panels_today_ends_well(tmp_path: Path) -> None:
    shy = Shy(losses={"t": LossTerm(losses.SquaredError())}, optimizer=partial(torch.optim.SGD, lr=0.1))
    fit(ImageLogger(str(tmp_path), every_n_steps=1), AnimationWriter(str(tmp_path / "fit.gif")), steps=3, task=shy)
    assert list(tmp_path.iterdir()) == []


class BatchCounter(Metric):
    """Counts its updates."""

    def __init__(self) -> None:
        super().__init__()
        self.add_state("seen", torch.tensor(0.0), dist_reduce_fx="sum")

    def update(self, prediction: torch.Tensor, target: torch.Tensor) -> None:
        self.seen += 1

    def compute(self) -> torch.Tensor:
        return self.seen


def test_a_report_scores_no_batch_twice(tmp_path: Path) -> None:
    toy = ToyTask(
        losses={"t": LossTerm(losses.SquaredError())},
        optimizer=partial(torch.optim.SGD, lr=0.1),
        metrics={"seen": MetricTerm(BatchCounter()), "psnr": MetricTerm(metrics.psnr)},
    )
    silent = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)
    trainer = Trainer(
        accelerator="cpu",
        callbacks=[BatchReport(str(tmp_path / "frames.csv"), str(tmp_path / "sequence.gif"))],
        **silent,
    )
    trainer.test(toy, datamodule=ToyData(), verbose=False)
    assert trainer.callback_metrics["test/seen"] == 1
    row = next(csv.DictReader((tmp_path / "frames.csv").read_text().splitlines()))
    assert float(row["psnr"]) == pytest.approx(float(trainer.callback_metrics["test/psnr"]))


class OneOfTwo:
    """A strategy of two processes; the other one's values are larger by 2."""

    def reduce(self, value: torch.Tensor, reduce_op: str) -> torch.Tensor:
        assert reduce_op == "mean"
        return value + 1


def steps_until_settled(values: list[float], **settings: Any) -> int:
    stop = StopWhenSettled("train/loss", **settings)
    trainer = SimpleNamespace(
        callback_metrics={}, should_stop=False, is_global_zero=True, global_step=0, strategy=OneOfTwo()
    )
    for step, value in enumerate(values):
        trainer.callback_metrics["train/loss"] = torch.tensor(value)
        stop.on_train_batch_end(trainer, None, None, None, step)  # type: ignore[arg-type]
        if trainer.should_stop:
            return step
    return len(values)


@pytest.mark.parametrize("sign", [0.0, -10.0])
def test_a_fit_settles_whatever_the_sign_of_its_loss(sign: float) -> None:
    """Two gains, then losses that only grow worse."""
    assert steps_until_settled([sign + x for x in (5.0, 4.0, 3.0, 3.005, 3.006, 3.007, 3.008)], patience=3) == 5


def test_a_fit_that_settles_where_it_began_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    steps_until_settled([5.0, 4.9, 4.9, 4.9, 4.9], patience=2)
    assert "train/loss has settled" in (said := capsys.readouterr().out)
    assert "hardly fell" in said
    steps_until_settled([5.0, 1.0, 1.0, 1.0, 1.0], patience=2)
    assert "hardly" not in capsys.readouterr().out


def test_processes_stop_together() -> None:
    assert steps_until_settled([2.0, 1.0, 0.4, 0.0], below=1.5) == 2


def test_a_monitor_that_is_not_logged_is_named() -> None:
    stop = StopWhenSettled("train/los")
    trainer = SimpleNamespace(callback_metrics={"train/loss": torch.tensor(1.0)}, should_stop=False)
    with pytest.raises(UserError, match=r"no 'train/los'; there are: train/loss"):
        stop.on_train_batch_end(trainer, None, None, None, 0)  # type: ignore[arg-type]


def test_the_clock_waits_for_the_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    waited = []
    monkeypatch.setattr(torch.cuda, "synchronize", waited.append)
    module, timer = SimpleNamespace(device=torch.device("cuda", 1)), StepTimer()
    for step in range(2):
        timer.on_train_batch_start(None, module, None, step)  # type: ignore[arg-type]
        timer.on_train_batch_end(None, module, None, None, step)  # type: ignore[arg-type]
    assert waited[-2:] == [module.device] * 2
    assert timer.median_ms() is not None


def test_mesh_files_in_unknown_formats_are_refused_before_the_fit(tmp_path: Path) -> None:
    assert MeshLogger(str(tmp_path), formats=["PLY", ".glb"]).formats == ["ply", "glb"]
    with pytest.raises(UserError, match="no mesh format ends in doc; known: glb"):
        MeshLogger(str(tmp_path), formats=["ply", "doc"])
