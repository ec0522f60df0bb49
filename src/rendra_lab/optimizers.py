"""Optimizers that torch does not have."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from rendra_lab.settings import Positive, Size

_DOUBLINGS = 8  # of a step that pays: 256 times its length


class LevenbergMarquardt(torch.optim.Optimizer):
    """Damped Gauss-Newton steps for a few parameters and many residuals.

    Each step differentiates the residual vector r numerically, solves (J^T J + lambda diag(J^T J)) d = -J^T r and
    keeps the step if the objective falls; else lambda grows and it tries again. (Levenberg 1944, Marquardt 1963;
    Madsen, Nielsen & Tingleff, "Methods for non-linear least squares problems", 2004, Sec. 3.2.)

    The task hands over `residuals` before every step (`Task`): the vector (R,) at the parameters' present values.

    Args:
        params: the parameters; one group.
        lr: largest change of a parameter in one step (trust region), in the parameter's unit.
        difference: steps of the numerical derivative, in the parameter's unit: the first one, wide enough to see
            the large shape of the objective, is halved whenever no step helps, down to the second, about half a
            pixel's worth: a finer one would differentiate the pixels' own steps.
        damping: first lambda.
        tries: steps tried before the state is left as it is.
    """

    needs_residuals = True
    residuals: Callable[[], Tensor]

    def __init__(
        self,
        params: Any,
        lr: Size = 0.5,
        difference: Sequence[float] = (0.2, 5e-3),
        damping: Size = 1e-2,
        tries: Positive = 4,
    ) -> None:
        widest, finest = difference
        if not widest >= finest > 0:
            raise ValueError(f"difference goes from a wide to a fine positive step, got {list(difference)}")
        defaults = {
            "lr": lr,
            "difference": float(widest),
            "finest": float(finest),
            "damping": damping,
            "tries": tries,
        }
        super().__init__(params, defaults)
        if len(self.param_groups) != 1:
            raise ValueError(f"LevenbergMarquardt takes one parameter group, got {len(self.param_groups)}")

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """One accepted step, or none; the closure is called once, for its loss."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        group = self.param_groups[0]
        start = torch.nn.utils.parameters_to_vector(group["params"])[None]
        damping = start.new_full((1,), group["damping"])
        x, damping, _ = levenberg_marquardt_step(
            self._residuals_at, start, damping, group["difference"], group["lr"], group["tries"], _DOUBLINGS
        )
        group["damping"] = float(damping)
        if torch.equal(x, start):
            group["difference"] = max(group["difference"] / 2, group["finest"])
            group["damping"] = self.defaults["damping"]
        self._set(x[0])
        return loss

    def _residuals_at(self, x: Tensor) -> Tensor:
        rows = []
        for one in x[0]:
            self._set(one)
            rows.append(self.residuals())
        return torch.stack(rows)[None]

    def _set(self, x: Tensor) -> None:
        torch.nn.utils.vector_to_parameters(x, self.param_groups[0]["params"])


def levenberg_marquardt_step(
    residuals: Callable[[Tensor], Tensor],
    x: Tensor,
    damping: Tensor,
    difference: float,
    longest: float,
    tries: int = 1,
    doublings: int = 0,
) -> tuple[Tensor, Tensor, Tensor]:
    """One step of B independent problems side by side; each keeps its state unless its objective falls.

    An image whose outline is off by many pixels is linear over one pixel only: the step points the right way but is
    too short, and doubling it while that pays crosses the distance.

    Args:
        residuals: maps K states of every problem (B, K, P) to their residual vectors (B, K, R).
        x: (B, P) states.
        damping: (B,) lambda of each problem.
        difference: step of the forward difference.
        longest: bound on the length of a step.
        tries: steps tried, with growing damping, until all problems have moved.
        doublings: how often a successful step is doubled as long as the objective falls.

    Returns:
        x (B, P), damping (B,) and the objectives (B,), sums of squares.
    """
    problems, size = x.shape
    probes = torch.cat([x[:, None], x[:, None] + difference * torch.eye(size, device=x.device, dtype=x.dtype)], 1)
    values = residuals(probes)  # (B, 1 + P, R)
    here = values[:, 0]
    jacobian = (values[:, 1:] - here[:, None]) / difference  # (B, P, R)
    normal = jacobian @ jacobian.transpose(1, 2)
    slope = (jacobian @ here[..., None])[..., 0]
    start, cost, moved = x, here.square().sum(-1), torch.zeros_like(damping, dtype=torch.bool)
    for _ in range(tries):
        step = _damped_step(normal, slope, damping, longest)
        rival = residuals((x + step)[:, None])[:, 0].square().sum(-1)
        better = (rival < cost) & ~moved
        x, cost = torch.where(better[:, None], x + step, x), torch.where(better, rival, cost)
        damping = torch.where(moved, damping, torch.where(better, damping / 3, damping * 4)).clamp(1e-7, 1e7)
        moved |= better
        if bool(moved.all()):
            break
    for _ in range(doublings):
        further = x + (x - start)
        moved = moved & ((further - start).norm(dim=1) <= longest)
        if not bool(moved.any()):
            break
        rival = residuals(further[:, None])[:, 0].square().sum(-1)
        moved = moved & (rival < cost)
        x, cost = torch.where(moved[:, None], further, x), torch.where(moved, rival, cost)
    return x, damping, cost


def _damped_step(normal: Tensor, slope: Tensor, damping: Tensor, longest: float) -> Tensor:
    """The solution of (H + lambda diag H) d = -g, shortened to `longest`; zero where nothing pulls."""
    diagonal = normal.diagonal(dim1=1, dim2=2)
    floor = 1e-9 * diagonal.amax(1, keepdim=True) + 1e-20  # a parameter without effect must not make it singular
    step = torch.linalg.solve(normal + torch.diag_embed(damping[:, None] * diagonal + floor), -slope)
    step = step.nan_to_num(0.0, 0.0, 0.0)
    return step * (longest / step.norm(dim=1, keepdim=True).clamp(min=longest))


class UniformAdam(torch.optim.Optimizer):
    """Adam with one second moment a parameter tensor, the largest of its elements'.

    Elements keep their gradients' proportions, so that a step points where the gradient does: on vertices it does not
    depend on the axes, and a diffused gradient stays smooth. (Nicolet et al., "Large Steps in Inverse Rendering of
    Geometry", SIGGRAPH Asia 2021, Sec. 4.)

    Args:
        params: the parameters, or groups of them.
        lr: about the largest change of an element in one step, in the parameter's unit.
        betas: decay of the first and the second moment.
    """

    def __init__(self, params: Any, lr: float = 0.1, betas: Sequence[float] = (0.9, 0.999)) -> None:
        first, second = betas
        if not 0 <= lr < math.inf:
            raise ValueError(f"lr must be a number of at least 0, got {lr}")
        if not (0 <= first < 1 and 0 <= second < 1):
            raise ValueError(f"betas must lie in [0, 1), got {list(betas)}")
        super().__init__(params, {"lr": lr, "betas": (float(first), float(second))})

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """One step of every parameter that has a gradient."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._move(parameter, group["lr"], *group["betas"])
        return loss

    def _move(self, parameter: Tensor, lr: float, first: float, second: float) -> None:
        state, gradient = self.state[parameter], parameter.grad
        assert gradient is not None
        if not state:
            state.update(step=0, mean=torch.zeros_like(parameter), square=torch.zeros_like(parameter))
        state["step"] += 1
        state["mean"].lerp_(gradient, 1 - first)
        state["square"].lerp_(gradient.square(), 1 - second)
        size = (state["square"].amax() / (1 - second ** state["step"])).sqrt()
        parameter.sub_(state["mean"] / size.clamp_min(1e-20), alpha=lr / (1 - first ** state["step"]))
