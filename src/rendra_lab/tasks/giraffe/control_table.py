"""Disentanglement as a table for people: what each control does to the object that it names, and to the rest."""

from __future__ import annotations

from collections.abc import Sequence

from rendra_lab.report import markdown_table
from rendra_lab.tasks.giraffe.disentanglement import Probe, Row, means_of

TITLES = {
    "turn": "object turned once round",
    "move": "object moved by a quarter of the frame",
    "scale": "object 20 % smaller to 20 % larger",
    "appearance": "other appearance of the object",
    "shape": "other shape of the object",
    "background": "other appearance of the background",
}
"""What controls are called in tables and on sheets."""


def results(rows: Sequence[Row], probe: Probe, true_share: float | None = None) -> str:
    """The means of some scenes as a table in Markdown: controls by what changed, and how they were followed.

    Args:
        rows: of the scenes.
        probe: how they were measured.
        true_share: of a picture that a real object covers; None where nobody knows.
    """
    means = means_of(list(rows))
    table = [["", "object pixels change", "background pixels change", "as commanded"]]
    for control, title in TITLES.items():
        shares = [_percent(means.get(f"{control}_{where}_change")) for where in ("object", "background")]
        table.append([title, *shares, _followed(control, means)])
    seen = sum(row["seen"] or 0.0 for row in rows)
    share = _percent(means.get("mask_share"))
    head = f"# Controls of {len(rows)} scenes, in {seen:.0f} of which the object is seen"
    beside = "" if true_share is None else f"; a real one covers {_percent(true_share)}"
    notes = [
        "Changes in % of the range of a colour, mean over pixels; 0 is as it was. What a control does not name "
        "should stay: the background of the first five rows, the object of the last.",
        f"An object is where its picture changes by more than {probe.threshold:g} when it is taken away: {share} of "
        f"the picture{beside}. Codes at temperature {probe.temperature:g}.",
    ]
    return "\n".join([head, "", *markdown_table(table), "", *notes]) + "\n"


def _followed(control: str, means: dict[str, float]) -> str:
    if control in ("move", "scale"):
        found = means.get(f"{control}_correlation"), means.get(f"{control}_slope")
        what = "place" if control == "move" else "area"
        return "-" if None in found else f"{what}: correlation {found[0]:.3f}, slope {found[1]:.2f}"
    if control in ("appearance", "shape"):
        iou = means.get(f"{control}_mask_iou")
        return "-" if iou is None else f"masks overlap {iou:.3f}"
    return ""


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.2f} %"
