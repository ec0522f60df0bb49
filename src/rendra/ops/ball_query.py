"""Neighbours within a radius.

Notation: N clouds a batch, P1 and P2 points a cloud (padded), D coordinates, K neighbours.
"""

import torch
from torch import Tensor

from rendra.kernels.knn import points_in_ball
from rendra.ops.knn import KNN, knn_gather, lengths_of


def ball_query(
    p1: Tensor,
    p2: Tensor,
    lengths1: Tensor | None = None,
    lengths2: Tensor | None = None,
    K: int = 500,
    radius: float = 0.2,
    return_nn: bool = True,
    skip_points_outside_cube: bool = False,
) -> KNN:
    """The first K points of `p2`, in the order of their index, that lie within `radius` of each point of `p1`.

    Not the nearest K: the lowest indices. Distances are differentiable (once) with respect to both clouds.

    Args:
        p1: (N, P1, D) centres of the balls.
        p2: (N, P2, D) the points that are searched.
        lengths1: (N,) how many points of each cloud of `p1` count; all by default.
        lengths2: (N,) the same for `p2`.
        K: how many neighbours at most.
        radius: of the balls; a point at exactly this distance is outside.
        return_nn: whether to gather the neighbours' coordinates.
        skip_points_outside_cube: accepted and not needed: far points are always skipped, whole boxes at a time.

    Returns:
        KNN of squared dists (N, P1, K), zero where there is no neighbour; idx (N, P1, K), -1 there; and knn
        (N, P1, K, D), zero there, or None.

    Raises:
        ValueError: clouds, lengths, a radius or K that do not fit together.
    """
    lengths1, lengths2 = lengths_of(p1, p2, lengths1, lengths2)
    dists, idx = points_in_ball(p1, p2, lengths1, lengths2, K, radius)
    if not return_nn:
        return KNN(dists, idx, None)
    neighbours = knn_gather(p2, idx.clamp(min=0))
    return KNN(dists, idx, torch.where(idx[..., None] >= 0, neighbours, 0.0))
