"""A step that went wrong, kept in a folder: what it started from, and how to make it again.

before.ckpt         weights and optimizer before the step, a checkpoint like any other
batch.pt            what the step saw: tensors and plain values, read without unpickling code
random_state.pt     of Python, NumPy, torch and all other generators, at the start of the step
config.yaml         of the run, resolved
README.txt          what was found, and the command that makes the step again
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from rendra_lab import report
from rendra_lab.errors import UserError
from rendra_lab.random_state import Streams, owned_generators
from rendra_lab.records import TensorRecord
from rendra_lab.targets import below, trusted_packages

STATE, CONFIG = "before.ckpt", "config.yaml"
_BATCH, _RANDOM, _README = "batch.pt", "random_state.pt", "README.txt"
_RECORD = "record"  # the key under which a record's class stands among its fields


class _NotPlainError(Exception):
    """A batch holds something that a file without code cannot."""


def write(
    folder: Path,
    step: int,
    found: Sequence[str],
    batch: Any,
    streams: Streams,
    config: str,
    max_bytes: int,
) -> None:
    """Writes all but the checkpoint.

    Args:
        folder: of the step.
        step: its number.
        found: what was not finite.
        batch: what the step saw.
        streams: random ones at its start.
        config: of the run, YAML.
        max_bytes: a larger batch is left out, as is one that is not made of tensors and plain values.
    """
    folder.mkdir(parents=True, exist_ok=True)
    torch.save(streams.to_plain(), folder / _RANDOM)
    (folder / CONFIG).write_text(config, encoding="utf-8")
    try:
        plain = _plain(batch)
        kept = sum(each.numel() * each.element_size() for each in _tensors(plain)) <= max_bytes
        reason = f"is larger than {max_bytes / 1e6:g} MB"
    except _NotPlainError as error:
        kept, reason = False, str(error)
    if kept:
        torch.save(plain, folder / _BATCH)
    note = "" if kept else f"The batch {reason} and is not kept: the step is made again with the first of the data.\n"
    (folder / _README).write_text(
        f"Step {step} was not finite: {', '.join(found) or 'a loss of another process'}.\n"
        f"{note}Make it again, from the state before it, and see what is not finite:\n\n"
        f"    python scripts/replay_step.py {report.short_path(folder)}\n",
        encoding="utf-8",
    )


def read_batch(folder: Path) -> Any:
    """The batch of a kept step; None where it is not kept.

    Raises UserError for a file that asks for a class outside the allowed packages, or for one that is no record.
    """
    path = folder / _BATCH
    return _restored(torch.load(path, weights_only=True), path) if path.is_file() else None


class SameStart(Callback):
    """Lets a fit make one step from the random state of a kept one, and end.

    Args:
        folder: of the kept step.
    """

    def __init__(self, folder: Path) -> None:
        self.streams = Streams.from_plain(torch.load(folder / _RANDOM, weights_only=True))

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Sets the random state."""
        self.streams.restore(owned_generators(trainer))

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """That was it."""
        trainer.should_stop = True


class OneBatch:
    """A batch that is all the data there is; takes no notice of where other data were.

    Args:
        batch: to yield, endlessly.
    """

    def __init__(self, batch: Any) -> None:
        self.batch = batch

    def __iter__(self) -> Iterator[Any]:
        while True:
            yield self.batch

    def state_dict(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Nothing is taken over."""


def _plain(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value.detach().cpu().contiguous().clone()
    if isinstance(value, TensorRecord):
        fields = {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {_RECORD: f"{type(value).__module__}:{type(value).__qualname__}", "fields": fields}
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if type(value) in (list, tuple):
        return type(value)(_plain(item) for item in value)
    if value is None or isinstance(value, str | int | float | bool):
        return value
    raise _NotPlainError(f"holds {type(value).__name__}")


def _tensors(plain: Any) -> Iterator[Tensor]:
    if isinstance(plain, Tensor):
        yield plain
    for item in plain.values() if isinstance(plain, dict) else plain if isinstance(plain, list | tuple) else ():
        yield from _tensors(item)


def _restored(plain: Any, path: Path) -> Any:
    if isinstance(plain, dict) and _RECORD in plain:
        fields = {name: _restored(item, path) for name, item in plain["fields"].items()}
        return _record_class(plain[_RECORD], path)(**fields)
    if isinstance(plain, dict):
        return {key: _restored(item, path) for key, item in plain.items()}
    if isinstance(plain, list | tuple):
        return type(plain)(_restored(item, path) for item in plain)
    return plain


def _record_class(name: str, path: Path) -> type[TensorRecord]:
    module, _, attribute = name.partition(":")
    if not below(module, ("rendra_lab", *trusted_packages())):
        raise UserError(f"{path}: a batch may not be a {name}")
    found = getattr(importlib.import_module(module), attribute, None)
    if not (isinstance(found, type) and issubclass(found, TensorRecord)):
        raise UserError(f"{path}: {name} is no kind of batch")
    return found
