"""The report of a sweep: its runs compared."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rendra_lab.errors import UserError
from rendra_lab.html_report import media
from rendra_lab.html_report.curves import MOST_POINTS, read_curves, stages_of, unit_of
from rendra_lab.html_report.markup import Markup, joined, page, section, table, tag
from rendra_lab.html_report.run_page import STAGE_NAMES, spoken_seconds, status_badge, with_unit
from rendra_lab.report import format_number
from rendra_lab.sweep import collect

Row = dict[str, Any]

_FRAME_BYTES = 200_000  # of a page without its contents
_MOST_PICTURES = 12
_MOST_CURVES = 40  # runs in one chart
_RAMP = ((126, 76, 168), (72, 103, 170), (33, 145, 140), (84, 178, 84), (205, 160, 20))  # worst to best


def sweep_page(folder: Path, max_bytes: int) -> str:
    """The HTML of a sweep's report; UserError where the folder holds no job of a sweep."""
    rows = collect(folder) if folder.is_dir() else []
    if not rows:
        raise UserError(f"{folder} is not the folder of a sweep: no folder in it has a .hydra/overrides.yaml")
    aim = next((row["optimized_metric"] for row in rows if row.get("optimized_metric")), None)
    jobs = [_job(row, index, len(rows)) for index, row in enumerate(rows)]
    varied = _varied(rows)
    names = list(dict.fromkeys(name for row in rows for name in row["metrics"]))
    room = media.Room(max_bytes - _FRAME_BYTES)
    groups = _curve_groups(folder, rows, jobs)
    sections = [
        section("runs", "Runs", _table(folder, rows, jobs, varied, names, aim)),
        section("parallel", "Settings and result", _parallel_host(varied, names)),
        section("curves", "Curves", _charts(groups)),
        section("pictures", "Side by side, best first", _gallery(folder, rows, jobs, varied, aim, room)),
        section("notes", "Left out", tag("ul", *(tag("li", note) for note in room.notes)) if room.notes else None),
    ]
    data = {
        "kind": "sweep",
        "charts": [group["charts"] for group in groups],
        "parallel": _parallel(rows, jobs, varied, names, aim),
    }
    return page(f"sweep {folder.name}", _heading(folder, rows, aim), sections, data, ("", ""))


def _heading(folder: Path, rows: list[Row], aim: str | None) -> Markup:
    counts: dict[str, int] = {}
    for row in rows:
        counts[row["status"]] = counts.get(row["status"], 0) + 1
    badges = [joined([f"{count} ", status_badge(status), " "]) for status, count in counts.items()]
    title = tag("h1", f"Sweep of {len(rows)} runs ", tag("small", folder.name))
    fixed = {key: value for key, value in rows[0]["settings"].items() if key not in _varied(rows)}
    same = " ".join(f"{key}={value}" for key, value in fixed.items())
    order = f"Best {aim} first. " if aim else ""
    return joined(
        [title, tag("p", *badges), tag("p", order, f"The same in all: {same}" if same else "", class_="note")]
    )


def _job(row: Row, index: int, total: int) -> Row:
    share = 1.0 if total < 2 else 1 - index / (total - 1)
    return {"number": str(row["job"]), "label": f"job {row['job']}", "color": _ramp(share)}


def _ramp(share: float) -> str:
    """A colour between the worst and the best, as #rrggbb."""
    place = min(max(share, 0.0), 1.0) * (len(_RAMP) - 1)
    low = min(int(place), len(_RAMP) - 2)
    mixed = (round(a + (b - a) * (place - low)) for a, b in zip(_RAMP[low], _RAMP[low + 1], strict=True))
    return "#" + "".join(f"{channel:02x}" for channel in mixed)


def _varied(rows: list[Row]) -> list[str]:
    keys = list(dict.fromkeys(key for row in rows for key in row["settings"]))
    return [key for key in keys if len({row["settings"].get(key) for row in rows}) > 1]


def _table(
    folder: Path, rows: list[Row], jobs: list[Row], varied: list[str], names: list[str], aim: str | None
) -> Markup:
    short = [name.removeprefix("test/") for name in names]
    numbers = [(f"{name} [{unit_of(name)}]" if unit_of(name) else name) for name in short]
    right = [tag("th", text, class_="num") for text in (*numbers, "seconds")]
    head = ["job", "status", *varied, *right]
    lines = []
    for row, job in zip(rows, jobs, strict=True):
        swatch = tag("span", class_="swatch", data_color=job["color"])
        first = tag(
            "td",
            swatch,
            _link(folder, row, job["label"]),
            class_="first",
            data_value=row["job"],
            data_job=job["number"],
        )
        settings = [tag("td", tag("code", row["settings"].get(key, "-"))) for key in varied]
        values = [
            tag("td", format_number(row["metrics"].get(name)), class_="num aim" if name == aim else "num",
                data_value=_exact(row["metrics"].get(name)))
            for name in names
        ]  # fmt: skip
        seconds = tag("td", spoken_seconds(row["seconds"]), class_="num", data_value=_exact(row["seconds"]))
        status = tag("td", status_badge(row["status"]), title=row["error"])
        lines.append([first, status, *settings, *values, seconds])
    return table(head, lines, "jobs")


def _exact(value: Any) -> str:
    return "" if value is None else repr(float(value))


def _link(folder: Path, row: Row, words: str) -> Markup:
    place = row.get("folder")
    if not place or not (folder / place).is_dir():
        return tag("span", words)
    own = "report.html" if (folder / place / "report.html").is_file() else ""
    return tag("a", words, href=f"./{quote(str(place), safe='=')}/{own}")


def _parallel_host(varied: list[str], names: list[str]) -> Markup:
    return tag("div", id="parallel-view") if varied and names else Markup()


def _parallel(rows: list[Row], jobs: list[Row], varied: list[str], names: list[str], aim: str | None) -> Row:
    settings = [{"name": key, "values": _column([row["settings"].get(key) for row in rows])} for key in varied]
    metrics = [{"name": name, "values": [row["metrics"].get(name) for row in rows]} for name in names]
    return {"jobs": jobs, "settings": settings, "metrics": metrics, "aim": aim}


def _column(texts: list[str | None]) -> list[float | str | None]:
    """Numbers where all that is set is a finite number; words as they are."""
    try:
        numbers = [None if text is None else float(text) for text in texts]
    except ValueError:
        return list(texts)
    finite = all(number is None or math.isfinite(number) for number in numbers)
    return list(numbers) if finite else list(texts)


def _curve_groups(folder: Path, rows: list[Row], jobs: list[Row]) -> list[Row]:
    """The curves of all runs, a chart a quantity; worst first, so that the best lies on top."""
    charts: dict[str, list[Row]] = {}
    shown = [pair for pair in zip(rows, jobs, strict=True) if pair[0].get("folder")][:_MOST_CURVES]
    most = max(100, 4 * MOST_POINTS // max(1, len(shown)))
    for row, job in reversed(shown):
        for curve in read_curves(folder / row["folder"] / "metrics.csv"):
            if len(curve.steps) > 1 and curve.name != "epoch":
                points = curve.points(min(MOST_POINTS, most))
                line = {**points, "color": job["color"], "job": job["number"], "label": job["label"]}
                charts.setdefault(curve.name, []).append(line)
    return [
        {
            "title": STAGE_NAMES[stage],
            "charts": [
                {"title": name, "unit": unit_of(name), "over": "step", "series": charts[name]} for name in names
            ],
        }
        for stage, names in stages_of(list(charts)).items()
    ]


def _charts(groups: list[Row]) -> Markup:
    parts = [
        joined([tag("h3", group["title"]), tag("div", class_="charts", data_group=index)])
        for index, group in enumerate(groups)
    ]
    return joined([tag("div", class_="chart-controls"), *parts]) if parts else Markup()


def _gallery(
    folder: Path, rows: list[Row], jobs: list[Row], varied: list[str], aim: str | None, room: media.Room
) -> Markup:
    figures: list[Markup] = []
    for row, job in zip(rows, jobs, strict=True):
        path = _best_picture(folder / row["folder"]) if row.get("folder") else None
        if path is None or len(figures) == _MOST_PICTURES:
            continue
        told = ", ".join(f"{key}={row['settings'].get(key, '-')}" for key in varied)
        score = f"{aim} {with_unit(aim, row['metrics'].get(aim))}" if aim else ""
        caption = "; ".join(part for part in (job["label"], told, score, path.name) if part)
        figure = media.still_figure(media.Frame(path, caption), room, job["label"])
        if figure is not None:
            figures.append(figure)
    return tag("div", *figures, class_="gallery") if figures else Markup()


def _best_picture(job: Path) -> Path | None:
    """What shows a run best: the end of its fit, else its last validation, else its first test view."""
    images = job / "images"
    final = [images / "final.png"] if (images / "final.png").is_file() else []
    found = [*sorted(images.glob("test_*.png"))[:1], *sorted(images.glob("val_*.png"))[-1:], *final]
    return found[-1] if found else None
