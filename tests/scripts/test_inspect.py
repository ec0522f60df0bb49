"""scripts/inspect.py: what it prints and writes, its exit codes, and that it stands in nobody's way."""

import json
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from rendra.io import IO
from rendra.utils import ico_sphere

SCRIPTS = Path(__file__).parents[2] / "scripts"


def inspect(*arguments: str | Path) -> None:
    runpy.run_path(str(SCRIPTS / "inspect.py"))["main"]([str(argument) for argument in arguments])


def test_numbers_picture_and_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    IO().save_mesh(ico_sphere(1), "ball.ply")
    inspect("ball.ply", "--json", "out/ball.json", "--size", "32")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "ball.ply"
    assert lines[-1] == "closed, oriented, manifold"
    assert "42 vertices, 80 faces, 120 edges" in lines[1]
    assert json.loads(Path("out/ball.json").read_text())["topology"]["euler_characteristic"] == 2
    with Image.open("ball_inspected.png") as sheet:
        assert sheet.size[0] > 96


def test_no_picture_and_a_chosen_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    IO().save_mesh(ico_sphere(0), "ball.ply")
    inspect("ball.ply", "--no-picture")
    assert not list(tmp_path.glob("*.png"))
    inspect("ball.ply", "--output", "pictures/b.png", "--size", "16")
    assert Path("pictures/b.png").is_file()


def test_what_has_no_extent_has_numbers_and_no_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("flat.obj").write_text("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n")
    inspect("flat.obj", "--size", "32")
    lines = capsys.readouterr().out.splitlines()
    assert "  no picture: flat.obj has no extent, so there is nothing to draw" in lines
    assert "1 degenerate face" in lines[-1]
    assert not list(tmp_path.glob("*.png"))


@pytest.mark.parametrize("name", ["empty.obj", "empty.xyz"])
def test_an_empty_file_is_a_mistake(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / name).write_text("")
    with pytest.raises(SystemExit) as stop:
        inspect(tmp_path / name)
    assert stop.value.code == 2
    assert capsys.readouterr().err.endswith(f"{name} holds neither faces nor points\n")


@pytest.mark.parametrize(("name", "content"), [("no.obj", None), ("a.doc", "x"), ("a.ply", "ply\nformat what\n")])
def test_a_file_that_cannot_be_read_is_one_line_and_exit_2(
    name: str,
    content: str | None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(SystemExit) as stop:
        inspect(tmp_path / name)
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith("inspect.py: ")
    assert name in error


def test_scripts_beside_it_still_find_pythons_own_module() -> None:
    code = "import inspect; print(inspect.signature(lambda a: a), inspect.__file__)"
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(SCRIPTS)!r}); {code}"]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert out.startswith("(a) ")
    assert str(SCRIPTS) not in out
