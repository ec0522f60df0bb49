"""report.html: everything of a run on one page, nothing from outside runs in it, and no run fails over it."""

import json
import math
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from headless_chromium import seen
from PIL import Image

from rendra.io import IO
from rendra.utils import ico_sphere
from rendra_lab import html_report
from rendra_lab.errors import UserError
from rendra_lab.html_report import leave_run_report, write_run_report, write_sweep_report
from rendra_lab.html_report.curves import Curve, read_curves, unit_of
from rendra_lab.html_report.markup import data_block, tag
from rendra_lab.html_report.media import Room
from rendra_lab.html_report.run_page import spoken_seconds
from rendra_lab.html_report.settings import read_settings

RED, GREEN, BLUE = (220, 20, 20), (20, 180, 20), (20, 20, 220)
ATTACK = "</script><script>document.title='broken in'</script><img src=x onerror=\"document.title='broken in'\">"


def picture(path: Path, color: tuple[int, int, int], size: tuple[int, int] = (300, 200)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, color).save(path)


def make_run(folder: Path, metric: str = "test/psnr", value: float = 30.0, shape: bool = True, **record: Any) -> Path:
    """What a finished run leaves: numbers, three pictures of the fit, an animation and maybe a mesh."""
    for step, color in ((0, RED), (50, GREEN)):
        picture(folder / "images" / f"step_{step:06d}.png", color)
    picture(folder / "images" / "final.png", BLUE)
    (folder / "exports").mkdir()
    frames = [Image.new("RGB", (40, 40), color) for color in (RED, BLUE)]
    frames[0].save(folder / "exports" / "turntable.gif", save_all=True, append_images=frames[1:])
    if shape:
        IO().save_mesh(ico_sphere(2), folder / "exports" / "ball.ply")
    lines = ["step,train/loss,val/psnr", *(f"{step},{math.exp(-step / 30)}," for step in range(0, 100, 10))]
    (folder / "metrics.csv").write_text("\n".join([*lines, "49,,20.5", "99,,28.5", ""]))
    content = {
        "status": "ok",
        "task": "toy",
        "overrides": [],
        "optimized_metric": metric,
        "direction": "maximize",
        "steps": 100,
        "metrics": {"train/loss": 0.04, metric: value},
        "seconds": {"fit": 61.0, "total": 75.5},
        "command": "train.py task=toy",
        "device": "cpu",
    }
    (folder / "metrics.json").write_text(json.dumps(content | record))
    return folder


def make_job(folder: Path, lr: str, value: float) -> None:
    make_run(folder, value=value, shape=False, overrides=["task=toy", f"optimizer.lr={lr}"])
    (folder / ".hydra").mkdir()
    (folder / ".hydra" / "overrides.yaml").write_text(f"- task=toy\n- optimizer.lr={lr}\n")


class Page(HTMLParser):
    """The elements of a page: their names, attributes and text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {}
        self.feed(text)

    def handle_starttag(self, name: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((name, dict(attributes)))

    def handle_data(self, data: str) -> None:
        if self.tags:
            self.texts.setdefault(self.tags[-1][0], []).append(data)

    def all(self, name: str) -> list[dict[str, str | None]]:
        return [attributes for each, attributes in self.tags if each == name]


def read_page(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


def share_of(picture: np.ndarray, color: tuple[int, int, int]) -> float:
    return float((np.abs(picture - np.array(color)).max(-1) < 12).mean())


def test_a_run_has_everything_on_one_page(tmp_path: Path) -> None:
    page = read_page(write_run_report(make_run(tmp_path / "run")))
    sections = [attributes["id"] for attributes in page.all("section")]
    assert sections == ["result", "settings", "scene", "animations", "fit", "curves", "files"]
    assert [figure.get("data-step") for figure in page.all("figure")] == [None, "0", "50", "100"]
    assert "python train.py task=toy" in page.texts["pre"]
    cells = [text.replace("\u202f", " ") for text in page.texts["td"]]
    assert {"0.04", "30 dB"} <= set(cells)
    assert "1 min 16 s" in page.texts["dd"]


def test_a_page_needs_nothing_from_outside(tmp_path: Path) -> None:
    page = read_page(write_run_report(make_run(tmp_path / "run")))
    sources = [attributes[key] for _, attributes in page.tags for key in ("src", "href") if key in attributes]
    assert sources
    assert all(source and source.startswith(("data:", "#", "./")) for source in sources)
    (policy,) = [each["content"] or "" for each in page.all("meta") if "http-equiv" in each]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")


def test_what_comes_from_outside_is_text(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run", metric=f"test/{ATTACK}", command=ATTACK, error=ATTACK, status=ATTACK)
    table = (folder / "metrics.csv").read_text()
    quoted = ATTACK.replace('"', '""')
    (folder / "metrics.csv").write_text(table.replace("train/loss", f'"train/{quoted}"', 1))
    picture(folder / "images" / "<img src=x>.png", RED)
    page = read_page(write_run_report(folder))
    kinds = [attributes.get("type") for attributes in page.all("script")]
    assert sorted(kinds, key=str) == [None, "application/json", "application/json"]
    assert not [attributes for _, attributes in page.tags if any(key.startswith("on") for key in attributes)]


def test_a_hostile_page_runs_nothing_in_a_browser(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run", metric=f"test/{ATTACK}", command=ATTACK, shape=False)
    text = write_run_report(folder).read_text(encoding="utf-8")
    text += "<script>document.body.style.background='rgb(255, 0, 255)'; document.body.textContent = ''</script>"
    shown, said = seen(text, tmp_path, webgl=False)
    assert share_of(shown, (255, 0, 255)) == 0
    assert len(said) == 1
    assert "Content Security Policy" in said[0]  # the script that this test put there


def test_a_browser_shows_the_mesh(tmp_path: Path) -> None:
    text = write_run_report(make_run(tmp_path / "run")).read_text(encoding="utf-8")
    shown, said = seen(text, tmp_path, (900, 900), fragment="#show=scene")
    assert said == []
    middle = shown[380:620, 350:550]
    assert len(np.unique(middle.reshape(-1, 3), axis=0)) > 100  # shades of a ball
    assert middle.std(axis=(0, 1)).max() > 5


@pytest.mark.parametrize(("step", "color"), [(0, RED), (61, GREEN)])
def test_the_slider_shows_the_picture_of_its_step(tmp_path: Path, step: int, color: tuple[int, int, int]) -> None:
    text = write_run_report(make_run(tmp_path / "run", shape=False)).read_text(encoding="utf-8")
    shown, said = seen(text, tmp_path, webgl=False, fragment=f"#show=fit&step={step}")
    assert said == []
    others = {RED, GREEN, BLUE} - {color}
    assert share_of(shown, color) > 0.05
    assert max(share_of(shown, other) for other in others) < 0.001


def test_curves_are_drawn_on_a_log_scale_too(tmp_path: Path) -> None:
    text = write_run_report(make_run(tmp_path / "run", shape=False)).read_text(encoding="utf-8")
    pictures = [
        seen(text, tmp_path, webgl=False, fragment=f"#show=curves&{state}") for state in ("log=0", "log=1&smooth=0.5")
    ]
    assert [said for _, said in pictures] == [[], []]
    accent = (31, 111, 235)
    assert all(share_of(shown, accent) > 0.001 for shown, _ in pictures)
    assert np.abs(pictures[0][0] - pictures[1][0]).max() > 100


def test_a_sweep_is_compared(tmp_path: Path) -> None:
    sweep = tmp_path / "sweep"
    for number, (lr, value) in enumerate([("0.1", 20.0), ("0.2", 31.5), ("0.4", 25.0)]):
        make_job(sweep / f"{number}_lr={lr}", lr, value)
    path = write_sweep_report(sweep)
    page = read_page(path)
    assert [each["id"] for each in page.all("section")] == ["runs", "parallel", "curves", "pictures"]
    links = [each["href"] for each in page.all("a") if (each["href"] or "").endswith("report.html")]
    assert links == ["./1_lr=0.2/report.html", "./2_lr=0.4/report.html", "./0_lr=0.1/report.html"]  # best first
    assert all((sweep / str(link)).is_file() for link in links)
    assert len(page.all("figure")) == 3
    shown, said = seen(path.read_text(encoding="utf-8"), tmp_path, webgl=False, fragment="#show=pictures")
    assert said == []
    assert share_of(shown, BLUE) > 0.02


def test_a_sweep_answers_the_mouse(tmp_path: Path) -> None:
    sweep = tmp_path / "sweep"
    for number, (lr, value) in enumerate([("0.1", 20.0), ("0.2", 31.5), ("0.4", 9.0)]):
        make_job(sweep / str(number), lr, value)
    text = write_sweep_report(sweep).read_text(encoding="utf-8")
    policy = re.compile("<meta http-equiv[^>]*>")  # or the script of this test would not run
    script = """<script>
      const order = () => [...document.querySelectorAll("table.jobs tbody a")].map((link) => link.textContent).join();
      const heads = [...document.querySelectorAll("table.jobs th")];
      const head = heads.find((each) => each.textContent.startsWith("psnr"));
      head.click(); console.log("up " + order());
      head.click(); console.log("down " + order());
      const svg = document.querySelector(".chart svg"), frame = svg.getBoundingClientRect();
      svg.dispatchEvent(new PointerEvent("pointermove", { clientX: frame.right - 1, clientY: frame.top + 9 }));
      console.log(svg.closest(".chart").querySelector("span").textContent);
      const line = document.querySelector("#parallel-view path[data-job='2']");
      line.dispatchEvent(new PointerEvent("pointerover", { bubbles: true }));
      console.log([...document.querySelectorAll("#parallel-view .lit")].map((each) => each.textContent).join());
    </script>"""
    _, said = seen(policy.sub("", text) + script, tmp_path, webgl=False)
    last = "0.049787"
    assert said == [
        "up job 2,job 0,job 1",
        "down job 1,job 0,job 2",
        f"job 2: {last}  job 0: {last}  job 1: {last} at step 90",
        "job 2",
    ]


def test_pictures_beyond_the_size_are_left_out_and_named(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    noise = np.random.default_rng(0).integers(0, 255, (300, 300, 3), dtype=np.uint8)
    for step in range(100, 1100, 100):
        Image.fromarray(noise).save(folder / "images" / f"step_{step:06d}.png")
    path = write_run_report(folder, max_mb=1.5)
    assert path.stat().st_size < 1.5e6
    notes = " ".join(read_page(path).texts["li"])
    assert re.search(r"Fit: \d+ of 13 pictures were left out for size", notes)


def test_room_is_never_overdrawn() -> None:
    room = Room(100)
    assert room.take(60, "a")
    assert not room.take(41, "b.gif")
    assert room.left == 40
    assert room.notes == ["b.gif (0.0 MB) did not fit."]


def test_a_failed_run_shows_its_reason_and_its_log(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run", status="failed", error="RuntimeError: the toy broke as told")
    (folder / "train.log").write_text("Traceback: here <b>it</b> broke")
    text = write_run_report(folder).read_text(encoding="utf-8")
    assert "the toy broke as told" in text
    assert "here &lt;b&gt;it&lt;/b&gt; broke" in text


def test_damaged_files_are_noted_not_fatal(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    (folder / "exports" / "ball.ply").write_bytes(b"ply\nformat nonsense")
    (folder / "images" / "final.png").write_bytes(b"\x89PNG" + bytes(500_000))
    (folder / "metrics.csv").write_text("step,train/loss\n0,1.0\n1,nan\n2,0.")
    (folder / "metrics.json").write_text('{"status": "ok", "metr')
    notes = " ".join(read_page(write_run_report(folder)).texts["li"])
    assert "The shapes in exports cannot be shown" in notes
    assert "final.png cannot be read" in notes


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="not the folder of a run"):
        write_run_report(tmp_path)
    with pytest.raises(UserError, match="not the folder of a sweep"):
        write_sweep_report(tmp_path / "nowhere")


def test_a_report_that_cannot_be_made_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(folder: Path) -> Path:
        raise RuntimeError("no\nluck")

    folder = make_run(tmp_path / "run")
    monkeypatch.setattr(html_report, "write_run_report", broken)
    assert leave_run_report(folder) is None
    assert [record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == [
        "no report.html: RuntimeError: no luck"
    ]
    assert leave_run_report(folder, wanted=False) is None
    assert leave_run_report(tmp_path) is None  # nothing was reached
    assert len(caplog.records) <= 2


def test_a_run_ends_with_its_report_and_names_it(train: Callable[..., tuple[int, str, str]], tmp_path: Path) -> None:
    code, said, _ = train("optimizer.lr=0.07", "trainer.max_steps=10", "trainer.log_every_n_steps=5", "seed=3")
    assert code == 0
    (path,) = tmp_path.glob("outputs/*/*/report.html")
    assert re.search(rf"^report\s+{re.escape(str(path.relative_to(tmp_path)))}$", said, re.MULTILINE)
    settings = read_settings(path.parent)
    assert settings.note is None
    told = {key: value for key, _, value in settings.told}
    assert told == {"optimizer.lr": "0.07", "trainer.max_steps": "10", "trainer.log_every_n_steps": "5", "seed": "3"}
    assert settings.implied == settings.choices == []


def test_failed_jobs_and_their_sweep_have_reports_too(
    train: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    code, said, _ = train("-m", "+module.fail_at=5,50", "trainer.max_steps=8", "trainer.log_every_n_steps=2")
    assert code == 1
    (sweep,) = [
        path for path in tmp_path.glob("outputs/*/*/report.html") if f"report    {path.relative_to(tmp_path)}" in said
    ]
    statuses = [text for text in read_page(sweep).texts["span"] if text in ("ok", "failed")]
    assert sorted(statuses) == ["failed", "failed", "ok", "ok"]  # in the heading and in the table
    (failed,) = sweep.parent.glob("0_*/report.html")
    assert "RuntimeError: the toy broke as told" in read_page(failed).texts["p"]
    assert ("module.fail_at", "(absent)", "5") in read_settings(failed.parent).told


def test_a_report_can_be_switched_off(train: Callable[..., tuple[int, str, str]], tmp_path: Path) -> None:
    code, said, _ = train("trainer.max_steps=2", "report=false")
    assert code == 0
    assert not list(tmp_path.rglob("report.html"))
    assert "report    " not in said


def test_the_script_makes_reports_anew(program: Callable[..., tuple[int, str, str]], tmp_path: Path) -> None:
    make_job(tmp_path / "sweep" / "0_a", "0.1", 3.0)
    code, said, _ = program("scripts/report.py", f"run={tmp_path / 'sweep' / '0_a'}")
    assert (code, said.strip()) == (0, str(tmp_path / "sweep" / "0_a" / "report.html"))
    code, said, _ = program("scripts/report.py", f"run={tmp_path / 'sweep'}", "max_mb=5")
    assert (code, said.strip()) == (0, str(tmp_path / "sweep" / "report.html"))


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["run=nowhere"], "nowhere is not the folder of a run"),
        (["max_mb=5"], "say run=FOLDER"),
        (["run=.", "max_mb=many"], "max_mb must be a number, got 'many'"),
        (["run=.", "max_mb=nan"], "max_mb must be at least 1"),
        (["ran=."], "expected run=FOLDER or max_mb=NUMBER, got 'ran=.'"),
    ],
)
def test_the_script_answers_mistakes_in_one_line(
    program: Callable[..., tuple[int, str, str]], words: list[str], complaint: str
) -> None:
    code, _, error = program("scripts/report.py", *words)
    assert code == 2
    assert error.startswith(f"report.py: {complaint}")
    assert error.count("\n") == 1


def test_curves_are_read_as_they_were_logged(tmp_path: Path) -> None:
    table = tmp_path / "metrics.csv"
    table.write_text("step,train/loss,val/psnr\n5,0.5,\n3,0.75,\n4,,21.5\n5,inf,\n,9,\nx,9,\n6,0.2")
    loss, psnr = read_curves(table)
    assert (loss.name, loss.steps, loss.values) == ("train/loss", [3, 5, 6], [0.75, math.inf, 0.2])
    assert loss.points()["y"] == [0.75, None, 0.2]
    assert (psnr.stage, psnr.steps, psnr.points()["unit"]) == ("val", [4], "dB")
    assert read_curves(tmp_path / "none.csv") == []


def test_a_long_curve_keeps_its_extremes() -> None:
    values = [math.sin(index / 900) for index in range(100_000)]
    values[54_321], values[7] = 9.0, -9.0
    points = Curve("a", list(range(100_000)), values).points()
    assert len(points["x"]) <= 1500
    assert {0, 7, 54_321, 99_999} <= set(points["x"])
    assert points["x"] == sorted(points["x"])


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("test/psnr_object", "dB"),
        ("test/rotation_deg", "°"),
        ("test/position_percent", "%"),
        ("film/seconds", "s"),
        ("film/frames_per_s", "frames/s"),
        ("val/ssim", ""),
        ("train/loss", ""),
    ],
)
def test_units_follow_names(name: str, unit: str) -> None:
    assert unit_of(name) == unit


def test_durations_are_spoken() -> None:
    assert [spoken_seconds(value) for value in (0.04, 59.96, 100.2, 7300, None)] == [
        "0.0 s",
        "1 min 0 s",
        "1 min 40 s",
        "2 h 1 min",
        "-",
    ]


def test_markup_escapes_all_but_itself() -> None:
    assert tag("p", "<b>", tag("i", "x & y"), title='"') == '<p title="&quot;">&lt;b&gt;<i>x &amp; y</i></p>'
    assert tag("img", src="data:,", alt=None, hidden=True) == '<img src="data:," hidden>'
    block = data_block("id", {"a": "</script>&\u2028", "b": math.nan})
    assert json.loads(block.removesuffix("</script>").split(">", 1)[1]) == {"a": "</script>&\u2028", "b": None}
    assert block.count("<") == 2
