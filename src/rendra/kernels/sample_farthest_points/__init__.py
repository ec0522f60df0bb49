"""Farthest point sampling: each new point is the one farthest from all those taken before."""

import torch
from torch import Tensor

from rendra.kernels.sample_farthest_points import numba_cpu, reference

__all__ = ["sample_farthest_points"]


def sample_farthest_points(points: Tensor, lengths: Tensor, num_samples: Tensor, start: Tensor) -> Tensor:
    """Greedy choice of points that are far apart (Gonzalez 1985; Eldar et al. 1997); `reference.py` has the rules.

    Equal on every number of threads, and for float32 equal to the reference to the bit. Not differentiable.

    Args:
        points: (N, P, D) floats; finite in the first `lengths[n]` rows of each cloud, whatever in the rest.
        lengths: (N,) int64, at most P.
        num_samples: (N,) int64, how many to take; never more than there are.
        start: (N,) int64, the first that is taken, below `lengths[n]` where that is not 0.

    Returns:
        (N, max num_samples) int64, indices in the order in which they were taken; -1 after a cloud's last.

    Raises:
        ValueError: a shape, type, device or number that cannot be.
    """
    if points.ndim != 3 or not points.is_floating_point():
        raise ValueError(f"points must be floats of shape (N, P, D), got {points.dtype} of {tuple(points.shape)}")
    for name, value in (("lengths", lengths), ("num_samples", num_samples), ("start", start)):
        if value.shape != points.shape[:1] or value.dtype != torch.int64 or value.device != points.device:
            raise ValueError(
                f"{name} must be int64 of shape ({len(points)},) on {points.device}, got {value.dtype} of "
                f"{tuple(value.shape)} on {value.device}"
            )
    known = torch.stack([lengths, num_samples, start], dim=1).tolist()
    for n, (length, number, first) in enumerate(known):
        if not 0 <= length <= points.shape[1] or number < 0 or not 0 <= first < max(length, 1):
            raise ValueError(
                f"cloud {n} of {points.shape[1]} points cannot have length {length}, {number} samples and start "
                f"{first}"
            )
    if points.device.type != "cpu" or points.dtype != torch.float32:
        return reference.sample_farthest_points(points.detach(), lengths, num_samples, start)
    return _sample_on_cpu(points.detach(), lengths, num_samples, start)


@torch.library.custom_op("rendra::sample_farthest_points", mutates_args=(), device_types="cpu")
def _sample_on_cpu(points: Tensor, lengths: Tensor, num_samples: Tensor, start: Tensor) -> Tensor:
    width = int(num_samples.max()) if len(points) else 0
    picked = torch.full((len(points), width), -1)
    numba_cpu.forward(
        points.contiguous().numpy(), lengths.contiguous().numpy(), num_samples.contiguous().numpy(),
        start.contiguous().numpy(), picked.numpy(),
    )  # fmt: skip
    return picked


@_sample_on_cpu.register_fake
def _(points, lengths, num_samples, start):  # type: ignore[no-untyped-def]
    width = torch.library.get_ctx().new_dynamic_size()
    return points.new_empty((len(points), width), dtype=torch.int64)
