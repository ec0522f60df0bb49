"""How far a fit is, how fast it goes, how long it will take; and a word in time when that is very long."""

from __future__ import annotations

import logging
import sys
from collections import deque
from time import perf_counter
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar, Timer

from rendra_lab import report
from rendra_lab.settings import Amount

log = logging.getLogger(__name__)


class Pace:
    """How long steps take now: the mean of the last ones.

    Args:
        window: steps that are looked at. The first step of a fit, which compiles, is never among them.
    """

    def __init__(self, window: int = 200) -> None:
        self._ends: deque[tuple[int, float]] = deque(maxlen=window)

    def tick(self, step: int, now: float) -> None:
        """Notes that so many steps were done at this time, in seconds."""
        self._ends.append((step, now))

    def seconds_per_step(self) -> float | None:
        """None before the end of the second step."""
        if not self._ends or self._ends[-1][0] == self._ends[0][0]:
            return None
        (first, begin), (last, end) = self._ends[0], self._ends[-1]
        return (end - begin) / (last - first)


def seconds_left(trainer: Trainer, pace: Pace) -> float | None:
    """Until the last step at this pace, or until `trainer.max_time` where that is sooner; None: not known."""
    end, each = _end_of(trainer), pace.seconds_per_step()
    by_steps = None if end is None or each is None else max(0, end - trainer.global_step) * each
    limits = [seconds for seconds in (by_steps, _time_limit(trainer)) if seconds is not None]
    return min(limits) if limits else None


def clock_time(seconds: float) -> str:
    """Minutes and seconds as 2:05, with hours as 1:02:05."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


class Progress(ProgressBar):
    """Steps, losses, speed and time left: a live line in a terminal, a printed line now and then elsewhere.

    Shows what a task logs with `prog_bar=True`: its losses, and `train/psnr` where there is one.

    Args:
        refresh_s: seconds between drawings in a terminal.
        line_s: seconds between lines where the output is no terminal.
    """

    def __init__(self, refresh_s: float = 0.1, line_s: float = 10.0) -> None:
        super().__init__()
        self.interval_s = refresh_s if sys.stdout.isatty() else line_s
        self._enabled = True
        self._bar: Any = None
        self._pace = Pace()
        self._drawn = 0.0

    def disable(self) -> None:
        """Lightning's switch: says nothing from now on."""
        self._enabled = False

    def enable(self) -> None:
        """Lightning's switch: speaks again."""
        self._enabled = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Opens the line."""
        self._pace = Pace()
        self._drawn = perf_counter()
        if self._enabled and sys.stdout.isatty():
            self._bar = _open_bar(_end_of(trainer), trainer.global_step)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Draws, if enough time has passed since the last drawing."""
        now = perf_counter()
        self._pace.tick(trainer.global_step, now)
        if self._enabled and now - self._drawn >= self.interval_s:
            self._drawn = now
            self._draw(trainer)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draws the end and closes the line."""
        if self._bar is not None:
            self._draw(trainer)
        self._close()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Gives the terminal back."""
        self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _draw(self, trainer: Trainer) -> None:
        numbers = {name.removeprefix("train/"): value for name, value in trainer.progress_bar_metrics.items()}
        text = "  ".join(f"{name} {float(value):.4g}" for name, value in numbers.items())
        seconds, each = seconds_left(trainer, self._pace), self._pace.seconds_per_step()
        left = "" if seconds is None else f"left {clock_time(seconds)}"
        step = trainer.global_step
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=step, numbers=text, left=left)
            self._bar.refresh()
            return
        end = _end_of(trainer)
        speed = f"{1 / each:.1f}/s" if each else ""
        words = [f"step {step}{'' if end is None else f'/{end}'}", speed, text, left]
        sys.stdout.write("  ".join(word for word in words if word) + "\n")
        sys.stdout.flush()


class Forecast(Callback):
    """Warns within the first seconds of a fit that will take long, and says where `trainer.max_time` ended one.

    The first look is after five warm steps, or after the first one when steps are very long. As steps may grow
    longer, it looks again whenever twice as many are done, until it has warned.

    Args:
        longest_min: minutes from which on a fit is worth a warning.
    """

    def __init__(self, longest_min: Amount = 30.0) -> None:
        self.longest_min = longest_min
        self._pace = Pace()
        self._begun = (0, 0.0)
        self._next_look = 0
        self._has_warned = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Starts the clock."""
        self._pace = Pace()
        self._begun = (trainer.global_step, perf_counter())
        self._next_look = trainer.global_step + 6
        self._has_warned = False

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Looks, if it is time."""
        if self._has_warned or not trainer.is_global_zero:
            return
        now, step = perf_counter(), trainer.global_step
        self._pace.tick(step, now)
        each = self._pace.seconds_per_step()
        if each is not None and (step >= self._next_look or each > 2):
            self._next_look = self._begun[0] + 2 * max(step - self._begun[0], 3)
            self._look(trainer, each, now - self._begun[1])

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Says that time was up, where it was."""
        limit, end = _time_limit(trainer), _end_of(trainer)
        if limit is not None and limit <= 0 and trainer.is_global_zero:
            of = f" of {end}" if end else ""
            report.say(f"trainer.max_time ended the fit after step {trainer.global_step}{of}")

    def _look(self, trainer: Trainer, each: float, passed: float) -> None:
        left = seconds_left(trainer, self._pace)
        if left is None or passed + left <= 60 * self.longest_min:
            return
        self._has_warned = True
        end = _end_of(trainer)
        steps = "" if end is None else f", {end - self._begun[0]} steps of {each:.3g} s"
        fewer = f"trainer.max_steps={max(1, int(60 * self.longest_min / each))}"
        log.warning(
            "this fit will take about %s (h:mm:ss) on this machine%s; for less: fewer steps (%s), a time limit "
            "(trainer.max_time=00:00:%d:00), or a smaller configuration",
            clock_time(passed + left), steps, fewer, self.longest_min,
        )  # fmt: skip


def _end_of(trainer: Trainer) -> int | None:
    total = trainer.estimated_stepping_batches
    return int(total) if 0 < total < float("inf") else None


def _time_limit(trainer: Trainer) -> float | None:
    """Seconds until `trainer.max_time`; None where there is no such limit."""
    timers = [callback for callback in trainer.callbacks if isinstance(callback, Timer)]  # type: ignore[attr-defined]
    remaining = [seconds for timer in timers if (seconds := timer.time_remaining()) is not None]
    return max(0.0, min(remaining)) if remaining else None


def _open_bar(end: int | None, step: int) -> Any:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = (
        BarColumn(30),
        MofNCompleteColumn(),
        TextColumn("{task.fields[left]}"),
        TextColumn("{task.fields[numbers]}"),
    )
    bar = Progress(*columns, auto_refresh=False)
    bar.add_task("", total=end, completed=step, numbers="", left="")
    bar.start()
    return bar
