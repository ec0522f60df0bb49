"""How a fit ends early and what it leaves: a checkpoint of the last finished step, one line, and the exit code.

SIGINT and SIGTERM end a run after the step that is running, or after the validation batch; before the first step and
during the test at once. SIGUSR1 does the same, and within a SLURM job (`#SBATCH --signal=SIGUSR1@90`) has the job
requeued: the same command then goes on from that checkpoint by itself.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.utilities.exceptions import SIGTERMException

from rendra_lab import report, signals
from rendra_lab.checkpoint_io import SaveError, save_weights
from rendra_lab.signals import Interrupted

_INTERACTIVE_JOBS = ("bash", "interactive")  # the names that Lightning knows such a job by


class LastStepKeeper(Checkpoint):
    """Saves the state after the last step of a fit, be it finished, broken or interrupted.

    Beside the checkpoint lie its weights alone, `weights.safetensors`.

    Lightning calls it after all callbacks that save nothing, so that each of them has seen the step.

    Args:
        path: of the checkpoint.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self._begun_at = 0
        self._seen = 0
        self._in_validation = False
        self._patience = contextlib.ExitStack()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Notes where the fit begins; from here on signals wait for the end of a step."""
        self._begun_at = self._seen = trainer.global_step
        signals.take_over()
        self._patience.enter_context(signals.patient())

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Ends the fit, with a checkpoint, if a signal has come to any of its processes."""
        if trainer.global_step == self._seen:  # gradients are still being gathered
            return
        self._seen = trainer.global_step
        if number := _wanted(trainer):
            self._save(trainer)
            raise Interrupted(number)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Signals are ours again, not Lightning's."""
        signals.take_over()

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: Any
    ) -> None:
        """Ends the fit within its validation; several processes first finish it, as each has its own batches."""
        number = signals.waiting()
        if number and trainer.world_size == 1 and not trainer.sanity_checking and trainer.state.fn == "fit":
            self._in_validation = True
            self._save(trainer)
            raise Interrupted(number)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """A validation that was cut off begins anew: what its first batches scored is in no checkpoint."""
        if self._in_validation:
            progress = checkpoint["loops"]["fit_loop"]["epoch_loop.val_loop.batch_progress"]
            progress["current"] = dict.fromkeys(progress["current"], 0)
            done = progress["total"]["started"] - 1  # Lightning knows by this that a batch was under way
            progress["total"].update(processed=done, completed=done)

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Signals are ours again, not Lightning's."""
        signals.take_over()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Saves the end; a signal that came after the last step ends the run here."""
        self._save(trainer)
        self._patience.close()
        if number := _wanted(trainer):
            raise Interrupted(number)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Saves what a broken fit has reached, if it made a step; alone, as other processes may be gone.

        A second Ctrl-C may have come in the middle of an update: then the checkpoint before stays the last one.
        """
        self._patience.close()
        made_a_step = trainer.training and trainer.global_step > self._begun_at
        if trainer.world_size == 1 and made_a_step and not isinstance(exception, Interrupted | SaveError):
            self._save(trainer)

    def _save(self, trainer: Trainer) -> None:
        with signals.patient(for_all=True):
            trainer.save_checkpoint(self.path)
            save_weights(trainer, Path(self.path).with_name("weights.safetensors"))


def _wanted(trainer: Trainer) -> int | None:
    """The number of the signal that any process of the run has got; all of them get the same answer."""
    number = signals.waiting() or 0
    if trainer.world_size > 1:
        wish = torch.tensor(number, device=trainer.strategy.root_device)
        torch.distributed.all_reduce(wish, op=torch.distributed.ReduceOp.MAX)
        number = int(wish)
    return number or None


def signal_of(error: BaseException) -> int | None:
    """The number of the signal that ended a run; None where it ended by something else."""
    if isinstance(error, SIGTERMException):
        return int(signal.SIGTERM)
    if isinstance(error, SaveError):  # whatever came before: what the run reached is not kept
        return None
    if stop := signals.behind(error):
        return stop.number
    stopped = isinstance(error, KeyboardInterrupt) or isinstance(error.__context__, KeyboardInterrupt)
    return int(signal.SIGINT) if stopped else None


def farewell(number: int, folder: Path, step: int, output_root: Path, overrides: Sequence[str]) -> str:
    """The last line of an interrupted run: what happened, and how it goes on. Has a SLURM job requeued if asked.

    Args:
        number: of the signal.
        folder: of the run.
        step: how many were made.
        output_root: where all runs lie.
        overrides: the command line of the run.
    """
    name, place = signal.Signals(number).name, report.short_path(folder)
    kept = (folder / "checkpoints" / "last.ckpt").is_file()
    line = f"interrupted by {name} after {step} steps; go on with ckpt_path={place}"
    if not kept:
        line = f"interrupted by {name} before the first step was done; there is nothing to go on from in {place}"
    if number != getattr(signal, "SIGUSR1", None) or slurm_job() is None:
        return line
    if kept:
        report.write_json(_note(output_root, overrides), {"folder": str(folder.resolve())})
    return f"{line}\n{_requeue()}"


def slurm_job() -> str | None:
    """The SLURM job that this process belongs to, as `scontrol` names it; None in an interactive one, or outside."""
    if os.environ.get("SLURM_JOB_NAME") in _INTERACTIVE_JOBS:
        return None
    if array := os.environ.get("SLURM_ARRAY_JOB_ID"):
        return f"{array}_{os.environ.get('SLURM_ARRAY_TASK_ID', '0')}"
    return os.environ.get("SLURM_JOB_ID")


def requeued_from(output_root: Path, overrides: Sequence[str]) -> str | None:
    """The folder of the run that this SLURM job made before it was requeued; None where it is new."""
    if slurm_job() is None or os.environ.get("SLURM_RESTART_COUNT", "0") == "0":
        return None
    note = _note(output_root, overrides)
    return json.loads(note.read_text(encoding="utf-8"))["folder"] if note.is_file() else None


def _note(output_root: Path, overrides: Sequence[str]) -> Path:
    command = hashlib.sha256("\0".join(overrides).encode()).hexdigest()[:12]
    return output_root / ".requeued" / f"{slurm_job()}_{command}.json"


def _requeue() -> str:
    job = slurm_job()
    try:
        answer = subprocess.run(
            ["scontrol", "requeue", str(job)], capture_output=True, text=True, timeout=60, check=False
        )
        problem = " ".join(answer.stderr.split()) if answer.returncode else None
    except (OSError, subprocess.TimeoutExpired) as error:
        problem = str(error)
    if problem is None:
        return f"SLURM job {job} is requeued and goes on from there"
    return f"SLURM job {job} could not be requeued ({problem}): submit it again with that ckpt_path"
