"""Checkpoints that are killed while they are saved: what was acknowledged is never lost, and nothing is half."""

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from rendra_lab.checkpoint_archive import read_checkpoint
from rendra_lab.checkpoints import newest_checkpoint
from rendra_lab.durable import sweep_leftovers

SOURCE = Path(__file__).parents[2] / "src"
MEMORY = Path("/dev/shm")


@pytest.fixture(scope="module")
def savers() -> Iterator[subprocess.Popen[str]]:
    """The process that forks savers, once for all tests."""
    process = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("checkpoint_saver.py"))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(SOURCE)},
    )
    yield process
    process.communicate(timeout=30)


@pytest.fixture
def in_memory() -> Iterator[Path]:
    """A folder on a filesystem of its own."""
    if not MEMORY.is_dir() or MEMORY.stat().st_dev == Path(tempfile.gettempdir()).stat().st_dev:
        pytest.skip("/dev/shm is no filesystem of its own here")
    folder = Path(tempfile.mkdtemp(prefix="rendra-kills-", dir=MEMORY))
    yield folder
    shutil.rmtree(folder)


def acknowledged(folder: Path) -> int:
    noted = folder / "acknowledged"
    return int(noted.read_bytes() or b"0") if noted.exists() else 0


def kill_in_a_save(savers: subprocess.Popen[str], folder: Path, step: int, delay_s: float) -> None:
    assert savers.stdin is not None
    assert savers.stdout is not None
    savers.stdin.write(f"{folder / 'checkpoints'} {step}\n")
    savers.stdin.flush()
    saver = int(savers.stdout.readline())
    while step == 0 and acknowledged(folder) == 0:  # the first of all
        time.sleep(0.001)
    time.sleep(delay_s)
    os.kill(saver, signal.SIGKILL)
    assert savers.stdout.readline() == "gone\n"


def survive(savers: subprocess.Popen[str], folder: Path, kills: int) -> tuple[int, int]:
    """Kills savers at random moments; answers how many were in the middle of a file, and the last step."""
    (folder / "checkpoints").mkdir(parents=True)
    chance = random.Random(7)
    step = in_the_middle = 0
    for _ in range(kills):
        kill_in_a_save(savers, folder, step, chance.uniform(0, 0.1))
        in_the_middle += bool(list((folder / "checkpoints").glob(".*.tmp")))
        found = newest_checkpoint(folder)
        state = read_checkpoint(found.path)
        assert found.step == state["global_step"] >= max(acknowledged(folder), step)
        step = found.step
        for tensor in (*state["state_dict"].values(), state["optimizer_states"][0]["moment"]):
            assert torch.equal(tensor, torch.full_like(tensor, step))
    sweep_leftovers(folder / "checkpoints")
    assert not list((folder / "checkpoints").glob(".*"))
    return in_the_middle, step


@pytest.mark.parametrize("kills", [6, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("other_filesystem", [False, True])
def test_no_kill_costs_a_checkpoint(
    kills: int,
    other_filesystem: bool,
    savers: subprocess.Popen[str],
    tmp_path: Path,
    in_memory: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Checkpoints lie on the filesystem of the temporary folder, or on another."""
    folder = in_memory / "run" if other_filesystem else tmp_path / "run"
    in_the_middle, step = survive(savers, folder, kills)
    assert in_the_middle > 0
    assert step > 0
    assert "damaged" not in capfd.readouterr().err
    print(f"{kills} kills, {in_the_middle} in the middle of a file, {step} steps saved")
