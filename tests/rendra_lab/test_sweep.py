"""Sweeps that survive: killed, failed, interrupted, shared between processes, and gone on with."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from rendra_lab_toy import ToyTask

from rendra_lab import origins
from rendra_lab.sweep import _print_table, collect, job_folder
from rendra_lab.sweep_job import job_key

HERE = Path(__file__).parent
LIGHT = str(HERE / "sweep_program.py")  # without torch: a second, not ten
SEARCH = f"hydra.searchpath=[file://{HERE / 'conf'}]"
ENVIRONMENT = {
    "RENDRA_CONF": str(HERE.parents[1] / "conf"),  # where the light program finds the launchers and searches
    "RENDRA_LAB_CONFIGS": str(HERE.parents[1] / "conf"),
    "RENDRA_LAB_PACKAGES": "rendra_lab_toy,rendra_lab_diary",
}
TRAIN = str(HERE.parents[1] / "train.py")


class Sweeps:
    """Runs sweeps of a program in processes of their own, in one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.started: list[subprocess.Popen] = []

    def start(self, *arguments: str, program: str = LIGHT) -> subprocess.Popen:
        environment = {**os.environ, **ENVIRONMENT, "PYTHONPATH": str(HERE.parent)}
        command = [sys.executable, program, "-m", *arguments]
        said = (self.folder / f"said_{len(self.started)}.txt").open("w")
        with said:
            process = subprocess.Popen(
                command, cwd=self.folder, env=environment, stdout=said, stderr=said, start_new_session=True
            )
        self.started.append(process)
        return process

    def run(self, *arguments: str, program: str = LIGHT, timeout: float = 120) -> tuple[int, str]:
        code = self.start(*arguments, program=program).wait(timeout=timeout)
        return code, self.said()

    def said(self) -> str:
        return (self.folder / f"said_{len(self.started) - 1}.txt").read_text()

    def diary(self, what: str) -> list[list[str]]:
        """The lines `start` or `end` of the jobs: learning rate, process, threads."""
        path = self.folder / "outputs" / "diary.txt"
        lines = path.read_text().splitlines() if path.exists() else []
        return [line.split()[1:] for line in lines if line.startswith(f"{what} ")]

    def wait_for(self, what: str, count: int, timeout: float = 300) -> None:
        deadline = time.monotonic() + timeout
        while len(self.diary(what)) < count:
            assert time.monotonic() < deadline, self.said()
            assert self.started[-1].poll() is None, self.said()
            time.sleep(0.02)

    @property
    def sweep(self) -> Path:
        (found,) = (path for path in (self.folder / "outputs").glob("*/*"))
        return found

    def events(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in (self.sweep / "ledger.jsonl").read_text().splitlines()]

    def statuses(self) -> Counter[str]:
        return Counter(row["status"] for row in collect(self.sweep))


Here = Callable[..., tuple[int, str, str]]


@pytest.fixture
def here(program: Here, monkeypatch: pytest.MonkeyPatch) -> Here:
    """Runs a sweep of the light program in this process; answers its exit code, stdout and stderr."""
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(origins, "_trusted", set())  # this program's folder is no other's
    monkeypatch.setattr(ConfigLoaderImpl, "_load_single_config", ConfigLoaderImpl._load_single_config)
    light = str(Path(LIGHT).relative_to(HERE.parents[1]))
    return lambda *arguments: program(light, "-m", *arguments)


@pytest.fixture
def sweeps(tmp_path: Path) -> Any:
    made = Sweeps(tmp_path)
    yield made
    for process in made.started:
        if process.poll() is None:
            process.kill()
            process.wait()


def rates(count: int) -> str:
    return "optimizer.lr=" + ",".join(str(round(0.01 * (i + 1), 2)) for i in range(count))


def each_once(lines: Sequence[Sequence[str]], count: int) -> bool:
    return sorted(Counter(line[0] for line in lines).values()) == [1] * count


@pytest.mark.parametrize("count", [4, pytest.param(12, marks=pytest.mark.slow)])
def test_a_killed_sweep_goes_on_where_it_was(sweeps: Sweeps, count: int) -> None:
    """The parent dies in the fifth of twelve jobs, and a worker of the second attempt too."""
    at = 5 if count == 12 else 2
    killed = sweeps.start(rates(count), "nap=0.3")
    sweeps.wait_for("start", at)
    killed.kill()
    killed.wait()
    assert sweeps.statuses() == Counter(ok=at - 1, interrupted=1, waiting=count - at)

    helped = sweeps.start(rates(count), "nap=0.3", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
    sweeps.wait_for("start", at + 2)
    os.kill(int(sweeps.diary("start")[-1][1]), signal.SIGKILL)
    assert helped.wait(timeout=90) == 0, sweeps.said()

    assert each_once(sweeps.diary("end"), count)
    assert count + 2 <= len(sweeps.diary("start")) <= count + 3  # the killed ones twice, and maybe a neighbour
    assert Counter(event["event"] for event in sweeps.events())["done"] == count
    assert sweeps.statuses() == Counter(ok=count)
    folders = sorted(path for path in sweeps.sweep.iterdir() if path.name[0].isdigit())
    assert [folder.name for folder in folders] == sorted(
        f"{i}_nap=0.3-optimizer.lr={0.01 * (i + 1):.2g}" for i in range(count)
    )
    assert [len((folder / "mark").read_text().splitlines()) for folder in folders] == [1] * count
    assert f"{count} runs" in sweeps.said()
    if count == 12:
        code, said = sweeps.run(rates(count), "nap=0.3", "hydra/launcher=joblib")
        assert code == 0
        assert "12 jobs, 12 of them done" in said
        assert len(sweeps.diary("end")) == 12


@pytest.mark.parametrize("count", [4, pytest.param(12, marks=pytest.mark.slow)])
def test_two_parents_drain_one_sweep(sweeps: Sweeps, count: int) -> None:
    both = [sweeps.start(rates(count), "nap=0.2") for _ in range(2)]
    assert [process.wait(timeout=90) for process in both] == [0, 0], sweeps.said()
    assert each_once(sweeps.diary("end"), count)
    assert each_once(sweeps.diary("start"), count)
    assert count == 4 or len({line[1] for line in sweeps.diary("end")}) == 2
    for number in range(2):
        assert f"{count} runs" in (sweeps.folder / f"said_{number}.txt").read_text()


def test_an_interrupted_sweep_prints_its_table(sweeps: Sweeps) -> None:
    stopped = sweeps.start(rates(3), "nap=1")
    sweeps.wait_for("start", 2)
    stopped.send_signal(signal.SIGINT)
    assert stopped.wait(timeout=30) == 130, sweeps.said()
    assert sweeps.statuses() == Counter(ok=1, interrupted=1, waiting=1)
    assert "job 1 interrupted" in sweeps.said()
    assert "3 runs" in sweeps.said()


def test_processes_of_submitit_may_die(sweeps: Sweeps) -> None:
    parent = sweeps.start(rates(2), "nap=1", "hydra/launcher=submitit_local")
    sweeps.wait_for("start", 2)
    os.kill(int(sweeps.diary("start")[0][1]), signal.SIGKILL)
    assert parent.wait(timeout=90) == 0, sweeps.said()
    assert each_once(sweeps.diary("end"), 2)
    assert len(sweeps.diary("start")) == 3
    share = max(1, len(os.sched_getaffinity(0)) // 2)
    assert {line[2] for line in sweeps.diary("start")} == {str(share)}


def test_a_search_goes_on_and_further(sweeps: Sweeps) -> None:
    search = ["hparams_search=optuna", "nap=0.2"]
    killed = sweeps.start(*search, "hydra.sweeper.n_trials=3")
    sweeps.wait_for("start", 2)
    killed.kill()
    killed.wait()
    code, said = sweeps.run(*search, "hydra.sweeper.n_trials=4")
    assert code == 0, said
    assert each_once(sweeps.diary("end"), 4)
    starts = [line[0] for line in sweeps.diary("start")]
    assert starts[1] == starts[2]
    assert len(starts) == 5
    best = (sweeps.sweep / "optimization_results.yaml").read_text()
    nearest = min((line[0] for line in sweeps.diary("end")), key=lambda rate: abs(float(rate) - 0.3))
    assert f"optimizer.lr: {nearest}" in best


def test_a_failure_hides_nowhere_and_is_tried_again(sweeps: Sweeps, here: Here) -> None:
    outputs = sweeps.folder / "outputs"
    outputs.mkdir()
    (outputs / "doom 0.02").touch()
    code, said, errors = here(rates(3))
    assert code == 1
    assert sweeps.statuses() == Counter(ok=2, failed=1)
    assert "job 1 failed: RuntimeError: broke as told" in said
    assert "Traceback" not in said + errors
    assert "RuntimeError: broke as told" in (sweeps.sweep / "1_optimizer.lr=0.02" / "sweep_program.log").read_text()
    (failed,) = [event for event in sweeps.events() if event["event"] == "failed"]
    assert "Traceback" in failed["traceback"]

    (outputs / "doom 0.02").touch()
    code, said, _ = here(rates(3), "sweep.retries=1")
    assert code == 0, said
    assert [line[0] for line in sweeps.diary("start")] == ["0.01", "0.02", "0.03", "0.02", "0.02"]


def test_a_sweep_may_stop_at_its_first_failure(sweeps: Sweeps, here: Here) -> None:
    stopping = [rates(3), "sweep.stop_on_failure=true", "hydra.sweeper.max_batch_size=2"]
    (sweeps.folder / "outputs").mkdir()
    (sweeps.folder / "outputs" / "doom 0.02").touch()
    code, said, _ = here(*stopping)
    assert code == 1
    assert sweeps.statuses() == Counter(ok=1, failed=1, waiting=1)
    assert "go on     with the same command" in said
    assert here(*stopping)[0] == 0
    assert each_once(sweeps.diary("end"), 3)


def test_a_sweep_can_begin_anew(sweeps: Sweeps, here: Here) -> None:
    assert here("optimizer.lr=0.01,0.02")[0] == 0
    first = sweeps.sweep
    assert here("sweep.fresh=true", "optimizer.lr=0.01,0.02")[0] == 0
    assert here("optimizer.lr=0.010,0.020")[0] == 0  # the newest of its folders
    folders = sorted(path.name for path in (sweeps.folder / "outputs" / "light").iterdir())
    assert folders == [first.name, f"{first.name}_2"]
    assert re.fullmatch(r"sweep_optimizer\.lr=0\.01-0\.02_[0-9a-f]{8}", first.name)
    assert [line[0] for line in sweeps.diary("start")] == ["0.01", "0.02"] * 2


def test_an_explicit_folder_takes_more_jobs_and_overwrites_none(sweeps: Sweeps, here: Here) -> None:
    there = "hydra.sweep.dir=outputs/light/mine"
    assert here("optimizer.lr=0.01,0.02", there)[0] == 0
    assert here("optimizer.lr=0.03,0.02", there)[0] == 0
    names = sorted(path.name for path in sweeps.sweep.iterdir() if path.name[0].isdigit())
    assert names == ["0_optimizer.lr=0.01", "1_optimizer.lr=0.02", "2_optimizer.lr=0.03"]
    assert each_once(sweeps.diary("start"), 3)


def test_what_cannot_be_is_told(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    code, _, errors = here(rates(2), "sweep.stale_s=0.3")
    assert code == 2
    assert "sweep.stale_s=0.3 must be twice" in errors
    code, _, errors = here(rates(2), "hydra.sweep.subdir=x")
    assert code == 2
    assert "named by the ledger of the sweep" in errors


@pytest.mark.parametrize("launcher", ["slurm", "ray_cluster", "submitit_slurm", "submitit_local", "joblib", "basic"])
def test_launchers_compose(launcher: str, compose: Callable[..., Any]) -> None:
    from hydra import compose as compose_all

    compose(Path("outputs/toy/run"))  # the repository's configurations are at hand
    settings = compose_all("train", overrides=[f"hydra/launcher={launcher}"], return_hydra_config=True).hydra.launcher
    named = {"slurm": "SlurmLauncher", "submitit_slurm": "SlurmLauncher", "submitit_local": "LocalLauncher"}
    named |= {"ray_cluster": "RayLauncher", "joblib": "JoblibLauncher", "basic": "BasicLauncher"}
    assert settings._target_.endswith(named[launcher])
    if launcher == "slurm":
        assert settings.additional_parameters == {"requeue": True}
        assert settings.partition is None


def test_half_a_job_goes_on_inside_its_folder(
    train: Callable[..., tuple[int, str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner = ToyTask.training_step
    steps: list[int] = []

    def interrupted(self: ToyTask, batch: Any, batch_idx: int) -> Any:
        steps.append(self.global_step)
        if len(steps) == 8 + 5:
            raise KeyboardInterrupt
        return inner(self, batch, batch_idx)

    monkeypatch.setattr(ToyTask, "training_step", interrupted)
    command = ["-m", "optimizer.lr=0.001,0.1", "trainer.max_steps=8", "callbacks=[checkpoint]", "logger=csv"]
    code, out, _ = train(*command)
    assert code == 130
    assert "job 1 interrupted" in out
    (sweep,) = (tmp_path / "outputs" / "toy").iterdir()
    (whole,) = sweep.glob("0_*/metrics.json")
    (half,) = sweep.glob("1_*")
    before = whole.stat().st_mtime_ns

    code, out, _ = train(*command)
    assert code == 0, out
    assert steps == [*range(8), *range(5), *range(4, 8)]
    assert whole.stat().st_mtime_ns == before
    record = json.loads((half / "metrics.json").read_text())
    assert record["resumed_from"].startswith(str(half / "checkpoints"))
    assert record["steps"] == 8
    assert [row["status"] for row in collect(sweep)] == ["ok", "ok"]
    kept = (half / ".hydra" / "config.yaml").read_text()
    assert "ckpt_path: null" in kept


def test_names_of_folders_are_harmless() -> None:
    assert job_folder(3, "+note=../a/b c,x=1") == "3_note=..-a-b-c-x=1"
    assert job_folder(0, "") == "0"
    assert len(job_folder(1, "x=" + "y" * 500)) < 100


def test_a_pattern_of_experiments_is_a_sweep() -> None:
    """Hydra lists what a pattern means only once jobs are made; folder and key are wanted before."""
    sweep = job_key(["task=pose", "experiment=glob(pose_*)"])
    assert sweep == job_key(["experiment=glob(pose_*)", "task=pose"]) != job_key(["task=pose", "experiment=glob(x*)"])


def test_a_table_leaves_out_what_does_not_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    metrics = {f"test/metric_{index}": float(index) for index in range(40)}
    row = {"metrics": metrics, "seconds": 1.0, "status": "ok", "error": None, "optimized_metric": "test/metric_30"}
    rows = [{**row, "job": job, "settings": {"lr": str(job)}, "folder": str(job)} for job in range(2)]
    _print_table(tmp_path, rows)
    said = capsys.readouterr().out
    head = said.splitlines()[2]
    assert re.findall(r"[a-z]\w*", head)[:3] == ["job", "lr", "metric_30"]
    assert re.findall(r"[a-z]\w*", head)[-2:] == ["seconds", "status"]
    shown = len(re.findall(r"metric_", head))
    assert f"{40 - shown} more metrics in" in said
    assert max(map(len, said.splitlines()[1:6])) <= 140


@pytest.mark.slow
def test_a_killed_sweep_of_a_task_goes_on_where_it_was(sweeps: Sweeps) -> None:
    """As above with real runs: twelve toys on joblib, parent killed at the fifth, then a worker."""
    command = [
        "task=toy",
        SEARCH,
        rates(12),
        "hydra/launcher=joblib",
        "hydra.launcher.n_jobs=2",
        "trainer.max_steps=400",
        "logger=csv",
    ]
    command += [
        "callbacks=[checkpoint]",
        "module._target_=rendra_lab_diary.DiaryToy",
        "callbacks.checkpoint.every_n_train_steps=20",
    ]
    killed = sweeps.start(*command, program=TRAIN)
    sweeps.wait_for("start", 5)
    killed.kill()
    killed.wait()
    helped = sweeps.start(*command, program=TRAIN)
    sweeps.wait_for("start", 8)
    time.sleep(1)
    os.kill(int(sweeps.diary("start")[-1][1]), signal.SIGKILL)
    assert helped.wait(timeout=300) == 0, sweeps.said()
    assert each_once(sweeps.diary("end"), 12)
    assert sweeps.statuses() == Counter(ok=12)
    records = [json.loads(path.read_text()) for path in sweeps.sweep.glob("*/metrics.json")]
    assert [record["steps"] for record in records] == [400] * 12
    resumed = [record["resumed_from"] for record in records if record["resumed_from"]]
    assert all(str(sweeps.sweep) in path for path in resumed)
