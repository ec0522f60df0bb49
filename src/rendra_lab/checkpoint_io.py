"""How every run writes and reads its checkpoints: whole or not at all, proven, and never as code."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.fabric.plugins.io.checkpoint_io import CheckpointIO
from lightning.pytorch import Trainer
from torch import Tensor

from rendra_lab import report
from rendra_lab.checkpoint_archive import FORMAT, KEY, CheckpointError, read_checkpoint, write_checkpoint
from rendra_lab.checkpoints import last_good
from rendra_lab.weights_file import write_weights_file


class SaveError(OSError):
    """A checkpoint could not be written; the message names it, the reason, and the last one that is whole."""


class SafeCheckpointIO(CheckpointIO):
    """Lightning's way to the disk.

    A save either replaces the file by one that was forced to the disk and proven, or raises and leaves everything
    as it was. Lightning's own goes through the temporary folder and keeps quiet about a lack of permission.

    Args:
        metadata: what each checkpoint says about its run, plain values; `describe` makes it.
    """

    def __init__(self, metadata: Mapping[str, Any]) -> None:
        self.metadata = dict(metadata)

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Writes a state with its metadata.

        Raises:
            SaveError: the disk is full, the folder forbidden, or the state cannot be read back.
            TypeError: `storage_options` is given, which a local file has none of.
        """
        if storage_options is not None:
            raise TypeError("a checkpoint on a local disk has no storage_options")
        path = Path(path)
        try:
            write_checkpoint(path, {**checkpoint, KEY: self.metadata})
        except (OSError, CheckpointError) as error:
            raise _failed("save", path, error) from error

    def save_weights(self, weights: Mapping[str, Any], path: Path) -> None:
        """Writes the tensors of a state_dict as safetensors; SaveError as above."""
        tensors = {name: value for name, value in weights.items() if isinstance(value, Tensor)}
        try:
            write_weights_file(path, tensors, self.metadata)
        except (OSError, CheckpointError) as error:
            raise _failed("save", path, error) from error

    def load_checkpoint(
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Tensors and plain values of a proven file, on the CPU; both options are Lightning's and change nothing."""
        content = read_checkpoint(Path(path))
        if "pytorch-lightning_version" not in content:
            raise CheckpointError(Path(path), "holds weights, but not the state of a fit that could go on")
        return content

    def remove_checkpoint(self, path: str | Path) -> None:
        """Removes a file that newer ones have replaced; SaveError where that is not allowed."""
        try:
            Path(path).unlink(missing_ok=True)
        except OSError as error:
            raise _failed("remove", Path(path), error) from error


def save_weights(trainer: Trainer, path: Path) -> None:
    """The weights of a fit as safetensors; every process of it must call this, the first one writes."""
    weights = trainer.strategy.lightning_module_state_dict()
    own = trainer.strategy.checkpoint_io
    if trainer.is_global_zero and isinstance(own, SafeCheckpointIO):
        own.save_weights(weights, path)


def describe(task: str, config: Mapping[str, Any], commit: str | None) -> dict[str, Any]:
    """The metadata of a run's checkpoints.

    Args:
        task: its name on the command line.
        config: the resolved configuration as plain containers.
        commit: of the checkout.
    """
    module = config.get("module")
    return {
        "format": FORMAT,
        "task": task,
        "module": module.get("_target_") if isinstance(module, Mapping) else None,
        "config": _plain(config),
        "versions": report.versions(),
        "git_commit": commit,
        "seed": config.get("seed"),
    }


def _plain(value: Any) -> Any:
    """Only what a checkpoint may hold and JSON can say; anything else by its words."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value if value is None or type(value) in (bool, int, float, str) else str(value)


def _failed(what: str, path: Path, error: Exception) -> SaveError:
    if isinstance(error, CheckpointError):
        reason = f"what was written {error.reason}"
    else:
        number = getattr(error, "errno", None)
        reason = os.strerror(number) if number else str(error)
    return SaveError(f"cannot {what} {report.short_path(path)}: {reason}; {last_good(path.parent)}")
