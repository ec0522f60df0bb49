"""scripts/benchmark.py from outside."""

import json
import subprocess
import sys
from pathlib import Path

import torch

from rendra.io import save_obj
from rendra.utils import ico_sphere

SCRIPT = Path(__file__).parents[2] / "scripts" / "benchmark.py"


def run(*arguments: str) -> subprocess.CompletedProcess:
    command = [sys.executable, str(SCRIPT), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_it_lists_what_it_can_time() -> None:
    done = run("--list")
    assert done.returncode == 0, done.stderr
    assert "raster_soft_backward" in done.stdout
    assert "command_pose_silhouette" in done.stdout


def test_it_times_and_writes_json(tmp_path: Path) -> None:
    sphere = ico_sphere(1)
    save_obj(tmp_path / "ball.obj", sphere.verts_packed(), sphere.faces_packed())
    report = tmp_path / "report.json"
    done = run("ico_*", "--skip-tests", "--threads", "1", "--mesh", str(tmp_path / "ball.obj"), "--json", str(report))
    assert done.returncode == 0, done.stderr
    assert "ico_sphere(4)" in done.stdout
    written = json.loads(report.read_text())
    assert written["settings"]["mesh"] == "ball.obj, 80 faces"
    assert written["settings"]["threads"] == 1
    assert written["settings"]["torch"] == torch.__version__
    (timed,) = written["benchmarks"]
    assert timed["name"] == "ico_sphere"
    assert timed["tested"] is False
    numbers = timed["rendra"]
    assert 0 < numbers["min_ms"] <= numbers["median_ms"] <= numbers["max_ms"]


def test_it_answers_mistakes_in_one_line() -> None:
    done = run("rasta")
    assert done.returncode == 2
    assert done.stderr.startswith("benchmark.py: no benchmark is called 'rasta'; there are: raster_hard")
    assert run("--mesh", "nowhere.obj", "ico_sphere").returncode == 2
