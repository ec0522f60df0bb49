"""Rays through a grid of density and features: sampled and composited in one pass, without keeping samples."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.kernels.march_volume import numba_cpu, reference

__all__ = ["MarchedRays", "march_volume"]

_MODES = ("opacity", "density")
_ACTIVATIONS = ("none", "sigmoid", "softplus", "exp")
_LANES = (1, 2, 4, 8, 16, 32)  # channels that kernels are compiled for


class MarchedRays(NamedTuple):
    """What rays see."""

    features: Tensor  # (N, R, C) sum of weight times feature: over black
    opacity: Tensor  # (N, R) one minus what is left of light from behind
    depth: Tensor  # (N, R) sum of weight times length


def march_volume(
    grid: Tensor,
    origins: Tensor,
    directions: Tensor,
    first_length: Tensor | float,
    step_length: Tensor | float,
    num_samples: int,
    *,
    mode: str = "opacity",
    delta: Tensor | float | None = None,
    activations: tuple[str, str] = ("none", "none"),
    occupancy: Tensor | None = None,
    stop_below: float = 0.0,
) -> MarchedRays:
    """March evenly spaced samples of rays through grids, front to back.

    Sample j of a ray lies at origin + (first_length + j step_length) direction, in voxels: the voxel [z, y, x] of a
    grid has its centre at (x, y, z). Between voxels values are trilinear, and fade to 0 over one voxel outside the
    outermost centres, as `grid_sample` with padding zeros has it. With w_j = a_j prod_{k<j} (1 - a_k) a ray sees
    sum_j w_j f_j. Differentiable with respect to the grid on every device, bit-equal on any number of threads, and
    through the reference with respect to the rays. What costs time are the samples between the voxels; those outside
    are never visited. Jittered samples are rays with their own `first_length`.

    Args:
        grid: (N, D, H, W, 1 + C): channel 0 the density or opacity, then features. (1, ...): one grid for all rays,
            of which there is one gradient.
        origins: (N, R, 3) xyz in voxels.
        directions: (N, R, 3) voxels a unit of length.
        first_length: of sample 0: a number, or a tensor that expands to (N, R).
        step_length: from sample to sample: a number, or a tensor that expands to (N, R).
        num_samples: S of each ray.
        mode: "opacity": channel 0 is a_j, the opacity of a sample in [0, 1], however far the next one is. "density":
            it is sigma >= 0 with a_j = 1 - exp(-sigma delta).
        delta: the distance from sample to sample in the units whose inverse densities have: a number, or a tensor
            that expands to (N, R). Belongs to "density", where it must be given.
        activations: of channel 0 and of the features, after interpolation: "none", "sigmoid", "softplus", "exp" for
            the first, "none" or "sigmoid" for the second. With one of them the volume ends at its outermost
            centres: there is nothing to fade to.
        occupancy: (d, h, w) bool or uint8, of any resolution: cells that divide the box between the outermost
            centres evenly. Samples in cells that are 0 are left out; outside the box the nearest cell counts.
        stop_below: a ray ends where less light than this is left, and everything behind counts as empty; 0: never.

    Returns:
        `MarchedRays`. A ray with numbers that are not finite sees NaN.

    Raises:
        ValueError: a shape, type, device, number or word that cannot be.
    """
    _check_grid(grid, origins, directions)
    _check_words(mode, activations, delta)
    _check_numbers(num_samples, stop_below)
    if occupancy is not None:
        _check_occupancy(occupancy, grid.device)
    scalars = [
        _a_ray("first_length", first_length, origins),
        _a_ray("step_length", step_length, origins),
        _a_ray("delta", 1.0 if delta is None else delta, origins),
    ]
    rays = torch.cat((origins, directions, torch.stack(scalars, dim=-1)), dim=-1)
    is_fast = grid.device.type == "cpu" and grid.dtype == torch.float32 and grid.shape[-1] <= _LANES[-1]
    is_fast = is_fast and grid[:1, ..., 0].numel() < 2**31  # voxels are counted in 32 bits
    if not is_fast or (rays.requires_grad and torch.is_grad_enabled()):
        return MarchedRays(
            *reference.march_volume(grid, rays, occupancy, num_samples, mode, activations, float(stop_below))
        )
    seen = _march_on_cpu(
        _padded(grid), _in_steps(rays), occupancy, num_samples, mode, *activations, float(stop_below)
    )
    return MarchedRays(seen[0][..., : grid.shape[-1] - 1], seen[1], seen[2])


def _padded(grid: Tensor) -> Tensor:
    """The grid with as many channels as kernels are compiled for."""
    channels = next(count for count in _LANES if count >= grid.shape[-1])
    return F.pad(grid, (0, channels - grid.shape[-1])) if channels > grid.shape[-1] else grid


def _in_steps(rays: Tensor) -> Tensor:
    """Origin and direction as the place of sample 0 and the step to the next one, in voxels."""
    origins, directions, lengths = rays.detach().split(3, dim=-1)
    first, step = lengths[..., 0:1], lengths[..., 1:2]
    return torch.cat((origins + first * directions, step * directions, lengths), dim=-1)


@torch.library.custom_op("rendra::march_volume", mutates_args=(), device_types="cpu")
def _march_on_cpu(
    grid: Tensor,
    rays: Tensor,
    occupancy: Tensor | None,
    num_samples: int,
    mode: str,
    density_activation: str,
    feature_activation: str,
    stop_below: float,
) -> tuple[Tensor, Tensor, Tensor]:
    count = rays.shape[0] * rays.shape[1]
    cells = _cells(occupancy)
    settings = _settings(grid, rays, cells, num_samples, mode, density_activation, feature_activation, stop_below)
    features, opacity, depth = _empty_results(grid, rays)
    numba_cpu.forward(
        grid.detach().contiguous().view(-1).numpy(), rays.reshape(count, 9).numpy(), cells, settings, grid.shape[-1],
        (features.view(count, grid.shape[-1] - 1).numpy(), opacity.view(-1).numpy(), depth.view(-1).numpy()),
    )  # fmt: skip
    return features, opacity, depth


@_march_on_cpu.register_fake
def _(grid, rays, occupancy, num_samples, mode, density_activation, feature_activation, stop_below):  # type: ignore[no-untyped-def]
    return _empty_results(grid, rays)


@torch.library.custom_op("rendra::march_volume_backward", mutates_args=(), device_types="cpu")
def _gradient_on_cpu(
    grid: Tensor,
    rays: Tensor,
    occupancy: Tensor | None,
    num_samples: int,
    mode: str,
    density_activation: str,
    feature_activation: str,
    stop_below: float,
    upstream: Tensor,
    of_scalars: Tensor,
) -> Tensor:
    cells = _cells(occupancy)
    settings = _settings(grid, rays, cells, num_samples, mode, density_activation, feature_activation, stop_below)
    count = rays.shape[0] * rays.shape[1]
    grad = numba_cpu.backward(
        grid.detach().contiguous().view(-1).numpy(), rays.reshape(count, 9).numpy(), cells, settings,
        upstream.reshape(count, grid.shape[-1]).numpy(), of_scalars.reshape(count, 2).numpy(),
    )  # fmt: skip
    return torch.from_numpy(grad).view(grid.shape)


@_gradient_on_cpu.register_fake
def _(grid, rays, *_):  # type: ignore[no-untyped-def]
    return torch.empty_like(grid, memory_format=torch.contiguous_format)


def _remember(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    ctx.save_for_backward(*inputs[:3])
    ctx.settings = inputs[3:]


def _gradient(ctx, of_features, of_opacity, of_depth):  # type: ignore[no-untyped-def]
    upstream = F.pad(of_features, (1, 0))
    scalars = torch.stack((of_opacity, of_depth), dim=-1)
    return _gradient_on_cpu(*ctx.saved_tensors, *ctx.settings, upstream, scalars), *[None] * 7


_march_on_cpu.register_autograd(_gradient, setup_context=_remember)


def _empty_results(grid: Tensor, rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    shape = rays.shape[:2]
    return rays.new_empty((*shape, grid.shape[-1] - 1)), rays.new_empty(shape), rays.new_empty(shape)


def _settings(
    grid: Tensor,
    rays: Tensor,
    cells: np.ndarray,
    num_samples: int,
    mode: str,
    density_activation: str,
    feature_activation: str,
    stop_below: float,
) -> numba_cpu.Settings:
    depth, height, width = grid.shape[1:4]
    n, r = rays.shape[:2]
    first, rest = _ACTIVATIONS.index(density_activation), _ACTIVATIONS.index(feature_activation)
    return numba_cpu.Settings(
        depth, height, width, cells.shape[0], cells.shape[1], cells.shape[2],
        max(1, n * r if len(grid) == 1 else r), num_samples, mode == "density", first + rest > 0, first, rest,
        np.float32(stop_below),
    )  # fmt: skip


def _cells(occupancy: Tensor | None) -> np.ndarray:
    """The occupancy as kernels read it; without cells where there is none."""
    if occupancy is None:
        return np.empty((0, 0, 0), np.uint8)
    return occupancy.contiguous().view(torch.uint8).numpy()


def _a_ray(name: str, given: Tensor | float, origins: Tensor) -> Tensor:
    """A number or tensor as one number a ray, (N, R)."""
    numbers = torch.as_tensor(given, dtype=origins.dtype, device=origins.device)
    try:
        return numbers.expand(origins.shape[:2])
    except RuntimeError:
        raise ValueError(
            f"{name} must be a number or expand to (N, R) = {tuple(origins.shape[:2])}, got {tuple(numbers.shape)}"
        ) from None


def _check_grid(grid: Tensor, origins: Tensor, directions: Tensor) -> None:
    if grid.ndim != 5 or min(grid.shape[1:], default=0) < 1 or not grid.is_floating_point():
        raise ValueError(
            f"grid must be floats of shape (N or 1, D, H, W, 1 + C), got {grid.dtype} of {tuple(grid.shape)}"
        )
    if origins.ndim != 3 or origins.shape[-1] != 3 or directions.shape != origins.shape:
        raise ValueError(
            "origins and directions must both have shape (N, R, 3), got "
            f"{tuple(origins.shape)} and {tuple(directions.shape)}"
        )
    if len(grid) not in (1, len(origins)):
        raise ValueError(f"there must be 1 grid, or one for each of {len(origins)} batches of rays; got {len(grid)}")
    for name, each in (("origins", origins), ("directions", directions)):
        if each.dtype != grid.dtype or each.device != grid.device:
            raise ValueError(f"{name} must be {grid.dtype} on {grid.device}, got {each.dtype} on {each.device}")


def _check_words(mode: str, activations: tuple[str, str], delta: Tensor | float | None) -> None:
    if mode not in _MODES:
        raise ValueError(f"mode must be one of {', '.join(_MODES)}; got {mode!r}")
    if len(activations) != 2 or activations[0] not in _ACTIVATIONS or activations[1] not in _ACTIVATIONS[:2]:
        raise ValueError(
            f"activations must be one of {', '.join(_ACTIVATIONS)}, and one of {', '.join(_ACTIVATIONS[:2])}; "
            f"got {activations!r}"
        )
    if (delta is None) == (mode == "density"):
        raise ValueError(f"delta belongs to mode='density' and to no other; got mode={mode!r} and delta={delta!r}")


def _check_numbers(num_samples: int, stop_below: float) -> None:
    if num_samples < 0:
        raise ValueError(f"num_samples must not be negative, got {num_samples}")
    if not 0 <= stop_below < 1:
        raise ValueError(f"stop_below must be in [0, 1), got {stop_below}")


def _check_occupancy(occupancy: Tensor, device: torch.device) -> None:
    if occupancy.ndim != 3 or min(occupancy.shape) < 1 or occupancy.dtype not in (torch.bool, torch.uint8):
        raise ValueError(
            f"occupancy must be bool or uint8 of shape (d, h, w), got {occupancy.dtype} of {tuple(occupancy.shape)}"
        )
    if occupancy.device != device:
        raise ValueError(f"occupancy must be on {device}, got {occupancy.device}")
