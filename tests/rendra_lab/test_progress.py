"""What is said about the time that a fit takes, by a clock that the tests turn."""

import logging
from datetime import timedelta
from functools import partial
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, Trainer
from rendra_lab_toy import ToyBatch, ToyData, ToyTask

from rendra_lab import losses, progress
from rendra_lab.progress import Forecast, Pace, Progress, clock_time, seconds_left
from rendra_lab.terms import LossTerm


class Clock:
    """Every training step takes so many seconds of it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
        self.now, self.seconds = 0.0, seconds
        monkeypatch.setattr(progress, "perf_counter", lambda: self.now)


class ClockedTask(ToyTask):
    """Lets the clock go on, and logs a PSNR."""

    clock: Clock | None = None

    def training_step(self, batch: ToyBatch, batch_idx: int) -> torch.Tensor:
        if self.clock is not None:
            self.clock.now += self.clock.seconds
        self.log("train/psnr", 21.5, prog_bar=True, batch_size=1)
        return super().training_step(batch, batch_idx)


def fit(*callbacks: Callback, steps: int, clock: Clock | None = None, **settings: Any) -> Trainer:
    task = ClockedTask(
        losses={"texture": LossTerm(losses.SquaredError())}, optimizer=partial(torch.optim.SGD, lr=0.1)
    )
    task.clock = clock
    silent: dict[str, Any] = {"logger": False, "enable_checkpointing": False, "enable_model_summary": False}
    given: dict[str, Any] = {"max_steps": steps, "max_epochs": -1, "enable_progress_bar": False, **silent, **settings}
    trainer = Trainer(accelerator="cpu", callbacks=list(callbacks), **given)
    trainer.fit(task, datamodule=ToyData(steps=1000))
    return trainer


def test_lines_tell_steps_speed_losses_psnr_and_time_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fit(Progress(line_s=0.0), steps=12, clock=Clock(monkeypatch, 0.5), enable_progress_bar=True)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 12
    assert lines[0].startswith("step 1/12  ")
    assert "left" not in lines[0]  # the first step compiles: nothing is known yet
    assert lines[3].startswith("step 4/12  2.0/s  ")
    assert "psnr 21.5" in lines[3]
    assert "loss_texture" in lines[3]
    assert lines[3].endswith("  left 0:04")
    assert lines[-1].endswith("  left 0:00")


def test_time_left_respects_the_time_limit(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fit(
        Progress(line_s=0.0), steps=4, clock=Clock(monkeypatch, 100.0), enable_progress_bar=True,
        max_time=timedelta(seconds=90),
    )  # fmt: skip
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].rsplit("left ", 1)[1] in ("1:30", "1:29", "1:28")  # by steps it would be 1:40 and more


def test_a_pace_forgets_the_first_step_and_what_is_long_ago() -> None:
    pace = Pace(window=3)
    assert pace.seconds_per_step() is None
    for step, now in ((1, 50.0), (2, 51.0)):
        pace.tick(step, now)
    assert pace.seconds_per_step() == 1.0
    for step, now in ((3, 54.0), (4, 57.0), (5, 60.0)):
        pace.tick(step, now)
    assert pace.seconds_per_step() == 3.0


@pytest.mark.parametrize(("seconds", "shown"), [(0, "0:00"), (59.6, "1:00"), (125, "2:05"), (3725, "1:02:05")])
def test_times_are_written_like_a_clock(seconds: float, shown: str) -> None:
    assert clock_time(seconds) == shown


def warnings_of(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_a_fit_of_hours_says_so_after_a_few_steps(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch, 0.4)
    seen_at: list[int] = []
    monkeypatch.setattr(progress.log, "warning", lambda *words: seen_at.append(round(clock.now / 0.4)) or log(*words))
    log = logging.getLogger("test").warning
    with caplog.at_level(logging.WARNING):
        fit(Forecast(longest_min=30), StopAt(8), steps=30_000, clock=clock)
    (said,) = warnings_of(caplog)
    assert seen_at == [6]
    assert "about 3:20:00 (h:mm:ss)" in said
    assert "30000 steps of 0.4 s" in said
    assert "trainer.max_steps=4500" in said
    assert "trainer.max_time=00:00:30:00" in said


def test_very_long_steps_are_told_at_once(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    with caplog.at_level(logging.WARNING):
        fit(Forecast(), StopAt(2), steps=1000, clock=Clock(monkeypatch, 48.0))
    assert "about 13:20:00" in warnings_of(caplog)[0]


class StopAt(Callback):
    """Ends a fit."""

    def __init__(self, step: int) -> None:
        self.step = step

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        trainer.should_stop = trainer.global_step >= self.step


class SlowerFrom(Callback):
    """Lets steps become longer."""

    def __init__(self, clock: Clock, step: int, seconds: float) -> None:
        self.clock, self.step, self.seconds = clock, step, seconds

    def on_train_batch_start(self, trainer: Trainer, *_: Any) -> None:
        if trainer.global_step == self.step:
            self.clock.seconds = self.seconds


def test_steps_that_grow_longer_are_noticed_later(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch, 0.01)
    with caplog.at_level(logging.WARNING):
        fit(Forecast(), SlowerFrom(clock, 20, 1.0), StopAt(60), steps=10_000, clock=clock)
    assert len(warnings_of(caplog)) == 1


@pytest.mark.parametrize("settings", [{}, {"max_time": timedelta(minutes=5)}])
def test_short_fits_and_limited_ones_need_no_warning(
    settings: dict[str, Any], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = 30_000 if settings else 2000
    with caplog.at_level(logging.WARNING):
        fit(Forecast(), StopAt(30), steps=steps, clock=Clock(monkeypatch, 0.5), **settings)
    assert not warnings_of(caplog)


def test_a_fit_without_an_end_has_no_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = fit(StopAt(1), steps=-1)
    pace = Pace()
    pace.tick(1, 0.0)
    pace.tick(2, 1.0)
    assert seconds_left(trainer, pace) is None


def test_the_end_of_time_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    trainer = fit(Forecast(), steps=1_000_000, max_time=timedelta(milliseconds=200))
    assert 1 < trainer.global_step < 1_000_000
    assert f"trainer.max_time ended the fit after step {trainer.global_step} of 1000000" in capsys.readouterr().out
