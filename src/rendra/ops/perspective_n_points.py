"""
The pose of a calibrated camera from points in the world and where they are seen.

Source: Lepetit, Moreno-Noguer, Fua, "EPnP: An Accurate O(n) Solution to the PnP Problem", IJCV 2009; section and
equation numbers refer to it.
Letters: N problems, P points, 4 control points of which each point is an affine combination, S candidates.
Frames: row vectors, a world point x is at x R + T before the camera, and seen at (X / Z, Y / Z).
"""

from itertools import combinations
from typing import NamedTuple

import torch
from torch import Tensor

from rendra.ops.matrix_factors import symmetric_eigen
from rendra.ops.points_alignment import align_weighted
from rendra.ops.utils import convert_pointclouds_to_tensor, wmean
from rendra.structures.pointclouds import Pointclouds

_FLAT = 1e-4  # a cloud thinner than this share of its length counts as a plane (Sec. 3.1: then 3 control points)
_PAIRS = tuple(combinations(range(4), 2))  # of control points; those of point 1 lie off a plane
_GAUSS_NEWTON_STEPS = 10  # "less than 10 iterations" (Sec. 3.4)


class EpnpSolution(NamedTuple):
    """The pose, the points that it rests on, and how well it fits."""

    x_cam: Tensor  # (N, P, 3) the points before the camera, from their control points
    R: Tensor  # (N, 3, 3)
    T: Tensor  # (N, 3)
    err_2d: Tensor  # (N,) weighted mean distance between where x R + T and y are seen
    err_3d: Tensor  # (N,) weighted mean squared distance between x R + T and x_cam


def efficient_pnp(
    x: Tensor | Pointclouds,
    y: Tensor,
    weights: Tensor | None = None,
    skip_quadratic_eq: bool = False,
) -> EpnpSolution:
    """
    The extrinsic parameters of a camera, in closed form and linear time.

    Six points or more in general position give the exact pose; four and five, or a noisy view of a plane, may have
    several. Planes are recognised. Computed in float64, returned in the type of `x`.

    Args:
        x: N clouds of world points, or (N, P, 3).
        y: (N, P, 2) where they are seen, at unit focal length and without a principal point:
            y = (X / Z, Y / Z), in PyTorch3D's axes or any other.
        weights: (N, P) non-negative; all points count alike if None.
        skip_quadratic_eq: take the first eigenvector alone (Sec. 3.3, case N = 1), which is faster and worse.
            Otherwise combinations of one to four eigenvectors are tried, each refined by Gauss-Newton steps on
            its coefficients (Sec. 3.4), and the one with the smallest error in the image is returned.

    Raises:
        ValueError: shapes that do not fit together, or fewer than four points.
    """
    points, counts = convert_pointclouds_to_tensor(x)
    shares = _checked_weights(points, counts, y, weights).double()
    world, seen = points.double(), y.double()
    controls, affine, flat = _control_points(world, shares)
    vectors = _null_vectors(affine, seen, shares, flat)
    coefficients = _coefficients(vectors, controls, flat, skip_quadratic_eq)  # (N, S, 4)
    camera_controls = torch.einsum("nsk,nkjc->nsjc", coefficients, vectors)
    solutions = _poses(world, seen, shares, affine[:, None] @ camera_controls)
    best = solutions.err_2d.argmin(1)
    problems = torch.arange(len(best), device=best.device)
    return EpnpSolution(*(part[problems, best].to(points.dtype) for part in solutions))


def _checked_weights(points: Tensor, counts: Tensor, y: Tensor, weights: Tensor | None) -> Tensor:
    """Weights (N, P) that sum to 1, 0 in the padding."""
    N, P = points.shape[:2]
    if points.shape[2] != 3 or y.shape != (N, P, 2):
        raise ValueError(
            "x and y must have shapes (N, P, 3) and (N, P, 2) with the same N and P, "
            f"got {tuple(points.shape)} and {tuple(y.shape)}"
        )
    if weights is not None and weights.shape != (N, P):
        raise ValueError(
            f"weights must have the same first two dimensions as x, {(N, P)}; got {tuple(weights.shape)}"
        )
    if N and (counts < 4).any():
        raise ValueError(f"a pose needs at least 4 points, got {counts.tolist()}")
    real = (torch.arange(P, device=points.device) < counts[:, None]).to(points.dtype)
    shares = real if weights is None else weights * real
    return shares / shares.sum(1, keepdim=True).clamp(min=torch.finfo(shares.dtype).tiny)


def _control_points(world: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """
    The centroid and the ends of the principal axes, (N, 4, 3), and every point as their combination (Eq. 1).

    Returns:
        Control points; coefficients (N, P, 4), whose rows sum to 1; which clouds are flat (N,) bool. Point 1, at
        the end of the shortest axis, has no part in a flat cloud.
    """
    centroid = wmean(world, weights)
    centred = world - centroid
    variances, axes = symmetric_eigen((centred * weights[..., None]).mT @ centred)
    longest = variances[:, 2:].clamp(min=torch.finfo(variances.dtype).eps ** 2)
    thin = variances <= _FLAT**2 * longest
    lengths = torch.where(thin, longest, variances).sqrt()  # (N, 3), shortest first
    controls = torch.cat([centroid, centroid + lengths[..., None] * axes.mT], 1)
    flat = thin[:, 0]
    along = centred @ axes / lengths[:, None]
    along = torch.cat([along[..., :1].masked_fill(flat[:, None, None], 0), along[..., 1:]], -1)
    return controls, torch.cat([1 - along.sum(-1, keepdim=True), along], -1), flat


def _null_vectors(affine: Tensor, seen: Tensor, weights: Tensor, flat: Tensor) -> Tensor:
    """The four sets of camera control points that best project onto `seen` (Eq. 5-8), best first. (N, 4, 4, 3)"""
    one, zero = torch.ones_like(seen[..., 0]), torch.zeros_like(seen[..., 0])
    rows = torch.stack(
        [torch.stack([one, zero, -seen[..., 0]], -1), torch.stack([zero, one, -seen[..., 1]], -1)], 2
    )  # (N, P, 2, 3): Eq. 5 and 6
    system = (affine[:, :, None, :, None] * rows[..., None, :]).flatten(3).flatten(1, 2)  # (N, 2P, 12)
    normal = (system * weights.repeat_interleave(2, 1)[..., None]).mT @ system
    # on a plane point 1 takes no part: a stiff spring to the origin keeps it out of the null space
    spring = torch.zeros(12, dtype=normal.dtype, device=normal.device)
    spring[3:6] = 1
    stiffness = flat * normal.diagonal(dim1=1, dim2=2).sum(1)
    _, vectors = symmetric_eigen(normal + torch.diag_embed(stiffness[:, None] * spring))
    return vectors[..., :4].mT.unflatten(-1, (4, 3))


def _coefficients(vectors: Tensor, controls: Tensor, flat: Tensor, only_first: bool) -> Tensor:
    """
    How to combine the null vectors so that the control points keep their distances (Eq. 10-14).

    Returns:
        (N, S, 4), S = 1 with `only_first`, else 4.
    """
    first, second = torch.tensor(_PAIRS, device=vectors.device).unbind(1)
    edges = vectors[:, :, first] - vectors[:, :, second]  # (N, 4, 6, 3)
    products = torch.einsum("nkpc,nlpc->npkl", edges, edges)  # (N, 6, 4, 4): squared length = b^T products b
    squares = (controls[:, first] - controls[:, second]).square().sum(-1)  # (N, 6)
    counted = ~(flat[:, None] & ((first == 1) | (second == 1)))
    products, squares = products * counted[..., None, None], squares * counted
    if only_first:
        return _linearised(products, squares, 1)[:, None]
    starts = torch.stack([_linearised(products, squares, size) for size in (1, 2, 3, 4)], 1)
    return _refined(starts, products, squares)


def _linearised(products: Tensor, squares: Tensor, size: int) -> Tensor:
    """
    Coefficients of the first `size` vectors, from their products as unknowns of their own. (N, 4)

    Ten products of four coefficients are more than six equations: there only those with the first one are kept.
    """
    pairs = [(k, m) for k in range(size) for m in range(k, size) if size < 4 or k == 0]
    columns = torch.stack([products[..., k, m] * (1 if k == m else 2) for k, m in pairs], -1)  # (N, 6, U)
    gram = columns.mT @ columns
    ridge = 1e-12 * gram.diagonal(dim1=1, dim2=2).sum(1) + torch.finfo(gram.dtype).tiny
    gram = gram + ridge[:, None, None] * torch.eye(len(pairs), dtype=gram.dtype, device=gram.device)
    unknowns = torch.linalg.solve(gram, (columns.mT @ squares[..., None])[..., 0])
    outer = unknowns.new_zeros(len(unknowns), size, size)
    for column, (k, m) in enumerate(pairs):
        outer[:, k, m] = outer[:, m, k] = unknowns[:, column]
    values, directions = symmetric_eigen(outer)  # the outer product b b^T nearest to the unknowns
    scale = values[:, -1:].clamp(min=torch.finfo(values.dtype).eps).sqrt()
    return torch.nn.functional.pad(scale * directions[..., -1], (0, 4 - size))


def _refined(starts: Tensor, products: Tensor, squares: Tensor) -> Tensor:
    """Gauss-Newton steps on the errors of the squared distances (Eq. 15), damped so that none makes it worse."""
    best, damping = starts, torch.full_like(starts[..., :1], 1e-6)
    identity = torch.eye(4, dtype=starts.dtype, device=starts.device)
    for _ in range(_GAUSS_NEWTON_STEPS):
        half = torch.einsum("npkl,nsl->nspk", products, best)
        residuals = (half * best[:, :, None]).sum(-1) - squares[:, None]  # (N, S, 6)
        jacobian = 2 * half
        gram = jacobian.mT @ jacobian
        ridge = damping * gram.diagonal(dim1=2, dim2=3).sum(-1, keepdim=True) + torch.finfo(gram.dtype).tiny
        slope = (jacobian.mT @ residuals[..., None])[..., 0]
        tried = best - torch.linalg.solve(gram + ridge[..., None] * identity, slope)
        error = (torch.einsum("npkl,nsk,nsl->nsp", products, tried, tried) - squares[:, None]).square().sum(-1)
        better = (error < residuals.square().sum(-1))[..., None]
        best, damping = torch.where(better, tried, best), torch.where(better, damping / 10, damping * 100)
    return best


def _poses(world: Tensor, seen: Tensor, weights: Tensor, x_cam: Tensor) -> EpnpSolution:
    """The pose of each candidate x_cam (N, S, P, 3), turned before the camera: fields (N, S, ...)."""
    N, S, P, _ = x_cam.shape
    shares = weights[:, None].expand(N, S, P)
    depth = (x_cam[..., 2] * shares).sum(-1)[..., None, None]
    x_cam = torch.where(depth < 0, -x_cam, x_cam)
    flattened = (world[:, None].expand_as(x_cam).flatten(0, 1), x_cam.flatten(0, 1), shares.flatten(0, 1))
    (R, T, _), _ = align_weighted(*flattened)
    R, T = R.unflatten(0, (N, S)), T.unflatten(0, (N, S))
    placed = world[:, None] @ R + T[:, :, None]
    offsets = placed[..., :2] / placed[..., 2:].clamp(min=1e-9) - seen[:, None]
    err_2d = (_lengths(offsets) * shares).sum(-1)
    err_3d = ((placed - x_cam).square().sum(-1) * shares).sum(-1)
    return EpnpSolution(x_cam, R, T, err_2d, err_3d)


def _lengths(vectors: Tensor) -> Tensor:
    """Norms whose derivative is 0, not NaN, at 0."""
    squared = vectors.square().sum(-1)
    return squared.masked_fill(squared == 0, 1).sqrt().masked_fill(squared == 0, 0)
