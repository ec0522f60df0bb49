"""The launcher of every sweep: consults the ledger, and lets one of Hydra's launchers run what is missing.

Hydra takes launchers from the package `hydra_plugins` alone, and imports all of it at every start: stays light.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus, filter_overrides
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, flag_override

from rendra_lab.errors import UserError
from rendra_lab.ledger import JobState, Ledger
from rendra_lab.report import say, short_path
from rendra_lab.sweep import job_folder
from rendra_lab.sweep_job import SweepJob, SweepOptions, job_key

_POLL_S = 2.0  # between two looks at jobs that run elsewhere
_SUBMITIT_AT_ONCE = 2  # it starts all that it gets at the same moment


class LedgerLauncher(Launcher):
    """Runs the jobs that the ledger of the sweep folder does not know as done.

    `rendra_lab.sweep.SweepFolder` puts it in front of the launcher that the configuration chose.

    Args:
        inner: the configuration of that launcher, which starts the processes.
    """

    def __init__(self, inner: DictConfig) -> None:
        self._inner_config = inner
        self._ledger: Ledger | None = None

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Takes what Hydra gives; UserError where `sweep` of the configuration cannot be."""
        if any(item.startswith("hydra.sweep.subdir=") for item in config.hydra.overrides.hydra):
            raise UserError("hydra.sweep.subdir: the folders of jobs are named by the ledger of the sweep")
        self._folder = Path(config.hydra.sweep.dir).absolute()
        unsaid = config.hydra.job.config.override_dirname.exclude_keys
        self._unsaid = ("sweep.", *(f"{key}=" for key in unsaid))
        # a search has asked for a point and been told that it failed; a grid just has a hole
        self._searches = not str(config.hydra.sweeper._target_).endswith(".BasicSweeper")
        options = SweepOptions.of(config)
        self._at_once, neighbours = _at_once(self._inner_config, options.at_once)
        self._job = SweepJob(task_function, self._folder, options, threads=_share_of_processors(neighbours))
        with flag_override(config.hydra, ["readonly", "struct"], False):
            config.hydra.launcher = self._inner_config
        self._inner = Plugins.instance().instantiate_launcher(hydra_context, self._job, config)

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Brings every job to its end, here or wherever else the sweep is worked on; answers from the ledger."""
        try:
            ledger = self._opened()
            batch = [(job_key(overrides), filter_overrides(overrides)) for overrides in job_overrides]
            jobs = ledger.enqueue([(key, list(overrides)) for key, overrides in batch], self._name)
            if not self._searches:
                _announce(jobs, self._folder)
            self._drain({job.key: job for job in jobs}, ledger)
        except KeyboardInterrupt:
            raise SystemExit(130) from None
        states = ledger.states()
        return [self._answer(states[job.key]) for job in jobs]

    def _opened(self) -> Ledger:
        if self._ledger is None:
            self._ledger = self._job.ledger()
            self._job.since = len(self._ledger.events())
            self._ledger.append("command", host=platform.node(), pid=os.getpid())
        return self._ledger

    def _name(self, number: int, overrides: list[str]) -> str:
        shown = sorted(item for item in overrides if not item.lstrip("+~").startswith(self._unsaid))
        return job_folder(number, ",".join(shown))

    def _drain(self, jobs: dict[str, JobState], ledger: Ledger) -> None:
        alone: set[str] = set()  # jobs whose process vanished: run again, each by itself
        waited = False
        while True:
            states = ledger.states()
            if self._job.stopped(states):
                return
            open_jobs = {key: states[key] for key in jobs if not self._is_over(states[key])}
            free = {key: ledger.free_after(state) for key, state in open_jobs.items()}
            ready = [key for key, after in free.items() if after is not None]
            if ready:
                crowd = [key for key in ready if key not in alone][: self._at_once]
                self._job.free_after = {key: after for key, after in free.items() if after is not None}
                alone |= self._run([states[key] for key in crowd or ready[:1]], ledger)
            elif not open_jobs:
                return
            else:
                if not waited:
                    say(f"waiting for jobs that run elsewhere: {_places(open_jobs.values())}")
                waited = True
                time.sleep(_POLL_S)

    def _is_over(self, state: JobState) -> bool:
        """Done, or failed as often as it may; a command gives each failure of earlier ones another chance."""
        since = 0 if self._searches else self._job.since
        failures = sum(position >= since for position in state.failures)
        return state.status == "done" or failures > self._job.options.retries

    def _run(self, jobs: list[JobState], ledger: Ledger) -> set[str]:
        """Launches jobs; returns those whose process vanished. A second time, alone, that is a failure."""
        overrides = [
            [*job.overrides, f"hydra.sweep.subdir={_quoted(job.folder)}", "hydra.output_subdir=null"] for job in jobs
        ]
        before = len(ledger.events())
        broken = None
        try:
            self._inner.launch(overrides, initial_job_idx=jobs[0].number)
        except Exception as error:  # a pool of processes breaks with its first dead one
            broken = error
        vanished = set()
        states = ledger.states()
        for state in (states[job.key] for job in jobs):
            last = ledger.free_after(state)
            if state.status == "running" and last is not None and last not in state.ended:
                ledger.append("lost", job=state.key, claim=last)
                vanished.add(state.key)
                if len(jobs) == 1:
                    reason = "its process was killed, or ran out of memory"
                    ledger.append("failed", job=state.key, claim=last, error=reason)
        if len(ledger.events()) == before:
            if broken is not None:
                raise broken
            time.sleep(_POLL_S)  # others were faster with every job
        return vanished

    def _answer(self, state: JobState) -> JobReturn:
        """What a sweeper may see: a grid goes on after a failure, a search is told of it."""
        if state.status == "done" or not self._searches:
            return JobReturn(state.overrides, status=JobStatus.COMPLETED, _return_value=state.value)
        error = RuntimeError(state.error or f"the job is {state.status}")
        return JobReturn(state.overrides, status=JobStatus.FAILED, _return_value=error)


def _at_once(inner: DictConfig, wanted: int | None) -> tuple[int | None, int | None]:
    """How many jobs the launcher gets at a time, and how many of them share this machine; None for no limit."""
    kind = str(inner._target_).rpartition(".")[2]
    if kind == "LocalLauncher":
        count = wanted or _SUBMITIT_AT_ONCE
        return count, count
    return wanted, int(inner.n_jobs) if kind == "JoblibLauncher" else None


def _share_of_processors(jobs: int | None) -> int | None:
    """Threads of each of several jobs on this machine (-1: one a processor); None for a job that has it alone."""
    if jobs is None:
        return None
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, count // jobs) if jobs > 0 else 1


def _quoted(folder: str) -> str:
    return f"'{folder}'"  # its characters are harmless, but `=` is not


def _announce(jobs: list[JobState], folder: Path) -> None:
    done = sum(job.status == "done" for job in jobs)
    known = f", {done} of them done" if done else ""
    say(f"sweep     {short_path(folder)}: {len(jobs)} jobs{known}")


def _places(jobs: Iterable[JobState]) -> str:
    return "; ".join(f"job {job.number} on {job.holder or 'another machine'}" for job in jobs)
