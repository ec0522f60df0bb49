"""Callbacks that keep their output bounded, and loggers that lose nothing."""

import csv
import itertools
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, Trainer
from PIL import Image
from rendra_lab_toy import ToyData, ToyTask

from rendra_lab import losses
from rendra_lab.base_task import BaseTask
from rendra_lab.callbacks import AnimationWriter, ImageLogger, Progress
from rendra_lab.loggers import CsvTable, TensorBoard
from rendra_lab.terms import LossTerm


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


def test_progress_is_lines_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    fit(Progress(line_s=0.0), steps=3, enable_progress_bar=True)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert lines[-1].startswith("step 3/3  ")
    assert "loss_texture" in lines[-1]


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
