"""Optimizers that torch does not have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


class LevenbergMarquardt(torch.optim.Optimizer):
    """Damped Gauss-Newton steps for a few parameters and many residuals.

    Each step differentiates the residual vector r numerically, solves (J^T J + lambda diag(J^T J)) d = -J^T r and
    keeps the step if the objective falls; else lambda grows and it tries again. (Levenberg 1944, Marquardt 1963;
    Madsen, Nielsen & Tingleff, "Methods for non-linear least squares problems", 2004, Sec. 3.2.)

    The task hands over `residuals` before every step (`Task`): the vector (R,) as a function of the parameters' state.

    Args:
        params: the parameters; one group.
        lr: largest change of a parameter in one step (trust region), in the parameter's unit.
        difference: step of the numerical derivative, in the parameter's unit: about half a pixel's worth, so that
            it averages over the image's own steps.
        damping: first lambda.
        tries: steps tried before the state is left as it is.
    """

    needs_residuals = True
    residuals: Callable[[], Tensor]

    def __init__(
        self, params: Any, lr: float = 0.5, difference: float = 5e-3, damping: float = 1e-2, tries: int = 4
    ) -> None:
        super().__init__(params, {"lr": lr, "difference": difference, "damping": damping, "tries": tries})
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
        x = torch.nn.utils.parameters_to_vector(group["params"])[None]
        damping = x.new_full((1,), group["damping"])
        x, damping, _ = levenberg_marquardt_step(
            self._residuals_at, x, damping, group["difference"], group["lr"], group["tries"]
        )
        group["damping"] = float(damping)
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
) -> tuple[Tensor, Tensor, Tensor]:
    """One step of B independent problems side by side; each keeps its state unless its objective falls.

    Args:
        residuals: maps K states of every problem (B, K, P) to their residual vectors (B, K, R).
        x: (B, P) states.
        damping: (B,) lambda of each problem.
        difference: step of the forward difference.
        longest: bound on the length of a step.
        tries: steps tried, with growing damping, until all problems have moved.

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
    cost, moved = here.square().sum(-1), torch.zeros_like(damping, dtype=torch.bool)
    for _ in range(tries):
        step = _damped_step(normal, slope, damping, longest)
        rival = residuals((x + step)[:, None])[:, 0].square().sum(-1)
        better = (rival < cost) & ~moved
        x, cost = torch.where(better[:, None], x + step, x), torch.where(better, rival, cost)
        damping = torch.where(moved, damping, torch.where(better, damping / 3, damping * 4)).clamp(1e-7, 1e7)
        moved |= better
        if bool(moved.all()):
            break
    return x, damping, cost


def _damped_step(normal: Tensor, slope: Tensor, damping: Tensor, longest: float) -> Tensor:
    """The solution of (H + lambda diag H) d = -g, shortened to `longest`; zero where nothing pulls."""
    diagonal = normal.diagonal(dim1=1, dim2=2)
    floor = 1e-9 * diagonal.amax(1, keepdim=True) + 1e-20  # a parameter without effect must not make it singular
    step = torch.linalg.solve(normal + torch.diag_embed(damping[:, None] * diagonal + floor), -slope)
    step = step.nan_to_num(0.0, 0.0, 0.0)
    return step * (longest / step.norm(dim=1, keepdim=True).clamp(min=longest))
