"""The pairs of balls of one body that overlap, for many bodies at once: a broad phase."""

import torch
from torch import Tensor

from rendra.kernels.sphere_pairs import numba_cpu, reference

__all__ = ["sphere_pairs"]


def sphere_pairs(centers: Tensor, radii: Tensor, groups: Tensor, group_pairs: Tensor) -> tuple[Tensor, Tensor]:
    """All pairs of balls, of groups that are looked at, nearer to each other than the sum of their radii.

    Exact: no pair is left out or added. Not differentiable. The same on any number of threads.

    Args:
        centers: (N, S, 3) middles of the S balls of N bodies.
        radii: (N, S), at least 0. A ball that is not finite meets no other; one of radius 0 is a point.
        groups: (S,) int64, at least 0: which group each ball belongs to, in all bodies.
        group_pairs: (K, 2) int64: the pairs of groups to look at, in either order; a group with itself too.

    Returns:
        first: (N + 1,) int64, where the pairs of each body begin, and their number at the end.
        pairs: (M, 2) int64, balls of one body, the lower index first, in lexicographic order within each body.

    Raises:
        ValueError: shapes, types or numbers that cannot be, or tensors on several devices.
    """
    _check(centers, radii, groups, group_pairs)
    centers, radii = centers.detach(), radii.detach().to(centers.dtype)
    if centers.device.type != "cpu" or centers.dtype != torch.float32:
        return reference.sphere_pairs(centers, radii, groups, group_pairs)
    return _pairs_on_cpu(centers, radii, groups, group_pairs)


@torch.library.custom_op("rendra::sphere_pairs", mutates_args=(), device_types="cpu")
def _pairs_on_cpu(centers: Tensor, radii: Tensor, groups: Tensor, group_pairs: Tensor) -> tuple[Tensor, Tensor]:
    arrays = (tensor.contiguous().numpy() for tensor in (centers, radii, groups, group_pairs))
    first, pairs = numba_cpu.sphere_pairs(*arrays)
    return torch.from_numpy(first), torch.from_numpy(pairs)


@_pairs_on_cpu.register_fake
def _(centers, radii, groups, group_pairs):  # type: ignore[no-untyped-def]
    pairs = groups.new_empty((torch.library.get_ctx().new_dynamic_size(), 2))
    return groups.new_empty(len(centers) + 1), pairs


def _check(centers: Tensor, radii: Tensor, groups: Tensor, group_pairs: Tensor) -> None:
    if centers.ndim != 3 or centers.shape[2] != 3 or not centers.is_floating_point():
        raise ValueError(f"centers must be floats of shape (N, S, 3), got {centers.dtype} of {tuple(centers.shape)}")
    if radii.shape != centers.shape[:2] or not radii.is_floating_point():
        wanted = tuple(centers.shape[:2])
        raise ValueError(f"radii must be floats of shape {wanted}, got {radii.dtype} of {tuple(radii.shape)}")
    if groups.shape != centers.shape[1:2] or groups.dtype != torch.int64:
        raise ValueError(
            f"groups must be int64 of shape ({centers.shape[1]},), got {groups.dtype} of {tuple(groups.shape)}"
        )
    if group_pairs.ndim != 2 or group_pairs.shape[1] != 2 or group_pairs.dtype != torch.int64:
        raise ValueError(
            f"group_pairs must be int64 of shape (K, 2), got {group_pairs.dtype} of {tuple(group_pairs.shape)}"
        )
    for name, tensor in {"radii": radii, "groups": groups, "group_pairs": group_pairs}.items():
        if tensor.device != centers.device:
            raise ValueError(f"{name} must be on {centers.device}, like centers, got {tensor.device}")
        if tensor.numel() and bool((tensor < 0).any()):
            raise ValueError(f"{name} must be at least 0, got {tensor.min().item():g}")
