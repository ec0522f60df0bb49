"""The nearest neighbours of points in other clouds.

Notation: N clouds a batch, P1 and P2 points a cloud (padded), D coordinates, K neighbours.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from rendra.kernels.knn import nearest_points


class KNN(NamedTuple):
    """Neighbours of every point."""

    dists: Tensor  # (N, P1, K) squared distances (norm 2) or sums of absolute differences (norm 1)
    idx: Tensor  # (N, P1, K) int64, into the second cloud
    knn: Tensor | None  # (N, P1, K, D) the neighbours themselves


def knn_points(
    p1: Tensor,
    p2: Tensor,
    lengths1: Tensor | None = None,
    lengths2: Tensor | None = None,
    norm: int = 2,
    K: int = 1,
    version: int = -1,
    return_nn: bool = False,
    return_sorted: bool = True,
) -> KNN:
    """The K points of `p2` that are nearest to each of `p1`: exact, of any size, spread or dimension.

    Of equally near points the one with the lower index comes first. A point with a NaN or infinite coordinate is
    infinitely far from every other. Distances are differentiable (once) with respect to both clouds.

    Args:
        p1: (N, P1, D) the points that ask.
        p2: (N, P2, D) the points that are searched.
        lengths1: (N,) how many points of each cloud of `p1` count; all by default.
        lengths2: (N,) the same for `p2`.
        norm: 2 for squared Euclidean distances, 1 for sums of absolute differences.
        K: how many neighbours.
        version: accepted and not needed: there is one implementation a device.
        return_nn: whether to gather the neighbours' coordinates.
        return_sorted: accepted and not needed: neighbours always come nearest first.

    Returns:
        KNN of dists (N, P1, K), idx (N, P1, K), and knn (N, P1, K, D) or None. All are zero where a cloud of `p2`
        has fewer than K points and for points behind `lengths1`.

    Raises:
        ValueError: clouds, lengths, a norm or K that do not fit together.
    """
    lengths1, lengths2 = lengths_of(p1, p2, lengths1, lengths2)
    dists, idx = nearest_points(p1, p2, lengths1, lengths2, norm, K)
    idx = idx.clamp(min=0)  # not in place: the backward pass needs the marks of missing neighbours
    return KNN(dists, idx, knn_gather(p2, idx, lengths2) if return_nn else None)


def lengths_of(p1: Tensor, p2: Tensor, lengths1: Tensor | None, lengths2: Tensor | None) -> tuple[Tensor, Tensor]:
    """Both lengths (N,) as int64, those of whole clouds where none are given.

    Raises:
        ValueError: clouds whose batches or dimensions differ.
    """
    if p1.ndim != 3 or p2.ndim != 3:
        raise ValueError(f"clouds must have shape (N, P, D), got {tuple(p1.shape)} and {tuple(p2.shape)}")
    if p1.shape[0] != p2.shape[0]:
        raise ValueError(f"pts1 and pts2 must have the same batch dimension, got {p1.shape[0]} and {p2.shape[0]}")
    if p1.shape[2] != p2.shape[2]:
        raise ValueError(f"pts1 and pts2 must have the same point dimension, got {p1.shape[2]} and {p2.shape[2]}")
    first, second = (
        torch.full((cloud.shape[0],), cloud.shape[1], dtype=torch.int64, device=cloud.device)
        if lengths is None
        else lengths.to(torch.int64)
        for cloud, lengths in ((p1, lengths1), (p2, lengths2))
    )
    return first, second


def knn_gather(x: Tensor, idx: Tensor, lengths: Tensor | None = None) -> Tensor:
    """What `x` holds for the neighbours that `knn_points` found: `x_out[n, l, k] = x[n, idx[n, l, k]]`.

    Args:
        x: (N, M, U) a feature of every point that was searched.
        idx: (N, L, K) int64, as `knn_points` returns it.
        lengths: (N,) how many points of `x` count; all by default.

    Returns:
        (N, L, K, U); zero for k >= lengths[n]. Differentiable with respect to `x`.

    Raises:
        ValueError: batches that differ.
    """
    if x.shape[0] != idx.shape[0]:
        raise ValueError(f"x and idx must have same batch dimension, got {x.shape[0]} and {idx.shape[0]}")
    N, L, K = idx.shape
    M, U = x.shape[1:]
    if M == 0:
        return x.new_zeros(N, L, K, U)
    rows = idx + M * torch.arange(N, device=idx.device)[:, None, None]
    gathered = x.reshape(N * M, U).index_select(0, rows.reshape(-1)).view(N, L, K, U)
    if lengths is None:
        return gathered
    exists = torch.arange(K, device=x.device) < lengths[:, None]  # (N, K)
    return torch.where(exists[:, None, :, None], gathered, 0.0)
