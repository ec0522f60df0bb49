"""What a caller may hand to `Volumes` and `VolumeLocator`, checked once and brought into one form."""

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import torch
from torch import Tensor

from rendra.structures.utils import list_to_padded

GridSize: TypeAlias = tuple[int, int, int]  # depth, height, width, in voxels


def grids_from(grids: Any, name: str) -> tuple[Tensor, list[GridSize]]:
    """
    Grids padded to one size, and the size of each, from N tensors (C, D_i, H_i, W_i) or one (N, C, D, H, W).

    Raises:
        ValueError: neither of the two, no grid in the list, or grids that differ in channels or device.
    """
    if isinstance(grids, Tensor):
        if grids.ndim != 5:
            raise ValueError(f"{name} must have shape (N, C, D, H, W), got {tuple(grids.shape)}")
        depth, height, width = grids.shape[2:]
        return grids, [(depth, height, width)] * len(grids)
    if not isinstance(grids, (list, tuple)) or not grids:
        raise ValueError(
            f"{name} must be a tensor (N, C, D, H, W) or a list of at least one tensor (C, D_i, H_i, W_i); "
            f"got {'an empty list' if isinstance(grids, (list, tuple)) else type(grids)}"
        )
    for i, grid in enumerate(grids):
        if not isinstance(grid, Tensor) or grid.ndim != 4:
            got = tuple(grid.shape) if isinstance(grid, Tensor) else type(grid)
            raise ValueError(f"{name}[{i}] must have shape (C, D, H, W), got {got}")
    for what, found in (("number of channels", {len(g) for g in grids}), ("device", {str(g.device) for g in grids})):
        if len(found) > 1:
            raise ValueError(f"all {name} must have the same {what}, got {sorted(found)}")
    sizes = [(grid.shape[1], grid.shape[2], grid.shape[3]) for grid in grids]
    return list_to_padded(grids, equisized=len(set(sizes)) == 1), sizes


def features_from(features: Any, densities: Tensor, sizes: list[GridSize]) -> Tensor | None:
    """
    Padded features (N, C, D, H, W) on the grids of the padded densities; None where there are none.

    Raises:
        ValueError: also where number, sizes or device of the grids are not those of the densities.
    """
    if features is None:
        return None
    padded, own_sizes = grids_from(features, "features")
    if len(padded) != len(densities):
        raise ValueError(f"features must have the densities' batch size, {len(densities)}; got {len(padded)}")
    for i, (own, expected) in enumerate(zip(own_sizes, sizes, strict=True)):
        if own != expected:
            raise ValueError(f"features must have the densities' sizes (D, H, W): grid {i} {expected}, got {own}")
    if padded.shape[2:] != densities.shape[2:]:
        raise ValueError(f"features must have the densities' sizes {tuple(densities.shape[2:])}")
    if padded.device != densities.device:
        raise ValueError(f"densities and features must be on one device, got {densities.device}, {padded.device}")
    return padded


def grid_sizes_from(grid_sizes: Any, batch_size: int) -> tuple[list[GridSize], GridSize]:
    """
    The size (D, H, W) of each of N grids and the smallest that holds all, from one size or a size for each.

    Raises:
        ValueError: not integers, not three for each grid, or not N grids.
    """
    listed = grid_sizes.tolist() if isinstance(grid_sizes, Tensor) else list(grid_sizes)
    rows = [row.tolist() if isinstance(row, Tensor) else row for row in listed]
    is_one_size = len(rows) == 3 and all(isinstance(row, int) for row in rows)
    sizes = [tuple(rows)] * batch_size if is_one_size else [tuple(row) for row in rows if isinstance(row, Sequence)]
    if len(sizes) != (batch_size if is_one_size else len(rows)) or len(sizes) != batch_size:
        raise ValueError(
            f"grid_sizes must be (depth, height, width), or a list of them for {batch_size} grids; got {grid_sizes}"
        )
    for size in sizes:
        if len(size) != 3 or not all(isinstance(n, int) and n >= 0 for n in size):
            raise ValueError(f"a grid size must be three integers (depth, height, width), got {size}")
    largest = tuple(rows) if is_one_size else tuple(max((s[d] for s in sizes), default=0) for d in range(3))
    return sizes, largest  # type: ignore[return-value]  # three each, as checked


def xyz_from(values: Any, name: str, batch_size: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """
    One number for each axis x, y, z and each of N grids, or for all of them. (1 or N, 3)

    Args:
        values: a number, three numbers, or a tensor of shape (), (1,), (3,), (N, 1) or (N, 3).
        name: what the messages call it.
        batch_size: N.
        device, dtype: of the result.

    Raises:
        ValueError: another shape, or numbers that are not finite.
    """
    try:
        given = values if isinstance(values, Tensor) else torch.tensor(values, dtype=torch.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be a number, three numbers or a tensor; got {values!r}") from error
    if not isinstance(values, Tensor) and not given.isfinite().all():
        raise ValueError(f"{name} must be finite, got {values}")
    shape = tuple(given.shape)
    if shape not in ((), (1,), (3,), (batch_size, 1), (batch_size, 3)):
        raise ValueError(
            f"{name} must be a number, three numbers (x, y, z), or a tensor of shape (1,), (3,), ({batch_size}, 1) "
            f"or ({batch_size}, 3); got shape {shape}"
        )
    rows = given.to(device=device, dtype=dtype).reshape(-1, shape[-1] if shape else 1)
    return rows.expand(len(rows), 3)


def check_voxel_size(voxel_size: Any) -> None:
    """
    Refuse voxels without extent, where that is known without waiting for a device.

    Raises:
        ValueError: a number given is 0 or not finite.
    """
    if isinstance(voxel_size, Tensor):
        return
    numbers = voxel_size if isinstance(voxel_size, (list, tuple)) else [voxel_size]
    if any(isinstance(n, (int, float)) and (n == 0 or not math.isfinite(n)) for n in numbers):
        raise ValueError(f"voxel_size must be finite and not 0, got {voxel_size}")
