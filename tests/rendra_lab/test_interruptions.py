"""Signals, real ones: what they leave in each phase of a run, the exit code, and that the run goes on from there."""

import csv
import importlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from rendra_lab_toy import ToyData, ToyTask

from rendra_lab import interruptions, signals
from rendra_lab.data.repeated import Repeated
from rendra_lab.experiment import run

Compose = Callable[..., Any]
REPOSITORY = Path(__file__).parents[2]
STEPS = 30


def send(*numbers: int) -> None:
    for number in numbers:
        os.kill(os.getpid(), number)


def record_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "metrics.json").read_text())


def weights_of(folder: Path) -> dict[str, torch.Tensor]:
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def ends(cfg: Any) -> int:
    with pytest.raises(SystemExit) as end:
        run(cfg)
    assert isinstance(end.value.code, int)
    return end.value.code


def goes_on(compose: Compose, folder: Path, *overrides: str) -> None:
    """From what an interrupted run has left to the end of one that nobody interrupted."""
    whole, resumed = (folder.with_name(name) for name in ("whole", "resumed"))
    settings = ["task=toy", f"trainer.max_steps={STEPS}", "optimizer=adamw", "logger=csv", *overrides]
    run(compose(whole, *settings))
    run(compose(resumed, *settings, f"ckpt_path={folder}"))
    metrics = record_of(resumed)["metrics"]
    assert metrics["test/psnr"] == record_of(whole)["metrics"]["test/psnr"]
    assert metrics.items() <= record_of(whole)["metrics"].items()
    if record_of(folder)["steps"] < STEPS:
        for name, weight in weights_of(whole).items():
            assert torch.equal(weight, weights_of(resumed)[name])


def validations(folder: Path) -> dict[int, str]:
    with (folder / "metrics.csv").open() as table:
        return {int(row["step"]): row["val/psnr"] for row in csv.DictReader(table) if row["val/psnr"]}


def interrupted(compose: Compose, folder: Path, code: int, *overrides: str) -> None:
    cfg = compose(folder, "task=toy", f"trainer.max_steps={STEPS}", "optimizer=adamw", "logger=csv", *overrides)
    assert ends(cfg) == code
    assert record_of(folder)["status"] == "interrupted"


def test_before_the_first_step_there_is_nothing_to_keep(
    compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(ToyData, "prepare_data", lambda self: send(signal.SIGTERM))
    folder = tmp_path / "toy" / "run"
    interrupted(compose, folder, 143)
    assert not list(folder.rglob("*.ckpt"))
    said = capsys.readouterr().err
    assert "interrupted by SIGTERM before the first step" in said
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGUSR1, 138)])
def test_a_step_is_finished_first(
    number: int, code: int, compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = [signal.getsignal(each) for each in signals.WATCHED]
    inner = ToyTask.training_step

    def training_step(self: ToyTask, batch: Any, batch_idx: int) -> Any:
        if self.global_step == 7:
            send(number)
        return inner(self, batch, batch_idx)

    folder = tmp_path / "toy" / "run"
    with monkeypatch.context() as patched:
        patched.setattr(ToyTask, "training_step", training_step)
        interrupted(compose, folder, code)
    assert record_of(folder)["steps"] == 8
    assert [signal.getsignal(each) for each in signals.WATCHED] == before
    goes_on(compose, folder)


def test_a_validation_that_was_cut_off_begins_anew(
    compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner = ToyTask.validation_step

    def validation_step(self: ToyTask, batch: Any, batch_idx: int) -> None:
        inner(self, batch, batch_idx)
        if self.global_step == 20 and batch_idx == 1:
            send(signal.SIGTERM)

    monkeypatch.setattr(ToyData, "val_dataloader", lambda self: Repeated(self.batch, 3))
    folder = tmp_path / "toy" / "run"
    with monkeypatch.context() as patched:
        patched.setattr(ToyTask, "validation_step", validation_step)
        interrupted(compose, folder, 143, "trainer.val_check_interval=10")
    assert record_of(folder)["steps"] == 20
    goes_on(compose, folder, "trainer.val_check_interval=10")
    expected = validations(folder.with_name("whole"))
    assert validations(folder.with_name("resumed")) == {step: expected[step] for step in expected if step >= 19}


def test_a_second_wish_does_not_tear_what_is_saved(
    compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signals, "_SECOND_THOUGHT_S", 0.0)
    inner = ToyTask.on_train_batch_end
    folder = tmp_path / "toy" / "run"
    with monkeypatch.context() as patched:
        patched.setattr(
            ToyTask, "on_train_batch_start", lambda self, *_: send(signal.SIGINT) if self.global_step == 7 else None
        )
        patched.setattr(ToyTask, "on_save_checkpoint", lambda self, checkpoint: send(signal.SIGINT, signal.SIGINT))
        interrupted(compose, folder, 130)
    assert inner is ToyTask.on_train_batch_end
    goes_on(compose, folder)


def test_a_second_ctrl_c_does_not_wait_for_a_long_step(
    compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signals, "_SECOND_THOUGHT_S", 0.0)
    monkeypatch.setattr(
        ToyTask,
        "on_train_batch_start",
        lambda self, *_: send(signal.SIGINT, signal.SIGINT) if self.global_step else None,
    )
    folder = tmp_path / "toy" / "run"
    interrupted(compose, folder, 130)
    assert record_of(folder)["steps"] == 1
    assert not list(folder.rglob("*.ckpt"))  # it may have come in the middle of an update


def test_in_the_test_the_fit_is_kept(compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "toy" / "run"
    with monkeypatch.context() as patched:
        patched.setattr(ToyTask, "test_step", lambda self, batch, batch_idx: send(signal.SIGTERM))
        interrupted(compose, folder, 143)
    assert record_of(folder)["steps"] == STEPS
    goes_on(compose, folder)


def test_a_run_that_is_done_stays_done(compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rendra_lab.report.closing_table", lambda *_: send(signal.SIGINT))
    folder = tmp_path / "toy" / "run"
    assert (
        ends(compose(folder, "task=toy", "debug=fast", "logger=csv")) == 130
    )  # what would follow, in a sweep, is not wanted
    assert record_of(folder)["status"] == "ok"


def test_what_somebody_else_handles_stays_theirs() -> None:
    heard = []
    before = signal.signal(signal.SIGUSR1, lambda number, _: heard.append(number))
    try:
        with signals.listening():
            send(signal.SIGUSR1)
            with pytest.raises(signals.Interrupted, match="interrupted by SIGTERM"):
                send(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert heard == [signal.SIGUSR1]


def stop_untidily() -> None:
    try:
        raise signals.Interrupted(signal.SIGTERM)
    finally:
        [].pop()


def test_what_fails_over_an_interruption_is_one() -> None:
    with pytest.raises(IndexError) as caught:
        stop_untidily()
    assert interruptions.signal_of(caught.value) == signal.SIGTERM
    assert interruptions.signal_of(IndexError()) is None


def load_and_wait(module: str) -> None:
    with signals.listening():
        importlib.import_module(module)
        time.sleep(5)


def test_a_module_that_is_being_loaded_is_loaded_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An importer may take an interrupted module for a whole one."""
    waits = "import os, signal, time\nos.kill(os.getpid(), signal.SIGTERM)\ntime.sleep(0.2)\nwhole = True\n"
    (tmp_path / "module_of_a_test.py").write_text(waits)
    monkeypatch.syspath_prepend(tmp_path)
    try:
        with pytest.raises(signals.Interrupted):
            load_and_wait("module_of_a_test")
        assert sys.modules["module_of_a_test"].whole
    finally:
        sys.modules.pop("module_of_a_test", None)


@pytest.mark.parametrize("number", signals.WATCHED)
@pytest.mark.parametrize("listens", [False, True])
def test_a_program_that_only_loads_leaves_at_once(number: int, listens: bool, tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text("import time\nprint('loads', flush=True)\ntime.sleep(60)\n")
    inner = "with signals.listening():\n    import slow\n" if listens else "import slow\n"
    (tmp_path / "program.py").write_text(f"from rendra_lab import signals\nsignals.leave_at_once()\n{inner}")
    process = subprocess.Popen(
        [sys.executable, "program.py"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "loads\n"
    process.send_signal(number)
    assert process.communicate(timeout=30)[1] == f"program.py: interrupted by {signal.Signals(number).name}\n"
    assert process.returncode == 128 + number


def test_a_program_leaves_the_handlers_as_it_found_them(train: Callable[..., tuple[int, str, str]]) -> None:
    before = [signal.getsignal(number) for number in signals.WATCHED]
    for arguments in (["trainer.max_stes=1"], ["--no-such-flag"]):
        assert train(*arguments)[0] == 2
        assert [signal.getsignal(number) for number in signals.WATCHED] == before


@pytest.fixture
def scontrol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program of that name which writes down how it was called."""
    program = tmp_path / "bin" / "scontrol"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/called\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("SLURM_JOB_ID", "42")
    return tmp_path / "called"


def test_a_slurm_job_is_requeued_and_goes_on(
    scontrol: Path, compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "toy" / "run"
    with monkeypatch.context() as patched:
        patched.setattr(
            ToyTask, "on_train_batch_start", lambda self, *_: send(signal.SIGUSR1) if self.global_step == 7 else None
        )
        interrupted(compose, folder, 138)
    assert scontrol.read_text() == "requeue 42\n"
    again = tmp_path / "toy" / "again"
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    run(compose(again, "task=toy", f"trainer.max_steps={STEPS}", "optimizer=adamw", "logger=csv"))
    assert record_of(again)["resumed_from"].startswith(str(folder))
    monkeypatch.setenv("SLURM_JOB_ID", "43")
    assert interruptions.requeued_from(tmp_path, []) is None
    monkeypatch.setenv("SLURM_JOB_NAME", "bash")
    assert interruptions.slurm_job() is None


def test_a_slurm_job_that_cannot_be_requeued_says_so(scontrol: Path, tmp_path: Path) -> None:
    (tmp_path / "bin" / "scontrol").write_text("#!/bin/sh\necho 'not permitted' >&2\nexit 1\n")
    line = interruptions.farewell(int(signal.SIGUSR1), tmp_path / "run", 3, tmp_path, [])
    assert "SLURM job 42 could not be requeued (not permitted)" in line


def start(folder: Path, *overrides: str) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "tests"), "RENDRA_LAB_PACKAGES": "rendra_lab_toy"}
    search = f"hydra.searchpath=[file://{Path(__file__).parent / 'conf'}]"
    command = [sys.executable, str(REPOSITORY / "train.py"), *overrides, "task=toy", search]
    with (folder / "said").open("w") as said:
        return subprocess.Popen(
            command, cwd=folder, env=environment, stdout=said, stderr=said, start_new_session=True
        )


def wait_for(folder: Path, pattern: str, process: subprocess.Popen, seconds: float = 120) -> Path:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := list(folder.glob(pattern)):
            return found[0]
        assert process.poll() is None, (folder / "said").read_text()
        time.sleep(0.05)
    raise AssertionError(f"no {pattern} after {seconds} s")


def test_a_program_ends_with_the_code_of_the_signal(tmp_path: Path) -> None:
    process = start(tmp_path, "trainer.max_steps=1000000", "callbacks.checkpoint.every_n_train_steps=10")
    checkpoint = wait_for(tmp_path, "outputs/toy/*/checkpoints/step_*.ckpt", process)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=60) == 143
    said = (tmp_path / "said").read_text()
    assert "Traceback" not in said
    assert said.splitlines()[-1].startswith("interrupted by SIGTERM after ")
    assert record_of(checkpoint.parents[1])["status"] == "interrupted"
    last = torch.load(checkpoint.with_name("last.ckpt"), weights_only=True)
    assert last["global_step"] == record_of(checkpoint.parents[1])["steps"]


@pytest.mark.slow
@pytest.mark.parametrize("to_all", [True, False])
def test_processes_of_one_run_end_together(to_all: bool, tmp_path: Path) -> None:
    distributed = ["trainer=ddp", "trainer.accelerator=cpu", "callbacks.checkpoint.every_n_train_steps=10"]
    process = start(tmp_path, "trainer.max_steps=1000000", *distributed)
    checkpoint = wait_for(tmp_path, "outputs/toy/*/checkpoints/step_*.ckpt", process)
    if to_all:
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    else:
        process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=60) == (130 if to_all else 143)
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)
    last = torch.load(checkpoint.with_name("last.ckpt"), weights_only=True)
    assert last["global_step"] == record_of(checkpoint.parents[1])["steps"]
    goes_on_to = int(last["global_step"]) + 5
    more = start(tmp_path, f"trainer.max_steps={goes_on_to}", "ckpt_path=last")
    assert more.wait(timeout=120) == 0


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.3, 0.7, 1.1, 1.5, 2.0, 2.5, 3.2, 4.0, 5.0])
def test_a_signal_while_a_program_starts_gives_one_line(delay_s: float, tmp_path: Path) -> None:
    process = start(tmp_path, "trainer.max_steps=1000000")
    time.sleep(delay_s)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) == 130
    assert "Traceback" not in (tmp_path / "said").read_text()


@pytest.mark.slow
def test_a_sweep_ends_with_its_interrupted_run(tmp_path: Path) -> None:
    process = start(
        tmp_path, "-m", "seed=0,1,2", "trainer.max_steps=1000000", "callbacks.checkpoint.every_n_train_steps=10"
    )
    checkpoint = wait_for(tmp_path, "outputs/toy/*/*/checkpoints/step_*.ckpt", process)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=60) == 143
    assert record_of(checkpoint.parents[1])["status"] == "interrupted"
    assert len(list(tmp_path.glob("outputs/toy/*/*/metrics.json"))) == 1
