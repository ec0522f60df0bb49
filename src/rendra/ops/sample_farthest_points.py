"""Farthest point sampling of point clouds."""

from collections.abc import Sequence

import torch
from torch import Tensor

from rendra.kernels import sample_farthest_points as kernel


def sample_farthest_points(
    points: Tensor,
    lengths: Tensor | None = None,
    K: int | Sequence[int] | Tensor = 50,
    random_start_point: bool = False,
) -> tuple[Tensor, Tensor]:
    """Take points one after the other, each time the one farthest from all those taken (Eldar et al., 1997).

    Among equally far points the one of lowest index. The same on any number of threads.

    Args:
        points: (N, P, D) floats, D any.
        lengths: (N,) how many rows of each cloud are points; None for all P. The rest may hold anything.
        K: how many to take, one number or one for each cloud. A cloud of fewer points gives all it has; coinciding
            points may then be named more than once.
        random_start_point: start at a point drawn with torch's generator instead of at index 0.

    Returns:
        The points (N, max K, D), 0 after a cloud's last, differentiable in `points`; and their indices (N, max K)
        int64, -1 after a cloud's last.

    Raises:
        ValueError: shapes that do not fit, a length or K out of range, or a point that is not finite.
    """
    lengths = _lengths(points, lengths)
    wanted = _numbers(points, K)
    start = torch.zeros_like(lengths)
    if random_start_point:
        drawn = torch.rand(len(points), dtype=torch.float64, device=points.device) * lengths
        start = torch.minimum(drawn.long(), (lengths - 1).clamp(min=0))
    _check_finite(points, lengths)
    picked = kernel.sample_farthest_points(points, lengths, torch.minimum(wanted, lengths), start)
    width = max(wanted.tolist(), default=0)
    indices = torch.nn.functional.pad(picked, (0, width - picked.shape[1]), value=-1)
    if not points.shape[1]:
        return points.new_zeros(len(points), width, points.shape[2]), indices
    rows = points.gather(1, indices.clamp(min=0)[..., None].expand(-1, -1, points.shape[2]))
    return torch.where(indices[..., None] >= 0, rows, torch.zeros_like(rows)), indices


def sample_farthest_points_naive(
    points: Tensor,
    lengths: Tensor | None = None,
    K: int | Sequence[int] | Tensor = 50,
    random_start_point: bool = False,
) -> tuple[Tensor, Tensor]:
    """The same as `sample_farthest_points`, under the name that PyTorch3D gives its version in plain Python."""
    return sample_farthest_points(points, lengths, K, random_start_point)


def _lengths(points: Tensor, lengths: Tensor | None) -> Tensor:
    if points.ndim != 3 or not points.is_floating_point():
        raise ValueError(f"points must be floats of shape (N, P, D), got {points.dtype} of {tuple(points.shape)}")
    n, most = points.shape[:2]
    if lengths is None:
        return torch.full((n,), most, dtype=torch.int64, device=points.device)
    if lengths.shape != (n,):
        raise ValueError(
            f"points and lengths must have same batch dimension: {n} clouds, lengths {tuple(lengths.shape)}"
        )
    lengths = lengths.to(points.device, torch.int64)
    known = lengths.tolist()
    if known and not 0 <= min(known) <= max(known) <= most:
        raise ValueError(f"lengths must lie between 0 and the {most} points of each cloud, got {known}")
    return lengths


def _numbers(points: Tensor, K: int | Sequence[int] | Tensor) -> Tensor:
    """How many points are wanted of each cloud. (N,)"""
    n = len(points)
    wanted = torch.as_tensor(K, device=points.device)
    if wanted.numel() and (wanted.is_floating_point() or wanted.dtype == torch.bool):
        raise ValueError(f"K must be whole numbers, got {wanted.dtype}")
    wanted = wanted.to(torch.int64)
    wanted = wanted.expand(n) if wanted.ndim == 0 else wanted
    if wanted.shape != (n,):
        raise ValueError(f"K and points must have the same batch dimension: {n} clouds, K of {tuple(wanted.shape)}")
    if min(wanted.tolist(), default=0) < 0:
        raise ValueError(f"K must not be negative, got {wanted.tolist()}")
    return wanted.contiguous()


def _check_finite(points: Tensor, lengths: Tensor) -> None:
    broken = ~points.detach().isfinite().all(dim=2)
    broken &= torch.arange(points.shape[1], device=points.device) < lengths[:, None]
    if broken.any():
        cloud, index = broken.nonzero()[0].tolist()
        raise ValueError(f"points[{cloud}, {index}] is not finite, and so has no distance to the others")
