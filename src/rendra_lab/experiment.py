"""The composition root: configuration in, run out. The only module that builds parts from Hydra's tree."""

from __future__ import annotations

import functools
import logging
import sys
import time
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning.pytorch import Callback, LightningDataModule, Trainer, seed_everything
from lightning.pytorch.callbacks import Checkpoint, ModelCheckpoint
from lightning.pytorch.utilities.model_helpers import is_overridden
from omegaconf import DictConfig, OmegaConf

from rendra_lab import html_report, interruptions, report, signals
from rendra_lab.base_task import BaseTask
from rendra_lab.callbacks import StepTimer
from rendra_lab.checkpoint_io import SafeCheckpointIO, describe
from rendra_lab.checkpoints import checkpoints_are_data, find_checkpoint, must_fit, read_weights
from rendra_lab.durable import sweep_leftovers
from rendra_lab.errors import UserError
from rendra_lab.loggers import LogKeeper, TensorBoard
from rendra_lab.nan_guard import NanGuard
from rendra_lab.processes import check_divisible, is_first_process, own_processes
from rendra_lab.random_state import RandomState
from rendra_lab.settings import check_run, rehearse
from rendra_lab.targets import check_targets

log = logging.getLogger(__name__)

# What Lightning says that a user can do nothing about.
_IDLE_WARNINGS = (
    r".*does not have many workers.*",
    r".*`val_dataloader`.*",
    r".*is smaller than the logging interval.*",
    r".*exists and is not empty.*",
    r".*Checkpoint directory.*",
    r".*IterableDataset.*has `__len__` defined.*",
    r".*you defined a `validation_step` but have no `val_dataloader`.*",
    r"The dirpath has changed from.*",
    r".*LeafSpec.*is deprecated.*",
    r"Using ModelCheckpoint with manual optimization.*",  # it warns of what we want: the state after the step
    r"Be aware that when using `ckpt_path`, callbacks used to create the checkpoint.*",
    r"Found \d+ module\(s\) in eval mode.*",  # norms that keep what they learned elsewhere, and averages
)

# A trainer that writes nothing and starts no other processes.
_ALONE = {
    "logger": False,
    "enable_checkpointing": False,
    "enable_progress_bar": False,
    "strategy": "auto",
    "devices": 1,
    "num_nodes": 1,
}


@dataclass
class Experiment:
    """The built parts of one run."""

    cfg: DictConfig
    task: BaseTask
    data: LightningDataModule
    trainer: Trainer

    @property
    def folder(self) -> Path:
        """Where this run writes."""
        return Path(self.cfg.run_dir)


def build(cfg: DictConfig, *, observers: bool = True, reports: Path | None = None) -> Experiment:
    """Makes the parts that a configuration describes; calls nothing outside the allowed packages.

    Args:
        cfg: the composed configuration of `conf/train.yaml`, with `run_dir`.
        observers: False leaves loggers and callbacks out, so that nothing is written.
        reports: a folder for what callbacks write about a test, which are then not left out.

    Raises UserError for a forbidden `_target_` or an argument that it does not take, naming the key.
    """
    quieten()
    tree: Any = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
    check_run(tree)
    check_targets(tree)
    if cfg.threads is not None:
        torch.set_num_threads(int(cfg.threads))
    seed_everything(_seed(cfg), workers=True, verbose=False)
    shared = {} if cfg.scene is None else {"scene": instantiate(cfg.scene, _convert_="all")}
    data = instantiate(cfg.data, _convert_="all", **shared)
    for name in [name for name in ("optimizer", "adversary_optimizer") if name in cfg]:
        optimizer, scheduler = (instantiate(part, _convert_="all") for part in (cfg[name], cfg.scheduler))
        rehearse(optimizer, scheduler, name)
    task = instantiate(cfg.module, _convert_="all", **shared)
    settings: dict[str, Any] = {**_ALONE, "callbacks": _reporters(cfg, reports) if reports else []}
    if observers:
        callbacks = [RandomState(), LogKeeper(), *_parts(cfg.callbacks)]
        for guard in (callback for callback in callbacks if isinstance(callback, NanGuard)):
            guard.config = OmegaConf.to_yaml(cfg, resolve=True)
        settings = {
            "logger": _parts(cfg.logger) or False,
            "callbacks": callbacks,
            "enable_checkpointing": any(isinstance(callback, Checkpoint) for callback in callbacks),
            "enable_progress_bar": any(_is_progress(callback) for callback in callbacks),
        }
    plugins = [SafeCheckpointIO(describe(_task_name(), tree, _commit())), *_plugins(cfg.trainer)]
    return Experiment(cfg, task, data, instantiate(cfg.trainer, _convert_="all", plugins=plugins, **settings))


def run(cfg: DictConfig) -> float | None:
    """Builds, fits and tests; writes `metrics.json`, prints the numbers that matter and where they lie.

    Returns the value of `optimized_metric`, or None where none is named. A failed run leaves its traceback in
    the log file and a `metrics.json` with `status: failed`, and raises. One that is interrupted (Ctrl-C, SIGTERM)
    keeps its last step, and ends the program with code 130 or 143; SIGUSR1 with 138, see `interruptions`.
    """
    with signals.listening():
        signals.begun()
        return _run(cfg)


def _run(cfg: DictConfig) -> float | None:
    clock = _Clock()
    folder = Path(cfg.run_dir)
    record = _opening_record(cfg)
    experiment = None
    try:
        experiment = build(cfg)
        check_divisible(experiment.trainer, experiment.data)
        wanted = cfg.ckpt_path or interruptions.requeued_from(Path(cfg.output_root), record["overrides"])
        checkpoint = find_checkpoint(wanted, folder, Path(cfg.output_root), cfg.module.get("_target_"))
        if is_first_process():
            for place in {folder / "checkpoints", checkpoint.parent if checkpoint else folder}:
                sweep_leftovers(place)
        clock.lap("setup")
        record["resumed_from"] = None if checkpoint is None else str(checkpoint)
        with own_processes(experiment.trainer, folder):
            record["metrics"] = _fit_and_test(experiment, checkpoint, clock)
    except BaseException as error:
        record["steps"] = 0 if experiment is None else experiment.trainer.global_step
        with signals.patient(for_all=True):
            _conclude_early(cfg, record, clock, error)
        raise
    record.update(status="ok", steps=experiment.trainer.global_step, seconds=clock.laps())
    record.update(_measurements(experiment))
    with signals.patient(for_all=True):
        if experiment.trainer.is_global_zero:
            _conclude(experiment, record)
    if number := signals.waiting():  # this run is whole; what would follow it is not wanted
        raise SystemExit(128 + number)
    return _optimized(record)


def _conclude_early(cfg: DictConfig, record: dict[str, Any], clock: _Clock, error: BaseException) -> None:
    """Writes down why a run ended; SystemExit where a signal ended it."""
    number = interruptions.signal_of(error)
    log.info("the run ended early", exc_info=number is None)  # the console gets the message alone
    record.update(
        status="failed" if number is None else "interrupted",
        error=f"{type(error).__name__}: {error}"[:2000],
        seconds=clock.laps(),
    )
    folder = Path(cfg.run_dir)
    if is_first_process():
        try:
            report.write_json(folder / "metrics.json", record)
        except OSError as problem:  # the disk that ended the run
            log.warning("metrics.json could not be written: %s", problem)
        html_report.leave_run_report(folder, cfg.report)
    if number is None:
        return
    if is_first_process():
        line = interruptions.farewell(number, folder, record["steps"], Path(cfg.output_root), record["overrides"])
        sys.stderr.write(f"{line}\n")
    raise SystemExit(128 + number) from None


def load_run(
    folder: str | Path,
    weights: str = "last",
    overrides: Mapping[str, Any] | None = None,
    reports: str | Path | None = None,
) -> Experiment:
    """Rebuilds a run from its folder, with the weights of its checkpoint; nothing is written.

    Args:
        folder: of the run.
        weights: `last`, `best`, or the path of a checkpoint or of a `.safetensors` file.
        overrides: dotted keys of the configuration with other values.
        reports: a folder for the files that the run's callbacks write about a test; None: they write none.

    Raises UserError where the folder holds no run, no such checkpoint, or one that is damaged or does not fit.
    """
    folder = Path(folder)
    source = folder / ".hydra" / "config.yaml"
    if not source.is_file():
        raise UserError(f"{folder} is not the folder of a run: it has no .hydra/config.yaml")
    cfg = OmegaConf.load(source)
    assert isinstance(cfg, DictConfig)
    cfg.run_dir = str(folder)
    for key, value in (overrides or {}).items():
        OmegaConf.update(cfg, key, value)
    experiment = build(cfg, observers=False, reports=None if reports is None else Path(reports))
    state = read_weights(folder, weights, cfg.module.get("_target_"))
    experiment.data.prepare_data()
    experiment.data.setup("test")
    with must_fit(f"{weights} of {report.short_path(folder)}"):
        experiment.task.load_state_dict(state)
    experiment.task.eval()
    return experiment


def evaluate(experiment: Experiment) -> dict[str, float]:
    """The test metrics of built or loaded parts; UserError where the data has no test set."""
    if not _has_test(experiment.data):
        raise UserError(f"{type(experiment.data).__name__} has no test data")
    experiment.trainer.test(experiment.task, datamodule=experiment.data, verbose=False)
    return _numbers(experiment.trainer)


class _Clock:
    """Seconds of the phases of a run."""

    def __init__(self) -> None:
        self._start = self._last = time.perf_counter()
        self._laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        """Ends a phase."""
        now = time.perf_counter()
        self._laps[name] = round(now - self._last, 3)
        self._last = now

    def laps(self) -> dict[str, float]:
        """Every ended phase, and the total until now."""
        return {**self._laps, "total": round(time.perf_counter() - self._start, 3)}


def _fit_and_test(experiment: Experiment, checkpoint: Path | None, clock: _Clock) -> dict[str, float]:
    trainer, task, data = experiment.trainer, experiment.task, experiment.data
    with checkpoints_are_data(), must_fit(f"ckpt_path: {checkpoint}"):
        trainer.fit(task, datamodule=data, ckpt_path=None if checkpoint is None else str(checkpoint))
    clock.lap("fit")
    metrics = _numbers(trainer)
    if experiment.cfg.test is not None and _has_test(data):
        best = _best_checkpoint(trainer) if experiment.cfg.test == "best" else None
        with checkpoints_are_data():
            trainer.test(task, datamodule=data, ckpt_path=best, verbose=False)
        metrics.update(_numbers(trainer))
        clock.lap("test")
    return metrics


def _best_checkpoint(trainer: Trainer) -> str:
    for keeper in trainer.checkpoint_callbacks:
        if isinstance(keeper, ModelCheckpoint) and keeper.monitor and keeper.best_model_path:
            return keeper.best_model_path
    raise UserError("test=best needs callbacks=[default,best], callbacks.best.monitor=val/..., and a validation")


def _has_test(data: LightningDataModule) -> bool:
    return is_overridden("test_dataloader", data, LightningDataModule)


def _numbers(trainer: Trainer) -> dict[str, float]:
    return {name: float(value) for name, value in trainer.callback_metrics.items()}


def _measurements(experiment: Experiment) -> dict[str, Any]:
    timers = [callback for callback in experiment.trainer.callbacks if isinstance(callback, StepTimer)]  # type: ignore[attr-defined]
    device = experiment.trainer.strategy.root_device
    return {
        "step_ms_median": timers[0].median_ms() if timers else None,
        "peak_memory_mb": report.peak_memory_mb(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else device.type,
    }


def _opening_record(cfg: DictConfig) -> dict[str, Any]:
    known = HydraConfig.get() if HydraConfig.initialized() else None
    return {
        "status": "running",
        "task": _task_name(),
        "overrides": list(known.overrides.task) if known else [],
        "seed": cfg.seed if isinstance(cfg.seed, int) else str(cfg.seed),
        "optimized_metric": cfg.optimized_metric,
        "direction": cfg.direction,
        "steps": 0,
        "metrics": {},
        "threads": cfg.threads if isinstance(cfg.threads, int) else torch.get_num_threads(),
        "versions": report.versions(),
        "git_commit": _commit(),
        "command": " ".join(sys.argv),
    }


def _task_name() -> str:
    """What `task=` chose on the command line; `task` outside Hydra."""
    known = HydraConfig.get() if HydraConfig.initialized() else None
    return str(known.runtime.choices.get("task", "task")) if known else "task"


@functools.cache
def _commit() -> str | None:
    return report.git_commit(Path(__file__).parent)


def _conclude(experiment: Experiment, record: dict[str, Any]) -> None:
    for logger in experiment.trainer.loggers:
        if isinstance(logger, TensorBoard):
            name = " ".join([record["task"], *record["overrides"], f"({experiment.folder.name})"])
            logger.log_hyperparams(hyperparameters(experiment.cfg), name=name)
            logger.close()
    report.write_json(experiment.folder / "metrics.json", record)
    page = html_report.leave_run_report(experiment.folder, experiment.cfg.report)
    report.closing_table(record, experiment.folder, page)


def hyperparameters(cfg: DictConfig) -> dict[str, Any]:
    """The numbers, words and switches that distinguish runs, by dotted key, for TensorBoard's HPARAMS tab."""
    skipped = {"trainer", "logger", "callbacks", "run_dir", "output_root", "ckpt_path", "direction", "sweep"}
    tree = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(tree, dict)
    tree["module"] = {
        key: value
        for key, value in tree["module"].items()
        if key.removeprefix("adversary_") not in ("losses", "metrics", "optimizer", "scheduler")
    }
    flat = {key: value for name in tree if name not in skipped for key, value in _leaves(tree[name], str(name))}
    return {**flat, "trainer.max_steps": tree["trainer"].get("max_steps")}


def _leaves(tree: Any, key: str) -> Iterator[tuple[str, Any]]:
    if isinstance(tree, dict):
        for name, value in tree.items():
            if not str(name).startswith("_"):
                yield from _leaves(value, f"{key}.{name}")
    elif isinstance(tree, (bool, int, float, str)):
        yield key, tree
    elif isinstance(tree, list):
        yield key, str(tree)


def _optimized(record: Mapping[str, Any]) -> float | None:
    name = record["optimized_metric"]
    if name is None:
        return None
    if name in record["metrics"]:
        return record["metrics"][name]
    problem = f"optimized_metric: this run has no {name!r}; it has: {', '.join(record['metrics'])}"
    overrides = record["overrides"]
    if not overrides or any(item.startswith("optimized_metric=") for item in overrides):
        raise UserError(problem)
    log.warning(problem)  # the task's own, whose metric this run left out: nobody asked for its number
    return None


def _parts(group: DictConfig | None) -> list[Any]:
    """The parts of a group by name, without those switched off by null, or left out: nothing says what they are."""
    named = [part for part in (group or {}).values() if part is not None and "_target_" in part]
    return [instantiate(part, _convert_="all") for part in named]


def _reporters(cfg: DictConfig, folder: Path) -> list[Any]:
    """The callbacks of a configuration that have something to say about a test, as if the run were in a folder."""
    cfg = cfg.copy()
    cfg.run_dir = str(folder)
    hooks = ("on_test_batch_end", "on_test_epoch_end", "on_test_end")
    told = [part for part in _parts(cfg.callbacks) if any(is_overridden(hook, part, Callback) for hook in hooks)]
    return [callback for callback in told if not _is_progress(callback)]


def _plugins(trainer: DictConfig) -> list[Any]:
    """Those that a configuration adds to ours."""
    own = instantiate(trainer.get("plugins"), _convert_="all") or []
    return own if isinstance(own, list) else [own]


def _is_progress(callback: Any) -> bool:
    from lightning.pytorch.callbacks import ProgressBar

    return isinstance(callback, ProgressBar)


def _seed(cfg: DictConfig) -> int:
    if not isinstance(cfg.seed, int) or isinstance(cfg.seed, bool):
        raise UserError(f"seed must be a whole number, got {cfg.seed!r}")
    return cfg.seed


def quieten() -> None:
    """Silences what Lightning says that a user can do nothing about; everything else is still heard."""
    for pattern in _IDLE_WARNINGS:
        warnings.filterwarnings("ignore", message=pattern)
    for name in ("lightning.pytorch", "lightning.fabric", "lightning"):
        logging.getLogger(name).setLevel(logging.WARNING)
