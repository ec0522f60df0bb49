"""A run from configuration to files: numbers, pictures, events, checkpoints, and going on from them."""

import csv
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from rendra_lab_toy import ToyTask
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from rendra_lab.checkpoints import find_checkpoint
from rendra_lab.errors import UserError
from rendra_lab.experiment import build, evaluate, load_run, run
from rendra_lab.targets import check_targets

Compose = Callable[..., Any]


def record_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "metrics.json").read_text())


def save_config(cfg: Any) -> None:
    """What Hydra does before a run."""
    path = Path(cfg.run_dir) / ".hydra" / "config.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(cfg, path)


def test_a_run_leaves_everything_behind(compose: Compose, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "toy" / "run"
    cfg = compose(folder, "task=toy", "trainer.max_steps=30", "trainer.log_every_n_steps=5")
    value = run(cfg)

    record = record_of(folder)
    assert record["status"] == "ok"
    assert record["steps"] == 30
    assert record["metrics"]["test/psnr"] == value == pytest.approx(record["metrics"]["val/psnr"], abs=15)
    assert record["seconds"]["total"] >= record["seconds"]["fit"] > 0
    assert record["step_ms_median"] > 0
    assert record["peak_memory_mb"]["ram"] > 50
    assert record["versions"]["torch"] == torch.__version__
    assert record["seed"] == 0
    assert record["device"] == "cpu"

    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    for name in ("checkpoints/last.ckpt", "metrics.csv", "exports/fit.gif", "exports/triangle.ply"):
        assert name in files
    assert {"images/step_000000.png", "images/final.png", "images/story.png", "images/val_000020.png"} <= files
    assert not [name for name in files if ".tmp" in name]

    with (folder / "metrics.csv").open() as table:
        rows = list(csv.DictReader(table))
    assert [int(row["step"]) for row in rows if row["train/loss"]] == [4, 9, 14, 19, 24, 29]
    assert all(row["train/loss_texture"] for row in rows if row["train/loss"])
    assert any(row["val/iou"] for row in rows)

    said = capsys.readouterr().out
    assert "test/psnr" in said
    assert "tensorboard --logdir" in said


def test_tensorboard_shows_scalars_images_meshes_and_hparams(compose: Compose, tmp_path: Path) -> None:
    folder = tmp_path / "toy" / "run"
    run(compose(folder, "task=toy", "trainer.max_steps=20", "optimizer.lr=0.07"))
    (events,) = folder.glob("events.out.tfevents.*")
    shown = EventAccumulator(str(events))
    shown.Reload()
    tags = shown.Tags()
    assert {"train/loss", "train/loss_silhouette", "val/psnr", "test/psnr"} <= set(tags["scalars"])
    assert [event.step for event in shown.Scalars("train/loss")] == [9, 19]
    assert [event.step for event in shown.Images("train/prediction")] == [0, 20]
    assert "triangle_VERTEX" in tags["tensors"]
    assert "triangle_COLOR" in tags["tensors"]
    hparams = shown.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    assert b"optimizer.lr" in hparams
    assert b"loss.texture.weight" in hparams


def test_the_same_seed_gives_the_same_numbers(compose: Compose, tmp_path: Path) -> None:
    first = run(compose(tmp_path / "toy" / "a", "task=toy", "debug=fast"))
    second = run(compose(tmp_path / "toy" / "b", "task=toy", "debug=fast"))
    assert first == second


def test_a_broken_run_goes_on_to_the_same_end(compose: Compose, tmp_path: Path) -> None:
    whole = tmp_path / "toy" / "1_whole"
    run(compose(whole, "task=toy", "trainer.max_steps=24", "optimizer=adamw"))

    broken = tmp_path / "toy" / "2_broken"
    with pytest.raises(RuntimeError, match="broke as told"):
        run(compose(broken, "task=toy", "trainer.max_steps=24", "optimizer=adamw", "+module.fail_at=13"))
    record = record_of(broken)
    assert record["status"] == "failed"
    assert record["error"] == "RuntimeError: the toy broke as told"

    resumed = tmp_path / "toy" / "3_resumed"
    run(compose(resumed, "task=toy", "trainer.max_steps=24", "optimizer=adamw", "ckpt_path=last"))
    assert record_of(resumed)["resumed_from"] == str(broken / "checkpoints" / "last.ckpt")
    assert record_of(resumed)["metrics"] == record_of(whole)["metrics"]
    with (resumed / "metrics.csv").open() as table:
        steps = [int(row["step"]) for row in csv.DictReader(table) if row["train/loss"]]
    assert steps == [19]  # of 9, 19: the steps go on, they do not start anew
    ends = [torch.load(f / "checkpoints" / "last.ckpt", weights_only=True) for f in (whole, resumed)]
    assert ends[0]["global_step"] == ends[1]["global_step"] == 24
    for name, weight in ends[0]["state_dict"].items():
        assert torch.equal(weight, ends[1]["state_dict"][name])


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_an_interrupted_run_keeps_its_step(
    name: str, code: int, compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    inner = ToyTask.training_step

    def interrupted(self: ToyTask, batch: Any, batch_idx: int) -> Any:
        if self.global_step == 7:
            os.kill(os.getpid(), signal.Signals[name])
        return inner(self, batch, batch_idx)

    monkeypatch.setattr(ToyTask, "training_step", interrupted)
    folder = tmp_path / "toy" / "run"
    try:
        with pytest.raises(SystemExit) as end:
            run(compose(folder, "task=toy", "trainer.max_steps=30"))
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert end.value.code == code
    assert record_of(folder)["status"] == "interrupted"
    state = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    assert state["global_step"] in (7, 8)


def test_the_checkpoint_to_resume_from(tmp_path: Path) -> None:
    old, new = (tmp_path / "toy" / name / "checkpoints" for name in ("1", "2_sweep/0_lr=1"))
    for age, folder in enumerate((old, new)):
        folder.mkdir(parents=True)
        torch.save({"global_step": 1, "state_dict": {}}, folder / "last.ckpt")
        os.utime(folder / "last.ckpt", (age, age))
    here = tmp_path / "toy" / "3"
    assert find_checkpoint(None, here, tmp_path) is None
    assert find_checkpoint("last", here, tmp_path) == new / "last.ckpt"
    assert find_checkpoint("last", tmp_path / "toy" / "4_sweep" / "0", tmp_path) == new / "last.ckpt"
    assert find_checkpoint(str(old.parent), here, tmp_path) == old / "last.ckpt"
    assert find_checkpoint(str(old / "last.ckpt"), here, tmp_path) == old / "last.ckpt"
    with pytest.raises(UserError, match="neither a checkpoint nor a run folder at nowhere"):
        find_checkpoint("nowhere", here, tmp_path)
    with pytest.raises(UserError, match="no checkpoint under"):
        find_checkpoint("last", tmp_path / "nerf" / "1", tmp_path)


def test_a_run_can_be_loaded_and_scored_again(compose: Compose, tmp_path: Path) -> None:
    folder = tmp_path / "toy" / "run"
    cfg = compose(folder, "task=toy", "debug=fast")
    save_config(cfg)
    value = run(cfg)
    before = sorted(folder.rglob("*"))
    loaded = load_run(folder)
    assert evaluate(loaded)["test/psnr"] == value
    assert not loaded.task.training
    assert sorted(folder.rglob("*")) == before
    with pytest.raises(UserError, match="not the folder of a run"):
        load_run(tmp_path)
    with pytest.raises(UserError, match=r"no checkpoint at .*best.ckpt; say last, best or a file"):
        load_run(folder, weights="best")


def test_the_best_weights_can_be_tested(compose: Compose, tmp_path: Path) -> None:
    watch = ["callbacks=[default,best]", "callbacks.best.monitor=val/psnr", "callbacks.best.mode=max"]
    folder = tmp_path / "toy" / "run"
    # a rate that overshoots: the validation in the middle is better than the last
    cfg = compose(folder, "task=toy", "test=best", "optimizer.lr=0.05", "trainer.max_steps=28", *watch)
    cfg.trainer.val_check_interval = 7
    save_config(cfg)
    run(cfg)
    with (folder / "metrics.csv").open() as table:
        seen = [float(row["val/psnr"]) for row in csv.DictReader(table) if row["val/psnr"]]
    assert record_of(folder)["metrics"]["test/psnr"] == pytest.approx(max(seen))
    assert max(seen) > seen[-1]
    assert evaluate(load_run(folder, "best"))["test/psnr"] == pytest.approx(max(seen))
    with pytest.raises(UserError, match="test=best needs"):
        run(compose(tmp_path / "toy" / "other", "task=toy", "debug=fast", "test=best"))


def test_parts_can_be_switched_off(compose: Compose, tmp_path: Path) -> None:
    folder = tmp_path / "toy" / "run"
    off = ["logger=csv", "callbacks=[timer]", "test=null", "optimized_metric=null", "+callbacks.images.max_files=3"]
    assert run(compose(folder, "task=toy", "debug=fast", *off)) is None
    names = {path.name for path in folder.rglob("*")}
    assert names == {"metrics.json", "metrics.csv", "report.html"}


@pytest.mark.parametrize("mode", ["fast", "overfit", "anomaly", "profile"])
def test_debug_modes_run(mode: str, compose: Compose, tmp_path: Path) -> None:
    folder = tmp_path / "toy" / "run"
    cfg = compose(folder, "task=toy", f"debug={mode}")
    cfg.trainer.max_steps = min(cfg.trainer.max_steps, 6)
    run(cfg)
    assert record_of(folder)["steps"] <= 6
    if mode == "profile":
        assert list((folder / "exports").glob("*profile*.txt"))


def test_code_outside_the_allowed_packages_is_never_called(compose: Compose, tmp_path: Path) -> None:
    for target in ("os.system", "builtins.eval", "rendra_lab.report.subprocess.run", "torch.load", "pathlib.Path"):
        cfg = compose(tmp_path / "toy" / "run", "task=toy", f"data._target_={target}")
        with pytest.raises(UserError, match="data: a configuration may not call"):
            build(cfg)


def test_targets_and_arguments_that_do_not_exist_are_explained() -> None:
    with pytest.raises(UserError, match=r"loss: rendra_lab.losses has no 'huberr'; did you mean 'huber'\?"):
        check_targets({"loss": {"_target_": "rendra_lab.losses.huberr"}})
    with pytest.raises(UserError, match=r"no module|rendra_lab has no 'nowhere'"):
        check_targets({"loss": {"_target_": "rendra_lab.nowhere.thing"}})
    adam = {"_target_": "torch.optim.Adam", "_partial_": True, "weight_decays": 0.1}
    with pytest.raises(UserError, match=r"optimizer.weight_decays: Adam takes no .*did you mean 'weight_decay'\?"):
        check_targets({"optimizer": adam})
    check_targets({"list": [{"_target_": "torch.nn.functional.mse_loss", "_partial_": True}]})


def test_numbers_that_nobody_measured_cannot_be_optimised(compose: Compose, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no 'test/lpips'; it has: train/loss"):
        run(compose(tmp_path / "toy" / "run", "task=toy", "debug=fast", "optimized_metric=test/lpips"))
    with pytest.raises(UserError, match="seed must be a whole number, got 'x'"):
        build(compose(tmp_path / "toy" / "run", "task=toy", "seed=x"))


def test_a_checkpoint_that_is_cut_off_is_told(compose, tmp_path):
    first = tmp_path / "toy" / "1"
    run(compose(first, "task=toy", "trainer.max_steps=2"))
    checkpoint = first / "checkpoints" / "last.ckpt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:-100])
    with pytest.raises(UserError, match="is cut off, or is no checkpoint; there is no other good"):
        run(compose(tmp_path / "toy" / "2", "task=toy", f"ckpt_path={checkpoint}"))
