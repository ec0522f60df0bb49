"""A run that was cut off and goes on ends, to the bit, where it would have ended: every task, at a random step."""

from __future__ import annotations

import contextlib
import hashlib
import os
import random
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback, LightningDataModule, LightningModule, Trainer, seed_everything
from lightning.pytorch.callbacks import Checkpoint
from torch import Tensor, nn
from torch.utils.data import DataLoader

from rendra_lab import experiment, signals
from rendra_lab.callbacks import StopWhenSettled
from rendra_lab.checkpoints import checkpoints_are_data
from rendra_lab.data.epochs import ShuffledEpochs
from rendra_lab.interruptions import LastStepKeeper
from rendra_lab.random_state import RandomState, Streams, seeded, untouched

CONF = Path(__file__).parents[2] / "conf"
STEPS = 8
SEED = random.SystemRandom().randrange(10**6)  # stands in the message of whatever fails

_VIEWS = ("mesh=ico_sphere", "data.image_size=16", "data.counts=[4,1,1]", "data.antialias=1", "data.rays_per_step=48")
_SCENE = (*_VIEWS, "data.rays_per_pixel_side=[[0,1],[6,2]]", "data.jitter=true", "trainer.val_check_interval=5")
_OCCUPANCY = ("sampler.cells=8", "sampler.steps_across=8", "sampler.refresh_every=3", "sampler.empty_from=4")
_HASHES = ("field.encoding.log2_table_size=8", "field.width=8")
_VOLUME = ("volume.voxels=[6,8]", "module.refine_at=[4]", "+module.look_every=3", "+module.look_from=3")
_ROOMS = (
    *("data.counts=[4,1,1]", "data.models_per_name=1", "data.batch_size=2", "data.cache=null"),
    "callbacks.detections.pictures=0",
)
_SMALL_MESH = ("mesh=torus", "scene.image_size=24")
SMALLER = {
    "mesh_fit": (
        "data.name=ico_sphere",
        "data.scan_points=500",
        "surface.levels=[1,2,3]",
        "module.refine_at=[2,5]",
        "module.samples=200",
    ),
    "giraffe": (
        *("data.counts=[12,2,2]", "data.batch_size=4", "data.eval_batch_size=2", "data.cache=null"),
        *("data.image_size=16", "network.discriminator.picture_side=16", "network.discriminator.widest=16"),
        *("network.generator.renderer.feature_side=4", "network.generator.renderer.picture_side=16"),
    ),
    "mask_rcnn": _ROOMS,
    "mesh_rcnn": (
        *(*_ROOMS, "data.points=100", "data.voxels=12", "network.detector.heads.shapes.warmup_steps=3"),
        *("network.detector.heads.shapes.voxels.side=8", "network.detector.heads.shapes.voxel_pool.side=4"),
    ),
    "nerf": (*_SCENE, *_OCCUPANCY, *_HASHES),
    "volume": (*_SCENE, *_VOLUME),
    "pose_track": ("data.frames=4", "data.steps_per_frame=3", *_SMALL_MESH),
    "pose": _SMALL_MESH,
    "smplify": ("data.count=4", "data.image_size=64", "data.cache=null", "module.narrow=[[3,2]]"),
    "synsin": ("data.image_size=64", "data.counts=[2,1,1]", "data.batch_size=4", "data.cache=null"),
    "voxmesh": (
        *("data.image_size=33", "data.counts=[2,1,1]", "data.views=2", "data.eval_views=1", "data.voxels=16"),
        *("data.batch_size=2", "data.cache=null", "head.start.warmup_steps=2", "callbacks.shapes.samples=500"),
        *("network.side_px=33", "network.voxel_head.side=8"),
    ),
    "toy": ("+data.steps=5", "trainer.val_check_interval=1.0"),
}
VARIANTS = {
    "nerf tri_plane stratified": ("task=nerf", "field=tri_plane", "sampler=stratified", *_SCENE, "sampler.samples=6"),
    "nerf mlp_original hierarchical": (
        *("task=nerf", "field=mlp_original", "sampler=hierarchical", "loss=[rgb,rgb_coarse,opacity]", *_SCENE),
        *("sampler.coarse_samples=6", "sampler.fine_samples=6", "field.width=8"),
    ),
    "nerf mlp_book stratified": ("task=nerf", "field=mlp_book", "sampler=stratified", *_SCENE, "sampler.samples=6"),
    "nerf mlp_original occupancy": ("task=nerf", "field=mlp_original", *_SCENE, *_OCCUPANCY, "field.width=8"),
    "volume book": (
        "task=volume",
        "volume=book",
        "volume.voxels=8",
        "volume.samples=6",
        "module.refine_at=[]",
        *_SCENE,
    ),
    "pose six_dof": ("task=pose", "pose=six_dof", *_SMALL_MESH),
    "pose levenberg_marquardt": ("task=pose", "solver=levenberg_marquardt", "compare_px=16", *_SMALL_MESH),
    "giraffe in turn": ("task=giraffe", "module.in_turn=true", "adversary_loss.r1.every=3", *SMALLER["giraffe"]),
    "mesh_fit book": ("experiment=mesh_fit_all", "trainer.log_every_n_steps=1"),
}
_BARE = ("logger=csv", "trainer.log_every_n_steps=1")


def tasks() -> list[str]:
    return sorted(path.stem for path in (CONF / "task").glob("*.yaml"))


class EndAt(Callback):
    """Ends a fit early: as SIGTERM does, or as the clock or a loss that is low enough."""

    def __init__(self, step: int, by_signal: bool) -> None:
        self.step, self.by_signal = step, by_signal

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        if trainer.global_step == self.step:
            if self.by_signal:
                os.kill(os.getpid(), signal.SIGTERM)
            else:
                trainer.should_stop = True


class Keeper(Callback):
    """Remembers the losses of a fit, to the bit, and its trainer."""

    def __init__(self) -> None:
        self.losses: dict[int, str] = {}

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, *_: Any) -> None:
        self.losses[trainer.global_step] = float(outputs["loss"]).hex()


def digest(value: Any) -> str:
    """A hash of tensors and plain values, nested as they like."""
    sha = hashlib.sha256()

    def add(item: Any) -> None:
        if isinstance(item, Tensor):
            sha.update(str((item.dtype, tuple(item.shape))).encode())
            sha.update(item.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
        elif isinstance(item, dict):
            for name in sorted(item, key=str):
                sha.update(str(name).encode())
                add(item[name])
        elif isinstance(item, list | tuple):
            for part in item:
                add(part)
        else:
            sha.update(repr(item).encode())

    add(value)
    return sha.hexdigest()


class Runs:
    """Makes runs of one configuration: whole, ended early, and resumed."""

    def __init__(self, compose: Callable[..., Any], folder: Path, settings: tuple[str, ...]) -> None:
        self.compose, self.folder, self.settings = compose, folder, settings

    def __call__(self, name: str, *overrides: str, ended: EndAt | None = None) -> tuple[Path, dict[int, str]]:
        folder, keeper = self.folder / "task" / name, Keeper()
        cfg = self.compose(folder, *self.settings, *overrides)
        made = experiment.build(cfg)
        kept = [
            part for part in made.trainer.callbacks if isinstance(part, Checkpoint | RandomState | StopWhenSettled)
        ]
        made.trainer.callbacks = [keeper, *([] if ended is None else [ended]), *kept]
        with signals.listening(), contextlib.suppress(signals.Interrupted):
            made.trainer.fit(made.task, datamodule=made.data, ckpt_path=cfg.ckpt_path)
        return folder, keeper.losses


def final_state(folder: Path) -> dict[str, str]:
    """Hashes of what a run ends with."""
    state = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    for streams in state["random_state"]:
        del streams["python"]  # beartype, which only tests have, draws from it to check items of tuples
    parts = ("state_dict", "optimizer_states", "lr_schedulers", "random_state", "global_step")
    return {part: digest(state[part]) for part in parts}


def check(compose: Callable[..., Any], folder: Path, *settings: str, steps: int = STEPS, ended_by: str = "") -> None:
    """A whole run and one that goes on from a checkpoint in its midst; and one that was ended there, and goes on."""
    broken_at = random.Random(f"{SEED} {settings}").randrange(1, steps)
    where = f"broken at step {broken_at} of {steps}, SEED = {SEED}"
    limit = () if "task=pose_track" in settings else (f"trainer.max_steps={steps}",)
    keep = (f"callbacks.checkpoint.every_n_train_steps={broken_at}", "+callbacks.checkpoint.save_top_k=-1")
    runs = Runs(compose, folder, (*settings, *_BARE, *limit, *keep))
    whole, losses_of_whole = runs("whole")
    before = {step: loss for step, loss in losses_of_whole.items() if step <= broken_at}
    checkpoints = [whole / "checkpoints" / f"step_{broken_at:06d}.ckpt"]
    if ended_by:
        ended, losses_of_ended = runs("ended", ended=EndAt(broken_at, ended_by == "signal"))
        assert losses_of_ended == before, where
        checkpoints.append(ended / "checkpoints" / "last.ckpt")
    for checkpoint in checkpoints:
        again, after = runs(f"from_{checkpoint.stem}", f"ckpt_path={checkpoint}")
        assert {**before, **after} == losses_of_whole, f"{checkpoint.stem}, {where}"
        assert min(after) == broken_at + 1, f"{checkpoint.stem}, {where}"
        assert final_state(again) == final_state(whole), f"{checkpoint.stem}, {where}"


@pytest.mark.parametrize("ended_by", ["signal", "itself"])
def test_a_toy_goes_on_in_the_middle_of_an_epoch(ended_by: str, compose: Callable[..., Any], tmp_path: Path) -> None:
    settings = ("task=toy", "+data.steps=5", "trainer.val_check_interval=1.0", "optimizer=adamw")
    check(compose, tmp_path, *settings, steps=12, ended_by=ended_by)


@pytest.mark.parametrize("task", tasks())
def test_every_task_goes_on_as_if_it_had_not_stopped(task: str, compose: Callable[..., Any], tmp_path: Path) -> None:
    check(compose, tmp_path, f"task={task}", *SMALLER.get(task, ()))


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_part_goes_on_as_if_it_had_not_stopped(
    variant: str, compose: Callable[..., Any], tmp_path: Path
) -> None:
    check(compose, tmp_path, *VARIANTS[variant], steps=12, ended_by="signal")


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("task", tasks())
def test_every_task_goes_on_from_any_step(task: str, seed: int, compose: Callable[..., Any], tmp_path: Path) -> None:
    settings = (f"task={task}", *SMALLER.get(task, ()), f"seed={seed}")
    check(compose, tmp_path, *settings, steps=12, ended_by="signal")


@pytest.mark.parametrize("task", ["toy", pytest.param("nerf", marks=pytest.mark.slow)])
def test_showing_and_measuring_disturb_nothing(task: str, compose: Callable[..., Any], tmp_path: Path) -> None:
    """Nor do callbacks that are left out, logging, checkpoints, or turntables."""
    settings = (f"task={task}", *SMALLER.get(task, ()), "trainer.max_steps=12", "report=null")
    busy = ("callbacks.images.every_n_steps=5", "callbacks.meshes.every_n_steps=5", "trainer.val_check_interval=3")
    films = ("callbacks.turntable.frames=2",) if task == "nerf" else ("callbacks.animation.every_n_steps=5",)
    ends = []
    for name, more in {
        "busy": (*busy, *films),
        "bare": ("+trainer.limit_val_batches=0",),
    }.items():
        made = experiment.build(compose(tmp_path / name, *settings, *more))
        if name == "bare":
            made.trainer.callbacks = [part for part in made.trainer.callbacks if isinstance(part, LastStepKeeper)]
        made.trainer.fit(made.task, datamodule=made.data)
        ends.append(digest(made.task.state_dict()))
    assert ends[0] == ends[1]


class NoisyRows(LightningDataModule):
    """Rows with noise, shuffled."""

    def __init__(self, num_workers: int) -> None:
        super().__init__()
        self.num_workers = num_workers

    def train_dataloader(self) -> ShuffledEpochs[Tensor]:
        return ShuffledEpochs(_Rows(), 4, num_workers=self.num_workers)

    def val_dataloader(self) -> DataLoader[Any]:
        return DataLoader(_Rows(), batch_size=5, shuffle=True)  # draws from the fit's own stream


class _Rows:
    """Ten numbers with noise."""

    def __len__(self) -> int:
        return 10

    def __getitem__(self, index: int) -> Tensor:
        return index + torch.rand(3) + random.random()


class Noisy(LightningModule):
    """Draws from every stream in each step, and breaks when told."""

    def __init__(self, breaks_at: int | None = None) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(3))
        self.drop = nn.Dropout(0.5)
        self.own = torch.Generator().manual_seed(1)
        self.numpy = np.random.default_rng(1)
        self.breaks_at = breaks_at

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor:
        noise = torch.rand(3, generator=self.own) + self.numpy.random() + random.random() + np.random.rand()  # noqa: NPY002
        if self.global_step == self.breaks_at:
            raise RuntimeError("broke as told")
        return (self.drop(batch) - self.weight - noise).square().mean()

    def validation_step(self, batch: Tensor, batch_idx: int) -> None:
        random.random()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.parameters(), lr=0.1)


def fit_noisy(folder: Path, num_workers: int = 0, breaks_at: int | None = None, ckpt_path: Path | None = None) -> str:
    """Ten steps over rows in batches of three an epoch; the hash of the weights."""
    seed_everything(3, verbose=False)
    task = Noisy(breaks_at)
    trainer = Trainer(
        max_steps=10,
        max_epochs=-1,
        accelerator="cpu",
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        val_check_interval=2,
        check_val_every_n_epoch=None,
        callbacks=[RandomState(), LastStepKeeper(str(folder / "last.ckpt"))],
    )
    with checkpoints_are_data():
        trainer.fit(task, datamodule=NoisyRows(num_workers), ckpt_path=ckpt_path)
    return digest(task.state_dict())


@pytest.mark.parametrize("breaks_at", [1, 3, 4, 6, 9])
def test_a_step_that_broke_is_made_again(breaks_at: int, tmp_path: Path) -> None:
    whole = fit_noisy(tmp_path / "whole")
    with pytest.raises(RuntimeError, match="broke as told"):
        fit_noisy(tmp_path / "broken", breaks_at=breaks_at)
    assert fit_noisy(tmp_path / "again", ckpt_path=tmp_path / "broken" / "last.ckpt") == whole


@pytest.mark.slow
@pytest.mark.parametrize("breaks_at", [2, 4])
def test_workers_load_what_a_resumed_fit_needs(breaks_at: int, tmp_path: Path) -> None:
    whole = fit_noisy(tmp_path / "whole")
    with pytest.raises(RuntimeError, match="broke as told"):
        fit_noisy(tmp_path / "broken", 2, breaks_at)
    assert fit_noisy(tmp_path / "again", 2, ckpt_path=tmp_path / "broken" / "last.ckpt") == whole


def draws() -> tuple[float, ...]:
    return random.random(), np.random.rand(), float(torch.rand(())), random.gauss(0, 1), np.random.randn()  # noqa: NPY002


@pytest.mark.parametrize("bits", [np.random.PCG64, np.random.MT19937, np.random.Philox, np.random.SFC64])
def test_streams_survive_a_file_of_plain_values(bits: Any, tmp_path: Path) -> None:
    owned = {"torch": torch.Generator().manual_seed(4), "numpy": np.random.Generator(bits(5))}
    draws()  # the second of a pair of normal numbers waits within the stream
    torch.save(Streams.now(owned).to_plain(), tmp_path / "streams.pt")
    expected = (*draws(), float(torch.rand((), generator=owned["torch"])), owned["numpy"].random())
    Streams.from_plain(torch.load(tmp_path / "streams.pt", weights_only=True)).restore(owned)
    assert (*draws(), float(torch.rand((), generator=owned["torch"])), owned["numpy"].random()) == expected


def test_what_is_drawn_aside_leaves_the_streams_alone() -> None:
    state = Streams.now()
    expected = draws()
    state.restore()
    with untouched():
        draws()
    with seeded(1, 2):
        first = draws()
    assert draws() == expected
    with seeded(1, 2):
        assert draws() == first
    with seeded(1, 3):
        assert draws() != first


def test_a_checkpoint_without_random_state_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    fit_noisy(tmp_path)
    path = tmp_path / "last.ckpt"
    state = torch.load(path, weights_only=True)
    del state["random_state"]
    torch.save(state, path)
    fit_noisy(tmp_path / "again", ckpt_path=path)
    assert "the checkpoint holds no random state" in caplog.text
