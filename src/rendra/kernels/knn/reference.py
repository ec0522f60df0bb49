"""Nearest points, the specification: plain torch, any device, any float type, slow.

1. The distance of two points is the squared Euclidean one (norm 2) or the sum of absolute differences (norm 1). A
   pair whose difference is not finite along some axis (NaN or infinite coordinates) is infinitely far apart and
   pulls at nothing.
2. Of the candidates, those before `lengths2`, the K nearest count, nearest first; **of two equally near, the lower
   index comes first**.
3. In a ball, of the candidates strictly closer than the radius, the K of lowest index count, lowest first.
4. Places that stay empty (fewer than K candidates, or a query behind `lengths1`) have index -1 and distance zero.
5. The distances are differentiable with respect to both points; which points are near is not. The derivative of an
   absolute difference of zero is zero.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

_NUMBERS_AT_ONCE = 2**22


def nearest_points(
    p1: Tensor, p2: Tensor, lengths1: Tensor, lengths2: Tensor, norm: int, K: int
) -> tuple[Tensor, Tensor]:
    """Distances and indices (N, P1, K); see the package's `nearest_points` for the arguments."""
    idx = torch.full((*p1.shape[:2], K), -1, dtype=torch.int64, device=p1.device)
    for n, rows, dists in _pairwise(p1, p2, lengths1, lengths2, norm):
        if K == 1:  # sorting without need would be all that a GPU does
            order = _first(dists == dists.amin(1, keepdim=True))
        else:
            order = dists.sort(dim=1, stable=True).indices[:, :K]
        idx[n, rows, : order.shape[1]] = order
    return _differentiable_distances(p1, p2, idx, norm), idx


def points_in_ball(
    p1: Tensor, p2: Tensor, lengths1: Tensor, lengths2: Tensor, K: int, radius: float
) -> tuple[Tensor, Tensor]:
    """Distances and indices (N, P1, K); see the package's `points_in_ball` for the arguments."""
    idx = torch.full((*p1.shape[:2], K), -1, dtype=torch.int64, device=p1.device)
    for n, rows, dists in _pairwise(p1, p2, lengths1, lengths2, 2):
        inside = dists < dists.new_tensor(radius) ** 2
        order = inside.logical_not().byte().sort(dim=1, stable=True).indices[:, :K]
        idx[n, rows, : order.shape[1]] = torch.where(inside.gather(1, order), order, -1)
    return _differentiable_distances(p1, p2, idx, 2), idx


def nearest_sums(
    x: Tensor, y: Tensor, x_lengths: Tensor, y_lengths: Tensor, x_weights: Tensor, y_weights: Tensor, norm: int
) -> Tensor:
    """Weighted sums (N,) of nearest distances, both ways; see the package's `nearest_sums` for the arguments."""
    there, _ = nearest_points(x, y, x_lengths, y_lengths, norm, 1)
    back, _ = nearest_points(y, x, y_lengths, x_lengths, norm, 1)
    return x_weights * there.sum((1, 2)) + y_weights * back.sum((1, 2))


def _pairwise(
    p1: Tensor, p2: Tensor, lengths1: Tensor, lengths2: Tensor, norm: int
) -> Iterator[tuple[int, slice, Tensor]]:
    """All distances (rows, lengths2[n]) of a few rows of a cloud at a time, with the cloud and its rows."""
    for n, (num_queries, num_candidates) in enumerate(zip(lengths1.tolist(), lengths2.tolist(), strict=True)):
        if num_candidates == 0:
            continue
        candidates = p2[n, :num_candidates].detach()
        step = max(1, _NUMBERS_AT_ONCE // (num_candidates * max(1, p1.shape[2])))
        for begin in range(0, num_queries, step):
            rows = slice(begin, min(begin + step, num_queries))
            yield n, rows, _distances(p1[n, rows, None].detach() - candidates, norm)


def _first(mask: Tensor) -> Tensor:
    """Index (rows, 1) of the first true element of every row."""
    index = torch.arange(mask.shape[1], device=mask.device)
    return torch.where(mask, index, mask.shape[1]).amin(1, keepdim=True)


def _differentiable_distances(p1: Tensor, p2: Tensor, idx: Tensor, norm: int) -> Tensor:
    """Distances (N, P1, K) of every point to those that `idx` names, zero where it is negative."""
    if p2.shape[1] == 0:
        return p1.new_zeros(idx.shape)
    cloud = torch.arange(len(p2), device=p2.device)[:, None, None]
    dists = _distances(p1[:, :, None] - p2[cloud, idx.clamp(min=0)], norm)
    return torch.where(idx >= 0, dists, 0.0)


def _distances(difference: Tensor, norm: int) -> Tensor:
    """Rule 1, over the last axis."""
    finite = difference.isfinite().all(-1, keepdim=True)
    difference = torch.where(finite, difference, torch.inf)
    return (difference.abs() if norm == 1 else difference.square()).sum(-1)
