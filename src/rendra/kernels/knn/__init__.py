"""Nearest points between batches of clouds: the K nearest, those in a ball, and the sums that a chamfer loss takes."""

import torch
from torch import Tensor

from rendra.kernels.knn import reference

__all__ = ["nearest_points", "nearest_sums", "points_in_ball"]


def nearest_points(
    p1: Tensor, p2: Tensor, lengths1: Tensor, lengths2: Tensor, norm: int, K: int
) -> tuple[Tensor, Tensor]:
    """The K points of `p2` that are nearest to each of `p1`, exactly; `reference.py` states each rule.

    Distances are differentiable with respect to both clouds; the same on any number of threads.

    Args:
        p1: (N, P1, D) the points that ask, padded.
        p2: (N, P2, D) the points that are searched, padded.
        lengths1: (N,) int64, how many points of each cloud of `p1` count.
        lengths2: (N,) int64, the same for `p2`.
        norm: 2 for squared Euclidean distances, 1 for sums of absolute differences.
        K: how many neighbours.

    Returns:
        dists (N, P1, K), nearest first, zero where there is no neighbour; idx (N, P1, K) int64, -1 there.

    Raises:
        ValueError: a shape, type, device, length, norm or K that cannot be.
    """
    _check_clouds(p1, p2, lengths1, lengths2)
    _check_norm(norm)
    _check_count(K)
    return reference.nearest_points(p1, p2, lengths1, lengths2, norm, K)


def points_in_ball(
    p1: Tensor, p2: Tensor, lengths1: Tensor, lengths2: Tensor, K: int, radius: float
) -> tuple[Tensor, Tensor]:
    """The first K points of `p2`, in the order of their index, that are closer than `radius` to each of `p1`.

    Distances are differentiable with respect to both clouds; the same on any number of threads.

    Args:
        p1: (N, P1, D) the points that ask, padded.
        p2: (N, P2, D) the points that are searched, padded.
        lengths1: (N,) int64, how many points of each cloud of `p1` count.
        lengths2: (N,) int64, the same for `p2`.
        K: how many neighbours at most.
        radius: in the units of the points; a point at this distance is outside.

    Returns:
        dists (N, P1, K), squared, zero where there is no neighbour; idx (N, P1, K) int64, -1 there.

    Raises:
        ValueError: a shape, type, device, length, radius or K that cannot be.
    """
    _check_clouds(p1, p2, lengths1, lengths2)
    _check_count(K)
    if not radius >= 0:
        raise ValueError(f"radius must be zero or positive, got {radius}")
    return reference.points_in_ball(p1, p2, lengths1, lengths2, K, radius)


def nearest_sums(
    x: Tensor, y: Tensor, x_lengths: Tensor, y_lengths: Tensor, x_weights: Tensor, y_weights: Tensor, norm: int
) -> Tensor:
    """Per cloud, x_weights * sum_i min_j d(x_i, y_j) + y_weights * sum_j min_i d(y_j, x_i).

    Both searches share their preparation, and the gradient is found on the way forward: half the time of two calls
    of `nearest_points`. Differentiable with respect to both clouds; the same on any number of threads.

    Args:
        x: (N, P1, D) points, padded.
        y: (N, P2, D) points, padded.
        x_lengths: (N,) int64, how many points of each cloud of `x` count.
        y_lengths: (N,) int64, the same for `y`.
        x_weights: (N,) factor of the distances from `x` to `y`; no gradient flows into it.
        y_weights: (N,) the same from `y` to `x`; where all are zero, that way is not searched.
        norm: 2 for squared Euclidean distances, 1 for sums of absolute differences.

    Returns:
        (N,); zero for a way from or to an empty cloud.

    Raises:
        ValueError: a shape, type, device, length or norm that cannot be.
    """
    _check_clouds(x, y, x_lengths, y_lengths)
    _check_norm(norm)
    return reference.nearest_sums(x, y, x_lengths, y_lengths, x_weights, y_weights, norm)


def _check_clouds(p1: Tensor, p2: Tensor, lengths1: Tensor, lengths2: Tensor) -> None:
    if p1.ndim != 3 or p2.ndim != 3 or p1.shape[0] != p2.shape[0] or p1.shape[2] != p2.shape[2]:
        raise ValueError(
            f"the clouds must have shapes (N, P1, D) and (N, P2, D), got {tuple(p1.shape)} and {tuple(p2.shape)}"
        )
    if not p1.is_floating_point() or p1.dtype != p2.dtype or p1.device != p2.device:
        raise ValueError(
            "the clouds must be floats of one type on one device, got "
            f"{p1.dtype} on {p1.device} and {p2.dtype} on {p2.device}"
        )
    for lengths, cloud in ((lengths1, p1), (lengths2, p2)):
        if lengths.shape != cloud.shape[:1] or lengths.dtype != torch.int64 or lengths.device != cloud.device:
            raise ValueError(
                f"lengths must be int64 of shape ({len(cloud)},) on {cloud.device}, got {lengths.dtype} of "
                f"{tuple(lengths.shape)} on {lengths.device}"
            )
        # elsewhere than on the CPU, asking would wait for the device
        if lengths.device.type == "cpu" and any(not 0 <= length <= cloud.shape[1] for length in lengths.tolist()):
            raise ValueError(f"lengths must be between 0 and {cloud.shape[1]}, got {lengths.tolist()}")


def _check_norm(norm: int) -> None:
    if norm not in (1, 2):
        raise ValueError(f"Support for 1 or 2 norm; got {norm}")


def _check_count(K: int) -> None:
    if K < 1:
        raise ValueError(f"K must be at least 1, got {K}")
