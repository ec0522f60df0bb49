"""
Operators on padded point sets that others are made of.

Letters: N clouds, P points of the largest one, K neighbours, D dimensions.
"""

from typing import TypeGuard

import torch
from torch import Tensor

from rendra.ops.knn import knn_points
from rendra.structures.pointclouds import Pointclouds


def masked_gather(points: Tensor, idx: Tensor) -> Tensor:
    """
    The points that indices name, and 0 where an index is -1.

    Args:
        points: (N, P, D).
        idx: (N, K) or (N, M, K) integers into the points of the same cloud; -1 marks padding.

    Returns:
        (N, K, D) or (N, M, K, D).

    Raises:
        ValueError: other shapes, or different batch sizes.
    """
    if points.ndim != 3 or idx.ndim not in (2, 3):
        raise ValueError(
            "points and idx must have shapes (N, P, D) and (N, K) or (N, M, K); "
            f"got {tuple(points.shape)} and {tuple(idx.shape)}"
        )
    if len(idx) != len(points):
        raise ValueError(f"points and idx must have the same batch dimension, got {len(points)} and {len(idx)}")
    if points.shape[1] == 0:
        return points.new_zeros(*idx.shape, points.shape[2])
    padding = idx == -1
    first = torch.arange(len(points), device=points.device) * points.shape[1]
    rows = idx.masked_fill(padding, 0) + first.view(-1, *[1] * (idx.ndim - 1))
    gathered = points.flatten(0, 1).index_select(0, rows.flatten()).view(*idx.shape, points.shape[2])
    return gathered.masked_fill(padding[..., None], 0)


def wmean(
    x: Tensor,
    weight: Tensor | None = None,
    dim: int | tuple[int, ...] = -2,
    keepdim: bool = True,
    eps: float = 1e-9,
) -> Tensor:
    """
    The mean of vectors, weighted if there are weights.

    Args:
        x: (*, D) vectors.
        weight: non-negative, broadcastable to (*); one weight for all components of a vector.
        dim: the dimensions of `x` to average over.
        keepdim: keep them, with size 1.
        eps: the smallest sum of weights to divide by.

    Returns:
        sum(weight x) / max(sum(weight), eps) over `dim`.

    Raises:
        ValueError: the weights do not broadcast to the vectors.
    """
    if weight is None:
        return x.mean(dim=dim, keepdim=keepdim)
    try:
        weights = weight.expand(x.shape[:-1])[..., None]
    except RuntimeError:
        raise ValueError(
            f"wmean: weights are not compatible with the tensor: {tuple(weight.shape)} does not broadcast to "
            f"{tuple(x.shape[:-1])}"
        ) from None
    return (x * weights).sum(dim, keepdim=keepdim) / weights.sum(dim, keepdim=keepdim).clamp(min=eps)


def eyes(dim: int, N: int, device: torch.device | str | None = None, dtype: torch.dtype = torch.float32) -> Tensor:
    """N identity matrices. (N, dim, dim)"""
    return torch.eye(dim, device=device, dtype=dtype).repeat(N, 1, 1)


def is_pointclouds(pcl: Tensor | Pointclouds) -> TypeGuard[Pointclouds]:
    """Whether the object has the padded points and the counts of a `Pointclouds`."""
    return hasattr(pcl, "points_padded") and hasattr(pcl, "num_points_per_cloud")


def convert_pointclouds_to_tensor(pcl: Tensor | Pointclouds) -> tuple[Tensor, Tensor]:
    """
    Padded points (N, P, D) and the number of points of each cloud (N,), of `Pointclouds` or of padded points.

    Raises:
        ValueError: neither of the two.
    """
    if is_pointclouds(pcl):
        return pcl.points_padded(), pcl.num_points_per_cloud()
    if not isinstance(pcl, Tensor) or pcl.ndim != 3:
        got = tuple(pcl.shape) if isinstance(pcl, Tensor) else type(pcl)
        raise ValueError(f"Point sets should be either Pointclouds objects or tensors (N, P, D), got {got}")
    return pcl, torch.full((len(pcl),), pcl.shape[1], dtype=torch.int64, device=pcl.device)


def get_point_covariances(
    points_padded: Tensor, num_points_per_cloud: Tensor, neighborhood_size: int
) -> tuple[Tensor, Tensor]:
    """
    The covariance of each point's nearest neighbours, about their mean.

    Args:
        points_padded: (N, P, D).
        num_points_per_cloud: (N,), how many of the P points are real.
        neighborhood_size: K, the point itself included. A smaller cloud is its points' neighbourhood as a whole.

    Returns:
        Covariances (N, P, D, D) and the neighbours (N, P, K, D), both 0 where a point or a neighbour is none.

    Raises:
        ValueError: from `knn_points`, where shapes do not fit.
    """
    lengths = num_points_per_cloud
    found = knn_points(points_padded, points_padded, lengths, lengths, K=neighborhood_size, return_nn=True)
    assert found.knn is not None
    counts = lengths.clamp(max=neighborhood_size)[:, None]  # (N, 1)
    rank = torch.arange(neighborhood_size, device=lengths.device)
    row = torch.arange(points_padded.shape[1], device=lengths.device)
    real = (rank < counts)[:, None, :] & (row < lengths[:, None])[:, :, None]  # (N, P, K)
    neighbors = found.knn.masked_fill(~real[..., None], 0)
    share = 1 / counts.clamp(min=1).to(neighbors.dtype)[..., None]  # (N, 1, 1)
    mean = neighbors.sum(2) * share
    central = (neighbors - mean[:, :, None]).masked_fill(~real[..., None], 0)
    return central.mT @ central * share[..., None], neighbors
