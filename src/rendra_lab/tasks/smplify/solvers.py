"""Many small least-squares problems side by side."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor


class Problem(Protocol):
    """N problems of P numbers each."""

    def rows(self, x: Tensor) -> Tensor:
        """Residuals (N, R) at (N, P)."""

    def linearized(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals (N, R) and their derivatives (N, R, P)."""


def damped_steps(problem: Problem, x: Tensor, damping: Tensor, free: Tensor, tries: int = 3) -> tuple[Tensor, Tensor, Tensor]:
    """One Levenberg-Marquardt step of N problems."""
    here, jacobian = problem.linearized(x)
    jacobian = jacobian * free
    normal = jacobian.transpose(1, 2) @ jacobian
    slope = (jacobian.transpose(1, 2) @ here[..., None])
    cost = here.square().sum(1)
    diagonal = normal.diagonal(dim1=1, dim2=2)
    moved = torch.zeros_like(cost, dtype=torch.bool)
    for _ in range(tries):
        damped = normal + torch.diag_embed(damping[:, None] * diagonal.clamp_min(1e-3) + (1 - free) * 1.0 + 1e-6)
        factor, _ = torch.linalg.cholesky_ex(damped)
        step = -torch.cholesky_solve(slope, factor)[..., 0].nan_to_num(0.0, 0.0, 0.0) * free
        rival = problem.rows(x + step).square().sum(1)
        better = (rival < cost) & ~moved
        x = torch.where(better[:, None], x + step, x)
        cost = torch.where(better, rival, cost)
        damping = torch.where(moved, damping, torch.where(better, damping / 4, damping * 6)).clamp(1e-8, 1e8)
        moved = moved | better
        if bool(moved.all()):
            break
    return x, damping, cost
