"""Fixtures of the experiment framework; shapes written in the types of tasks are checked in these tests."""

import contextlib
import os
import runpy
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from jaxtyping import install_import_hook

_HOOK = install_import_hook(["rendra_lab.tasks", "rendra_lab_toy"], "beartype.beartype")

REPOSITORY = Path(__file__).parents[2]
TEST_CONF = f"hydra.searchpath=[file://{Path(__file__).parent / 'conf'}]"


@pytest.fixture(autouse=True)
def _toys_are_trusted_and_lightning_is_quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    from rendra_lab.experiment import quieten

    monkeypatch.setenv("RENDRA_LAB_PACKAGES", "rendra_lab_toy")
    quieten()


@pytest.fixture
def compose() -> Iterator[Callable[..., Any]]:
    """Composes conf/train.yaml with overrides, the tests' own configurations within reach."""
    from hydra import compose, initialize_config_dir
    from omegaconf import open_dict

    with initialize_config_dir(str(REPOSITORY / "conf"), version_base="1.3"):

        def composed(folder: Path, *overrides: str) -> Any:
            cfg = compose("train", overrides=[TEST_CONF, *overrides])
            with open_dict(cfg):
                cfg.run_dir = str(folder)
                cfg.output_root = str(folder.parent.parent)
            return cfg

        yield composed


@pytest.fixture
def program(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Runs a script of the repository in this process; answers its exit code, stdout and stderr."""
    return lambda script, *arguments: run_program(script, list(arguments), monkeypatch, tmp_path, capfd)


@pytest.fixture
def train(program: Callable[..., tuple[int, str, str]]) -> Callable[..., tuple[int, str, str]]:
    """Runs train.py with the toy task in this process; answers its exit code, stdout and stderr."""
    return lambda *arguments: program("train.py", *arguments, "task=toy", TEST_CONF)


def run_program(
    script: str,
    arguments: list[str],
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    capfd: pytest.CaptureFixture[str],
) -> tuple[int, str, str]:
    from hydra.core.global_hydra import GlobalHydra

    from rendra_lab import sweep
    from rendra_lab.front_door import FailureKeeper

    path = REPOSITORY / script
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", [str(path), *arguments])
    monkeypatch.setattr(FailureKeeper, "failure", None)
    monkeypatch.setattr(FailureKeeper, "active", False)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    sweep._running.clear()
    GlobalHydra.instance().clear()
    code: Any = 0
    with _logging_restored():
        try:
            runpy.run_path(str(path), run_name="__main__")
        except SystemExit as end:
            code = end.code
        except Exception:  # the interpreter would print it and end with 1
            import traceback

            traceback.print_exc()
            code = 1
    os.environ.pop("HYDRA_FULL_ERROR", None)
    captured = capfd.readouterr()
    return int(code or 0), captured.out, captured.err


@contextlib.contextmanager
def _logging_restored() -> Iterator[None]:
    """Hydra configures the root logger and leaves its file open."""
    import logging

    root = logging.getLogger()
    before, level = list(root.handlers), root.level
    try:
        yield
    finally:
        for handler in root.handlers:
            if handler not in before:
                handler.close()
        root.handlers[:] = before
        root.setLevel(level)
