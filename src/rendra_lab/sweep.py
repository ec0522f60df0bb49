"""The table of a sweep: every run, its settings that differ and its numbers, best first.

Imported by Hydra before anything runs, in every process of a sweep: stays light.
"""

from __future__ import annotations

import csv
import json
import math
import re
import sys
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from rendra_lab.report import format_number, short_path, shown_metrics, write_json

Row = dict[str, Any]


def job_folder(number: Any, overrides: str) -> str:
    """The folder of one job: its number and what was set, safe and short enough for a file name."""
    words = re.sub(r"[^A-Za-z0-9._=+-]+", "-", overrides or "").replace("+", "").strip("-.")[:80].rstrip("-.=")
    return f"{number}_{words}" if words else str(number)


OmegaConf.register_new_resolver("job_folder", job_folder, replace=True)

_PIPED_WIDTH = 140  # columns of the table where no terminal says how many there are
_running: list[Path] = []  # the sweep of this process, while it lasts


class SweepTable(Callback):
    """Hydra's callback: keeps `summary.{md,csv,json}` of a sweep folder up to date."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Remembers the folder, so that a sweep that ends by an exception has its table too."""
        _running[:] = [Path(config.hydra.sweep.dir)]

    def on_job_end(self, config: DictConfig, job_return: Any, **kwargs: Any) -> None:
        """Writes the table anew after every job."""
        if str(config.hydra.mode).endswith("MULTIRUN"):
            write_summary(Path(config.hydra.sweep.dir))


def conclude_sweep() -> bool | None:
    """Prints the table of the sweep that this process ran; whether all its runs succeeded, None without one."""
    rows = write_summary(_running[0]) if _running and _running[0].is_dir() else []
    if not rows:
        return None
    _print_table(_running.pop(), rows)
    return all(row["status"] == "ok" for row in rows)


def collect(folder: Path) -> list[Row]:
    """One row a run of the sweep, best first: job, status, settings, metrics, seconds, folder."""
    jobs = [path.parent.parent for path in folder.glob("*/.hydra/overrides.yaml")]
    rows = [_row(job) for job in jobs]
    rows.sort(key=lambda row: row["job"])
    ranked = [row for row in rows if row["optimized_metric"] is not None]
    if ranked:
        name, sign = ranked[0]["optimized_metric"], -1 if ranked[0]["direction"] == "maximize" else 1
        rows.sort(key=lambda row: _rank(row["metrics"].get(name), sign))
    return rows


def write_summary(folder: Path) -> list[Row]:
    """Writes `summary.json`, `summary.csv` and `summary.md` into the sweep folder; returns the rows."""
    rows = collect(folder)
    columns, lines = _cells(rows)
    write_json(folder / "summary.json", {"runs": rows})
    with (folder / "summary.csv").open("w", newline="") as file:
        csv.writer(file).writerows([columns, *lines])
    markdown = [columns, ["---"] * len(columns), *lines]
    (folder / "summary.md").write_text("".join(f"| {' | '.join(line)} |\n" for line in markdown))
    return rows


def _row(job: Path) -> Row:
    overrides = [str(item) for item in OmegaConf.load(job / ".hydra" / "overrides.yaml")]
    try:
        record = json.loads((job / "metrics.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        record = {}
    number = job.name.split("_", 1)[0]
    return {
        "job": int(number) if number.isdigit() else -1,
        "status": record.get("status", "unfinished"),
        "error": record.get("error"),
        "settings": dict(item.lstrip("+~").split("=", 1) for item in overrides if "=" in item),
        "metrics": shown_metrics(record.get("metrics", {})),
        "seconds": record.get("seconds", {}).get("total"),
        "optimized_metric": record.get("optimized_metric"),
        "direction": record.get("direction"),
        "folder": job.name,
    }


def _rank(value: float | None, sign: int) -> float:
    return math.inf if value is None or math.isnan(value) else sign * value


def _cells(rows: list[Row]) -> tuple[list[str], list[list[str]]]:
    """The table as text: settings that are the same everywhere are left out."""
    keys = list(dict.fromkeys(key for row in rows for key in row["settings"]))
    varied = [key for key in keys if len({row["settings"].get(key) for row in rows}) > 1]
    names = list(dict.fromkeys(name for row in rows for name in row["metrics"]))
    columns = ["job", *varied, *names, "seconds", "status"]
    lines = [
        [
            str(row["job"]),
            *(_shortened(row["settings"].get(key, "-")) for key in varied),
            *(format_number(row["metrics"].get(name)) for name in names),
            "-" if row["seconds"] is None else f"{row['seconds']:.1f}",
            row["status"],
        ]
        for row in rows
    ]
    return columns, lines


def _shortened(setting: str) -> str:
    """A drawn number with the digits that matter; words and typed numbers as they are."""
    try:
        return setting if len(setting) <= 8 else format_number(float(setting))
    except ValueError:
        return setting


def _one_line(message: str) -> str:
    line = " ".join(message.split()).replace("|", "/")
    return line if len(line) <= 120 else line[:117] + "..."


def _print_table(folder: Path, rows: list[Row]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else _PIPED_WIDTH)
    columns, lines = _cells(rows)
    best = rows[0]["optimized_metric"] if rows else None
    table = Table(title=f"{len(rows)} runs" + (f", best {best} first" if best else ""))
    for column in columns:
        table.add_column(
            column.removeprefix("test/"), justify="left" if column == "status" else "right", overflow="fold"
        )
    for row, line in zip(rows, lines, strict=True):
        table.add_row(*line, style="red" if row["status"] != "ok" else None)
    place = short_path(folder)
    console.print(table)
    for row in rows:
        if row["status"] != "ok":
            reason = _one_line(row["error"] or "it ended without a word")
            console.print(f"job {row['job']} {row['status']}: {reason}", highlight=False, markup=False)
            console.print(f"          more in {place}/{row['folder']}/train.log", highlight=False, soft_wrap=True)
    console.print(f"results   {place} (summary.md, .csv, .json)", highlight=False, soft_wrap=True)
    console.print(f"look      tensorboard --logdir {place}", highlight=False, soft_wrap=True)
