"""What a task is whose generator is judged by a network that learns beside it: two objectives, two optimizers."""

from __future__ import annotations

import inspect
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn.utils import get_total_norm
from torch.optim import Optimizer

from rendra_lab.base_task import BaseTask, BatchT, PredictionT, steps_in_all, weighted_sum, without_nulls
from rendra_lab.terms import LossTerm, MetricTerm


class AdversarialTask(BaseTask[BatchT, PredictionT]):
    """A generator, the task itself, and perhaps an adversary that tells its pictures from real ones.

    A task writes `predict`, and `shown`, which says what the adversary is shown. What the adversary says of made
    pictures is to the terms of both objectives a field `fake` of the prediction, what it says of real ones a field
    `real` of the batch; the generator's objective does not reach the adversary, nor the adversary's the generator.
    A term of the adversary that reads the field `real_pictures` of the batch gets the real pictures that it judged as
    `real`, through which its gradient can be taken.
    The gradients of both are made before either network moves: a step is one step of the fit, whole or not at all.

    What `watched` follows is logged under `train/` beside the losses, and so are the norms of both gradients and what
    a task makes of `verdicts`.

    Args:
        losses: the named terms of the generator's objective; at least one.
        optimizer: makes the generator's optimizer from parameters (a partial of a `torch.optim` class).
        adversary: the network that judges; None trains without, and then no term may read `fake` or `real`.
        adversary_losses: the named terms of its objective.
        adversary_optimizer: makes its optimizer.
        metrics: the named terms of the score.
        scheduler: makes the learning-rate scheduler of either optimizer, stepped after every step; None keeps rates.
        in_turn: the generator moves first, and the adversary's gradient is that of pictures which the moved generator
            makes anew (`turn` is 1 meanwhile): the order of many published methods, and a second prediction a step.
            A step that fails in between is then half a step.

    Raises:
        ValueError: an objective without terms, or a network without an optimizer.
    """

    def __init__(
        self,
        losses: Mapping[str, LossTerm],
        optimizer: Callable[..., Optimizer],
        adversary: nn.Module | None = None,
        adversary_losses: Mapping[str, LossTerm] | None = None,
        adversary_optimizer: Callable[..., Optimizer] | None = None,
        metrics: Mapping[str, MetricTerm] | None = None,
        scheduler: Callable[..., Any] | None = None,
        in_turn: bool = False,
    ) -> None:
        super().__init__(losses, metrics)
        self.automatic_optimization = False
        self.in_turn = in_turn
        self.turn = 0
        self.adversary = adversary
        self.adversary_losses = nn.ModuleDict(without_nulls(adversary_losses) if adversary is not None else {})
        if not self.losses:
            raise ValueError("a task needs at least one loss, such as loss=[l1]")
        if optimizer is None or (adversary is not None and adversary_optimizer is None):
            raise ValueError("each of the two networks needs an optimizer: optimizer and adversary_optimizer")
        if adversary is not None and not self.adversary_losses:
            raise ValueError("an adversary needs at least one loss, such as adversary_loss=[hinge_discriminator]")
        self._make_optimizers = [optimizer] if adversary_optimizer is None else [optimizer, adversary_optimizer]
        self._make_scheduler = scheduler

    @abstractmethod
    def shown(self, prediction: PredictionT, batch: BatchT) -> tuple[Tensor, Tensor]:
        """Pictures (B, 3, H, W) for the adversary: the generator's, with gradients, and real ones."""

    def verdicts(self, fake: Any, real: Any) -> dict[str, Tensor]:
        """Numbers worth following in what the adversary says of made and of real pictures, by name."""
        return {}

    def follow(self) -> None:
        """What else moves with the networks, at the end of every step."""

    def training_step(self, batch: BatchT, batch_idx: int) -> Tensor:
        """Lightning's hook: one step of both networks, logged under `train/`."""
        step, prediction = self.global_step, self.predict(batch)
        total, values = self._generator_objective(prediction, batch, step)
        self.manual_backward(total)
        logged = {**self.watched(prediction, batch), "train/gradient_norm": _norm(self.generator_parameters())}
        self.step_losses = values
        moved = 0
        if self.adversary is not None:
            if self.in_turn:
                moved, prediction = 1, self._predicted_after_a_move(batch)
            doubt, more, said = self._adversary_objective(prediction, batch, step)
            self.manual_backward(doubt)
            logged |= {**said, "train/adversary_gradient_norm": _norm(self.adversary.parameters())}
            self.step_losses = values | more
        self.log_dict(logged, batch_size=1)
        self.log_dict(self.step_losses, prog_bar=True, batch_size=1)
        self._move(moved)
        self.follow()
        return total.detach()

    def configure_optimizers(self) -> Any:
        """Lightning's hook: the generator's optimizer, the adversary's, and their schedulers."""
        optimizers = [make(network) for make, network in zip(self._make_optimizers, self._networks(), strict=False)]
        if self._make_scheduler is None:
            return optimizers
        keywords = {}
        if "total_steps" in inspect.signature(self._make_scheduler).parameters:
            keywords["total_steps"] = steps_in_all(self.trainer)
        return optimizers, [self._make_scheduler(optimizer, **keywords) for optimizer in optimizers]

    def generator_parameters(self) -> list[nn.Parameter]:
        """All that is trained and not the adversary's."""
        theirs = set() if self.adversary is None else set(self.adversary.parameters())
        return [each for each in self.parameters() if each.requires_grad and each not in theirs]

    def _generator_objective(
        self, prediction: PredictionT, batch: BatchT, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        seen: tuple[Any, Any] = prediction, batch
        if self.adversary is not None:
            made, real = self.shown(prediction, batch)
            with _frozen(self.adversary):
                seen = _Beside(prediction, fake=self.adversary(made)), batch
                if _is_read(self.losses, "real"):
                    with torch.no_grad():
                        seen = seen[0], _Beside(batch, real=self.adversary(real))
        total, terms = weighted_sum(self.losses, *seen, step)
        return total, _named_losses("", total, terms)

    def _adversary_objective(
        self, prediction: PredictionT, batch: BatchT, step: int
    ) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        assert self.adversary is not None
        made, real = self.shown(prediction, batch)
        real = real.detach().requires_grad_(_is_read(self.adversary_losses, "real_pictures", step))
        fakes, reals = self.adversary(made.detach()), self.adversary(real)
        seen = _Beside(prediction, fake=fakes), _Beside(batch, real=reals, real_pictures=real)
        total, terms = weighted_sum(self.adversary_losses, *seen, step)
        with torch.no_grad():
            said = {f"train/{name}": value for name, value in self.verdicts(fakes, reals).items()}
        return total, _named_losses("adversary_", total, terms), said

    def _predicted_after_a_move(self, batch: BatchT) -> PredictionT:
        """What the generator makes after its update."""
        self._update(0)
        self.turn = 1
        try:
            with torch.no_grad():
                return self.predict(batch)
        finally:
            self.turn = 0

    def _move(self, first: int) -> None:
        """One update of each network from the first on that has not moved."""
        for number in range(first, len(self._networks())):
            self._update(number)
        schedulers = self.lr_schedulers()
        for scheduler in schedulers if isinstance(schedulers, list) else [schedulers]:
            if scheduler is not None:
                scheduler.step()  # type: ignore[call-arg]

    def _update(self, number: int) -> None:
        """One update of a network; Lightning counts the generator's alone as a step of the fit."""
        optimizers = self.optimizers()
        optimizer: Any = optimizers[number] if isinstance(optimizers, list) else optimizers
        if number > 0:
            optimizer._on_before_step = optimizer._on_after_step = _count_nothing
        optimizer.step()
        optimizer.zero_grad()

    def _networks(self) -> list[list[nn.Parameter]]:
        """The parameters of each optimizer."""
        return [self.generator_parameters(), *([] if self.adversary is None else [list(self.adversary.parameters())])]


class _Beside(Mapping[str, Any]):
    """A batch or a prediction, and something else under a name of its own."""

    def __init__(self, record: Any, **more: Any) -> None:
        self._record, self._more = record, more

    def __getitem__(self, name: str) -> Any:
        if name not in self._more and not hasattr(self._record, name):
            raise KeyError(name)
        return self._more[name] if name in self._more else getattr(self._record, name)

    def __iter__(self) -> Iterator[str]:
        return iter([*self._record.names(), *self._more])

    def __len__(self) -> int:
        return len(list(iter(self)))


def _named_losses(who: str, total: Tensor, terms: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {
        f"train/{who}loss": total.detach(),
        **{f"train/loss_{name}": each.detach() for name, each in terms.items()},
    }


def _is_read(losses: nn.ModuleDict, field: str, step: int | None = None) -> bool:
    """Whether a term reads a field of the batch; with a step: one that is due."""
    terms = cast(Iterable[LossTerm], losses.values())
    return any(term.reads(field) and (step is None or term.is_due(step)) for term in terms)


def _norm(parameters: Iterable[nn.Parameter]) -> Tensor:
    """The length of the whole gradient, a scalar."""
    return get_total_norm([each.grad for each in parameters if each.grad is not None]).detach()


def _count_nothing() -> None:
    """In the place of Lightning's count of steps."""


@contextmanager
def _frozen(network: nn.Module) -> Iterator[None]:
    """Gradients pass through a network and leave none in it; as in evaluation, nothing in it moves."""
    trained = [each for each in network.parameters() if each.requires_grad]
    for each in trained:
        each.requires_grad_(False)
    try:
        yield
    finally:
        for each in trained:
            each.requires_grad_(True)
