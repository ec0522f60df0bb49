"""Solvers of many small least-squares problems side by side: each has its own damping, and its own best state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

_LEAST_CURVATURE = 1e-3  # of a number that nothing pulls at
_AT_REST = 1e4  # a lambda beyond it moves nothing: begin anew, for the objective may have changed since


@runtime_checkable
class Problem(Protocol):
    """N problems of P numbers each.

    Attributes:
        rows_at_work: those (N,) of all problems, the rows of the solver's parameter, that are still solved.
    """

    rows_at_work: Tensor

    def rows(self, x: Tensor) -> Tensor:
        """Residuals (N, R) at (N, P)."""

    def linearized(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals (N, R) and their derivatives (N, R, P)."""


class _Normal(NamedTuple):
    """Gauss and Newton's picture of N objectives: value, gradient and curvature, of half the sum of squares."""

    cost: Tensor  # (N,) the sum of squares
    slope: Tensor  # (N, P, 1)
    curvature: Tensor  # (N, P, P)

    @classmethod
    def of(cls, problem: Problem, x: Tensor) -> _Normal:
        rows, jacobian = problem.linearized(x)
        turned = jacobian.transpose(1, 2)
        return cls(rows.square().sum(1), turned @ rows[..., None], turned @ jacobian)


class LeastSquares(torch.optim.Optimizer):
    """What the solvers share: one parameter (N, P), and the problem that the task hands over before every step.

    Args:
        params: one parameter.
        **defaults: numbers of the solver.
    """

    needs_problem = True
    problem: Problem

    def __init__(self, params: Any, **defaults: Any) -> None:
        super().__init__(params, defaults)
        if len(self.param_groups) != 1 or len(self.param_groups[0]["params"]) != 1:
            raise ValueError(f"{type(self).__name__} moves one parameter (N, P)")

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """One step of every problem; one whose objective would not fall stays where it is."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        x = self.param_groups[0]["params"][0]
        state, rows = self.state[x], self.problem.rows_at_work
        reach = state.setdefault("reach", x.new_full((len(x),), self.param_groups[0]["reach"]))
        moved, now = self._moved(x.detach()[rows], reach[rows])
        x[rows], reach[rows] = moved, now
        return loss

    def _moved(self, x: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
        """States (N, P) after a step, and how far each problem reaches in the next (N,)."""
        raise NotImplementedError


class BatchedLevenbergMarquardt(LeastSquares):
    """Damped Gauss-Newton: (J^T J + lambda diag(J^T J)) d = -J^T r, each problem with its own lambda.

    Madsen, Nielsen and Tingleff, "Methods for non-linear least squares problems", 2004, Sec. 3.2.

    Args:
        params: one parameter (N, P).
        damping: the first lambda.
        tries: steps tried, with growing lambda, before a problem is left as it is until the next step.
    """

    def __init__(self, params: Any, damping: float = 1e-3, tries: int = 3) -> None:
        if not damping > 0 or tries < 1:
            raise ValueError(f"damping must be positive and tries at least 1, got {damping} and {tries}")
        super().__init__(params, reach=float(damping), tries=int(tries))

    def _moved(self, x: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
        group, damping = self.param_groups[0], reach
        here = _Normal.of(self.problem, x)
        scale = here.curvature.diagonal(dim1=1, dim2=2).clamp_min(_LEAST_CURVATURE)
        best, cost, moved = x, here.cost, torch.zeros_like(here.cost, dtype=torch.bool)
        for _ in range(int(group["tries"])):
            step = _solve(here.curvature + torch.diag_embed(damping[:, None] * scale), here.slope)
            rival = self.problem.rows(x + step).square().sum(1)
            better = (rival < cost) & ~moved
            best = torch.where(better[:, None], x + step, best)
            damping = torch.where(moved, damping, torch.where(better, damping / 4, damping * 6)).clamp_min(1e-8)
            moved = moved | better
            if bool(moved.all()):
                break
        return best, torch.where(damping > _AT_REST, group["reach"], damping)


class BatchedDogleg(LeastSquares):
    """Powell's dogleg: along the steepest descent, then towards Gauss-Newton, as far as a trust region reaches.

    Powell 1970; Madsen, Nielsen and Tingleff, 2004, Sec. 3.3. SMPLify's own solver is of this kind.

    Args:
        params: one parameter (N, P).
        radius: of the first trust region.
        tries: radii tried in one step.
    """

    def __init__(self, params: Any, radius: float = 1.0, tries: int = 4) -> None:
        if not radius > 0 or tries < 1:
            raise ValueError(f"radius must be positive and tries at least 1, got {radius} and {tries}")
        super().__init__(params, reach=float(radius), tries=int(tries))

    def _moved(self, x: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
        group, radius = self.param_groups[0], reach
        here = _Normal.of(self.problem, x)
        slope = here.slope[..., 0]
        bend = (slope * (here.curvature @ here.slope)[..., 0]).sum(1).clamp_min(1e-30)
        steepest = -(slope.square().sum(1) / bend)[:, None] * slope
        floor = 1e-9 * here.curvature.diagonal(dim1=1, dim2=2).amax(1) + 1e-12
        newton = _solve(here.curvature + torch.diag_embed(floor[:, None].expand_as(x)), here.slope)
        best, moved = x, torch.zeros_like(here.cost, dtype=torch.bool)
        for _ in range(int(group["tries"])):
            step = _dogleg(steepest, newton, radius)
            rival = self.problem.rows(x + step).square().sum(1)
            expected = -2 * (slope * step).sum(1) - (step * (here.curvature @ step[..., None])[..., 0]).sum(1)
            gain = (here.cost - rival) / expected.clamp_min(1e-30)
            better = (rival < here.cost) & ~moved
            best = torch.where(better[:, None], x + step, best)
            wider = torch.maximum(radius, 3 * step.norm(dim=1))
            after = torch.where(gain > 0.75, wider, torch.where(gain < 0.25, radius / 2, radius))
            radius = torch.where(moved, radius, after).clamp(1e-8, 1e8)
            moved = moved | better
            if bool(moved.all()):
                break
        return best, radius


def _solve(curvature: Tensor, slope: Tensor) -> Tensor:
    """The step (N, P) to the bottom of N pictures of an objective; none where one has no bottom."""
    factor, failed = torch.linalg.cholesky_ex(curvature)
    step = -torch.cholesky_solve(slope, factor)[..., 0]
    return torch.where((failed == 0)[:, None] & step.isfinite().all(1, keepdim=True), step, 0.0)


def _dogleg(steepest: Tensor, newton: Tensor, radius: Tensor) -> Tensor:
    """The point (N, P) of each dogleg that is `radius` (N,) away, or its end."""
    reach = radius[:, None]
    first, last = steepest.norm(dim=1, keepdim=True), newton.norm(dim=1, keepdim=True)
    leg = newton - steepest
    a, b = leg.square().sum(1, keepdim=True).clamp_min(1e-30), (steepest * leg).sum(1, keepdim=True)
    c = first.square() - reach.square()
    share = (-b + (b.square() - a * c).clamp_min(0).sqrt()) / a
    between = steepest + share.clamp(0, 1) * leg
    return torch.where(last <= reach, newton, torch.where(first >= reach, steepest * (reach / first), between))
