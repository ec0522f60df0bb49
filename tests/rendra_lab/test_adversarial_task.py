"""A generator and its adversary: whose gradient is whose, what a step is, and what ends it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from jaxtyping import Float
from torch import Tensor, nn

from rendra_lab.adversarial_task import AdversarialTask
from rendra_lab.data.repeated import Repeated
from rendra_lab.nan_guard import NanGuard, NotFiniteError
from rendra_lab.records import FieldError, TensorRecord
from rendra_lab.terms import LossTerm

_REAL, _RATE = 0.8, 0.1


@dataclass(frozen=True)
class Pictures(TensorRecord):
    """As they should be."""

    rgb: Float[Tensor, "B 3 H W"]


class Adversary(nn.Module):
    """How much it likes a picture: its mean, times a weight."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor(2.0))

    def forward(self, pictures: Tensor) -> Tensor:
        return self.weight * pictures.mean()


class Painter(AdversarialTask[Pictures, Pictures]):
    """Paints everything in one shade."""

    def __init__(self, **parts: Any) -> None:
        super().__init__(**parts)
        self.shade = nn.Parameter(torch.tensor(0.1))

    def predict(self, batch: Pictures) -> Pictures:
        return Pictures(self.shade.expand_as(batch.rgb))

    def shown(self, prediction: Pictures, batch: Pictures) -> tuple[Tensor, Tensor]:
        return prediction.rgb, batch.rgb


def likes(fake: Tensor) -> Tensor:
    return -fake


def sgd(parameters: Any) -> torch.optim.Optimizer:
    return torch.optim.SGD(parameters, lr=_RATE)


def parts_of_painter(**parts: Any) -> dict[str, Any]:
    defaults: dict[str, Any] = {
        "losses": {
            "l1": LossTerm(lambda made, real: (made - real).abs().mean(), weight=0.5),
            "likes": LossTerm(likes, weight=3.0, prediction="fake", target=None),
        },
        "optimizer": sgd,
        "adversary": Adversary(),
        "adversary_losses": {
            "trusts": LossTerm(lambda fake, real: -real, prediction="fake", target="real"),
            "doubts": LossTerm(lambda fake: fake, prediction="fake", target=None),
        },
        "adversary_optimizer": sgd,
    }
    return {**defaults, **parts}


def painter(**parts: Any) -> Painter:
    return Painter(**parts_of_painter(**parts))


def fit(task: Painter, steps: int, *callbacks: Any) -> pl.Trainer:
    trainer = pl.Trainer(
        max_steps=steps, max_epochs=-1, accelerator="cpu", logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, callbacks=list(callbacks),
    )  # fmt: skip
    trainer.fit(task, Repeated(Pictures(torch.full((2, 3, 4, 4), _REAL)), 1000))
    return trainer


def test_a_step_moves_both_by_the_gradients_at_its_beginning() -> None:
    task = painter()
    trainer = fit(task, 1)
    assert float(task.shade.detach()) == pytest.approx(0.1 + _RATE * (0.5 + 3.0 * 2.0))
    assert isinstance(task.adversary, Adversary)
    assert float(task.adversary.weight.detach()) == pytest.approx(2.0 - _RATE * (0.1 - _REAL))  # of the shade before
    assert trainer.global_step == 1


class Turns(Painter):
    """Remembers whose turn it was."""

    def predict(self, batch: Pictures) -> Pictures:
        vars(self).setdefault("seen", []).append((self.global_step, self.turn, torch.is_grad_enabled()))
        return super().predict(batch)


def test_in_turn_the_adversary_sees_what_the_generator_makes_after_its_update() -> None:
    task = Turns(**parts_of_painter(in_turn=True))
    trainer = fit(task, 1)
    moved = 0.1 + _RATE * (0.5 + 3.0 * 2.0)
    assert float(task.shade.detach()) == pytest.approx(moved)
    assert isinstance(task.adversary, Adversary)
    assert float(task.adversary.weight.detach()) == pytest.approx(2.0 - _RATE * (moved - _REAL))
    assert trainer.global_step == 1
    assert task.seen == [(0, 0, True), (1, 1, False)]
    assert task.turn == 0


def test_in_turn_schedulers_step_once_and_steps_count_once() -> None:
    task = painter(in_turn=True, scheduler=lambda optimizer: torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.5))
    trainer = fit(task, 3)
    assert trainer.global_step == 3
    assert [each.param_groups[0]["lr"] for each in trainer.optimizers] == [_RATE / 8] * 2


def test_gradient_norms_are_logged_and_what_a_task_makes_of_verdicts() -> None:
    class Talking(Painter):
        def verdicts(self, fake: Tensor, real: Tensor) -> dict[str, Tensor]:
            return {"trust": real - fake}

    trainer = fit(Talking(**parts_of_painter()), 1)
    logged = {name: float(value) for name, value in trainer.callback_metrics.items()}
    assert logged["train/gradient_norm"] == pytest.approx(0.5 + 3.0 * 2.0)
    assert logged["train/adversary_gradient_norm"] == pytest.approx(_REAL - 0.1)
    assert logged["train/trust"] == pytest.approx(2.0 * (_REAL - 0.1))


def test_a_term_of_the_adversary_may_ask_for_gradients_at_real_pictures() -> None:
    def slope(real: Tensor, pictures: Tensor) -> Tensor:
        (gradient,) = torch.autograd.grad(real, pictures, create_graph=True)
        return gradient.square().sum()

    term = LossTerm(slope, weight=4.0, prediction=None, target="real", context={"pictures": "real_pictures"}, every=2)
    task = painter(adversary_losses={**painter().adversary_losses, "slope": term})
    trainer = fit(task, 1)
    pixels = 2 * 3 * 4 * 4  # the slope is that of a mean: weight / pixels in each
    assert float(trainer.callback_metrics["train/loss_slope"]) == pytest.approx(2.0**2 / pixels)
    assert isinstance(task.adversary, Adversary)
    expected = 2.0 - _RATE * (0.1 - _REAL + 2 * 4.0 * 2 * 2.0 / pixels)
    assert float(task.adversary.weight.detach()) == pytest.approx(expected)
    pictures = Pictures(torch.full((2, 3, 4, 4), _REAL))
    assert set(task._adversary_objective(pictures, pictures, 1)[1]) == {
        "train/adversary_loss", "train/loss_trusts", "train/loss_doubts",
    }  # fmt: skip


def test_steps_are_those_of_the_fit_not_of_its_optimizers() -> None:
    trainer = fit(painter(), 7)
    assert trainer.global_step == 7
    assert trainer.fit_loop.epoch_loop.total_batch_idx == 6


def test_losses_of_both_are_logged_and_judged() -> None:
    task = painter()
    trainer = fit(task, 1)
    assert float(task.step_losses["train/loss"]) == pytest.approx(0.5 * 0.7 - 3.0 * 0.2)
    assert float(task.step_losses["train/adversary_loss"]) == pytest.approx(2.0 * (0.1 - _REAL))
    names = {"train/loss", "train/loss_l1", "train/loss_likes"}
    assert names | {"train/adversary_loss", "train/loss_trusts", "train/loss_doubts"} <= set(trainer.callback_metrics)


def test_schedulers_step_for_both() -> None:
    task = painter(scheduler=lambda optimizer: torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.5))
    trainer = fit(task, 3)
    assert [each.param_groups[0]["lr"] for each in trainer.optimizers] == [_RATE / 8] * 2


def test_without_an_adversary_there_is_one_network_and_one_optimizer() -> None:
    losses = {"l1": LossTerm(lambda made, real: (made - real).abs().mean())}
    task = painter(adversary=None, losses=losses, adversary_losses=None, adversary_optimizer=None)
    trainer = fit(task, 3)
    assert len(trainer.optimizers) == 1
    assert trainer.global_step == 3
    assert float(task.shade.detach()) == pytest.approx(0.1 + 3 * _RATE)


def test_without_an_adversary_nobody_says_what_it_thinks() -> None:
    with pytest.raises(FieldError, match=r"'likes'.*'fake'"):
        fit(painter(adversary=None), 1)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"losses": {}}, "at least one loss, such as loss="),
        ({"adversary_losses": {}}, "at least one loss, such as adversary_loss="),
        ({"adversary_optimizer": None}, "optimizer and adversary_optimizer"),
    ],
)
def test_parts_that_are_missing(parts: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        painter(**parts)


class Broken(Adversary):
    """Its own gradient is not finite; that of pictures is."""

    def forward(self, pictures: Tensor) -> Tensor:
        weight = self.weight * 1.0
        if weight.requires_grad:
            weight.register_hook(lambda gradient: gradient * float("nan"))
        return weight * pictures.mean()


def test_a_gradient_of_the_adversary_that_is_no_number_stops_both(tmp_path: Path) -> None:
    task = painter(adversary=Broken())
    with pytest.raises(NotFiniteError, match=r"gradient of adversary\.weight is not finite at step 0"):
        fit(task, 5, NanGuard())
    assert float(task.shade.detach()) == pytest.approx(0.1)


def test_or_both_leave_the_step_out() -> None:
    task = painter(adversary=Broken())
    trainer = fit(task, 5, NanGuard(policy="skip"))
    assert float(task.shade.detach()) == pytest.approx(0.1)
    assert trainer.global_step == 5
