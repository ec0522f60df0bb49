"""The numbers of new views beside those of baselines: a row a pair, and the table of their means.

Methods are `model`, and those of `baselines`: `copy`, `true_warp`, `constant_warp`. Columns of a row: METHOD_MEASURE
over the whole target and METHOD_MEASURE_REGION; with a truth also `visible`, the share of the target's pixels that
the input shows, and depth_MEASURE of the model's depth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import get_args

import torch
from torch import Tensor

from rendra_lab.metrics import Scores
from rendra_lab.report import markdown_table
from rendra_lab.tasks.synsin.records import PairBatch, ViewPrediction
from rendra_lab.tasks.synsin.scores import REGIONS, DepthMeasure, depth_scores, measures, view_scores

Row = dict[str, float | None]  # of one pair; None where there was nothing to score

TITLES = {
    "model": "model",
    "copy": "input copied",
    "true_warp": "true-depth warp",
    "constant_warp": "constant-depth warp",
}
"""What methods are called in tables."""

_SMALLEST_SSIM_PX = 11


def numbers_of(views: Mapping[str, Tensor], prediction: ViewPrediction, batch: PairBatch) -> list[Row]:
    """What each of B pairs scores, a row a pair.

    Args:
        views: (B, 3, H, W) by the name of the method that made them.
        prediction: of the model, for its depth.
        batch: the pairs. SSIM is left out where they have a side of fewer than 11 pixels.
    """
    columns = dict(_view_columns(views, batch))
    if (truth := batch.truth) is not None:
        visible = truth.visible.float().mean((1, 2, 3))
        columns["visible"] = Scores(visible, torch.ones_like(visible, dtype=torch.bool))
        for measure in get_args(DepthMeasure):
            columns[f"depth_{measure}"] = depth_scores(prediction.depth, truth, measure=measure)
    plain = {name: (value.tolist(), counted.tolist()) for name, (value, counted) in columns.items()}
    return [
        {name: value[i] if counted[i] else None for name, (value, counted) in plain.items()}
        for i in range(len(batch.input))
    ]


def means_of(rows: Sequence[Row]) -> dict[str, float]:
    """The mean of every column over the rows that have a number there; columns without any are left out."""
    names = rows[0] if rows else {}
    columns = {name: [value for row in rows if (value := row[name]) is not None] for name in names}
    return {name: sum(column) / len(column) for name, column in columns.items() if column}


def results(rows: Sequence[Row], constant_depth: float | None) -> str:
    """The means of some pairs as a table in Markdown: measures and regions by methods.

    Args:
        rows: at least one.
        constant_depth: of the warp by one depth, metres; None if there is none.
    """
    means = means_of(rows)
    titles = {method: title for method, title in TITLES.items() if f"{method}_psnr" in means}
    table = [["", *titles.values()]]
    for measure in measures():
        for region in REGIONS:
            cells = [means.get(column_name(method, measure, region)) for method in titles]
            if any(cell is not None for cell in cells):
                name = measure if region == "whole" else f"{measure}, {region}"
                table.append([name, *(formatted(measure, cell) for cell in cells)])
    depths = {measure: means.get(f"depth_{measure}") for measure in get_args(DepthMeasure)}
    blank = [""] * (len(titles) - 1)
    table += [[f"depth {name}", formatted(name, cell), *blank] for name, cell in depths.items() if cell is not None]
    return (
        "\n".join([f"# {len(rows)} new views", "", *markdown_table(table), "", *_notes(rows, constant_depth)]) + "\n"
    )


def column_name(method: str, measure: str, region: str = "whole") -> str:
    """Of what a method scores by a measure over a region."""
    return f"{method}_{measure}" if region == "whole" else f"{method}_{measure}_{region}"


def formatted(measure: str, value: float | None) -> str:
    """A number as the tables have it; a dash for none."""
    if value is None:
        return "-"
    return f"{value:.2f}" if measure == "psnr" else f"{value:.3f}"


def _view_columns(views: Mapping[str, Tensor], batch: PairBatch) -> Iterator[tuple[str, Scores]]:
    regions = REGIONS if batch.truth is not None else REGIONS[:1]
    is_small = min(batch.target.shape[-2:]) < _SMALLEST_SSIM_PX
    for method, rgb in views.items():
        for measure in measures():
            if measure == "ssim" and is_small:
                continue
            for region in regions:
                scores = view_scores(rgb, batch.target, truth=batch.truth, measure=measure, region=region)
                yield column_name(method, measure, region), scores


def _notes(rows: Sequence[Row], constant_depth: float | None) -> list[str]:
    notes = ["psnr in dB; psnr and ssim: more is better; perceptual_lite0: less is better, and it is not LPIPS."]
    shares = [share for row in rows if (share := row.get("visible")) is not None]
    if shares:
        seen, unseen = sum(share > 0 for share in shares), sum(share < 1 for share in shares)
        notes.append(
            f"The inputs show {100 * sum(shares) / len(shares):.0f} % of the targets; "
            f"{seen} targets have visible pixels, {unseen} invisible ones."
        )
    if constant_depth is not None:
        notes.append(f"The constant depth is {constant_depth:.4g} m.")
    return [*notes, "Holes of warps have the mean colour of what is no hole."]
