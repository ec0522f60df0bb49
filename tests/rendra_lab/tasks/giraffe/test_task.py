"""What GIRAFFE's training draws, what follows it, what it shows, and what is said of its adversary."""

from __future__ import annotations

import math
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from far_device import Far, far  # noqa: F401
from torch import Tensor, nn

from rendra_lab.data.repeated import Repeated
from rendra_lab.random_state import stream
from rendra_lab.tasks.giraffe.box_sampler import BoxSampler
from rendra_lab.tasks.giraffe.camera_sampler import CameraSampler
from rendra_lab.tasks.giraffe.discriminator import Discriminator
from rendra_lab.tasks.giraffe.feature_fields import FeatureField
from rendra_lab.tasks.giraffe.gan_losses import logistic, non_saturating, r1
from rendra_lab.tasks.giraffe.generator import Generator
from rendra_lab.tasks.giraffe.mode_collapse import ModeCollapseWatcher
from rendra_lab.tasks.giraffe.neural_renderer import NeuralRenderer
from rendra_lab.tasks.giraffe.ray_sampling import BoxSampling
from rendra_lab.tasks.giraffe.records import PictureBatch
from rendra_lab.tasks.giraffe.sample_grids import SampleGrid, share_images
from rendra_lab.tasks.giraffe.task import Giraffe
from rendra_lab.terms import LossTerm

SIDE = 16


def generator(objects: int = 1) -> Generator:
    small = {"features": 8, "hidden": 8, "layers": 2, "code": 4, "point_octaves": 2, "view_octaves": 1, "skips": []}
    return Generator(
        FeatureField(**small),  # type: ignore[arg-type]
        FeatureField(**small, point_scale=6.0),  # type: ignore[arg-type]
        NeuralRenderer(features=8, feature_side=4, picture_side=SIDE, least_width=4),
        BoxSampling(in_box=4, in_background=3),
        BoxSampler(objects=objects, scale=([0.2] * 3, [0.25] * 3), translation=([-0.2, -0.2, 0.0], [0.2, 0.2, 0.0])),
        CameraSampler(fov_deg=20.0),
    )


def giraffe(**parts: Any) -> Giraffe:
    torch.manual_seed(0)
    penalty = LossTerm(
        r1, 10.0, prediction=None, target="real", context={"pictures": "real_pictures"}, every=parts.pop("every", 1)
    )
    defaults: dict[str, Any] = {
        "generator": generator(),
        "grid": SampleGrid(samples=4, turned=2, headings=3),
        "losses": {"non_saturating": LossTerm(non_saturating, prediction="fake", target=None)},
        "optimizer": lambda weights: torch.optim.RMSprop(weights, 1e-3),
        "adversary": Discriminator(SIDE, 8),
        "adversary_losses": {"logistic": LossTerm(logistic, prediction="fake", target="real"), "r1": penalty},
        "adversary_optimizer": lambda weights: torch.optim.RMSprop(weights, 1e-3),
    }
    return Giraffe(**{**defaults, **parts})


def pictures(count: int = 3) -> PictureBatch:
    return PictureBatch(torch.rand(count, 3, SIDE, SIDE, generator=stream(7)))


def fit(task: Giraffe, steps: int, *callbacks: Any, count: int = 3) -> pl.Trainer:
    trainer = pl.Trainer(
        max_steps=steps, max_epochs=-1, accelerator="cpu", logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, callbacks=list(callbacks),
    )  # fmt: skip
    trainer.fit(task, Repeated(pictures(count), 1000))
    return trainer


def weights(network: torch.nn.Module) -> Tensor:
    return torch.nn.utils.parameters_to_vector(network.parameters()).detach().clone()


class States(pl.Callback):
    """Remembers the weights after each step."""

    def __init__(self) -> None:
        self.raw: list[Tensor] = []
        self.averaged: list[Tensor] = []

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: Any, *_: Any) -> None:
        self.raw.append(weights(pl_module.generator))
        self.averaged.append(weights(pl_module.averaged))


def test_training_draws_what_follows_from_seed_and_step() -> None:
    task, batch = giraffe(), pictures()
    first = task.predict(batch).rgb
    assert first.shape == batch.rgb.shape
    assert torch.equal(task.predict(batch).rgb, first)
    task.turn = 1
    other = task.predict(batch).rgb
    task.turn, task.seed = 0, 1
    others = [first, other, task.predict(batch).rgb]
    assert len({tuple(each.flatten().tolist()) for each in others}) == 3


def test_evaluation_draws_other_scenes_for_each_batch_and_the_same_each_time() -> None:
    task, batch = giraffe().eval(), pictures()
    seen = []
    for number in (0, 1, 0):
        task.on_validation_batch_start(batch, number)
        seen.append(task.predict(batch).rgb)
    assert torch.equal(seen[0], seen[2])
    assert not torch.equal(seen[0], seen[1])
    task.on_test_batch_start(batch, 1)
    assert torch.equal(task.predict(batch).rgb, seen[1])


def test_the_average_follows_every_step_and_is_what_is_seen() -> None:
    task, states = giraffe(decay=0.3), States()
    expected = weights(task.generator)
    fit(task, 4, states)
    assert len(states.raw) == 4
    for decay, raw, averaged in zip((2 / 11, 3 / 12, 0.3, 0.3), states.raw, states.averaged, strict=True):
        expected = decay * expected + (1 - decay) * raw
        torch.testing.assert_close(averaged, expected)
    assert not torch.equal(weights(task.averaged), weights(task.generator))
    scenes = task.averaged.sample(3, stream(0, 0, 2, 0))
    assert torch.equal(task.observe(pictures()).rgb, task.averaged(scenes).rgb)
    trained = {id(each) for group in task.configure_optimizers() for each in group.param_groups[0]["params"]}
    assert not trained & {id(each) for each in task.averaged.parameters()}


@pytest.mark.parametrize("in_turn", [False, True])
def test_a_fit_logs_what_a_gan_should_be_watched_by(in_turn: bool) -> None:
    watcher = ModeCollapseWatcher(every_n_steps=2, samples=12)
    trainer = fit(giraffe(in_turn=in_turn, every=2), 4, watcher, count=12)
    logged = {name.removeprefix("train/"): float(value) for name, value in trainer.callback_metrics.items()}
    assert all(map(math.isfinite, logged.values()))
    names = {"loss", "loss_non_saturating", "adversary_loss", "loss_logistic", "loss_r1", "score_made", "score_real"}
    assert names | {"gradient_norm", "adversary_gradient_norm", "variety_pairs", "variety_nearest"} <= set(logged)
    assert logged["variety_pairs"] < 1  # of real pictures that are noise


def test_the_watcher_looks_at_enough_pictures_only() -> None:
    trainer = fit(giraffe(), 2, ModeCollapseWatcher(every_n_steps=1), count=2)
    assert "train/variety_pairs" not in trainer.callback_metrics


@pytest.mark.parametrize("objects", [1, 2])
def test_panels_show_the_same_scenes_whatever_batch(objects: int) -> None:
    task = giraffe(generator=generator(objects))
    first, second = task.show(pictures(3)), task.show(pictures(5))
    assert {name: tuple(image.shape) for name, image in first.items()} == {
        "samples": (4, SIDE, SIDE, 3),
        "objects": (4, SIDE, SIDE, 3),
        "turned": (2 * SIDE, 3 * SIDE, 3),
        "real": (3, SIDE, SIDE, 3),
    }
    torch.testing.assert_close(first["turned"][SIDE:, :SIDE], first["samples"][1])
    assert all(torch.equal(first[name], second[name]) for name in ("samples", "objects", "turned"))


def test_many_scenes_are_made_a_few_at_once() -> None:
    maker = generator().eval()
    scenes = maker.sample(19, stream(3))
    with torch.no_grad():
        made = maker(scenes)
        last = maker(scenes.rows(torch.tensor([18])))
    assert len(made.rgb) == len(made.shares) == 19
    torch.testing.assert_close(made.rgb[18:], last.rgb)


def test_shares_in_colours() -> None:
    shares = torch.zeros(1, 3, 2, 2)
    shares[0, 0, 0, 0] = shares[0, 1, 0, 1] = shares[0, 2, 1, 0] = 1.0
    image = share_images(shares, 4)
    assert image.shape == (1, 4, 4, 3)
    corners = image[0, ::2, ::2]
    torch.testing.assert_close(corners[1, 0], torch.full((3,), 0.25))
    assert not corners[1, 1].any()
    assert not torch.equal(corners[0, 0], corners[0, 1])


def test_a_step_stays_where_its_batch_lies(far: Any) -> None:  # noqa: F811
    task = giraffe()
    for module in task.modules():
        for name, weight in module._parameters.items():
            if weight is not None:
                module._parameters[name] = nn.Parameter(weight.detach().to(far), weight.requires_grad)
    batch = pictures().to(far)
    prediction = task.predict(batch)
    for total, *_ in (
        task._generator_objective(prediction, batch, 0),
        task._adversary_objective(prediction, batch, 0),
    ):
        assert isinstance(total, Far)
        total.backward()
    assert all(isinstance(each.grad, Far) for network in task._networks() for each in network)
    task.follow()
    assert all(image.shape[-1] == 3 for image in task.show(batch).values())
