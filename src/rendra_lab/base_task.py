"""What every task is: a prediction, scored by named metrics, shown by panels, fitted by named losses."""

from __future__ import annotations

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Generic, TypeVar, cast

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor, nn
from torch.optim import Optimizer
from torchmetrics import Metric

from rendra_lab.random_state import untouched
from rendra_lab.records import FieldError
from rendra_lab.terms import LossTerm, MetricTerm

BatchT = TypeVar("BatchT")
PredictionT = TypeVar("PredictionT")


class BaseTask(LightningModule, ABC, Generic[BatchT, PredictionT]):
    """A prediction with its losses and metrics; runs validation and test.

    A task derives from `Task` (one objective) and writes `predict`, perhaps `panels` and `meshes`, and
    nothing else of Lightning: no `training_step`, no `self.log`.

    Args:
        losses: the named terms of the objective.
        metrics: the named terms of the score.
    """

    def __init__(
        self, losses: Mapping[str, LossTerm] | None = None, metrics: Mapping[str, MetricTerm] | None = None
    ) -> None:
        super().__init__()
        self.losses = nn.ModuleDict(without_nulls(losses))
        self.metrics = nn.ModuleDict(without_nulls(metrics))
        self.step_losses: dict[str, Tensor] = {}  # by name, of the update to come: what `NanGuard` judges

    @abstractmethod
    def predict(self, batch: BatchT) -> PredictionT:
        """What the model makes of a batch: a frozen dataclass of tensors. Differentiable."""

    def panels(self, prediction: PredictionT, batch: BatchT) -> dict[str, Tensor]:
        """Images worth looking at, by caption: (H, W), (H, W, 1|3|4) or (B, H, W, C), sRGB in [0, 1]."""
        return {}

    def meshes(self, prediction: PredictionT, batch: BatchT) -> dict[str, Any]:
        """Meshes worth looking at, by name: each a `rendra.structures.Meshes`."""
        return {}

    def facts(self, prediction: PredictionT, batch: BatchT) -> dict[str, Any]:
        """Results for other programs, by file name: numbers, strings and lists of them."""
        return {}

    def score(self, prediction: PredictionT, batch: BatchT) -> dict[str, Tensor | Metric]:
        """Every metric on this batch, by name."""
        return {name: _named(name, term, prediction, batch) for name, term in self.metrics.items()}

    def watched(self, prediction: PredictionT, batch: BatchT) -> dict[str, Any]:
        """The metrics that are followed during training, as they are logged."""
        metrics = cast(Iterator[tuple[str, MetricTerm]], self.metrics.items())
        return {f"train/{name}": _named(name, term, prediction, batch) for name, term in metrics if term.in_training}

    def observe(self, batch: BatchT) -> PredictionT:
        """What evaluation predicts; modes, gradients and random state stay untouched."""
        with self._observed():
            return self.predict(batch)

    def show(self, batch: BatchT) -> dict[str, Tensor]:
        """The panels of a batch, as evaluation sees it; modes, gradients and random state stay untouched."""
        with self._observed():
            return self.panels(self.predict(batch), batch)

    def show_meshes(self, batch: BatchT) -> dict[str, Any]:
        """The meshes of a batch, as evaluation sees it; modes, gradients and random state stay untouched."""
        with self._observed():
            return self.meshes(self.predict(batch), batch)

    def show_facts(self, batch: BatchT) -> dict[str, Any]:
        """The facts of a batch, as evaluation sees it; modes, gradients and random state stay untouched."""
        with self._observed():
            return self.facts(self.predict(batch), batch)

    def validation_step(self, batch: BatchT, batch_idx: int) -> None:
        """Lightning's hook: scores one validation batch under `val/`."""
        self._log_score(batch, "val")

    def test_step(self, batch: BatchT, batch_idx: int) -> dict[str, Tensor | Metric]:
        """Lightning's hook: scores one test batch under `test/`; callbacks get the score."""
        return self._log_score(batch, "test")

    def predict_step(self, batch: BatchT, batch_idx: int) -> PredictionT:
        """Lightning's hook: `predict`."""
        return self.predict(batch)

    def _log_score(self, batch: BatchT, stage: str) -> dict[str, Tensor | Metric]:
        score = self.score(self.predict(batch), batch)
        logged = {f"{stage}/{name}": value for name, value in score.items()}
        size = getattr(batch, "batch_size", 1)
        self.log_dict(logged, on_step=False, on_epoch=True, batch_size=size, sync_dist=True)
        return score

    @contextmanager
    def _observed(self) -> Iterator[None]:
        modes = [(module, module.training) for module in self.modules()]
        self.eval()
        try:
            with torch.no_grad(), untouched():
                yield
        finally:
            for module, training in modes:
                module.training = training


def with_rate(learned: Iterable[nn.Parameter], part: nn.Module, lr: float | None) -> list[Any]:
    """Parameter groups in which a part has a learning rate of its own; without a rate the parameters as they are.

    Args:
        learned: all that is trained.
        part: perhaps one that has learned elsewhere, and is to keep most of that.
        lr: of the part; the rest has the optimizer's.
    """
    if lr is None:
        return list(learned)
    theirs = set(part.parameters())
    groups: tuple[list[nn.Parameter], list[nn.Parameter]] = [], []
    for each in learned:
        groups[each in theirs].append(each)
    return [{"params": groups[False]}, {"params": groups[True], "lr": lr}]


class Task(BaseTask[BatchT, PredictionT]):
    """A task with one objective, the weighted sum of its losses, one optimizer and perhaps a scheduler.

    Args:
        losses: the named terms of the objective; at least one.
        optimizer: makes the optimizer from parameters (a partial of a `torch.optim` class).
        metrics: the named terms of the score.
        scheduler: makes a learning-rate scheduler, stepped after every step, from the optimizer, and from
            `total_steps` if it has such a parameter. None keeps the rate.

    An optimizer whose class sets `needs_residuals = True` is handed, before every step, a function without
    arguments as its attribute `residuals`: the vector (R,) whose squared length is the objective, as a
    function of the current parameters.
    """

    def __init__(
        self,
        losses: Mapping[str, LossTerm],
        optimizer: Callable[..., Optimizer],
        metrics: Mapping[str, MetricTerm] | None = None,
        scheduler: Callable[..., Any] | None = None,
    ) -> None:
        super().__init__(losses, metrics)
        if not self.losses:
            raise ValueError("a task needs at least one loss, such as loss=[silhouette]")
        if optimizer is None:
            raise ValueError("a task needs an optimizer, such as optimizer=adam")
        self._make_optimizer = optimizer
        self._make_scheduler = scheduler
        self._unfinished: dict[str, Tensor] = {}

    def parameter_groups(self) -> Iterable[Any]:
        """What the optimizer gets: the parameters with gradients, or `torch.optim` parameter groups."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def objective(self, prediction: PredictionT, batch: BatchT) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted sum, a scalar, and every term without its weight."""
        return weighted_sum(self.losses, prediction, batch, self.global_step)

    def residuals(self, batch: BatchT) -> Tensor:
        """The vector (R,) whose squared length is the objective; TypeError for a term without residuals."""
        return self.residuals_of(self.predict(batch), batch)

    def residuals_of(self, prediction: PredictionT, batch: BatchT) -> Tensor:
        """`residuals` of a prediction that is made already."""
        step = self.global_step
        return torch.cat([term.residuals(prediction, batch, step) for _, term in self._weighted()])

    def training_step(self, batch: BatchT, batch_idx: int) -> Tensor:
        """Lightning's hook: the objective of one batch, logged with its terms and watched metrics under `train/`."""
        prediction = self.predict(batch)
        total, terms = self.objective(prediction, batch)
        values = {f"train/loss_{name}": value.detach() for name, value in terms.items()}
        self.step_losses = {"train/loss": total.detach(), **values}
        self.log_dict({**self.step_losses, **self.watched(prediction, batch)}, prog_bar=True, batch_size=1)
        return total

    def finish(self) -> None:
        """What the result still needs when the fit is over; called before it is saved and shown.

        Checkpoints keep the state before it too, from which a fit goes on as if it had not ended. Nothing may change
        the state in `on_train_batch_end`: by then callbacks have saved the step.
        """

    def on_train_epoch_end(self) -> None:
        """Lightning's hook: finishes what is over."""
        if type(self).finish is not Task.finish and self.trainer.fit_loop.done:
            self._unfinished = {name: tensor.clone() for name, tensor in self.state_dict().items()}
            self.finish()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Lightning's hook: adds the state before `finish`."""
        if self._unfinished:
            checkpoint["unfinished"] = self._unfinished

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Lightning's hook: a fit goes on from the state before `finish`."""
        if "unfinished" in checkpoint and self.trainer.state.fn == TrainerFn.FITTING:
            checkpoint["state_dict"] = checkpoint["unfinished"]

    def on_train_batch_start(self, batch: BatchT, batch_idx: int) -> None:
        """Lightning's hook: hands the residuals to an optimizer that declares a need for them."""
        self._unfinished = {}
        for optimizer in self.trainer.optimizers:
            if getattr(optimizer, "needs_residuals", False):
                optimizer.residuals = lambda: self.residuals(batch)  # type: ignore[attr-defined]

    def configure_optimizers(self) -> Any:
        """Lightning's hook: the optimizer, and the scheduler counted in steps."""
        optimizer = self._make_optimizer(self.parameter_groups())
        if self._make_scheduler is None:
            return optimizer
        keywords = {}
        if "total_steps" in inspect.signature(self._make_scheduler).parameters:
            keywords["total_steps"] = steps_in_all(self.trainer)
        scheduler = self._make_scheduler(optimizer, **keywords)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def _weighted(self) -> Iterator[tuple[str, LossTerm]]:
        return cast(Iterator[tuple[str, LossTerm]], self.losses.items())


def weighted_sum(losses: nn.ModuleDict, prediction: Any, batch: Any, step: int) -> tuple[Tensor, dict[str, Tensor]]:
    """An objective of named `LossTerm`s at a step, a scalar, and every term that is due, without its weight.

    Raises:
        ValueError: no term is due.
    """
    due = {name: term for name, term in cast(Iterable[tuple[str, LossTerm]], losses.items()) if term.is_due(step)}
    if not due:
        raise ValueError(f"no loss is due at step {step}: {', '.join(losses)}; one of them needs every=1")
    terms = {name: _named(name, term, prediction, batch) for name, term in due.items()}
    weights = {name: term.weight_at(step) for name, term in due.items()}
    return torch.as_tensor(sum(weights[name] * value for name, value in terms.items())), terms


def steps_in_all(trainer: Trainer) -> int:
    """How many steps a fit will have; ValueError where it has no end."""
    total = trainer.estimated_stepping_batches
    if not math.isfinite(total):
        raise ValueError("this scheduler needs an end: set trainer.max_steps or trainer.max_epochs")
    return int(total)


def without_nulls(terms: Mapping[str, Any] | None) -> dict[str, Any]:
    """A term set to null in the configuration is switched off."""
    return {name: term for name, term in (terms or {}).items() if term is not None}


def _named(name: str, term: nn.Module, prediction: Any, batch: Any) -> Any:
    """The value of a term; its name stands in front of a complaint about fields."""
    try:
        return term(prediction, batch)
    except FieldError as error:
        raise FieldError(f"{type(term).__name__} {name!r}: {error}") from None
