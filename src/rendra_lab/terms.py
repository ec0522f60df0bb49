"""Terms bind a function to named fields of the prediction and the batch; objectives are sums of terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import jvp, vmap
from torchmetrics import Metric

from rendra_lab.records import read_field
from rendra_lab.settings import Positive

Weight = float | Sequence[Sequence[float]]


class PiecewiseLinear:
    """A number that follows straight lines between knots, constant before the first and after the last.

    Args:
        knots: pairs (step, value), steps not decreasing. Two knots at one step make a jump: the later one
            holds from that step on.
    """

    def __init__(self, knots: Sequence[Sequence[float]]) -> None:
        if not knots or any(len(knot) != 2 for knot in knots):
            raise ValueError(f"a schedule is a list of [step, value] pairs, got {knots!r}")
        self.steps = [float(step) for step, _ in knots]
        self.values = [float(value) for _, value in knots]
        if sorted(self.steps) != self.steps:
            raise ValueError(f"the steps of a schedule must not decrease, got {self.steps}")

    def __call__(self, step: int) -> float:
        """The value at an optimisation step, counted from 0."""
        after = sum(knot <= step for knot in self.steps)
        if after == 0:
            return self.values[0]
        if after == len(self.steps):
            return self.values[-1]
        start, stop = self.steps[after - 1], self.steps[after]
        share = (step - start) / (stop - start)
        return (1 - share) * self.values[after - 1] + share * self.values[after]


class _Term(nn.Module):
    """A function and the names of the fields that it reads."""

    def __init__(
        self,
        fn: Callable[..., Any],
        prediction: str | None,
        target: str | None,
        context: Mapping[str, str] | None,
    ) -> None:
        super().__init__()
        if not callable(fn):
            raise TypeError(f"a term needs a function or a callable object, got {type(fn).__name__}")
        self.fn = fn
        self.prediction = prediction
        self.target = target
        self.context = dict(context or {})

    def _arguments(self, prediction: Any, batch: Any) -> tuple[list[Any], dict[str, Any]]:
        positional = [] if self.prediction is None else [read_field(prediction, self.prediction, "prediction")]
        if self.target is not None:
            positional.append(read_field(batch, self.target, "batch"))
        return positional, {key: read_field(batch, name, "batch") for key, name in self.context.items()}


class LossTerm(_Term):
    """One summand of an objective: `weight * fn(prediction.<field>, batch.<field>)`.

    Args:
        fn: returns a scalar tensor; called with the predicted field, then the target, then `context` by
            keyword. A least-squares term has a method `residuals` of the same arguments besides, with
            `fn(...) == fn.residuals(...).square().sum()`.
        weight: a number, or a schedule as a list of [step, weight] pairs (`PiecewiseLinear`).
        prediction: the field of the prediction, or null where the function takes the target alone.
        target: the field of the batch, or null where the function takes the prediction alone (a regulariser).
        context: further keyword arguments of `fn`, each with the batch field that it takes, such as
            `{mask: mask}`.
        every: a costly term is counted once in so many steps, and then so many times as much.
    """

    def __init__(
        self,
        fn: Callable[..., Any],
        weight: Weight = 1.0,
        prediction: str | None = "rgb",
        target: str | None = "rgb",
        context: Mapping[str, str] | None = None,
        every: Positive = 1,
    ) -> None:
        super().__init__(fn, prediction, target, context)
        if every < 1:
            raise ValueError(f"a term is counted every so many steps, at least 1, got every={every}")
        self.every = every
        self.weight = float(weight) if isinstance(weight, (int, float)) else PiecewiseLinear(weight)

    def forward(self, prediction: Any, batch: Any) -> Tensor:
        """The value without its weight: a scalar."""
        positional, keyword = self._arguments(prediction, batch)
        return self.fn(*positional, **keyword)

    def is_due(self, step: int) -> bool:
        """Whether it is counted at an optimisation step."""
        return step % self.every == 0

    def weight_at(self, step: int) -> float:
        """The weight at an optimisation step."""
        if not self.is_due(step):
            return 0.0
        return self.every * (self.weight if isinstance(self.weight, float) else self.weight(step))

    def reads(self, field: str) -> bool:
        """Whether it takes a field of the batch."""
        return field == self.target or field in self.context.values()

    def residuals(self, prediction: Any, batch: Any, step: int = 0) -> Tensor:
        """The vector (R,) whose squared length is the weighted term; TypeError if `fn` has none."""
        return self.residual_rows(prediction, batch, step).reshape(-1)

    def residual_rows(self, prediction: Any, batch: Any, step: int = 0) -> Tensor:
        """`residuals` as `fn` shapes them: many problems side by side have a row each."""
        if not hasattr(self.fn, "residuals"):
            raise TypeError(f"{_name(self.fn)} is not a sum of squares: this optimizer needs terms with residuals")
        positional, keyword = self._arguments(prediction, batch)
        weight = self.weight_at(step)
        if weight < 0:
            raise ValueError(f"a sum of squares needs a weight of at least 0, got {weight}")
        return weight**0.5 * self.fn.residuals(*positional, **keyword)

    def row_derivatives(self, prediction: Any, batch: Any, changes: Tensor, step: int = 0) -> Tensor:
        """How `residual_rows` (N, R) change as the predicted field (N, ...) does: (N, R, P).

        Args:
            prediction, batch, step: as there.
            changes: (N, ..., P) of the field, in P directions.
        """
        positional, keyword = self._arguments(prediction, batch)
        field, *others = positional
        fn: Any = self.fn
        if hasattr(fn, "row_derivatives"):
            rows = fn.row_derivatives(changes, field, *others, **keyword)
        else:

            def along(change: Tensor) -> Tensor:
                return jvp(lambda value: fn.residuals(value, *others, **keyword), (field,), (change,))[1]

            rows = vmap(along, in_dims=-1, out_dims=-1)(changes)
        return self.weight_at(step) ** 0.5 * rows


class MetricTerm(_Term):
    """One number that judges a prediction; never differentiated.

    Args:
        fn: a function of the predicted and the target field that returns a scalar, averaged over the
            batches in proportion to their sizes; or a `torchmetrics.Metric`, which does its own averaging.
        prediction: the field of the prediction.
        target: the field of the batch, or null.
        context: further keyword arguments of `fn`, each with the batch field that it takes.
        in_training: also measured at every training step, and shown beside the losses. Only of functions.
    """

    def __init__(
        self,
        fn: Callable[..., Any],
        prediction: str = "rgb",
        target: str | None = "rgb",
        context: Mapping[str, str] | None = None,
        in_training: bool = False,
    ) -> None:
        super().__init__(fn, prediction, target, context)
        if in_training and isinstance(fn, Metric):
            raise TypeError(f"{type(fn).__name__} averages over an epoch: it cannot be shown at every training step")
        self.in_training = in_training

    @torch.no_grad()
    def forward(self, prediction: Any, batch: Any) -> Tensor | Metric:
        """The value on this batch, or the updated `Metric`: what Lightning's `log` takes."""
        positional, keyword = self._arguments(prediction, batch)
        if isinstance(self.fn, Metric):
            self.fn.update(*positional, **keyword)
            return self.fn
        return torch.as_tensor(self.fn(*positional, **keyword))


def _name(fn: Any) -> str:
    fn = getattr(fn, "func", fn)
    return getattr(fn, "__name__", type(fn).__name__)
