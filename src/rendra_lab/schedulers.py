"""Learning-rate schedules that know where the run ends. `total_steps` is filled in by the task."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from rendra_lab.settings import Amount, Count
from rendra_lab.terms import PiecewiseLinear


def cosine(optimizer: Optimizer, total_steps: int, final_factor: Amount = 0.01, warmup_steps: Count = 0) -> LambdaLR:
    """Half a cosine from the optimizer's rate down to `final_factor` times it, after a linear warm-up.

    Source: Loshchilov and Hutter, "SGDR", ICLR 2017, Eq. 5, without restarts.
    """

    def factor(step: int) -> float:
        if step < warmup_steps:
            return (step + 1) / (warmup_steps + 1)
        progress = min((step - warmup_steps) / max(total_steps - warmup_steps, 1), 1.0)
        return final_factor + (1 - final_factor) * 0.5 * (1 + math.cos(math.pi * progress))

    return LambdaLR(optimizer, factor)


def exponential(optimizer: Optimizer, total_steps: int, final_factor: Amount = 0.1) -> LambdaLR:
    """The rate falls by the same factor every step and ends at `final_factor` times the optimizer's rate."""
    if final_factor <= 0:
        raise ValueError(f"final_factor must be above 0, got {final_factor}")
    return LambdaLR(optimizer, lambda step: final_factor ** (step / max(total_steps, 1)))


def piecewise(optimizer: Optimizer, knots: Sequence[Sequence[float]]) -> LambdaLR:
    """The rate times a factor that follows straight lines between knots (step, factor): `PiecewiseLinear`."""
    return LambdaLR(optimizer, PiecewiseLinear(knots))


def restarted(optimizer: Optimizer, total_steps: int, at: float = 0.75, final_factor: Amount = 0.1) -> LambdaLR:
    """After a share `at` of the run the rate is `final_factor` times what it was, and the optimizer starts anew.

    As if another optimizer took over: Adam's running means are forgotten.
    """
    if not 0 <= at <= 1:
        raise ValueError(f"at is a share of the run, in [0, 1], got {at}")
    restart = round(at * total_steps)

    def rate(step: int) -> float:
        if step == restart:
            optimizer.state.clear()
        return final_factor if step >= restart else 1.0

    return LambdaLR(optimizer, rate)
