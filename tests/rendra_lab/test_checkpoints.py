"""Which checkpoint counts: the newest whole one, the named one or none, and what a run says about it."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from rendra_lab_toy import save_config

from rendra_lab import durable
from rendra_lab.checkpoint_archive import FORMAT, CheckpointError
from rendra_lab.checkpoints import find_checkpoint, newest_checkpoint, read_weights
from rendra_lab.errors import UserError
from rendra_lab.experiment import evaluate, load_run, run
from rendra_lab.weights_file import write_weights_file

Compose = Callable[..., Any]

CONF = Path(__file__).parent / "conf"


def keep(path: Path, step: int, written_at: int = 0, module: str = "here.Pose") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    own = {"format": FORMAT, "task": "pose", "module": module}
    lightning = {"pytorch-lightning_version": "2.6.0", "loops": {}}
    torch.save(
        {"global_step": step, "state_dict": {"step": torch.tensor(step)}, "rendra_lab": own, **lightning}, path
    )
    os.utime(path, (written_at, written_at))
    return path


def cut_off(path: Path) -> Path:
    os.truncate(path, path.stat().st_size // 2)
    return path


def test_of_one_run_the_later_step_is_newer_whatever_the_clock_says(tmp_path: Path) -> None:
    folder = tmp_path / "run" / "checkpoints"
    keep(folder / "step_000200.ckpt", 200, written_at=10)
    last = keep(folder / "last.ckpt", 200, written_at=5)
    keep(folder / "best.ckpt", 100, written_at=99)
    assert newest_checkpoint(tmp_path).path == last
    later = keep(folder / "step_000300.ckpt", 300, written_at=1)
    assert newest_checkpoint(tmp_path).path == later


def test_of_several_runs_that_which_wrote_last_is_newer(tmp_path: Path) -> None:
    keep(tmp_path / "toy" / "1" / "checkpoints" / "last.ckpt", 500, written_at=10)
    new = keep(tmp_path / "toy" / "2_sweep" / "0" / "checkpoints" / "last.ckpt", 7, written_at=20)
    assert find_checkpoint("last", tmp_path / "toy" / "3", tmp_path) == new


@pytest.mark.parametrize("share", [0, 0.01, 0.5, 0.99])
def test_what_is_damaged_is_passed_over_and_said(
    share: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = keep(tmp_path / "toy" / "1" / "checkpoints" / "last.ckpt", 50, written_at=1)
    folder = tmp_path / "toy" / "2" / "checkpoints"
    good, bad = keep(folder / "step_000100.ckpt", 100), keep(folder / "last.ckpt", 120)
    os.truncate(bad, int(share * bad.stat().st_size))
    for wanted in ("last", str(folder.parent)):
        assert find_checkpoint(wanted, tmp_path / "toy" / "3", tmp_path) == good
        said = capsys.readouterr().err
        assert f"{bad} is " in said
        assert f"; taken instead: {good}, step 100\n" in said
    cut_off(good)
    assert find_checkpoint("last", tmp_path / "toy" / "3", tmp_path) == old
    cut_off(old)
    with pytest.raises(UserError, match=r"no whole checkpoint under .*step_000100.ckpt is cut off"):
        find_checkpoint("last", tmp_path / "toy" / "3", tmp_path)


def test_damaged_bytes_are_passed_over_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = keep(tmp_path / "checkpoints" / "step_000100.ckpt", 100)
    bad = keep(tmp_path / "checkpoints" / "last.ckpt", 120)
    content = bad.read_bytes()
    place = content.index(torch.tensor(120).numpy().tobytes())
    bad.write_bytes(content[:place] + b"\xff" + content[place + 1 :])
    assert newest_checkpoint(tmp_path).path == good
    assert "last.ckpt is damaged: last/data/0 fails its checksum; taken instead: " in capsys.readouterr().err


def test_a_damaged_file_that_was_named_is_refused(tmp_path: Path) -> None:
    good = keep(tmp_path / "run" / "checkpoints" / "step_000100.ckpt", 100)
    bad = cut_off(keep(tmp_path / "run" / "checkpoints" / "last.ckpt", 120))
    said = rf"last.ckpt is cut off, or is no checkpoint; the last good checkpoint is {good}, step 100$"
    with pytest.raises(UserError, match=said):
        find_checkpoint(str(bad), tmp_path / "new", tmp_path)
    with pytest.raises(UserError, match=said):
        read_weights(tmp_path / "run", str(bad))


def test_a_checkpoint_of_another_task_is_refused(tmp_path: Path) -> None:
    path = keep(tmp_path / "run" / "checkpoints" / "last.ckpt", 9)
    weights = tmp_path / "weights.safetensors"
    write_weights_file(weights, {"step": torch.tensor(9)}, {"format": FORMAT, "module": "here.Pose"})
    assert find_checkpoint(str(path), tmp_path / "new", tmp_path, "here.Pose") == path
    with pytest.raises(UserError, match=r"last.ckpt is a checkpoint of here.Pose; this run has there.NeRF$"):
        find_checkpoint(str(path), tmp_path / "new", tmp_path, "there.NeRF")
    for source in ("last", str(path), str(weights)):
        assert read_weights(tmp_path / "run", source, "here.Pose") == {"step": torch.tensor(9)}
        with pytest.raises(UserError, match=r"is a checkpoint of here.Pose; this run has there.NeRF"):
            read_weights(tmp_path / "run", source, "there.NeRF")
    with pytest.raises(UserError, match=r"holds weights alone; a run goes on from a .ckpt"):
        find_checkpoint(str(weights), tmp_path / "new", tmp_path)


def test_a_run_keeps_what_it_is_and_its_weights_alone(compose: Compose, tmp_path: Path) -> None:
    folder = tmp_path / "toy" / "run"
    cfg = compose(folder, "task=toy", "debug=fast", "logger=csv", "optimizer.lr=0.07")
    save_config(cfg)
    value = run(cfg)
    content = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    own = content["rendra_lab"]
    assert (own["format"], own["task"], own["module"]) == (FORMAT, "task", "rendra_lab_toy.ToyTask")
    assert own["config"]["optimizer"]["lr"] == 0.07
    assert own["versions"]["torch"] == torch.__version__
    assert own["seed"] == 0
    assert own["git_commit"]
    weights = folder / "checkpoints" / "weights.safetensors"
    loaded = load_run(folder, str(weights))
    assert torch.equal(loaded.task.color, content["state_dict"]["color"])  # type: ignore[arg-type]
    assert evaluate(loaded)["test/psnr"] == value
    with pytest.raises(CheckpointError, match="is damaged"):
        load_run(folder, str(cut_off(weights)))


def test_a_model_that_does_not_fit_is_one_line(compose: Compose, tmp_path: Path) -> None:
    path = keep(tmp_path / "toy" / "1" / "checkpoints" / "last.ckpt", 3, module="rendra_lab_toy.ToyTask")
    with pytest.raises(UserError, match=r"last.ckpt does not fit this configuration: Missing key\(s\) in state_dict"):
        run(compose(tmp_path / "toy" / "2", "task=toy", "debug=fast", "logger=csv", f"ckpt_path={path}"))


def test_leftovers_are_swept_when_a_run_starts(compose: Compose, tmp_path: Path) -> None:
    first, second = tmp_path / "toy" / "1", tmp_path / "toy" / "2"
    run(compose(first, "task=toy", "debug=fast", "logger=csv"))
    pid = os.spawnlp(os.P_NOWAIT, "true", "true")
    os.waitpid(pid, 0)
    leftovers = [folder / "checkpoints" / f".last.ckpt.{pid}.0123abcd.tmp" for folder in (first, second)]
    for path in leftovers:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    run(compose(second, "task=toy", "debug=fast", "logger=csv", "ckpt_path=last"))
    assert not [path for path in leftovers if path.exists()]


class FullDisk:
    """The `os` module of a disk on which a checkpoint of the wanted step has no room."""

    def __init__(self) -> None:
        self.room = 1

    def __getattr__(self, name: str) -> Any:
        return getattr(os, name)

    def write(self, descriptor: int, data: Any) -> int:
        is_checkpoint = bytes(data[:2]) == b"PK"  # a zip archive; small files have room
        self.room -= is_checkpoint
        if is_checkpoint and self.room < 0:
            raise OSError(28, "No space left on device")
        return os.write(descriptor, data)


def test_a_full_disk_ends_a_run_in_one_line(
    train: Callable[..., tuple[int, str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first checkpoint fits, the second does not."""
    monkeypatch.setattr(durable, "os", FullDisk())
    every = ["callbacks.checkpoint.every_n_train_steps=2", "callbacks.checkpoint.save_last=false"]
    code, _, said = train("trainer.max_steps=8", "logger=csv", "hydra.run.dir=run", *every)
    folder = tmp_path / "run"
    assert code == 1
    assert said == (
        "train.py: cannot save run/checkpoints/step_000004.ckpt: No space left on device; "
        "the last good checkpoint is run/checkpoints/step_000002.ckpt, step 2\n"
    )
    assert [path.name for path in (folder / "checkpoints").iterdir()] == ["step_000002.ckpt"]
    record = json.loads((folder / "metrics.json").read_text())
    assert record["status"] == "failed"
    assert "No space left" in record["error"]


def test_lost_permission_is_not_swallowed(compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Forbidden(FullDisk):
        def open(self, *arguments: Any) -> int:
            raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(durable, "os", Forbidden())
    with pytest.raises(OSError, match=r"last.ckpt: Permission denied; there is no other good checkpoint"):
        run(compose(tmp_path / "toy" / "run", "task=toy", "debug=fast", "logger=csv"))


@pytest.mark.parametrize("script", ["evaluate", "export", "render", "train"])
def test_no_script_runs_a_planted_pickle(
    script: str, program: Callable[..., tuple[int, str, str]], compose: Compose, tmp_path: Path
) -> None:
    class Planted:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "executed"),)

    folder = tmp_path / "outputs" / "toy" / "run"
    cfg = compose(folder, "task=toy", "logger=csv")
    save_config(cfg)
    path = keep(folder / "checkpoints" / "last.ckpt", 3)
    torch.save({"global_step": 1, "state_dict": {"color": Planted()}}, path)
    commands = {
        "evaluate": ["scripts/evaluate.py", str(folder)],
        "export": ["scripts/export.py", f"run={folder}"],
        "render": ["scripts/render.py", f"run={folder}"],
        "train": ["train.py", "task=toy", f"hydra.searchpath=[file://{CONF}]", f"ckpt_path={path}"],
    }
    code, _, said = program(*commands[script])
    assert code == 2
    assert len(said.splitlines()) == 1
    assert "is refused: it asks for posix.mkdir, which could run code; nothing was run" in said
    assert not (tmp_path / "executed").exists()


def test_an_update_that_no_disk_keeps_ends_without_a_second_try(
    compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What could not be saved at a step is not saved at the end of the broken fit either."""
    disk = FullDisk()
    disk.room = 0
    monkeypatch.setattr(durable, "os", disk)
    every = "callbacks.checkpoint.every_n_train_steps=2"
    with pytest.raises(OSError, match=r"step_000002.ckpt: No space left"):
        run(compose(tmp_path / "toy" / "run", "task=toy", "logger=csv", every))
    assert disk.room == -1
