"""One job of a sweep, in whatever process it runs: claimed, run or resumed, and entered into the ledger.

Unpickled in the workers of parallel sweeps: stays light until a job is really run.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, QuotedString, ValueType
from omegaconf import DictConfig, OmegaConf, read_write

from rendra_lab.errors import UserError
from rendra_lab.ledger import Claim, JobState, Ledger
from rendra_lab.report import write_text

log = logging.getLogger(__name__)

# Settings that say where or how a sweep runs, not what its jobs are.
_BESIDE_THE_POINT = ("output_root", "run_dir", "threads")


def job_key(overrides: Sequence[str]) -> str:
    """What makes a job that job: a hash of its settings, whatever their order, quotes and spelling of numbers."""
    settings = {}
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.get_key_element()
        if not override.is_hydra_override() and key not in _BESIDE_THE_POINT and not key.startswith("sweep."):
            settings[key] = swept_values(override) if override.is_sweep_override() else _plain(override.value())
    canonical = json.dumps(settings, sort_keys=True)
    return hashlib.sha256(canonical.encode()).hexdigest()[:12]


@dataclass(frozen=True)
class SweepOptions:
    """`sweep` of the configuration.

    Args:
        fresh: whether to begin a new folder instead of going on.
        retries: how often one command tries a failed job again.
        at_once: the most jobs that the launcher gets at a time; None for all.
        stop_on_failure: whether no further job begins after a failure.
        heartbeat_s: seconds between two signs of life of a running job.
        stale_s: seconds without one after which a job of another machine is taken over.
    """

    fresh: bool = False
    retries: int = 0
    at_once: int | None = None
    stop_on_failure: bool = False
    heartbeat_s: float = 10.0
    stale_s: float = 120.0

    def __post_init__(self) -> None:
        for name in ("fresh", "stop_on_failure"):
            if not isinstance(getattr(self, name), bool):
                raise UserError(f"sweep.{name} must be true or false, got {getattr(self, name)!r}")
        if not isinstance(self.retries, int) or isinstance(self.retries, bool) or self.retries < 0:
            raise UserError(f"sweep.retries must be a whole number from 0 on, got {self.retries!r}")
        if self.at_once is not None and (not isinstance(self.at_once, int) or self.at_once < 1):
            raise UserError(f"sweep.at_once must be a whole number from 1 on, or null, got {self.at_once!r}")
        for name in ("heartbeat_s", "stale_s"):
            value = getattr(self, name)
            if not isinstance(value, (int, float)) or isinstance(value, bool) or not value > 0:
                raise UserError(f"sweep.{name} must be a positive number of seconds, got {value!r}")
        if self.stale_s < 2 * self.heartbeat_s:
            raise UserError(
                f"sweep.stale_s={self.stale_s} must be twice sweep.heartbeat_s={self.heartbeat_s} or more"
            )

    @classmethod
    def of(cls, config: DictConfig) -> SweepOptions:
        """Those of a configuration; the defaults where it has none."""
        node = OmegaConf.select(config, "sweep")
        return cls() if node is None else cls(**OmegaConf.to_container(node, resolve=True))  # type: ignore[arg-type]


@dataclass
class SweepJob:
    """What Hydra calls for every job of a sweep instead of the program itself. Failures go into the ledger.

    Args:
        program: the program's main function, of a configuration.
        folder: of the sweep.
        options: of the sweep.
        since: the length of the ledger when this command began.
        threads: of each job, where the configuration leaves them open.
        free_after: for each job the last claim on it that the parent has seen end.
    """

    program: Callable[[DictConfig], Any]
    folder: Path
    options: SweepOptions
    since: int = 0
    threads: int | None = None
    free_after: dict[str, int] = field(default_factory=dict)

    def __call__(self, cfg: DictConfig) -> Any:
        """Runs the job, unless someone else runs it or has run it; returns what the program returned."""
        ledger = self.ledger()
        state, claim = self._claimed(ledger, job_key(HydraConfig.get().overrides.task))
        if claim is None:
            return None
        with claim:
            return self._run(cfg, state, claim)

    def ledger(self) -> Ledger:
        """The ledger of the sweep."""
        return Ledger(self.folder, self.options.stale_s, self.options.heartbeat_s)

    def stopped(self, states: dict[str, JobState]) -> bool:
        """Whether a failure of this command's time keeps further jobs from beginning."""
        failures = [position for state in states.values() for position in state.failures]
        return self.options.stop_on_failure and any(position >= self.since for position in failures)

    def _claimed(self, ledger: Ledger, key: str) -> tuple[JobState, Claim | None]:
        states = ledger.states()
        state = states[key]
        if state.status == "done" or self.stopped(states):
            return state, None
        after = ledger.free_after(state)
        while after is None and "SLURM_RESTART_COUNT" in os.environ:  # the claim may be that of this job, preempted
            time.sleep(self.options.heartbeat_s)
            after = ledger.free_after(ledger.states()[key])
        after = self.free_after.get(key) if after is None else after
        claim = None if after is None else ledger.claim(state, after)
        state = ledger.states()[key]
        if claim is not None and state.status == "done":  # between the look at the ledger and the claim
            with claim:
                claim.tell("released")
            return state, None
        return state, claim

    def _run(self, cfg: DictConfig, state: JobState, claim: Claim) -> Any:
        known = HydraConfig.get()
        folder = Path(known.runtime.output_dir)
        finished = _finished(folder)
        if finished is not None:  # killed between its last act and the line about it
            claim.tell("done", value=finished["metrics"].get(finished.get("optimized_metric")), **_numbers(folder))
            return None
        with read_write(known):  # type: ignore[arg-type]
            known.job.num = state.number
        _write_configuration(cfg, folder)
        self._prepare(cfg, folder)
        claim.tell("running", resumed=OmegaConf.select(cfg, "ckpt_path"))
        try:
            value = self.program(cfg)
        except Exception as error:
            log.info("job %d failed", state.number, exc_info=True)
            reason = f"{type(error).__name__}: {error}"[:2000]
            claim.tell("failed", error=reason, traceback=traceback.format_exc()[-8000:])
            return None
        except BaseException as error:
            if claim.lost:
                log.warning("job %d was taken over by another machine while this one slept", state.number)
                return None
            claim.tell("interrupted", error=f"{type(error).__name__}: {error}")
            raise
        claim.tell("done", value=_number(value), **_numbers(folder))
        return value

    def _prepare(self, cfg: DictConfig, folder: Path) -> None:
        """Points the configuration to the job's own newest checkpoint, and divides the threads."""
        if "threads" in cfg and cfg.threads is None and self.threads is not None:
            cfg.threads = self.threads
        if "ckpt_path" in cfg and any(folder.glob("checkpoints/*.ckpt")):
            from rendra_lab.checkpoints import newest_checkpoint

            try:
                cfg.ckpt_path = str(newest_checkpoint(folder).path)
            except UserError as error:
                log.warning("the job begins anew: %s", error)


def _write_configuration(cfg: DictConfig, folder: Path) -> None:
    """What Hydra writes, but only once the job is claimed."""
    overrides = HydraConfig.get().overrides.task
    for name, content in (("config", cfg), ("hydra", HydraConfig.instance().cfg), ("overrides", overrides)):
        write_text(folder / ".hydra" / f"{name}.yaml", OmegaConf.to_yaml(content))


def _finished(folder: Path) -> dict[str, Any] | None:
    """The record of a run that came to its end in this folder."""
    try:
        record = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if record.get("status") == "ok" else None


def _numbers(folder: Path) -> dict[str, Any]:
    record = _finished(folder)
    return {} if record is None else {"metrics": record["metrics"]}


def _number(value: Any) -> float | None:
    """A returned number; None for whatever nobody can sort by."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def swept_values(override: Override) -> list[str] | str:
    """What an override of a sweep goes through: values, or an interval or a pattern as it was written."""
    if override.is_discrete_sweep() and override.value_type != ValueType.GLOB_CHOICE_SWEEP:
        return list(override.sweep_string_iterator())
    return str(override.input_line).partition("=")[2]


def _plain(value: Any) -> Any:
    """The value of an override without the way in which it was written."""
    if isinstance(value, QuotedString):
        return value.text
    if isinstance(value, dict):
        return {str(_plain(key)): _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return value if isinstance(value, (bool, int, float, type(None))) else str(value)
