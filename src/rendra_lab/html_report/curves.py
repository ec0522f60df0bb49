"""The numbers of a run over its steps, as the table of its logger has them."""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

MOST_POINTS = 1500  # of one curve on a page; a screen has no more columns
_STAGES = ("train", "val", "test")
_UNITS = {"psnr": "dB", "deg": "°", "percent": "%", "seconds": "s", "ms": "ms", "mm": "mm", "px": "px", "db": "dB"}


@dataclass
class Curve:
    """One logged quantity: values over steps; NaN and infinities are gaps."""

    name: str
    steps: list[int]
    values: list[float]

    @property
    def stage(self) -> str:
        """train, val, test or other."""
        stage = self.name.partition("/")[0]
        return stage if stage in _STAGES and "/" in self.name else "other"

    def points(self, most: int = MOST_POINTS) -> dict[str, Any]:
        """For the page: at most so many of them, where the extremes of what is left out stay."""
        kept = _spread_with_extremes(self.values, most)
        return {
            "name": self.name,
            "unit": unit_of(self.name),
            "x": [self.steps[index] for index in kept],
            "y": [_short(self.values[index]) for index in kept],
        }


def read_curves(path: Path) -> list[Curve]:
    """The columns of a metrics table beside its steps, sorted by step; empty where there is no such file.

    Lines that a killed run left unfinished are skipped.
    """
    found: dict[str, dict[int, float]] = {}
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        for row in csv.DictReader(line.replace("\0", "") for line in file):
            step = _number(row.get("step"))
            if step is None or not math.isfinite(step):
                continue
            for name, text in row.items():
                value = None if name is None or name == "step" else _number(text)
                if value is not None:
                    found.setdefault(name, {})[int(step)] = value
    return [Curve(name, sorted(points), [points[step] for step in sorted(points)]) for name, points in found.items()]


def stages_of(names: list[str]) -> dict[str, list[str]]:
    """Names by stage, in the order train, val, test, other; empty stages are left out."""
    groups: dict[str, list[str]] = {stage: [] for stage in (*_STAGES, "other")}
    for name in names:
        groups[Curve(name, [], []).stage].append(name)
    return {stage: members for stage, members in groups.items() if members}


def unit_of(name: str) -> str:
    """The unit that a metric's name tells, such as dB for PSNR; empty where there is none."""
    quantity = name.rpartition("/")[2].lower()
    if quantity.endswith("_per_s"):
        return f"{quantity.removesuffix('_per_s').replace('_', ' ')}/s"
    if quantity.startswith("psnr"):
        return "dB"
    return _UNITS.get(quantity.rpartition("_")[2], "")


def final_table(metrics: Mapping[str, Any]) -> tuple[list[str], list[tuple[str, list[Any]]]]:
    """Metrics as a table: the stages that occur, and for each quantity its values in them."""
    columns = list(stages_of(list(metrics)))
    quantities: dict[str, dict[str, Any]] = {}
    for name, value in metrics.items():
        stage = Curve(name, [], []).stage
        short = name if stage == "other" else name.partition("/")[2]
        quantities.setdefault(short, {})[stage] = value
    return columns, [(name, [cells.get(stage) for stage in columns]) for name, cells in quantities.items()]


def _number(text: Any) -> float | None:
    try:
        return float(text) if text not in (None, "") else None
    except (TypeError, ValueError):
        return None


def _short(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _spread_with_extremes(values: list[float], most: int) -> list[int]:
    """Indices of first, last, and the lowest and highest value of equal stretches between them."""
    if len(values) <= most:
        return list(range(len(values)))
    kept = {0, len(values) - 1}
    stretches = max(1, most // 2 - 1)
    edges = [round(index * len(values) / stretches) for index in range(stretches + 1)]
    for start, end in itertools.pairwise(edges):
        finite = [index for index in range(start, end) if math.isfinite(values[index])]
        if finite:
            kept.update((min(finite, key=values.__getitem__), max(finite, key=values.__getitem__)))
    return sorted(kept)
