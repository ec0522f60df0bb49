"""
The similarity that brings one point set onto another, with known or with unknown correspondence.

Sources: Umeyama, "Least-Squares Estimation of Transformation Parameters Between Two Point Patterns", PAMI 1991;
Besl and McKay, "A Method for Registration of 3-D Shapes", PAMI 1992.
Letters: N problems, P points of the largest set, D dimensions. Row vectors: x goes to s x R + T.
"""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from rendra.ops.knn import knn_points
from rendra.ops.matrix_factors import nearest_rotation
from rendra.ops.utils import convert_pointclouds_to_tensor, eyes, is_pointclouds, wmean
from rendra.structures.pointclouds import Pointclouds
from rendra.structures.utils import list_to_padded


class SimilarityTransform(NamedTuple):
    """x goes to s x R + T."""

    R: Tensor  # (N, D, D) orthonormal
    T: Tensor  # (N, D), in the units of the target
    s: Tensor  # (N,), not negative


class ICPSolution(NamedTuple):
    """What iterative closest points came to."""

    converged: bool  # whether the error of every problem stopped falling before the iterations ran out
    rmse: Tensor | None  # (N,) root mean square distance of the moved points to their nearest; None without steps
    Xt: Tensor | Pointclouds  # the moved points, in the form in which X was given
    RTs: SimilarityTransform  # from X to Xt
    t_history: list[SimilarityTransform]  # from X, after each iteration


def corresponding_points_alignment(
    X: Tensor | Pointclouds,
    Y: Tensor | Pointclouds,
    weights: Tensor | Sequence[Tensor] | None = None,
    estimate_scale: bool = False,
    allow_reflection: bool = False,
    eps: float = 1e-9,
) -> SimilarityTransform:
    """
    The rotation, translation and scale that minimise sum_i w_i |s x_i R + T - y_i|^2 (Umeyama, Eq. 34-43).

    Gradients are finite for symmetric, flat and straight sets too.

    Args:
        X: N clouds, or (N, P, D).
        Y: as many points, point i belongs to point i of X.
        weights: (N, P) non-negative, or a list of N tensors (P_i,); all points count alike if None.
        estimate_scale: also find s; it is 1 otherwise.
        allow_reflection: R may have determinant -1.
        eps: the smallest sum of weights, and the smallest variance of X, to divide by.

    Raises:
        ValueError: the sets, or the weights, differ in their numbers of points.

    Warns:
        UserWarning: the points leave the rotation open, as those of a line do.
    """
    Xt, num_points = convert_pointclouds_to_tensor(X)
    Yt, num_points_Y = convert_pointclouds_to_tensor(Y)
    if Xt.shape != Yt.shape or (num_points != num_points_Y).any():
        raise ValueError(
            "Point sets X and Y have to have the same number of batches, points and dimensions; got "
            f"{tuple(Xt.shape)} with {num_points.tolist()} points and {tuple(Yt.shape)} with "
            f"{num_points_Y.tolist()} points"
        )
    shares = _weights_of_points(weights, Xt, num_points)
    transform, stretch = align_weighted(Xt, Yt, shares, estimate_scale, allow_reflection, eps)
    _warn_if_ambiguous(stretch, allow_reflection)
    return transform


def align_weighted(
    X: Tensor,
    Y: Tensor,
    weights: Tensor,
    estimate_scale: bool = False,
    allow_reflection: bool = False,
    eps: float = 1e-9,
) -> tuple[SimilarityTransform, Tensor]:
    """
    The maths of `corresponding_points_alignment`, for padded points (N, P, D) and weights (N, P).

    Returns:
        The transform, and how far the points fix the rotation: see `nearest_rotation`, (N, D).
    """
    total = weights.sum(1).clamp(min=eps)
    mean_X, mean_Y = wmean(X, weights, eps=eps), wmean(Y, weights, eps=eps)  # (N, 1, D)
    centred_X, centred_Y = X - mean_X, Y - mean_Y
    weighted_X = centred_X * (weights / total[:, None])[..., None]
    covariance = weighted_X.mT @ centred_Y  # (N, D, D)
    R, stretch = nearest_rotation(covariance, allow_reflection)
    if estimate_scale:
        variance = (weighted_X * centred_X).sum((1, 2))
        s = (R * covariance).sum((1, 2)) / variance.clamp(min=eps)
    else:
        s = torch.ones_like(total)
    T = mean_Y[:, 0] - s[:, None] * (mean_X @ R)[:, 0]
    return SimilarityTransform(R, T, s), stretch


def _weights_of_points(weights: Tensor | Sequence[Tensor] | None, X: Tensor, num_points: Tensor) -> Tensor:
    """Weights (N, P), 0 in the padding."""
    real = (torch.arange(X.shape[1], device=X.device) < num_points[:, None]).to(X.dtype)
    if weights is None:
        return real
    if not isinstance(weights, Tensor):
        lengths = [len(w) for w in weights]
        if lengths != num_points.tolist():
            raise ValueError(f"weights should have one entry for each point, {num_points.tolist()}; got {lengths}")
        weights = list_to_padded(list(weights), (X.shape[1],)) if lengths else X.new_zeros(X.shape[:2])
    if weights.shape != X.shape[:2]:
        raise ValueError(
            f"weights should have the same first two dimensions as X, {tuple(X.shape[:2])}; "
            f"got {tuple(weights.shape)}"
        )
    return weights.to(X.dtype) * real


def _warn_if_ambiguous(stretch: Tensor, allow_reflection: bool) -> None:
    """Warn where another rotation is as good: a pair of eigenvalues, or with reflections one, vanishes."""
    if stretch.numel() == 0 or (stretch.shape[1] == 1 and not allow_reflection):
        return
    least = stretch[:, -1] if allow_reflection else stretch[:, -2] + stretch[:, -1]
    if (least <= 4 * torch.finfo(stretch.dtype).eps * stretch[:, 0]).any():
        warnings.warn(
            "Excessively low rank of cross-correlation between aligned point clouds. "
            "corresponding_points_alignment cannot return a unique rotation.",
            stacklevel=3,
        )


def iterative_closest_point(
    X: Tensor | Pointclouds,
    Y: Tensor | Pointclouds,
    init_transform: SimilarityTransform | None = None,
    max_iterations: int = 100,
    relative_rmse_thr: float = 1e-6,
    estimate_scale: bool = False,
    allow_reflection: bool = False,
    verbose: bool = False,
) -> ICPSolution:
    """
    The similarity that brings X near Y: match every point with its nearest one, align the pairs, and repeat.

    It finds the optimum next to its start, so the start must be about right.

    Args:
        X: N clouds, or (N, P, D), to be moved.
        Y: N clouds, or (N, Q, D), with any numbers of points.
        init_transform: where to start; the identity by default.
        max_iterations: at most so many.
        relative_rmse_thr: stop once no problem's error falls by more than this share of it.
        estimate_scale: see `corresponding_points_alignment`.
        allow_reflection: see `corresponding_points_alignment`.
        verbose: print a line for each iteration.

    Raises:
        ValueError: batches or dimensions differ, or a start of the wrong shape.

    Warns:
        UserWarning: the last pairs leave the rotation open.
    """
    start, num_points_X = convert_pointclouds_to_tensor(X)
    target, num_points_Y = convert_pointclouds_to_tensor(Y)
    if len(start) != len(target) or start.shape[2] != target.shape[2]:
        raise ValueError(
            "Point sets X and Y have to have the same number of batches and data dimensions, got "
            f"{tuple(start.shape)} and {tuple(target.shape)}"
        )
    weights = _weights_of_points(None, start, num_points_X)
    transform = _identity(start) if init_transform is None else _checked_start(init_transform, start)
    moved = _apply(transform, start)
    rmse: Tensor | None = None
    history: list[SimilarityTransform] = []
    converged = False
    while not converged and len(history) < max_iterations:
        nearest = knn_points(moved, target, num_points_X, num_points_Y, K=1, return_nn=True).knn
        assert nearest is not None
        matched = nearest[:, :, 0]
        transform, stretch = align_weighted(start, matched, weights, estimate_scale, allow_reflection)
        moved = _apply(transform, start)
        history.append(transform)
        before, rmse = rmse, _root_mean_square(moved - matched, weights)
        converged = before is not None and bool((before - rmse <= relative_rmse_thr * before).all())
        if verbose:
            mean = rmse.detach().mean().item()
            print(f"ICP iteration {len(history)}: mean rmse = {mean:1.2e}")  # noqa: T201 - asked for
    if history:
        _warn_if_ambiguous(stretch, allow_reflection)
    result = X.update_padded(moved) if is_pointclouds(X) else moved
    return ICPSolution(converged, rmse, result, transform, history)


def _identity(points: Tensor) -> SimilarityTransform:
    N, _, D = points.shape
    R = eyes(D, N, device=points.device, dtype=points.dtype)
    return SimilarityTransform(R, points.new_zeros(N, D), points.new_ones(N))


def _checked_start(transform: SimilarityTransform, points: Tensor) -> SimilarityTransform:
    N, _, D = points.shape
    try:
        R, T, s = transform
        fits = R.shape == (N, D, D) and T.shape == (N, D) and s.shape == (N,)
    except (TypeError, ValueError, AttributeError):
        fits = False
    if not fits:
        raise ValueError(
            "The initial transformation init_transform has to be a named tuple SimilarityTransform with elements "
            f"R ({N}, {D}, {D}), T ({N}, {D}) and s ({N},)"
        )
    return transform


def _apply(transform: SimilarityTransform, points: Tensor) -> Tensor:
    R, T, s = transform
    return s[:, None, None] * (points @ R) + T[:, None]


def _root_mean_square(offsets: Tensor, weights: Tensor) -> Tensor:
    """Of vectors (N, P, D), (N,); its derivative is 0, not NaN, where all are 0."""
    mean = wmean(offsets.square().sum(2, keepdim=True), weights)[:, 0, 0]
    perfect = mean == 0
    return mean.masked_fill(perfect, 1).sqrt().masked_fill(perfect, 0)
