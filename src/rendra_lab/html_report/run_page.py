"""The report of one run."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rendra_lab.errors import UserError
from rendra_lab.html_report import media
from rendra_lab.html_report.curves import Curve, final_table, read_curves, stages_of, unit_of
from rendra_lab.html_report.markup import Markup, data_block, joined, page, section, table, tag
from rendra_lab.html_report.media import Room
from rendra_lab.html_report.settings import Settings, read_settings
from rendra_lab.report import format_number

_FRAME_BYTES = 400_000  # of a page without its contents
_SHAPES = (".glb", ".ply", ".obj", ".off", ".stl")  # what carries colours first, and what is read fastest
_MOST_SHAPES = 6
_MOST_ROWS = 100
_LOG_BYTES = 20_000
STAGE_NAMES = {"train": "Training", "val": "Validation", "test": "Test", "other": "Other"}


def run_page(folder: Path, max_bytes: int) -> str:
    """The HTML of a run's report; UserError where the folder holds nothing of a run."""
    record = read_record(folder)
    if not any((folder / name).exists() for name in ("metrics.json", "metrics.csv", ".hydra")):
        raise UserError(f"{folder} is not the folder of a run: it has no metrics.json, metrics.csv or .hydra")
    settings = read_settings(folder)
    room = Room(max_bytes - _FRAME_BYTES)
    curves = [curve for curve in read_curves(folder / "metrics.csv") if curve.name != "epoch"]  # bookkeeping
    groups = [*_curve_groups(curves), *_frame_curves(folder)]
    scene, assets = _scene(folder, room)
    sections = [
        section("result", "Result", _facts(record), _metrics(record), _error(folder, record)),
        section("settings", "Settings", _settings(settings)),
        section("scene", "In 3-D", scene),
        *_pictures(folder, record, room),
        section("curves", "Curves", *_charts(groups, curves)),
        section("files", "Files", _files(folder)),
    ]
    if room.notes:
        sections.append(section("notes", "Left out", tag("ul", *(tag("li", note) for note in room.notes))))
    task = str(record.get("task") or folder.parent.name)
    data = {"kind": "run", "charts": [group["charts"] for group in groups]}
    return page(f"{task} {folder.name}", _heading(task, folder, record, settings), sections, data, assets)


def read_record(folder: Path) -> dict[str, Any]:
    """`metrics.json` of a run; empty where it is missing or broken."""
    try:
        record = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def status_badge(status: Any) -> Markup:
    """The word for how a run ended, coloured."""
    known = {"ok": "good", "failed": "bad", "interrupted": "warn"}
    return tag("span", status or "unfinished", class_=f"badge {known.get(status, 'warn')}")


def spoken_seconds(seconds: Any) -> str:
    """A duration as people say it."""
    if not isinstance(seconds, int | float):
        return "-"
    minutes, rest = divmod(round(seconds), 60)
    if minutes == 0:
        return f"{seconds:.1f} s"
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def with_unit(name: str, value: Any) -> str:
    """A metric's value with the unit that its name tells."""
    unit = unit_of(name)
    gap = "" if unit == "°" else "\u202f"  # narrow and unbroken
    return f"{format_number(value)}{gap}{unit}" if unit and value is not None else format_number(value)


def _heading(task: str, folder: Path, record: Mapping[str, Any], settings: Settings) -> Markup:
    title = tag("h1", task, " ", tag("small", folder.name), " ", status_badge(record.get("status")))
    command = record.get("command") or " ".join(["train.py", *settings.command_words])
    lines = [f"python {command}"]
    if settings.command_words and {"-m", "--multirun"} & set(command.split()):
        lines.append(f"python {command.split()[0]} {' '.join(settings.command_words)}  # this job alone")
    return joined([title, tag("pre", "\n".join(lines), class_="command")])


def _facts(record: Mapping[str, Any]) -> Markup:
    seconds, memory = record.get("seconds") or {}, record.get("peak_memory_mb") or {}
    step_ms = record.get("step_ms_median")
    facts = {
        "steps": record.get("steps"),
        "time": spoken_seconds(seconds.get("total")),
        "a step, median": None if step_ms is None else f"{format_number(step_ms)} ms",
        "peak memory": f"{memory['ram']:.0f} MB" if memory.get("ram") else None,
        "peak GPU memory": f"{memory['gpu']:.0f} MB" if memory.get("gpu") else None,
        "device": record.get("device"),
        "threads": record.get("threads"),
        "seed": record.get("seed"),
        "torch": (record.get("versions") or {}).get("torch"),
        "commit": str(record.get("git_commit") or "")[:9] or None,
        "resumed from": record.get("resumed_from"),
    }
    shown = {name: value for name, value in facts.items() if value is not None}
    phases = ", ".join(f"{name} {spoken_seconds(value)}" for name, value in seconds.items() if name != "total")
    tiles = [
        tag("div", tag("dt", name), tag("dd", value, title=phases if name == "time" else None))
        for name, value in shown.items()
    ]
    return tag("dl", *tiles, class_="facts") if record else Markup()


def _metrics(record: Mapping[str, Any]) -> Markup:
    metrics = record.get("metrics") or {}
    if not metrics:
        return Markup()
    aim = record.get("optimized_metric")
    columns, rows = final_table(metrics)
    lines = []
    for name, values in rows:
        full = [name if stage == "other" else f"{stage}/{name}" for stage in columns]
        cells = [
            tag("td", with_unit(key, value) if key in metrics else "", class_="num aim" if key == aim else "num")
            for key, value in zip(full, values, strict=True)
        ]
        lines.append([tag("th", name, scope="row"), *cells])
    words = {"minimize": "lower is better", "maximize": "higher is better"}.get(str(record.get("direction")), "")
    note = tag("p", f"Highlighted: {aim}, what a sweep sorts by; {words}.", class_="note") if aim in metrics else None
    head = ["metric", *(tag("th", STAGE_NAMES[stage].lower(), class_="num") for stage in columns)]
    return joined([table(head, lines, "metrics"), note])


def _error(folder: Path, record: Mapping[str, Any]) -> Markup:
    if record.get("status") == "ok":
        return Markup()
    error = record.get("error")
    words = tag("p", error, class_="error") if error else tag("p", "This run did not end; what it reached is below.")
    log = ""
    for path in sorted(folder.glob("*.log")):
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _LOG_BYTES))
            log += file.read().decode("utf-8", errors="replace")
    kept = tag("details", tag("summary", "Log"), tag("pre", log), open=True) if log.strip() else None
    return joined([words, kept])


def _scene(folder: Path, room: Room) -> tuple[Markup, tuple[str, str]]:
    """The shapes of `exports` in the viewer, and the viewer's style and program."""
    paths = _shapes(folder)
    if not paths:
        return Markup(), ("", "")
    try:
        from rendra_lab.viewer import scene_payload, viewer_assets

        payload = scene_payload([(path.stem.replace("_", " "), path) for path in paths])
    except Exception as error:  # whatever a damaged file makes a reader say: the rest of the page stands
        room.notes.append(f"The shapes in exports cannot be shown: {type(error).__name__}: {error}")
        return Markup(), ("", "")
    block = data_block("scene-data", payload)
    if not room.take(len(block), "The 3-D view"):
        return Markup(), ("", "")
    view = tag("div", id="scene-view", role="img", aria_label="the resulting shapes, which turn with the mouse")
    sources = ", ".join(path.name for path in paths)
    return joined([view, tag("p", f"From exports: {sources}.", class_="note"), block]), viewer_assets()


def _shapes(folder: Path) -> list[Path]:
    """One file a shape: the same stem in several formats is one."""
    best: dict[str, Path] = {}
    for ending in _SHAPES:
        for path in sorted((folder / "exports").glob(f"*{ending}")):
            best.setdefault(path.stem, path)
    return list(best.values())[:_MOST_SHAPES]


def _pictures(folder: Path, record: Mapping[str, Any], room: Room) -> Iterator[Markup]:
    views = _view_captions(folder)
    animations = [media.animation_figure(frame, room) for frame in media.find_animations(folder)]
    reels = media.find_pictures(folder, record.get("steps"))
    shown = {}
    for index, reel in enumerate(reels):
        if reel.identity == "test":
            reel.frames = [
                media.Frame(frame.path, views.get(frame.path.stem.split("_")[1], frame.caption))
                for frame in reel.frames
            ]
        shown[reel.identity] = media.reel_figures(reel, room, room.left // (len(reels) - index))
    reel_order = [reel for reel in reels if reel.identity in ("fit", "val", "test")]
    singles = [shown[reel.identity] for reel in reels if reel not in reel_order]
    yield section("story", "Pictures", tag("div", *singles, class_="singles") if any(singles) else None)
    yield section("animations", "Animations", tag("div", *animations, class_="films") if any(animations) else None)
    for reel in reel_order:
        yield section(reel.identity, reel.title, shown[reel.identity])


def _view_captions(folder: Path) -> dict[str, str]:
    """What the table of the test says about each view, by its number as three digits."""
    captions = {}
    for index, row in enumerate(_rows(folder / "exports" / "views.csv")):
        numbers = [f"{name} {with_unit(name, _number(row[name]))}" for name in list(row)[1:3]]
        captions[f"{index:03d}"] = ", ".join([str(row.get("view", f"view {index}")), *numbers])
    return captions


def _curve_groups(curves: list[Curve]) -> list[dict[str, Any]]:
    by_name = {curve.name: curve for curve in curves if len(curve.steps) > 1}
    return [
        {"title": STAGE_NAMES[stage], "charts": [_chart(by_name[name], "step") for name in names]}
        for stage, names in stages_of(list(by_name)).items()
    ]


def _frame_curves(folder: Path) -> Iterator[dict[str, Any]]:
    """Tables of exports with a row a frame: curves over frames."""
    for path in sorted((folder / "exports").glob("*.csv")):
        rows = _rows(path)
        if len(rows) < 2 or "frame" not in rows[0]:
            continue
        steps = [int(_number(row["frame"]) or 0) for row in rows]
        columns = [name for name in rows[0] if name and name != "frame" and _number(rows[0][name]) is not None]
        curves = [Curve(name, steps, [_number(row[name]) or 0.0 for row in rows]) for name in columns]
        yield {"title": f"exports/{path.name}", "charts": [_chart(curve, "frame") for curve in curves]}


def _chart(curve: Curve, over: str) -> dict[str, Any]:
    points = curve.points()
    return {"title": curve.name, "unit": points["unit"], "over": over, "series": [points]}


def _charts(groups: list[dict[str, Any]], curves: list[Curve]) -> Iterator[Markup]:
    if groups:
        yield tag("div", class_="chart-controls")
    for index, group in enumerate(groups):
        yield tag("h3", group["title"])
        yield tag("div", class_="charts", data_group=index)
    once = [curve for curve in curves if len(curve.steps) == 1]
    if once:
        words = ", ".join(f"{curve.name} {with_unit(curve.name, curve.values[0])}" for curve in once)
        yield tag("p", f"Logged once, at step {once[0].steps[0]}: {words}.", class_="note")


def _settings(settings: Settings) -> Markup:
    head = ["setting", "default", "this run"]
    parts: list[Markup] = []
    if settings.note:
        parts.append(tag("p", settings.note, class_="note"))
        parts.append(tag("p", f"Told on the command line: {' '.join(settings.command_words) or 'nothing'}."))
    told = [*settings.choices, *settings.told]
    if told:
        parts.append(table(head, [_setting(row) for row in told], "settings"))
    elif not settings.note:
        parts.append(tag("p", "Nothing that the command set differs from the defaults of the task."))
    if settings.implied:
        words = "follow from these choices" if told else "differ, as the defaults have changed since"
        summary = tag("summary", f"{len(settings.implied)} more that {words}")
        parts.append(tag("details", summary, table(head, [_setting(row) for row in settings.implied], "settings")))
    if settings.text:
        parts.append(tag("details", tag("summary", "The whole configuration"), tag("pre", settings.text)))
    return joined(parts)


def _setting(row: tuple[str, str, str]) -> list[Markup]:
    return [tag("th", tag("code", row[0]), scope="row"), *(tag("td", tag("code", value)) for value in row[1:])]


def _files(folder: Path) -> Markup:
    found = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "report.html"]
    rows = []
    for path in found[:_MOST_ROWS]:
        place = path.relative_to(folder).as_posix()
        size = tag("td", _spoken_size(path.stat().st_size), class_="num")
        rows.append([tag("td", tag("a", place, href=_link(place))), size])
    more = f" (the first {_MOST_ROWS})" if len(found) > _MOST_ROWS else ""
    summary = tag("summary", f"{len(found)} files beside this page{more}")
    return tag("details", summary, table(["file", tag("th", "size", class_="num")], rows)) if rows else Markup()


def _link(place: str) -> str:
    from urllib.parse import quote

    return f"./{quote(place)}"


def _spoken_size(size: int) -> str:
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e3:.1f} kB"


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        return list(csv.DictReader(file))


def _number(text: Any) -> float | None:
    try:
        return float(text)
    except (TypeError, ValueError):
        return None
