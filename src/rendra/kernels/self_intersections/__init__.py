"""The pairs of triangles of one surface that cross each other."""

import torch
from torch import Tensor

from rendra.kernels.self_intersections import numba_cpu, reference

__all__ = ["crossing_pairs"]


def crossing_pairs(tris: Tensor, tolerance: float) -> Tensor:
    """All pairs of triangles that pass through each other by more than a tolerance; not differentiable.

    Triangles that touch, lie in one plane, or meet at a corner or edge with the same coordinates do not cross. The
    same on any number of threads.

    Args:
        tris: (F, 3, 3) corners.
        tolerance: a length: distances up to it are zero.

    Returns:
        (K, 2) int64, the lower index first, in lexicographic order.

    Raises:
        ValueError: a shape, type or tolerance that cannot be.
    """
    if tris.ndim != 3 or tris.shape[1:] != (3, 3) or not tris.is_floating_point():
        raise ValueError(f"tris must be floats of shape (F, 3, 3), got {tris.dtype} of {tuple(tris.shape)}")
    if not tolerance >= 0:
        raise ValueError(f"tolerance must be a length, zero or more, got {tolerance}")
    if tris.device.type != "cpu" or tris.dtype != torch.float32:
        return reference.crossing_pairs(tris.detach(), tolerance)
    return _pairs_on_cpu(tris.detach(), float(tolerance))


@torch.library.custom_op("rendra::crossing_pairs", mutates_args=(), device_types="cpu")
def _pairs_on_cpu(tris: Tensor, tolerance: float) -> Tensor:
    return torch.from_numpy(numba_cpu.crossing_pairs(tris.contiguous().numpy(), tolerance))


@_pairs_on_cpu.register_fake
def _(tris, tolerance):  # type: ignore[no-untyped-def]
    return tris.new_empty((torch.library.get_ctx().new_dynamic_size(), 2), dtype=torch.int64)
