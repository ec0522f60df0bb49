"""Chamfer distance between point clouds.

Barrow et al., "Parametric correspondence and chamfer matching", IJCAI 1977, in the squared form of Fan et al., "A
point set generation network", CVPR 2017, Eq. 1. Notation: N clouds a batch, P points a cloud (padded), D coordinates.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.kernels.knn import nearest_points, nearest_sums
from rendra.ops.knn import knn_gather
from rendra.structures.pointclouds import Pointclouds

_Loss = Tensor | tuple[Tensor, Tensor]


class _Cloud(NamedTuple):
    """A batch of padded points."""

    points: Tensor  # (N, P, D)
    lengths: Tensor  # (N,) int64
    normals: Tensor | None  # (N, P, D)


def chamfer_distance(
    x: Tensor | Pointclouds,
    y: Tensor | Pointclouds,
    x_lengths: Tensor | None = None,
    y_lengths: Tensor | None = None,
    x_normals: Tensor | None = None,
    y_normals: Tensor | None = None,
    weights: Tensor | None = None,
    batch_reduction: str | None = "mean",
    point_reduction: str | None = "mean",
    norm: int = 2,
    single_directional: bool = False,
    abs_cosine: bool = True,
) -> tuple[_Loss, _Loss | None]:
    """How far each point of one cloud is from the other cloud, both ways added: mean_i min_j |x_i - y_j|^2 + ...

    With normals, also how much the normals of the matched points disagree: 1 - |cos|. A cloud without points has
    distance zero. Differentiable with respect to points and normals; the match is not.

    Args:
        x: (N, P1, D) points, or N Pointclouds.
        y: (N, P2, D) points, or N Pointclouds.
        x_lengths: (N,) how many points of each cloud of `x` count; all by default. Pointclouds bring their own.
        y_lengths: (N,) the same for `y`.
        x_normals: (N, P1, D) normals; used if both clouds have them. Pointclouds bring their own.
        y_normals: (N, P2, D) the same for `y`.
        weights: (N,) non-negative weights of the clouds of the batch.
        batch_reduction: "mean" (over the weights, if given), "sum", or None for a value per cloud.
        point_reduction: "mean", "sum", "max" (of both ways: the squared Hausdorff distance), or None for a value per
            point; then the batch cannot be reduced.
        norm: 2 for squared Euclidean distances, 1 for sums of absolute differences.
        single_directional: whether only the way from `x` to `y` counts.
        abs_cosine: whether opposite normals agree; if not, the term is 1 - cos.

    Returns:
        The loss and the loss of the normals, the latter None without normals: scalars, (N,) where `batch_reduction`
        is None, and, where `point_reduction` is None, (N, P1), or the pair of (N, P1) and (N, P2) for both ways.

    Raises:
        ValueError: options or shapes that do not fit together.
    """
    _check_options(batch_reduction, point_reduction, norm)
    first, second = _cloud(x, x_lengths, x_normals), _cloud(y, y_lengths, y_normals)
    if point_reduction == "max" and (first.normals is not None or second.normals is not None):
        raise ValueError('Normals must be None if point_reduction is "max"')
    if first.points.shape[0] != second.points.shape[0] or first.points.shape[2] != second.points.shape[2]:
        raise ValueError(
            f"y does not have the correct shape: x is {tuple(first.points.shape)}, y {tuple(second.points.shape)}"
        )
    _check_weights(weights, len(first.points))
    has_normals = first.normals is not None and second.normals is not None
    if point_reduction in ("mean", "sum") and not has_normals:
        x_scale, y_scale = (_scale(cloud, weights, point_reduction) for cloud in (first, second))
        loss = nearest_sums(
            first.points, second.points, first.lengths, second.lengths, x_scale,
            torch.zeros_like(y_scale) if single_directional else y_scale, norm,
        )  # fmt: skip
        return _reduce_batch(loss, weights, batch_reduction), None
    ways = [(first, second)] if single_directional else [(first, second), (second, first)]
    losses = [_one_way(*way, weights, point_reduction, norm, abs_cosine) for way in ways]
    dists, normals = [dist for dist, _ in losses], [normal for _, normal in losses if normal is not None]
    if point_reduction is None:
        return _all_or_one(dists), _all_or_one(normals) if has_normals else None
    total = torch.stack(dists).amax(0) if point_reduction == "max" else torch.stack(dists).sum(0)
    normal_total = _reduce_batch(torch.stack(normals).sum(0), weights, batch_reduction) if has_normals else None
    return _reduce_batch(total, weights, batch_reduction), normal_total


def _check_options(batch_reduction: str | None, point_reduction: str | None, norm: int) -> None:
    if batch_reduction not in ("mean", "sum", None):
        raise ValueError(f'batch_reduction must be one of ["mean", "sum"] or None, got {batch_reduction!r}')
    if point_reduction not in ("mean", "sum", "max", None):
        raise ValueError(f'point_reduction must be one of ["mean", "sum", "max"] or None, got {point_reduction!r}')
    if point_reduction is None and batch_reduction is not None:
        raise ValueError(f"Batch reduction must be None if point_reduction is None, got {batch_reduction!r}")
    if norm not in (1, 2):
        raise ValueError(f"Support for 1 or 2 norm; got {norm}")


def _cloud(points: Tensor | Pointclouds, lengths: Tensor | None, normals: Tensor | None) -> _Cloud:
    """Padded tensors of either kind of input, checked."""
    if isinstance(points, Pointclouds):
        return _Cloud(points.points_padded(), points.num_points_per_cloud(), points.normals_padded())
    if not isinstance(points, Tensor):
        raise ValueError(
            "The input pointclouds should be either Pointclouds objects or torch.Tensor of shape "
            f"(minibatch, num_points, 3), got {type(points).__name__}"
        )
    if points.ndim != 3:
        raise ValueError(f"Expected points to be of shape (N, P, D), got {tuple(points.shape)}")
    if lengths is None:
        lengths = torch.full(points.shape[:1], points.shape[1], dtype=torch.int64, device=points.device)
    elif lengths.shape != points.shape[:1]:
        raise ValueError(f"Expected lengths to be of shape ({len(points)},), got {tuple(lengths.shape)}")
    elif len(lengths) and lengths.max() > points.shape[1]:
        raise ValueError(f"A length value was too long: {int(lengths.max())} of {points.shape[1]} points")
    if normals is not None and (normals.ndim != 3 or normals.shape[:2] != points.shape[:2]):
        raise ValueError(
            f"Expected normals to be of shape (N, P, 3), one for each of {tuple(points.shape)}, "
            f"got {tuple(normals.shape)}"
        )
    return _Cloud(points, lengths.to(torch.int64), normals)


def _check_weights(weights: Tensor | None, num_clouds: int) -> None:
    if weights is None:
        return
    if weights.shape != (num_clouds,):
        raise ValueError(f"weights must be of shape ({num_clouds},), got {tuple(weights.shape)}")
    if not (weights >= 0).all():
        raise ValueError(f"weights cannot be negative, got {weights.tolist()}")


def _scale(cloud: _Cloud, weights: Tensor | None, point_reduction: str) -> Tensor:
    """What the sum of a cloud's distances is multiplied by: (N,)."""
    scale = torch.ones_like(cloud.lengths, dtype=cloud.points.dtype)
    if point_reduction == "mean":
        scale = scale / cloud.lengths.clamp(min=1)
    return scale if weights is None else scale * weights


def _one_way(
    x: _Cloud, y: _Cloud, weights: Tensor | None, point_reduction: str | None, norm: int, abs_cosine: bool
) -> tuple[Tensor, Tensor | None]:
    """Distances from `x` to `y`, and disagreement of normals, reduced over points: (N,), or (N, P) if not."""
    dists, idx = nearest_points(x.points, y.points, x.lengths, y.lengths, norm, 1)
    exists = idx[..., 0] >= 0
    terms = [dists[..., 0]]
    if x.normals is not None and y.normals is not None:
        matched = knn_gather(y.normals, idx.clamp(min=0))[:, :, 0]
        cosine = F.cosine_similarity(x.normals, matched, dim=2, eps=1e-6)
        terms.append(torch.where(exists, 1 - (cosine.abs() if abs_cosine else cosine), 0.0))
    if weights is not None:
        terms = [term * weights[:, None] for term in terms]
    if point_reduction is not None:
        terms = [_reduce_points(term, x.lengths, point_reduction) for term in terms]
    return terms[0], terms[1] if len(terms) > 1 else None


def _reduce_points(terms: Tensor, lengths: Tensor, point_reduction: str) -> Tensor:
    """(N, P) to (N,); zero for a cloud without points."""
    if point_reduction == "max":
        return F.pad(terms, (0, 1)).amax(1)  # distances are not negative
    total = terms.sum(1)
    return total / lengths.clamp(min=1) if point_reduction == "mean" else total


def _reduce_batch(loss: Tensor, weights: Tensor | None, batch_reduction: str | None) -> Tensor:
    """(N,) to a scalar, unless nothing is asked; zero where all weights are."""
    if batch_reduction is None:
        return loss
    if batch_reduction == "sum":
        return loss.sum()
    if weights is None:
        return loss.sum() / max(1, len(loss))
    total = weights.sum()
    return loss.sum() / torch.where(total > 0, total, 1.0)


def _all_or_one(values: list[Tensor]) -> _Loss:
    return (values[0], values[1]) if len(values) == 2 else values[0]
