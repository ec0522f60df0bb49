"""The folder of a sweep, which the same command finds again, and its table: every run, best first.

Imported by Hydra before anything runs, in every process of a sweep: stays light.
"""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import json
import math
import re
import sys
import traceback
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, flag_override
from omegaconf.errors import OmegaConfBaseException

from rendra_lab import signals
from rendra_lab.errors import UserError
from rendra_lab.html_report import leave_sweep_report
from rendra_lab.ledger import JobState, Ledger
from rendra_lab.report import format_number, short_path, shown_metrics, write_json, write_text
from rendra_lab.sweep_job import SweepOptions, job_key, swept_values

Row = dict[str, Any]


def job_folder(number: Any, overrides: str) -> str:
    """The folder of one job: its number and what was set, safe and short enough for a file name."""
    words = _words(overrides or "", 80)
    return f"{number}_{words}" if words else str(number)


def _words(settings: str, longest: int) -> str:
    safe = re.sub(r"[^A-Za-z0-9._=+-]+", "-", settings).replace("+", "").strip("-.")
    return safe[:longest].rstrip("-.=")


OmegaConf.register_new_resolver("job_folder", job_folder, replace=True)

_PIPED_WIDTH = 140  # columns of the table where no terminal says how many there are
_running: list[Path] = []  # the sweep of this process, while it lasts


class SweepFolder(Callback):
    """Hydra's callback: finds the folder of a sweep, and puts its ledger in front of the chosen launcher."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """An exception of a callback would be a mere warning to Hydra: here it ends the program."""
        signals.begun()
        try:
            _settle(config)
        except (OSError, UserError, HydraException, OmegaConfBaseException) as error:
            sys.stderr.write(f"{Path(sys.argv[0]).name}: {error}\n")
            raise SystemExit(2) from None
        except Exception:
            traceback.print_exc()
            raise SystemExit(1) from None
        _running[:] = [Path(config.hydra.sweep.dir)]


def _settle(config: DictConfig) -> None:
    """The folder that the same command had before, or a new one; an explicit `hydra.sweep.dir` stays."""
    given = any(item.startswith("hydra.sweep.dir=") for item in config.hydra.overrides.hydra)
    folder = config.hydra.sweep.dir if given else str(choose_folder(config))
    with flag_override(config.hydra, ["readonly", "struct"], False):
        if not given:
            config.hydra.sweep.dir = folder
            config.hydra.overrides.hydra.append(f"hydra.sweep.dir={json.dumps(folder)}")
        target = "hydra_plugins.rendra_lab_launcher.LedgerLauncher"
        config.hydra.launcher = {"_target_": target, "_recursive_": False, "inner": config.hydra.launcher}
        _settle_search(config)


def _settle_search(config: DictConfig) -> None:
    """A search can be repeated, looks where the task says, and survives a failed trial, unless told otherwise."""
    sweeper = config.hydra.sweeper
    if "sampler" in sweeper and "seed" in sweeper.sampler and sweeper.sampler.seed is None:
        sweeper.sampler.seed = config.seed
    if "max_failure_rate" in sweeper:
        sweeper.max_failure_rate = sweeper.max_failure_rate or 1.0
    if "direction" in sweeper and str(sweeper.direction).endswith("minimize"):
        sweeper.direction = config.direction


def choose_folder(config: DictConfig) -> Path:
    """Where a sweep lies: named by what it sweeps and by a hash of its command, never by the time of day.

    Where `sweep.fresh` has begun anew before, the newest of these folders is meant.
    """
    root = Path(config.hydra.sweep.dir).parent
    name = f"sweep_{_swept_words(config)}_{sweep_key(config)[:8]}"
    first = root / name
    later = (root / f"{name}_{count}" for count in itertools.count(2))
    candidates = itertools.chain([first], later)
    fresh = SweepOptions.of(config).fresh
    newest = first
    for folder in candidates:
        if not folder.exists():
            break
        newest = folder
    if fresh and newest.exists():
        newest = folder
        newest.mkdir(parents=True)
    return newest


def sweep_key(config: DictConfig) -> str:
    """What makes a sweep that sweep: a hash of its settings and of its sweeper's, without the number of trials."""
    ways = [
        item
        for item in config.hydra.overrides.hydra
        if item.startswith(("hydra/sweeper", "hydra.sweeper.")) and not item.startswith("hydra.sweeper.n_trials=")
    ]
    text = json.dumps([job_key(config.hydra.overrides.task), sorted(ways)])
    return hashlib.sha256(text.encode()).hexdigest()


def _swept_words(config: DictConfig) -> str:
    overrides = OverridesParser.create().parse_overrides(list(config.hydra.overrides.task))
    swept = [
        f"{item.get_key_element()}={_in_words(item) if item.is_discrete_sweep() else 'search'}"
        for item in overrides
        if item.is_sweep_override()
    ]
    chosen = OmegaConf.select(config, "hydra.runtime.choices.hparams_search")
    return _words(",".join(sorted(swept)), 48) or str(chosen or "all")


def _in_words(override: Override) -> str:
    values = swept_values(override)
    return values if isinstance(values, str) else "-".join(values)


def conclude_sweep() -> bool | None:
    """Prints the table of the sweep that this process ran, and leaves its page; whether all its runs succeeded.

    None where this process ran no sweep.
    """
    rows = write_summary(_running[0]) if _running and _running[0].is_dir() else []
    if not rows:
        return None
    folder = _running.pop()
    page = leave_sweep_report(folder, wanted=any(row["settings"].get("report") != "false" for row in rows))
    _print_table(folder, rows)
    if page is not None:
        sys.stdout.write(f"report    {short_path(page)}\n")
    return all(row["status"] == "ok" for row in rows)


def collect(folder: Path) -> list[Row]:
    """One row a job of the sweep, best first: job, status, error, settings, metrics, seconds, folder.

    The status is ok, failed, interrupted, running (here or on another machine), or waiting.
    """
    ledger = Ledger(folder)
    states = ledger.states().values()
    rows = [_row(folder / state.folder, state.overrides) | _entered(ledger, state) for state in states]
    if not rows:  # a sweep of another program, without a ledger
        rows = [_row(path.parent.parent, OmegaConf.load(path)) for path in folder.glob("*/.hydra/overrides.yaml")]
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
    table = io.StringIO()
    csv.writer(table, lineterminator="\n").writerows([columns, *lines])
    write_text(folder / "summary.csv", table.getvalue())
    markdown = [columns, ["---"] * len(columns), *lines]
    write_text(folder / "summary.md", "".join(f"| {' | '.join(line)} |\n" for line in markdown))
    return rows


def _entered(ledger: Ledger, state: JobState) -> Row:
    """What the ledger says of a job, which counts more than what lies in the job's folder."""
    told: Row = {"job": state.number, "error": state.error}
    if state.status == "done":
        given = {} if state.value is None else {"value": state.value}
        return told | {"status": "ok", **({} if state.metrics else {"metrics": given})}
    if state.status == "running" and ledger.free_after(state) is None:
        return told | {"status": "running", "error": f"on {state.holder}"}
    words = {"queued": "waiting", "running": "interrupted", "lost": "interrupted"}
    return told | {"status": words.get(state.status, state.status)}


def _row(job: Path, overrides: Any) -> Row:
    try:
        record = json.loads((job / "metrics.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        record = {}
    number = job.name.split("_", 1)[0]
    return {
        "job": int(number) if number.isdigit() else -1,
        "status": record.get("status", "unfinished"),
        "error": record.get("error"),
        "settings": dict(str(item).lstrip("+~").split("=", 1) for item in overrides if "=" in str(item)),
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
    best = [row["optimized_metric"] for row in rows if row["optimized_metric"] in row["metrics"]]
    names = list(dict.fromkeys([*best, *(name for row in rows for name in row["metrics"])]))
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


def _within(
    width: int, columns: list[str], lines: list[list[str]], metrics: int
) -> tuple[list[str], list[list[str]], int]:
    """The table without the last of its metrics, as many as do not fit into a width, and how many these are."""
    shown = [
        max(len(cell.removeprefix("test/")) for cell in column) + 3 for column in zip(columns, *lines, strict=True)
    ]
    left_out, last = 0, len(columns) - 2  # behind the metrics stand the time and the status
    while left_out < metrics - 1 and sum(shown) + 1 > width:
        left_out, last = left_out + 1, last - 1
        del shown[last]
    columns, *lines = ([*row[:last], *row[-2:]] for row in (columns, *lines))
    return columns, lines, left_out


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
    columns, lines, left_out = _within(
        console.width, columns, lines, len({name for row in rows for name in row["metrics"]})
    )
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
    if left_out:
        console.print(f"{left_out} more metrics in {place}/summary.md", highlight=False, soft_wrap=True)
    for row in rows:
        if row["status"] not in ("ok", "waiting"):
            reason = _one_line(row["error"] or "its process ended without a word")
            console.print(f"job {row['job']} {row['status']}: {reason}", highlight=False, markup=False)
            console.print(f"          more in {place}/{row['folder']}/train.log", highlight=False, soft_wrap=True)
    if any(row["status"] != "ok" for row in rows):
        console.print("go on     with the same command: what is done stays", highlight=False)
    console.print(f"results   {place} (summary.md, .csv, .json)", highlight=False, soft_wrap=True)
    console.print(f"look      tensorboard --logdir {place}", highlight=False, soft_wrap=True)
