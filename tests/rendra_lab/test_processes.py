"""Several processes that fit together: they see what one would, end where it does, and leave nothing behind."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import LightningDataModule
from omegaconf import OmegaConf
from rendra_lab_toy import SphereViews
from torch import Tensor

from rendra_lab.data.shares import Share, ShareSampler
from rendra_lab.errors import UserError
from rendra_lab.experiment import build, run
from rendra_lab.run_names import run_name

Compose = Callable[..., Any]
REPOSITORY = Path(__file__).parents[2]
TWO = ("trainer=ddp", "trainer.accelerator=cpu")


def start(folder: Path, *arguments: str, **variables: str) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "tests"), "RENDRA_LAB_PACKAGES": "rendra_lab_toy"}
    search = f"hydra.searchpath=[file://{Path(__file__).parent / 'conf'}]"
    command = [sys.executable, str(REPOSITORY / "train.py"), search, *arguments]
    with (folder / "said").open("a") as said:
        return subprocess.Popen(
            command, cwd=folder, env={**environment, **variables}, stdout=said, stderr=said, start_new_session=True
        )


def nobody_left(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


def views(rank: int, count: int, **settings: Any) -> SphereViews:
    data = SphereViews(**settings)
    data.trainer = SimpleNamespace(global_rank=rank, world_size=count)  # type: ignore[assignment]
    data.setup("fit")
    return data


@pytest.mark.parametrize("count", [1, 2, 3])
def test_processes_see_together_what_one_sees(count: int) -> None:
    settings = {"rays_per_step": 64, "rays_per_pixel_side": 2, "jitter": True, "background": "random", "seed": 3}
    alone = next(iter(views(0, 1, **settings).train_dataloader()))
    shares = [next(iter(views(rank, count, **settings).train_dataloader())) for rank in range(count)]
    for name in alone.names():
        whole, parts = getattr(alone, name), [getattr(share, name) for share in shares]
        assert sum(len(part) for part in parts) == len(whole)
        for rank, part in enumerate(parts):
            assert torch.equal(part, whole[rank::count])


def test_a_validation_is_divided_and_a_test_is_not() -> None:
    alone = list(views(0, 1).val_dataloader())
    assert [len(views(rank, 2).val_dataloader()) for rank in range(2)] == [len(alone)] * 2  # one view: each sees it
    assert [len(views(rank, 2).test_dataloader()) for rank in range(2)] == [2, 2]


@pytest.mark.parametrize(("total", "count"), [(10, 1), (10, 3), (2, 3), (0, 2)])
@pytest.mark.parametrize("shuffle", [False, True])
def test_no_sample_is_counted_twice(total: int, count: int, shuffle: bool) -> None:
    samplers = [ShareSampler(total, Share(rank, count), shuffle) for rank in range(count)]
    assert sorted(index for sampler in samplers for index in sampler) == list(range(total))
    assert [len(sampler) for sampler in samplers] == [len(list(sampler)) for sampler in samplers]
    even = [ShareSampler(total, Share(rank, count), shuffle, equal=True) for rank in range(count)]
    assert {len(sampler) for sampler in even} == {total // count}
    together = np.concatenate([list(sampler) for sampler in even])
    assert len(set(together)) == len(together)


def test_every_epoch_has_its_own_order() -> None:
    sampler = ShareSampler(50, Share(), shuffle=True, seed=1)
    first = list(sampler)
    sampler.set_epoch(1)
    assert list(sampler) != first
    sampler.set_epoch(0)
    assert list(sampler) == first


@pytest.mark.parametrize("task", ["mesh_fit", "localize"])
def test_one_whole_problem_is_not_divided(task: str, compose: Compose, tmp_path: Path) -> None:
    folder = tmp_path / task / "run"
    with pytest.raises(UserError, match="one whole problem, whose steps 2 processes cannot divide"):
        run(compose(folder, f"task={task}", *TWO))


def test_a_share_outside_a_run_is_all() -> None:
    assert Share.of(LightningDataModule()) == Share(0, 1)
    assert Share(1, 4).whole_if_few(3) == Share()
    assert Share(1, 4).whole_if_few(4) == Share(1, 4)


def test_several_machines_are_composed(compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lightning.pytorch.plugins.environments import TorchElasticEnvironment
    from lightning.pytorch.utilities import rank_zero_only

    monkeypatch.setattr(rank_zero_only, "rank", 0)  # for all of this process; a trainer changes it

    variables = {"WORLD_SIZE": "8", "RANK": "5", "LOCAL_RANK": "1", "GROUP_RANK": "2", "LOCAL_WORLD_SIZE": "2",
                 "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500", "TORCHELASTIC_RUN_ID": "fit7"}  # fmt: skip
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    cfg = compose(
        tmp_path / "toy" / "run", "task=toy_scene", "trainer=ddp_multi_node", "trainer.accelerator=cpu",
        "trainer.num_nodes=4", "trainer.devices=2",
    )  # fmt: skip
    header = (REPOSITORY / "conf" / "trainer" / "ddp_multi_node.yaml").read_text().splitlines()
    assert len(header) <= 40
    trainer = build(cfg).trainer
    assert isinstance(trainer.strategy.cluster_environment, TorchElasticEnvironment)  # type: ignore[attr-defined]
    assert (trainer.world_size, trainer.global_rank, trainer.local_rank, trainer.node_rank) == (8, 5, 1, 2)
    assert trainer.num_nodes == 4


def test_processes_that_a_launcher_started_share_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("TORCHELASTIC_RUN_ID", "SLURM_STEP_NUM_TASKS", "SLURM_PROCID"):
        monkeypatch.delenv(name, raising=False)
    assert run_name("now") == "now"
    for name, value in {"STEP_NUM_TASKS": "4", "PROCID": "2", "JOB_ID": "42", "STEP_ID": "1"}.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    assert run_name("now") == "slurm_42_1_0"
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "fit7")
    assert run_name("now") == "torchrun_fit7"


def weights_of(folder: Path) -> dict[str, Tensor]:
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def test_two_processes_fit_what_one_fits(tmp_path: Path, compose: Compose) -> None:
    settings = ["task=toy_scene", "trainer.max_steps=6", "callbacks.turntable=null", "logger=csv"]
    process = start(tmp_path, *settings, *TWO, "threads=1")
    alone = tmp_path / "alone" / "run"
    run(compose(alone, *settings))
    assert process.wait(timeout=120) == 0, (tmp_path / "said").read_text()
    assert nobody_left(process.pid)
    (folder,) = (tmp_path / "outputs" / "toy_scene").iterdir()
    for name, weight in weights_of(alone).items():
        torch.testing.assert_close(weights_of(folder)[name], weight, rtol=1e-5, atol=1e-6)
    first, second = (json.loads((each / "metrics.json").read_text()) for each in (alone, folder))
    assert first["metrics"]["test/psnr"] == pytest.approx(second["metrics"]["test/psnr"], abs=1e-4)
    said = (tmp_path / "said").read_text()
    assert said.count("\nresults ") == 1
    assert "Warning" not in said


@pytest.mark.slow
@pytest.mark.parametrize("task", ["nerf", "volume"])
def test_scenes_are_fitted_by_two_processes(task: str, tmp_path: Path) -> None:
    small = ["data.counts=[6,2,2]", "data.image_size=32", "data.rays_per_step=256", "trainer.max_steps=24",
             "trainer.val_check_interval=12", "callbacks.turntable=null", "callbacks.surface=null"]  # fmt: skip
    process = start(tmp_path, f"task={task}", *small, *TWO)
    assert process.wait(timeout=500) == 0, (tmp_path / "said").read_text()
    (folder,) = (path for path in (tmp_path / "outputs" / task).iterdir())
    scored = json.loads((folder / "metrics.json").read_text())["metrics"]
    again = subprocess.run(
        [sys.executable, str(REPOSITORY / "scripts" / "evaluate.py"), str(folder), "--json"],
        cwd=tmp_path, capture_output=True, text=True, check=True, timeout=300,
    )  # fmt: skip
    for name, value in json.loads(again.stdout).items():
        assert scored[name] == pytest.approx(value, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("rank", [0, 1])
def test_when_one_process_is_killed_the_other_ends(rank: int, tmp_path: Path) -> None:
    process = start(
        tmp_path, "task=toy", *TWO, "trainer.max_steps=1000000", "callbacks.checkpoint.every_n_train_steps=10"
    )
    end = time.monotonic() + 120
    while not list(tmp_path.glob("outputs/toy/*/checkpoints/step_*.ckpt")):
        assert time.monotonic() < end
        time.sleep(0.1)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    (other,) = [int(each) for each in children if b"train_ddp_process" in Path(f"/proc/{each}/cmdline").read_bytes()]
    os.kill(other if rank else process.pid, signal.SIGKILL)
    assert process.wait(timeout=20) != 0
    end = time.monotonic() + 20
    while not nobody_left(process.pid):
        assert time.monotonic() < end
        time.sleep(0.1)
    if rank:
        assert "process 1 of 2 failed, and its run with it" in (tmp_path / "said").read_text()
        (record,) = tmp_path.glob("outputs/toy/*/metrics.json")
        assert json.loads(record.read_text())["status"] == "failed"


@pytest.mark.slow
def test_torchrun_starts_one_run_in_one_folder(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "tests"), "RENDRA_LAB_PACKAGES": "rendra_lab_toy"}
    search = f"hydra.searchpath=[file://{Path(__file__).parent / 'conf'}]"
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    command += [str(REPOSITORY / "train.py"), search, "task=toy_scene", "trainer=ddp_multi_node"]
    command += ["trainer.accelerator=cpu", "trainer.num_nodes=1", "trainer.devices=2", "callbacks.turntable=null"]
    answer = subprocess.run(
        command, cwd=tmp_path, env=environment, timeout=240, check=False, capture_output=True, text=True
    )
    assert answer.returncode == 0, answer.stderr
    (folder,) = (tmp_path / "outputs" / "toy_scene").iterdir()
    assert json.loads((folder / "metrics.json").read_text())["status"] == "ok"
    assert OmegaConf.load(folder / ".hydra" / "config.yaml").trainer.devices == 2
