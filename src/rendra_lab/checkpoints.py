"""Which checkpoint a run goes on from, or is loaded from: the newest that is whole, or the one that was named."""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from torch import Tensor

from rendra_lab import report
from rendra_lab.checkpoint_archive import CheckpointError, CheckpointFacts, examine, read_checkpoint
from rendra_lab.errors import UserError
from rendra_lab.weights_file import read_weights_file


def find_checkpoint(
    wanted: str | None, run_folder: Path, output_root: Path, module: str | None = None
) -> Path | None:
    """The checkpoint to resume from, proven whole.

    Args:
        wanted: None, a file, a folder (its newest whole checkpoint), or `last` (the newest one of the same task).
        run_folder: of the run that will go on; `last` never means its own.
        output_root: where runs of all tasks lie.
        module: the class of the task, which must be that of the checkpoint.

    Raises UserError where there is none, a named file is damaged, or it belongs to another task.
    """
    if wanted is None:
        return None
    if wanted == "last":
        found = newest_checkpoint(_task_folder(run_folder, output_root), besides=run_folder)
    elif Path(wanted).is_dir():
        found = newest_checkpoint(Path(wanted))
    elif not Path(wanted).is_file():
        raise UserError(f"ckpt_path: there is neither a checkpoint nor a run folder at {wanted}")
    elif Path(wanted).suffix == ".safetensors":
        raise UserError(f"ckpt_path: {wanted} holds weights alone; a run goes on from a .ckpt")
    else:
        found = _named(Path(wanted))
    check_module(found.path, found.module, module)
    return found.path


def newest_checkpoint(folder: Path, besides: Path | None = None) -> CheckpointFacts:
    """The newest whole checkpoint of the runs under `folder`, except the run `besides`.

    Of the files of one run the later step is newer; of several runs, that which wrote last. What is damaged is
    passed over, and said on stderr. UserError where nothing is left.
    """
    found = [path for path in folder.rglob("checkpoints/*.ckpt") if besides is None or besides not in path.parents]
    if not found:
        raise UserError(f"there is no checkpoint under {report.short_path(folder)}; start without ckpt_path")
    newest, damaged = _newest_whole(found)
    if newest is None:
        reasons = "; ".join(map(str, damaged))
        raise UserError(f"there is no whole checkpoint under {report.short_path(folder)}: {reasons}")
    if damaged and os.environ.get("LOCAL_RANK", "0") == "0":
        reasons = "; ".join(map(str, damaged))
        sys.stderr.write(f"{reasons}; taken instead: {report.short_path(newest.path)}, step {newest.step}\n")
    return newest


def last_good(folder: Path, besides: Path | None = None) -> str:
    """Half a sentence that names the newest whole checkpoint directly in `folder`, the file `besides` left out."""
    newest, _ = _newest_whole([path for path in folder.glob("*.ckpt") if path != besides])
    if newest is None:
        return "there is no other good checkpoint in its folder"
    return f"the last good checkpoint is {report.short_path(newest.path)}, step {newest.step}"


def read_weights(folder: Path, weights: str, module: str | None = None) -> dict[str, Tensor]:
    """The weights of a finished run, by name.

    Args:
        folder: of the run.
        weights: `last`, `best`, or the path of a checkpoint or of a `.safetensors` file.
        module: the class of the task, which must be that of the weights.

    Raises UserError where there are none, they are damaged, or belong to another task.
    """
    if weights == "last":
        path = newest_checkpoint(folder).path
    else:
        path = folder / "checkpoints" / "best.ckpt" if weights == "best" else Path(weights)
    if not path.is_file():
        raise UserError(f"there is no checkpoint at {path}; say last, best or a file")
    if path.suffix == ".safetensors":
        tensors, owner = read_weights_file(path)
        check_module(path, owner, module)
        return tensors
    facts = _named(path)
    check_module(path, facts.module, module)
    return read_checkpoint(path)["state_dict"]


def check_module(path: Path, owner: str | None, module: str | None) -> None:
    """UserError where both classes are known and differ: weights belong to one task."""
    if owner is not None and module is not None and owner != module:
        raise UserError(f"{report.short_path(path)} is a checkpoint of {owner}; this run has {module}")


@contextlib.contextmanager
def checkpoints_are_data() -> Iterator[None]:
    """Whatever is loaded meanwhile is read as tensors and plain values; a file cannot run code."""
    name = "TORCH_FORCE_WEIGHTS_ONLY_LOAD"
    before = os.environ.get(name)
    os.environ[name] = "1"
    try:
        yield
    finally:
        os.environ.pop(name)
        if before is not None:
            os.environ[name] = before


@contextlib.contextmanager
def must_fit(source: str) -> Iterator[None]:
    """Weights that do not fit the model are one line: UserError with the first difference."""
    try:
        yield
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        if len(lines) < 2 or not lines[0].startswith("Error(s) in loading state_dict"):
            raise
        raise UserError(f"{source} does not fit this configuration: {lines[1]}") from error


def _named(path: Path) -> CheckpointFacts:
    """A file that someone asked for by name: nothing else is taken in its place, but named."""
    try:
        return examine(path)
    except CheckpointError as error:
        raise UserError(f"{error}; {last_good(path.parent, besides=path)}") from error


def _newest_whole(paths: Iterable[Path]) -> tuple[CheckpointFacts | None, list[CheckpointError]]:
    """The newest file that proves whole, and those which did not although they may be newer."""
    damaged: list[CheckpointError] = []
    for run in _by_run(paths):
        known: list[CheckpointFacts] = []
        for path in run:
            with _collected(damaged):
                known.append(examine(path, checksums=False))
        for facts in sorted(known, key=lambda facts: (facts.step, facts.path.name == "last.ckpt"), reverse=True):
            with _collected(damaged):
                return examine(facts.path), damaged
    return None, damaged


@contextlib.contextmanager
def _collected(damaged: list[CheckpointError]) -> Iterator[None]:
    try:
        yield
    except CheckpointError as error:
        damaged.append(error)
    except FileNotFoundError:  # removed meanwhile by a run that goes on
        pass
    except OSError as error:  # a disk that fails
        damaged.append(CheckpointError(Path(error.filename or "?"), f"cannot be read: {error.strerror}"))


def _by_run(paths: Iterable[Path]) -> list[list[Path]]:
    """Files by the folder they lie in, that which was written to last first."""
    runs = [list(group) for _, group in itertools.groupby(sorted(paths), key=lambda path: path.parent)]
    return sorted(runs, key=lambda run: max(map(_written_at, run)), reverse=True)


def _written_at(path: Path) -> int:
    """Nanoseconds; 0 for what a run that goes on has removed meanwhile."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def _task_folder(run_folder: Path, output_root: Path) -> Path:
    """outputs/<task>, for a run directly in it and for a job of a sweep."""
    try:
        relative = run_folder.resolve().relative_to(output_root.resolve())
    except ValueError:
        return run_folder.parent
    return output_root / relative.parts[0] if len(relative.parts) > 1 else run_folder.parent
