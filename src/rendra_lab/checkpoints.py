"""Which checkpoint a run goes on from or is loaded from, and what a file must be to count as one."""

from __future__ import annotations

import contextlib
import os
import zipfile
from collections.abc import Iterator
from pathlib import Path

from rendra_lab import report
from rendra_lab.errors import UserError


def find_checkpoint(wanted: str | None, run_folder: Path, output_root: Path) -> Path | None:
    """The checkpoint to resume from: None, a file, the newest of a run folder, or `last` of the same task."""
    if wanted is None:
        return None
    if wanted == "last":
        return newest_checkpoint(_task_folder(run_folder, output_root), besides=run_folder)
    path = Path(wanted)
    if path.is_dir():
        return newest_checkpoint(path)
    if not path.is_file():
        raise UserError(f"ckpt_path: there is neither a checkpoint nor a run folder at {wanted}")
    return path


def newest_checkpoint(folder: Path, besides: Path | None = None) -> Path:
    """The checkpoint written last in any run under `folder`, except the run `besides`."""
    found = [path for path in folder.rglob("checkpoints/*.ckpt") if besides is None or besides not in path.parents]
    if not found:
        raise UserError(f"there is no checkpoint under {report.short_path(folder)}; start without ckpt_path")
    return max(found, key=lambda path: (path.stat().st_mtime_ns, path.name == "last.ckpt"))


def whole(checkpoint: Path | None) -> Path | None:
    """The checkpoint itself, if its archive has an end."""
    if checkpoint is not None and not zipfile.is_zipfile(checkpoint):
        raise UserError(f"ckpt_path: {checkpoint} is cut off, or no checkpoint: take an older one of its folder")
    return checkpoint


def named_checkpoint(folder: Path, weights: str) -> Path:
    """The file that `weights` means for a run: `best`, or a path."""
    path = folder / "checkpoints" / "best.ckpt" if weights == "best" else Path(weights)
    if not path.is_file():
        raise UserError(f"there is no checkpoint at {path}; say last, best or a file")
    return path


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


def _task_folder(run_folder: Path, output_root: Path) -> Path:
    """outputs/<task>, for a run directly in it and for a job of a sweep."""
    try:
        relative = run_folder.resolve().relative_to(output_root.resolve())
    except ValueError:
        return run_folder.parent
    return output_root / relative.parts[0] if len(relative.parts) > 1 else run_folder.parent
