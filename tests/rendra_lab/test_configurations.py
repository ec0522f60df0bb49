"""Every task and every experiment composes, builds and makes one step. Removing one removes its test."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rendra_lab.experiment import run

CONF = Path(__file__).parents[2] / "conf"

# a step of these takes a laptop minutes
_TINY = ("data.image_size=16", "data.rays_per_step=12", "field.width=16", "callbacks.turntable.frames=0")
SMALLER = {
    "nerf_book": (*_TINY, "sampler.samples=4"),
    "nerf_book_laptop": (*_TINY, "sampler.samples=4"),
    "nerf_original": (*_TINY, "sampler.fine_samples=4"),
    "nerf_original_laptop": (*_TINY, "sampler.fine_samples=4"),
}


def names(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def one_step(compose: Callable[..., Any], folder: Path, *overrides: str) -> dict[str, Any]:
    run(compose(folder, *overrides, "debug=fast", "trainer.max_steps=1"))
    return json.loads((folder / "metrics.json").read_text())


@pytest.mark.parametrize("task", names("task"))
def test_every_task_makes_a_step(task: str, compose: Callable[..., Any], tmp_path: Path) -> None:
    record = one_step(compose, tmp_path / task / "run", f"task={task}")
    assert record["steps"] >= 1
    assert record["metrics"]


@pytest.mark.parametrize("experiment", names("experiment"))
def test_every_experiment_makes_a_step_and_says_how(
    experiment: str, compose: Callable[..., Any], tmp_path: Path
) -> None:
    lines = (CONF / "experiment" / f"{experiment}.yaml").read_text().splitlines()
    assert lines[0] == "# @package _global_"
    assert f"python train.py experiment={experiment}" in lines[1]
    settings = (f"experiment={experiment}", *SMALLER.get(experiment, ()))
    assert one_step(compose, tmp_path / "experiment" / "run", *settings)["steps"] >= 1


@pytest.mark.parametrize("group", ["optimizer", "scheduler", "trainer", "logger", "callbacks", "debug"])
def test_every_choice_of_the_shared_groups_composes(group: str, compose: Callable[..., Any], tmp_path: Path) -> None:
    for name in names(group):
        assert compose(tmp_path / "toy" / "run", "task=toy", f"{group}={name}") is not None


def test_configurations_are_sentences() -> None:
    long = {path.name: count for path in CONF.rglob("*.yaml") if (count := len(path.read_text().splitlines())) > 60}
    assert not long
