"""Pictures of volumes in one pass, for the combinations of parts that the kernel `march_volume` knows.

They are those of the usual renderer: float32 on a CPU, trilinear, even steps along rays that need no gradient, and
one of the two ray markers of this package. What is computed is what sampling and marching one after the other
gives, up to rounding, without samples in memory.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rendra.kernels.march_volume import march_volume
from rendra.renderer.implicit.raymarching import (
    OPACITY_TOLERANCE,
    AbsorptionOnlyRaymarcher,
    EmissionAbsorptionRaymarcher,
)
from rendra.renderer.implicit.utils import HeterogeneousRayBundle, RayBundle
from rendra.structures.volumes import Volumes

_MOST_FEATURES = 31  # beyond it the kernel is not the faster way


def march_in_one_pass(
    volumes: Volumes,
    rays: RayBundle | HeterogeneousRayBundle,
    raymarcher: Callable[..., Tensor],
    kwargs: dict[str, Any],
) -> Tensor | None:
    """The picture of each volume along its rays.

    Args:
        volumes: N of them, read between voxels.
        rays: origins and directions (N, ..., 3).
        raymarcher: what the renderer would give the samples to.
        kwargs: what it would be called with.

    Returns:
        What the marcher gives, (N, ..., C + 1) or (N, ..., 1); None where the kernel does not apply.
    """
    grids = _grids_for(raymarcher, volumes, kwargs)
    if grids is None or not _are_known_rays(rays, volumes) or not _are_opacities(grids[0]):
        return None
    steps = _even_steps(rays.lengths)
    if steps is None:
        return None
    shape, count = rays.origins.shape[:-1], rays.lengths.shape[-1]
    first, step = (each.expand(shape).flatten(1) for each in steps)
    features, opacity = _march(volumes, grids, _in_voxels(rays, volumes), first, step, count)
    images = torch.cat((features, opacity[..., None]), dim=-1)
    return images.view(*shape, images.shape[-1])


def _grids_for(raymarcher: Callable[..., Tensor], volumes: Volumes, kwargs: dict[str, Any]) -> list[Tensor] | None:
    """What a marcher uses of the volumes: densities and perhaps features, (N, C, D, H, W); None if it is unknown."""
    if "eps" in kwargs or _has_hooks(raymarcher):
        return None
    densities, features = volumes.densities(), volumes.features()
    if type(raymarcher) is AbsorptionOnlyRaymarcher:
        grids = [densities]
    elif type(raymarcher) is EmissionAbsorptionRaymarcher and raymarcher.surface_thickness == 1:
        if features is None or not 1 <= features.shape[1] <= _MOST_FEATURES:
            return None
        grids = [densities, features]
    else:
        return None
    is_known = densities.shape[1] == 1 and all(
        each.device.type == "cpu" and each.dtype == torch.float32 and each.numel() > 0 for each in grids
    )
    return grids if is_known else None


def _has_hooks(module: Any) -> bool:
    return any(getattr(module, name, None) for name in ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks"))


def _are_known_rays(rays: RayBundle | HeterogeneousRayBundle, volumes: Volumes) -> bool:
    """Whether the rays are a batch for each volume, and neither they nor the volumes' places need gradients."""
    if not isinstance(rays, RayBundle) or len(rays.origins) != len(volumes):
        return False
    if any(0 in size for size in volumes.locator.sizes):
        return False
    parts = (rays.origins, rays.directions, rays.lengths)
    if any(type(each) is not Tensor or each.device.type != "cpu" or each.dtype != torch.float32 for each in parts):
        return False
    placed = volumes.get_world_to_local_coords_transform().get_matrix()
    return placed.dtype == torch.float32 and not (
        torch.is_grad_enabled() and any(each.requires_grad for each in (*parts, placed))
    )


def _are_opacities(densities: Tensor) -> bool:
    """Whether no sample can lie outside [0, 1]: of others the ray marchers warn."""
    low, high = (densities[:1] if densities.stride(0) == 0 else densities).detach().aminmax()
    return bool(low >= -OPACITY_TOLERANCE) and bool(high <= 1 + OPACITY_TOLERANCE)


def _even_steps(lengths: Tensor) -> tuple[Tensor, Tensor] | None:
    """The first length and the step of rays with even steps, (N or 1, ...); None for other rays."""
    own = lengths[tuple(slice(0, 1 if stride == 0 else None) for stride in lengths.stride()[:-1])]
    count = own.shape[-1]
    if own.numel() == 0:
        return None
    first = own[..., 0]
    step = (own[..., -1] - first) / max(1, count - 1)
    ideal = torch.addcmul(first[..., None], step[..., None], torch.arange(count, dtype=own.dtype))
    rounding = 8 * torch.finfo(own.dtype).eps * own.abs().amax()
    return (first, step) if bool(((own - ideal).abs() <= rounding).all()) else None


def _in_voxels(rays: RayBundle | HeterogeneousRayBundle, volumes: Volumes) -> tuple[Tensor, Tensor]:
    """Origins and directions (N, R, 3) in the voxels of each volume."""
    sizes = volumes.get_grid_sizes().flip(1).to(rays.origins.dtype)[:, None]  # (N, 1, 3) xyz
    half = (sizes - 1 if volumes.get_align_corners() else sizes) / 2
    to_local = volumes.get_world_to_local_coords_transform().get_matrix()[:, :3, :3]
    origins = volumes.world_to_local_coords(rays.origins.flatten(1, -2))
    return origins * half + (sizes - 1) / 2, (rays.directions.flatten(1, -2) @ to_local) * half


def _march(
    volumes: Volumes,
    grids: list[Tensor],
    places: tuple[Tensor, Tensor],
    first: Tensor,
    step: Tensor,
    count: int,
) -> tuple[Tensor, Tensor]:
    """Features (N, R, C) and opacity (N, R)."""
    origins, directions = places
    sizes = volumes.locator.sizes
    if all(size == tuple(grids[0].shape[2:]) for size in sizes):
        seen = march_volume(_interleaved(_without_copies(grids)), origins, directions, first, step, count)
        return seen.features, seen.opacity
    parts = []
    for i, (depth, height, width) in enumerate(sizes):
        own = _interleaved([each[i : i + 1, :, :depth, :height, :width] for each in grids])
        row = slice(i, i + 1)
        parts.append(march_volume(own, origins[row], directions[row], first[row], step[row], count))
    return torch.cat([each.features for each in parts]), torch.cat([each.opacity for each in parts])


def _without_copies(grids: list[Tensor]) -> list[Tensor]:
    """(1, C, D, H, W) each where all N are views of one, so that there is one gradient; as given otherwise."""
    roots = [_root(each) for each in grids]
    return [each for each in roots if each is not None] if None not in roots else grids


def _root(grids: Tensor) -> Tensor | None:
    """What N views repeat, (1, C, D, H, W); None if they are not that, or a gradient is wanted for each."""
    if len(grids) == 1 or grids.stride(0) != 0:
        return None
    if not (grids.requires_grad and torch.is_grad_enabled()):
        return grids[:1]
    base = grids._base
    if base is None or not base.requires_grad or grids.is_leaf or grids.retains_grad:
        return None
    is_whole = base.numel() == grids[0].numel() and base.is_contiguous() and grids[0].is_contiguous()
    return base.view(1, *grids.shape[1:]) if is_whole and base.data_ptr() == grids.data_ptr() else None


def _interleaved(grids: list[Tensor]) -> Tensor:
    """Channels last, side by side for each voxel."""
    interleaved: Tensor = _Interleaved.apply(*grids)
    return interleaved


class _Interleaved(torch.autograd.Function):
    """The copy, in memory of NumPy's, which asks for large pages: rays jump through it, a tenth faster."""

    @staticmethod
    def forward(ctx: Any, *grids: Tensor) -> Tensor:
        ctx.channels = [each.shape[1] for each in grids]
        shape = (len(grids[0]), *grids[0].shape[2:], sum(ctx.channels))
        return torch.cat([each.movedim(1, -1) for each in grids], dim=-1, out=torch.from_numpy(np.empty(shape, "f4")))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, ...]:
        return tuple(each.movedim(-1, 1).contiguous() for each in gradients[0].split(ctx.channels, dim=-1))
