"""What a run leaves behind for people and programs: metrics.json and the closing table."""

from __future__ import annotations

import csv
import json
import math
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from rendra_lab.durable import write_durably

_PACKAGES = ("rendra", "torch", "lightning", "numpy", "numba", "hydra-core", "torchmetrics", "tensorboard")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes a JSON file atomically: a reader sees the old content or the new one, never half of it.

    NaN and infinities become null, as JSON knows none of them.
    """
    write_text(path, json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def write_text(path: Path, content: str) -> None:
    """Writes a text file atomically, into a folder that is made where it is missing."""
    write_durably(path, lambda sink: sink.write(content.encode()))


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes rows with the same keys as a table with a header."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, fieldnames=list(rows[0]))
        table.writeheader()
        table.writerows(rows)


def markdown_table(table: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table whose first row is its head; columns stand below each other, the first to the left."""
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    padded = [
        [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        for row in table
    ]
    return [f"| {' | '.join(line)} |" for line in (padded[0], rule, *padded[1:])]


def say(line: str) -> None:
    """One line for whoever watches a run, at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def versions() -> dict[str, str | None]:
    """The versions of Python and of the packages that numbers depend on; None for a missing one."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in _PACKAGES:
        found[package] = _version(package)
    return found


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def git_commit(folder: Path) -> str | None:
    """The commit of the checkout around `folder`, with `-dirty` for uncommitted changes; None outside git."""
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() or None


def peak_memory_mb() -> dict[str, float]:
    """The most memory this process held: `ram`, and `gpu` where CUDA was used, both in MB of 10^6 bytes."""
    import torch

    peaks = {}
    try:
        import resource
    except ImportError:  # Windows
        pass
    else:
        unit = 1 if sys.platform == "darwin" else 1024
        peaks["ram"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6, 1)
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        peaks["gpu"] = round(torch.cuda.max_memory_allocated() / 1e6, 1)
    return peaks


def closing_table(record: Mapping[str, Any], folder: Path, page: Path | None = None) -> None:
    """Prints the final numbers, where the results and their page lie, and how to look at them."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table(title=f"{record['task']}: {record['steps']} steps in {record['seconds']['total']:.1f} s")
    table.add_column("metric")
    table.add_column("value", justify="right")
    for name, value in shown_metrics(record["metrics"]).items():
        table.add_row(name, format_number(value))
    console.print(table)
    place = short_path(folder)
    console.print(f"results   {place}", highlight=False, soft_wrap=True)
    if page is not None:
        console.print(f"report    {short_path(page)}", highlight=False, soft_wrap=True)
    console.print(f"look      tensorboard --logdir {place}", highlight=False, soft_wrap=True)


def shown_metrics(metrics: Mapping[str, float]) -> dict[str, float]:
    """The numbers that matter: those of the test, else of the validation, else of training."""
    for stage in ("test/", "val/", "train/"):
        chosen = {name: value for name, value in metrics.items() if name.startswith(stage)}
        if chosen:
            return chosen
    return dict(metrics)


def format_number(value: Any) -> str:
    """Five significant digits; a dash for what is missing."""
    if value is None:
        return "-"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def short_path(folder: Path) -> str:
    """Relative to the working directory where the folder lies below it."""
    try:
        return str(folder.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(folder)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
