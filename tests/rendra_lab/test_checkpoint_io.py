"""Saving on disks that refuse: a clear error, the previous checkpoint intact, nothing half-written."""

import errno
import os
import re
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from rendra_lab import durable
from rendra_lab.checkpoint_archive import CheckpointError, examine, read_checkpoint
from rendra_lab.checkpoint_io import SafeCheckpointIO, SaveError, describe
from rendra_lab.durable import sweep_leftovers, write_durably
from rendra_lab.weights_file import read_weights_file

CALLS = ("open", "write", "fsync", "replace")
ERRORS = (errno.ENOSPC, errno.EIO, errno.EACCES)
METADATA = describe("pose", {"module": {"_target_": "here.Pose"}, "seed": 3, "threads": None}, "abc")


class FaultyDisk:
    """The `os` module, in which a call fails for the k-th time.

    Args:
        call: its name, or "" for none.
        which: k, counted from 1.
        number: the errno.
    """

    def __init__(self, call: str = "", which: int = 1, number: int = errno.EIO) -> None:
        self._faulty, self._which, self._number = call, which, number
        self.counts = dict.fromkeys(CALLS, 0)

    def __getattr__(self, name: str) -> Any:
        return (lambda *arguments: self._call(name, *arguments)) if name in CALLS else getattr(os, name)

    def _call(self, name: str, *arguments: Any) -> Any:
        self.counts[name] += 1
        if (name, self.counts[name]) == (self._faulty, self._which):
            raise OSError(self._number, os.strerror(self._number))
        return getattr(os, name)(*arguments)


def state_of(step: int, numbers: int = 600_000) -> dict[str, Any]:
    return {"global_step": step, "state_dict": {"weight": torch.full((numbers,), float(step))}}


def save(path: Path, step: int, numbers: int = 600_000) -> None:
    SafeCheckpointIO(METADATA).save_checkpoint(state_of(step, numbers), path)


def save_the_weights(path: Path, step: int) -> None:
    SafeCheckpointIO(METADATA).save_weights(state_of(step)["state_dict"], path)


def step_of(path: Path) -> int:
    """Of all of it; raises where it is not whole."""
    weights = read_weights_file(path)[0] if path.suffix == ".safetensors" else read_checkpoint(path)["state_dict"]
    step = int(weights["weight"][0])
    assert torch.equal(weights["weight"], torch.full((600_000,), float(step)))
    return step


@pytest.mark.parametrize("number", ERRORS, ids=errno.errorcode.__getitem__)
@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize(("name", "save"), [("last.ckpt", save), ("weights.safetensors", save_the_weights)])
def test_every_call_may_fail(
    name: str, save: Callable[[Path, int], None], call: str, number: int, tmp_path: Path, monkeypatch: Any
) -> None:
    """Each k-th open, write, fsync and replace of a save fails once."""
    path = tmp_path / "checkpoints" / name
    counting = FaultyDisk()
    with monkeypatch.context() as patch:
        patch.setattr(durable, "os", counting)
        save(path, 1)
    assert counting.counts == {"open": 2, "write": counting.counts["write"], "fsync": 2, "replace": 1}
    assert counting.counts["write"] >= 2 or name != "last.ckpt"
    for which in range(1, counting.counts[call] + 1):
        before, disk = step_of(path), FaultyDisk(call, which, number)
        monkeypatch.setattr(durable, "os", disk)
        with pytest.raises(SaveError) as failure:
            save(path, before + 1)
        renamed = disk.counts["replace"] == 1 and call != "replace"
        assert step_of(path) == before + renamed
        said = rf"cannot save \S*{re.escape(name)}: {os.strerror(number)}; "
        last = rf"the last good checkpoint is \S*last.ckpt, step {step_of(path)}$"
        assert re.match(said + (last if name == "last.ckpt" else "there is no other"), str(failure.value))
        assert [file.name for file in path.parent.iterdir()] == [name]


def test_calls_that_a_signal_cuts_short_are_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for call in CALLS:
        with monkeypatch.context() as patch:
            patch.setattr(durable, "os", FaultyDisk(call, 1, errno.EINTR))
            save(tmp_path / "last.ckpt", 4)
        assert step_of(tmp_path / "last.ckpt") == 4


def test_a_disk_that_takes_a_little_at_a_time_gets_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = FaultyDisk()
    disk.write = lambda descriptor, data: os.write(descriptor, data[:100_001])  # type: ignore[attr-defined]
    monkeypatch.setattr(durable, "os", disk)
    save(tmp_path / "last.ckpt", 5)
    assert step_of(tmp_path / "last.ckpt") == 5


def test_a_filesystem_that_cannot_force_folders_is_borne(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(durable, "os", FaultyDisk("fsync", 2, errno.EINVAL))
    save(tmp_path / "last.ckpt", 5)
    assert step_of(tmp_path / "last.ckpt") == 5


def test_a_disk_that_keeps_something_else_is_found_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "last.ckpt"
    save(path, 1)
    disk = FaultyDisk()
    disk.write = lambda descriptor, data: os.write(descriptor, bytes(len(data)))  # type: ignore[attr-defined]
    monkeypatch.setattr(durable, "os", disk)
    with pytest.raises(SaveError, match="what was written is cut off"):
        save(path, 2)
    assert step_of(path) == 1
    assert list(tmp_path.iterdir()) == [path]


def test_a_quota_ends_a_save_not_the_program(tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    save(path, 1)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000, before[1]))
    try:
        with pytest.raises(
            SaveError, match=r"cannot save \S*step_2.ckpt: File too large; the last good checkpoint is"
        ):
            save(tmp_path / "step_2.ckpt", 2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert step_of(path) == 1
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_kept_is_said(tmp_path: Path) -> None:
    own = SafeCheckpointIO(METADATA)
    with pytest.raises(
        SaveError, match=r"what was written is refused: it asks for pathlib.* no other good checkpoint"
    ):
        own.save_checkpoint({**state_of(1, 3), "extra": Path("x")}, tmp_path / "last.ckpt")
    (tmp_path / "file").touch()
    with pytest.raises(SaveError, match=r"cannot save .*last.ckpt: (File exists|Not a directory)"):
        own.save_checkpoint(state_of(1, 3), tmp_path / "file" / "last.ckpt")
    with pytest.raises(TypeError, match="has no storage_options"):
        own.save_checkpoint(state_of(1, 3), tmp_path / "last.ckpt", storage_options={})
    own.remove_checkpoint(tmp_path / "nowhere.ckpt")
    (tmp_path / "folder.ckpt").mkdir()
    with pytest.raises(SaveError, match="cannot remove"):
        own.remove_checkpoint(tmp_path / "folder.ckpt")


def test_a_fit_goes_on_from_the_state_of_a_fit(tmp_path: Path) -> None:
    save(tmp_path / "last.ckpt", 1, 5)
    with pytest.raises(CheckpointError, match="holds weights, but not the state of a fit that could go on"):
        SafeCheckpointIO(METADATA).load_checkpoint(tmp_path / "last.ckpt")


def test_an_error_of_the_writer_leaves_nothing(tmp_path: Path) -> None:
    def fill(sink: durable.Sink) -> None:
        sink.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_durably(tmp_path / "file", fill, lambda _: None)
    assert not list(tmp_path.iterdir())


def test_metadata_are_plain(tmp_path: Path) -> None:
    metadata = describe("pose", {"seed": 1, "a": (1, Path("x")), "module": {"_target_": "here.Pose"}}, None)
    assert metadata["config"]["a"] == [1, "x"]
    assert metadata["versions"]["torch"] == torch.__version__
    own = SafeCheckpointIO(metadata)
    own.save_checkpoint({**state_of(2, 5), "pytorch-lightning_version": "2.6.0"}, tmp_path / "last.ckpt")
    back = own.load_checkpoint(tmp_path / "last.ckpt")
    assert back["rendra_lab"] == metadata
    assert examine(tmp_path / "last.ckpt").module == "here.Pose"


@pytest.fixture
def dead_process() -> int:
    """The number of a process that is gone."""
    pid = os.spawnlp(os.P_NOWAIT, "true", "true")
    os.waitpid(pid, 0)
    return pid


def test_only_leftovers_are_swept(tmp_path: Path, dead_process: int) -> None:
    leftover = tmp_path / f".last.ckpt.{dead_process}.0123abcd.tmp"
    others = (
        f".last.ckpt.{os.getpid()}.0123abcd.tmp",  # somebody at work
        f".metrics.json.{dead_process}.tmp",  # another naming
        f"last.ckpt.{dead_process}.0123abcd.tmp",
        "last.ckpt",
    )
    for path in (leftover, *(tmp_path / name for name in others)):
        path.touch()
    held = os.open(leftover, os.O_WRONLY)
    durable.fcntl.flock(held, durable.fcntl.LOCK_EX)  # in another container, whose processes are not seen here
    assert sweep_leftovers(tmp_path) == []
    os.close(held)
    assert sweep_leftovers(tmp_path) == [leftover]
    assert {path.name for path in tmp_path.iterdir()} == set(others)
    assert sweep_leftovers(tmp_path / "nowhere") == []
