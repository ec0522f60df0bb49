"""Where space is empty: a grid of occupied cells, its update, and the samples of rays that lie in them.

Müller et al., "Instant neural graphics primitives", SIGGRAPH 2022, appendix on ray marching; Li et al., "NerfAcc",
2022. Letters: R rays, M samples of all rays, P points. Grids are (D, H, W), cells along z, y, x of a box whose
corners are the rows of `box` (2, 3): least and greatest x, y, z.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.kernels.occupancy import numba_cpu, reference

__all__ = ["Samples", "cells_of", "dilate", "occupied_cells", "traverse", "update_density_grid"]


class Samples(NamedTuple):
    """Samples of rays, packed one ray after the other, first the nearest.

    Attributes:
        ray_first: (R + 1,) int64, index of each ray's first sample, and M at the end.
        starts: (M,) distance along the ray at which a sample begins, in lengths of the direction.
        ends: (M,) where it ends.
        ray_index: (M,) int64, the ray of each sample.
    """

    ray_first: Tensor
    starts: Tensor
    ends: Tensor
    ray_index: Tensor


def traverse(
    origins: Tensor,
    directions: Tensor,
    nearest: Tensor,
    farthest: Tensor,
    occupied: Tensor,
    box: Tensor,
    step: float,
    offset: Tensor | None = None,
    growth: float = 0.0,
    max_samples: int | None = None,
    opacity: Tensor | None = None,
    stop_below: float = 0.0,
) -> Samples:
    """The samples of rays whose middles lie in occupied cells; `reference.py` states each rule.

    Sample k of a ray begins at t_k = nearest + (offset + k) step and ends at t_{k+1}, the last one at `farthest`.
    With growth > 0 that holds up to the distance step / growth, and beyond it t_{k+1} = (1 + growth) t_k: samples as
    long as max(step, growth t). Empty cells are crossed cell by cell, and empty blocks at once, without asking their
    samples; the result is the same as if all were asked. Where it is known how opaque cells are, rays end where light
    does. Not differentiable; the same on any number of threads.

    Args:
        origins: (R, 3) where rays begin.
        directions: (R, 3); distances along a ray are in lengths of its direction: world units if it has length 1.
        nearest: (R,) distance from which a ray is sampled.
        farthest: (R,) up to where; may be infinite, as the box ends. Where nearest < farthest fails there is nothing.
        occupied: (D, H, W) bool.
        box: (2, 3) the corners of the grid.
        step: length of a sample, as a distance along the ray.
        offset: (R,) shift of each ray's samples in steps, in [0, 1): uniform noise in training; None is 0.
        growth: of samples with the distance, in [0, 1]: 1/256 for a scene without end; 0 leaves them equally long.
        max_samples: most samples of one ray, the nearest stay; None is all.
        opacity: (D, H, W) in [0, 1], of a sample in each cell; not checked to lie there.
        stop_below: in [0, 1]: a ray ends where the product of (1 - opacity) over its samples falls below it: these
            are the samples that `rendra.kernels.composite.visible` sees of all. 0 lets light reach everything.

    Raises:
        ValueError: a shape, type, device or number that cannot be; stop_below without opacity; a step so
            short that there are more than 2^28 samples.
    """
    _check_rays(origins, directions, {"nearest": nearest, "farthest": farthest, "offset": offset})
    _check_grid("occupied", occupied, torch.bool, origins.device)
    _check_box(box, origins)
    if not (0 < step < math.inf and 0 <= growth <= 1):
        raise ValueError(f"step must be positive and finite and growth in [0, 1], got {step} and {growth}")
    if max_samples is not None and max_samples < 1:
        raise ValueError(f"max_samples must be at least 1, or None for all, got {max_samples}")
    _check_light(opacity, stop_below, occupied, origins)
    opacity = None if opacity is None or not stop_below else opacity.detach()
    offset = torch.zeros_like(nearest) if offset is None else offset
    rays = origins.detach(), directions.detach(), nearest.detach(), farthest.detach(), offset.detach()
    if origins.device.type != "cpu" or origins.dtype != torch.float32:
        return Samples(
            *reference.traverse(rays, occupied, box.detach(), step, growth, max_samples, opacity, stop_below)
        )
    settings = float(step), float(growth), max_samples, opacity, float(stop_below)
    return Samples(*_traverse_on_cpu(*rays, occupied, box.detach(), *settings))


def cells_of(points: Tensor, box: Tensor, size: tuple[int, int, int]) -> Tensor:
    """Index (P,) of the cell of each point in `grid.flatten()`, -1 outside the box.

    Args:
        points: (P, 3).
        box: (2, 3) the corners of the grid.
        size: (D, H, W) of the grid.

    Raises:
        ValueError: a shape, type, device or box that cannot be.
    """
    if points.ndim != 2 or points.shape[1] != 3 or not points.is_floating_point():
        raise ValueError(f"points must be floats of shape (P, 3), got {points.dtype} of {tuple(points.shape)}")
    _check_box(box, points)
    depth, height, width = size
    ends = torch.tensor([width, height, depth], device=points.device)
    places = ((points.detach() - box[0]) * (ends.to(box.dtype) / (box[1] - box[0]))).floor()
    inside = ((places >= 0) & (places < ends)).all(1)
    x, y, z = torch.where(inside[:, None], places, 0.0).to(torch.int64).unbind(1)
    return torch.where(inside, (z * height + y) * width + x, -1)


def update_density_grid(density_grid: Tensor, cells: Tensor, densities: Tensor, decay: float = 0.95) -> Tensor:
    """A new grid with max(decay * old, new) in the cells that were looked at, and the old density in the others.

    What has vanished fades away; what is there stays, even where one look misses it.

    Args:
        density_grid: (D, H, W) greatest densities seen.
        cells: (P,) int64 from `cells_of`; a cell may stand there many times, -1 is ignored.
        densities: (P,) found at points of those cells.
        decay: in [0, 1].

    Raises:
        ValueError: a shape, type, device or decay that cannot be.
    """
    _check_grid("density_grid", density_grid, densities.dtype, densities.device)
    if cells.ndim != 1 or cells.dtype != torch.int64 or cells.device != densities.device:
        raise ValueError(f"cells must be int64 of shape (P,) on {densities.device}, got {cells.dtype} of "
                         f"{tuple(cells.shape)} on {cells.device}")  # fmt: skip
    if densities.shape != cells.shape or not densities.is_floating_point():
        raise ValueError(f"densities must be floats, one for each of {len(cells)} cells, got {densities.dtype} of "
                         f"{tuple(densities.shape)}")  # fmt: skip
    if not 0 <= decay <= 1:
        raise ValueError(f"decay must be in [0, 1], got {decay}")
    inside = cells >= 0
    cells, densities = cells[inside], densities.detach()[inside]
    old = density_grid.flatten()
    faded = old.index_copy(0, cells, decay * old.index_select(0, cells))  # equal writes where a cell stands twice
    return faded.scatter_reduce(0, cells, densities, "amax").view_as(density_grid)


def occupied_cells(density_grid: Tensor, threshold: float, dilation: bool = False) -> Tensor:
    """Cells (D, H, W) with a density above min(threshold, the mean of all): bool.

    The mean lets something through while a young field is thin everywhere.

    Args:
        density_grid: (D, H, W).
        threshold: density above which a cell counts, in 1 / length.
        dilation: whether the 26 neighbours of these cells count too.

    Raises:
        ValueError: the grid is no grid of floats, or holds NaN.
    """
    if density_grid.ndim != 3 or not density_grid.is_floating_point() or not density_grid.numel():
        raise ValueError(f"density_grid must be floats of shape (D, H, W), none 0, got {density_grid.dtype} of "
                         f"{tuple(density_grid.shape)}")  # fmt: skip
    mean = float(density_grid.mean(dtype=torch.float64))
    if math.isnan(mean):
        raise ValueError("density_grid holds NaN: the field that it was updated with has diverged")
    occupied = density_grid > min(threshold, mean)
    return dilate(occupied) if dilation else occupied


def dilate(occupied: Tensor) -> Tensor:
    """Cells (D, H, W) that are occupied, or have a neighbour that is, across a side, an edge or a corner: bool."""
    for axis in range(3):
        padded, size = F.pad(occupied, [0, 0] * (2 - axis) + [1, 1]), occupied.shape[axis]
        occupied = occupied | padded.narrow(axis, 0, size) | padded.narrow(axis, 2, size)
    return occupied


def _check_rays(origins: Tensor, directions: Tensor, per_ray: dict[str, Tensor | None]) -> None:
    if origins.ndim != 2 or origins.shape[1] != 3 or not origins.is_floating_point():
        raise ValueError(f"origins must be floats of shape (R, 3), got {origins.dtype} of {tuple(origins.shape)}")
    shapes = {"directions": (directions, origins.shape)}
    shapes |= {name: (tensor, origins.shape[:1]) for name, tensor in per_ray.items() if tensor is not None}
    for name, (tensor, shape) in shapes.items():
        if tensor.shape != shape or tensor.dtype != origins.dtype or tensor.device != origins.device:
            raise ValueError(
                f"{name} must be {origins.dtype} of shape {tuple(shape)} on {origins.device}, like the origins, got "
                f"{tensor.dtype} of {tuple(tensor.shape)} on {tensor.device}"
            )


def _check_grid(name: str, grid: Tensor, dtype: torch.dtype, device: torch.device) -> None:
    if grid.ndim != 3 or grid.dtype != dtype or grid.device != device or not grid.numel():
        raise ValueError(
            f"{name} must be {dtype} of shape (D, H, W), none 0, on {device}, got {grid.dtype} of "
            f"{tuple(grid.shape)} on {grid.device}"
        )


def _check_light(opacity: Tensor | None, stop_below: float, occupied: Tensor, origins: Tensor) -> None:
    if not 0 <= stop_below <= 1:
        raise ValueError(f"stop_below must be a transmittance in [0, 1], got {stop_below}")
    if opacity is None:
        if stop_below > 0:
            raise ValueError(f"stop_below={stop_below} needs the opacity of the cells, got None")
        return
    _check_grid("opacity", opacity, origins.dtype, origins.device)
    if opacity.shape != occupied.shape:
        raise ValueError(
            f"opacity must have the shape of occupied, {tuple(occupied.shape)}, got {tuple(opacity.shape)}"
        )


def _check_box(box: Tensor, points: Tensor) -> None:
    if box.shape != (2, 3) or box.dtype != points.dtype or box.device != points.device:
        raise ValueError(
            f"box must be {points.dtype} of shape (2, 3) on {points.device}, got {box.dtype} of "
            f"{tuple(box.shape)} on {box.device}"
        )
    low, high = box.tolist()
    if not all(math.isfinite(a) and math.isfinite(b) and a < b for a, b in zip(low, high, strict=True)):
        raise ValueError(f"box must be its least corner and its greatest, finite, got {low} and {high}")


@torch.library.custom_op("rendra::traverse", mutates_args=(), device_types="cpu")
def _traverse_on_cpu(
    origins: Tensor,
    directions: Tensor,
    nearest: Tensor,
    farthest: Tensor,
    offset: Tensor,
    occupied: Tensor,
    box: Tensor,
    step: float,
    growth: float,
    max_samples: int | None,
    opacity: Tensor | None,
    stop_below: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rays = (
        origins.contiguous().numpy(), directions.contiguous().numpy(), nearest.contiguous().numpy(),
        farthest.contiguous().numpy(), offset.contiguous().numpy(),
    )  # fmt: skip
    most = numba_cpu.LATTICE_END if max_samples is None else max_samples
    cells, corners = occupied.contiguous().numpy(), box.contiguous().numpy()
    opacities = None if opacity is None else opacity.contiguous().numpy()
    results = numba_cpu.forward(rays, cells, corners, step, growth, most, opacities, stop_below)
    ray_first, starts, ends, ray_index = map(torch.from_numpy, results)
    return ray_first, starts, ends, ray_index


@_traverse_on_cpu.register_fake
def _(origins, directions, nearest, farthest, offset, occupied, box, *settings):  # type: ignore[no-untyped-def]
    total = torch.library.get_ctx().new_dynamic_size()
    ray_first = origins.new_empty((len(origins) + 1,), dtype=torch.int64)
    starts = origins.new_empty((total,))
    return ray_first, starts, torch.empty_like(starts), torch.empty_like(starts, dtype=torch.int64)
