"""The numbers of rebuilt shapes: a row an object, and tables of their means by category and by method.

Methods are `model`, `start` (what refinement began with), and the class means of `MeanShapes`: `mean_shape` (put
where the truth is) and `mean_view` (as training cameras saw the class). Columns of a row: METHOD_chamfer,
METHOD_normal, METHOD_f1_30 and so on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rendra.structures import Meshes
from rendra_lab.mesh_scores import PROTOCOLS, ProtocolName, scores_of
from rendra_lab.report import markdown_table
from rendra_lab.shape_records import ShapeBatch

Row = dict[str, Any]  # of one object: shape, label, and numbers

TITLES = {
    "model": "model",
    "start": "model before refinement",
    "mean_shape": "mean shape of the class, placed by the truth",
    "mean_view": "mean shape of the class, as cameras saw it",
}
"""What methods are called in tables."""

_SHOWN: dict[ProtocolName, dict[str, str]] = {
    "scaled": {"f1_10": "F1@0.1", "f1_30": "F1@0.3", "f1_50": "F1@0.5"},
    "p2m": {"f1_1": "F1@1e-4", "f1_1.4142": "F1@2e-4"},  # squared distances, as its tables have them
}
LOGGED: dict[ProtocolName, tuple[str, ...]] = {
    "scaled": ("chamfer", "normal", "f1_30"),
    "p2m": ("chamfer", "normal", "f1_1"),
}
"""The numbers of each method that curves and summaries of runs show."""

_DISTANCES: dict[ProtocolName, str] = {
    "scaled": "Distances after the longest side of the true box is 10",
    "p2m": "Distances times 0.57; thresholds are squares",
}


def numbers_of(
    methods: Mapping[str, Meshes], batch: ShapeBatch, protocol: ProtocolName = "scaled", samples: int = 10_000
) -> list[Row]:
    """What the methods score at each of B objects, a row an object.

    Args:
        methods: B meshes in the camera's axes, by name.
        batch: the objects.
        protocol, samples: of the comparison.
    """
    rows: list[Row] = [
        {"shape": name, "label": label} for name, label in zip(batch.shape_ids, batch.labels.tolist(), strict=True)
    ]
    for method, meshes in methods.items():
        scores = scores_of(meshes, batch.shapes, protocol, samples)
        columns = {"chamfer": scores.chamfer, "normal": scores.normal}
        for place, threshold in enumerate(PROTOCOLS[protocol].thresholds):
            columns[f"f1_{100 * threshold:.6g}"] = scores.f1[:, place]
        for name, values in columns.items():
            for row, value in zip(rows, values.tolist(), strict=True):
                row[f"{method}_{name}"] = value
    return rows


def means_of(rows: Sequence[Row]) -> dict[str, float]:
    """The mean of every number over some objects."""
    names = [name for name in (rows[0] if rows else {}) if name not in ("shape", "label")]
    return {name: sum(row[name] for row in rows) / len(rows) for name in names}


def class_means_of(rows: Sequence[Row]) -> dict[str, float]:
    """The mean over classes of the means over their objects."""
    return means_of([means_of(of_class) for of_class in _by_class(rows).values()])


def results(rows: Sequence[Row], classes: Sequence[str], protocol: ProtocolName = "scaled") -> str:
    """The scores of the model by category, and those of all methods, in Markdown.

    The first table has the layout of the paper's: categories, the mean of categories, the mean of objects.

    Args:
        rows: at least one.
        classes: names by label.
        protocol: by which they were scored.
    """
    shown = {"chamfer": "chamfer", "normal": "normal", **_SHOWN[protocol]}
    table = [["category", "#instances", *shown.values()]]
    for label, of_class in sorted(_by_class(rows).items()):
        name = classes[label] if label < len(classes) else f"class {label}"
        table.append([name, str(len(of_class)), *_cells("model", shown, means_of(of_class))])
    count = str(len(rows))
    table.append(["mean of categories", count, *_cells("model", shown, class_means_of(rows))])
    table.append(["mean of instances", count, *_cells("model", shown, means_of(rows))])
    means = means_of(rows)
    methods = [["mean of instances", *shown.values()]]
    methods += [
        [title, *_cells(method, shown, means)] for method, title in TITLES.items() if f"{method}_chamfer" in means
    ]
    lines = [f"# {count} pictures of objects", "", *markdown_table(table), "", *markdown_table(methods), ""]
    better = "chamfer: less is better; normal (mean |cos|) and F1 (percent): more is better."
    return "\n".join([*lines, f"{_DISTANCES[protocol]}; {better}"]) + "\n"


def _by_class(rows: Sequence[Row]) -> dict[int, list[Row]]:
    classes: dict[int, list[Row]] = {}
    for row in rows:
        classes.setdefault(row["label"], []).append(row)
    return classes


def _cells(method: str, columns: Mapping[str, str], means: Mapping[str, float]) -> list[str]:
    values = {name: means[f"{method}_{name}"] for name in columns}
    return [f"{value:.2f}" if name.startswith("f1") else f"{value:.4g}" for name, value in values.items()]
