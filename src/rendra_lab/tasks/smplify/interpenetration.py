"""No part of a body inside another: the overlap of the balls that fill it.

Bogo et al., "Keep it SMPL: Automatic Estimation of 3D Human Pose and Shape from a Single Image", ECCV 2016, Eq. 6: a
Gaussian about each ball, and the product of two of them as the measure of their overlap.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rendra.kernels.sphere_pairs import sphere_pairs
from rendra_lab.tasks.smplify.body_spheres import CAPSULE_PAIRS, PARTS, Balls
from rendra_lab.tasks.smplify.energy import SumOfSquares

_NEGLIGIBLE = 1e-4  # overlap below which a pair of balls is left out


class Interpenetration(SumOfSquares):
    """How much the parts of a body overlap that can pass through each other; it moves the pose alone.

    With g = exp(-d^2 / (2 (s_i^2 + s_j^2))) for two balls d apart and s = alpha r, the paper's single residual is the
    root of the sum E of all g^2, whose slope is not defined where nothing overlaps. Here each pair of capsules has a
    row E / sqrt(E + softness^2), E summed over its own balls: the sum of their squares is the paper's term less at
    most softness^2 a pair, and flat where capsules are apart. A row a pair also tells Gauss-Newton more than one row
    in all.

    Args:
        alpha: how wide a ball's Gaussian is, of its radius.
        softness: overlap below which a row fades; its square is far above what `_NEGLIGIBLE` leaves out.
    """

    def __init__(self, alpha: float = 0.3, softness: float = 1e-2) -> None:
        super().__init__()
        if not (alpha > 0 and softness > 0):
            raise ValueError(f"alpha and softness must be positive, got {alpha} and {softness}")
        self.alpha = alpha
        self.softness = softness

    def residuals(self, spheres: Balls) -> Tensor:
        """Rows (N, R), R = 23 pairs of capsules, of the balls of N bodies."""
        near = self._near(spheres)
        overlap = self._sums(spheres, near, near.squares)
        return overlap / (overlap + self.softness**2).sqrt()

    def row_derivatives(self, changes: Tensor, spheres: Balls) -> Tensor:
        """How the rows change with the middles of the balls: (N, R, P) of changes (N, S, 3, P)."""
        near = self._near(spheres)
        overlap = self._sums(spheres, near, near.squares)
        slope = (overlap / 2 + self.softness**2) / (overlap + self.softness**2).pow(1.5)
        moves = changes.reshape(-1, *changes.shape[2:])
        pull = (-2 * near.squares / near.widths)[:, None] * near.apart  # (M, 3)
        moved = moves.index_select(0, near.first) - moves.index_select(0, near.second)  # (M, 3, P)
        return slope[..., None] * self._sums(spheres, near, (pull[:, None] @ moved)[:, 0])

    def _near(self, spheres: Balls) -> _Near:
        middles, radii = spheres.middles, spheres.radii.detach()
        size = radii.shape[1]
        parts, looked_at, row_of = _pairs_of_parts(spheres.parts, middles.device)
        reach = self.alpha * math.sqrt(-2 * math.log(_NEGLIGIBLE)) * radii
        body, i, j = _Touching.apply(middles, reach, parts, looked_at).unbind(1)
        first, second = body * size + i, body * size + j
        places, squared = middles.reshape(-1, 3), (self.alpha * radii).square().reshape(-1)
        apart = places.index_select(0, first) - places.index_select(0, second)
        widths = squared.index_select(0, first) + squared.index_select(0, second)
        rows = body * len(looked_at) + row_of[parts[i], parts[j]]
        return _Near(first, second, rows, apart, widths, (-apart.square().sum(1) / widths).exp())

    @staticmethod
    def _sums(spheres: Balls, near: _Near, values: Tensor) -> Tensor:
        """Sums (N, R, ...) of values (M, ...) of pairs of balls, for each body and pair of capsules."""
        count = len(spheres.middles)
        zeros = values.new_zeros(count * len(CAPSULE_PAIRS), *values.shape[1:])
        return zeros.index_add(0, near.rows, values).reshape(count, len(CAPSULE_PAIRS), *values.shape[1:])


class _Near(NamedTuple):
    """M pairs of balls that are near each other."""

    first: Tensor  # (M,) ball, counted through all bodies
    second: Tensor  # (M,)
    rows: Tensor  # (M,) pair of capsules, counted through all bodies
    apart: Tensor  # (M, 3) from the second to the first
    widths: Tensor  # (M,) s_i^2 + s_j^2
    squares: Tensor  # (M,) g^2


class _Touching(torch.autograd.Function):
    """Balls near enough to count: body, first and second ball (M, 3). No derivatives: a choice, not a number.

    A function of its own so that `torch.func` hands it plain tensors, of which the broad phase takes the numbers.
    """

    @staticmethod
    def forward(middles: Tensor, radii: Tensor, parts: Tensor, looked_at: Tensor) -> Tensor:
        """Pairs of the broad phase, each with its body; float32 is enough for what is negligible."""
        first, pairs = sphere_pairs(middles.float(), radii.float(), parts, looked_at)
        bodies = torch.arange(len(middles), device=middles.device).repeat_interleave(first.diff())
        return torch.cat([bodies[:, None], pairs], dim=1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        """Nothing to remember."""
        ctx.mark_non_differentiable(output)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[None, ...]:
        """None."""
        return None, None, None, None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> None:
        """None."""
        return None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *arguments: Tensor) -> tuple[Tensor, None]:
        """Many directions share the bodies; what differs within the batch cannot share a number of pairs."""
        if any(dim is not None for dim in in_dims):
            raise NotImplementedError(
                "Interpenetration takes a batch of bodies at once: call it without vmap over them"
            )
        return _Touching.apply(*arguments), None


@functools.lru_cache(maxsize=16)
def _pairs_of_parts(parts: tuple[int, ...], device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """The part of each ball (S,), the pairs of parts to look at (R, 2), and the row (P, P) of each such pair."""
    pairs = torch.tensor([[PARTS.index(name) for name in pair] for pair in CAPSULE_PAIRS])
    row_of = torch.zeros(len(PARTS), len(PARTS), dtype=torch.int64)
    row_of[pairs[:, 0], pairs[:, 1]] = row_of[pairs[:, 1], pairs[:, 0]] = torch.arange(len(pairs))
    return torch.tensor(parts, device=device), pairs.to(device), row_of.to(device)
