"""The processes of one run that fit together: who may, how they are started, and that none outlives the run."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch import LightningDataModule, Trainer
from lightning.pytorch.utilities.rank_zero import rank_zero_only
from omegaconf import read_write

from rendra_lab.errors import UserError
from rendra_lab.signals import Interrupted

_FAREWELL_S = 10.0  # that a process has to end by itself after a run that all of them ended together
_NOTICE_S = 2.0  # until the exit code of a failed process is known
_OWN_VARIABLES = ("MASTER_ADDR", "MASTER_PORT", "NODE_RANK", "LOCAL_RANK", "WORLD_SIZE")


class ProcessError(ValueError):
    """Another process of the run failed, and this one had to end."""


def is_first_process() -> bool:
    """Whether this process is the one of its run that writes, prints and reports."""
    return getattr(rank_zero_only, "rank", 0) in (0, None)


def check_divisible(trainer: Trainer, data: LightningDataModule) -> None:
    """UserError where several processes would do the same work: the data do not divide their steps."""
    if trainer.world_size > 1 and not getattr(data, "is_divisible", False):
        raise UserError(
            f"this task is one whole problem, whose steps {trainer.world_size} processes cannot divide among them: "
            "leave out trainer=ddp, or say trainer.devices=1"
        )


@contextlib.contextmanager
def own_processes(trainer: Trainer, folder: Path) -> Iterator[None]:
    """Distributed processes of one run begin and end with it.

    Lightning starts them with this process's command line. In a sweep that would repeat the whole sweep in each
    of them; here they get the command of the one job, and its folder.

    Raises:
        ProcessError: another process failed, which is the reason why this one cannot go on.
    """
    known = HydraConfig.get() if HydraConfig.initialized() else None
    arguments, environment, threads = sys.argv, dict(os.environ), torch.get_num_threads()
    if known is not None and known.mode == RunMode.MULTIRUN:
        hydra_own = [item for item in known.overrides.hydra if not item.startswith("hydra.mode=")]
        sys.argv = [arguments[0], *known.overrides.task, *hydra_own]
        with read_write(known):  # type: ignore[arg-type]
            known.run.dir = str(folder)
    patience_s = 0.0
    try:
        yield
        patience_s = _FAREWELL_S
    except Interrupted:
        patience_s = _FAREWELL_S
        raise
    except Exception as error:
        if failed := _failed(trainer):
            raise ProcessError(f"process {failed} of {trainer.world_size} failed, and its run with it") from error
        raise
    finally:
        sys.argv = arguments
        for process in _started(trainer):
            _end(process, patience_s)
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
        _restore(environment)
        torch.set_num_threads(threads)


def _started(trainer: Trainer) -> list[subprocess.Popen]:
    return getattr(trainer.strategy.launcher, "procs", [])


def _failed(trainer: Trainer) -> int | None:
    """The rank of a process that has failed, if one has; its connections end a little before it does."""
    end = time.monotonic() + _NOTICE_S if _started(trainer) else 0.0
    while True:
        for rank, process in enumerate(_started(trainer), start=1):
            if process.poll():
                return rank
        if time.monotonic() >= end:
            return None
        time.sleep(0.05)


def _end(process: subprocess.Popen, patience_s: float) -> None:
    """Waits for a process of a run that is over, and ends it; then nobody may judge it by its exit code any more.

    Lightning watches that code every five seconds and kills this process too when it is not 0, in the middle of
    the next job of a sweep.
    """
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=patience_s)
    if process.poll() is None:
        process.kill()  # it writes nothing, and may hang where no other signal reaches it
        process.wait()
    process.returncode = 0


def _restore(environment: dict[str, str]) -> None:
    for name in _OWN_VARIABLES:
        os.environ.pop(name, None)
        if name in environment:
            os.environ[name] = environment[name]
