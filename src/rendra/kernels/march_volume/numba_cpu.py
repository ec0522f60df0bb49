"""Marching rays through a grid on the CPU: the fast twin of `reference.py`. See README.md for the backward pass.

A ray is 9 numbers here: the place of sample 0 and the step between samples, in voxels, then the length of sample 0,
the step in length and delta. The grid is flat; K channels of a voxel are `lanes`.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import prange
from numba.cpython.unsafe.tuple import tuple_setitem

from rendra.kernels.geometry import ONE, ZERO, exponential, sigmoid
from rendra.kernels.march_volume.lanes import add_scaled, dot, gather, load, multiplied, scatter, store
from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel

SIGMOID, SOFTPLUS, EXP = 1, 2, 3  # activations; 0 is none
_NOTHING = np.float32(1e-20)  # light so faint that a picture needs none of it
_RAYS_AT_ONCE = 64  # that a thread takes in turn
_SLABS = 16  # of planes along z: what threads own in the backward pass
_BYTES_AT_ONCE = 2**23  # of gradients of samples, on their way from rays to slabs


class Settings(NamedTuple):
    """How to march; the same for all rays."""

    depth: int  # voxels
    height: int
    width: int
    rays_per_grid: int
    samples: int
    is_density: int
    density_activation: int
    feature_activation: int
    stop_below: np.float32


def forward(
    grid: np.ndarray,
    rays: np.ndarray,
    occupancy: np.ndarray,
    settings: Settings,
    channels: int,
    results: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Write features (M, C), opacity (M,) and depth (M,) of M rays through a flat grid of `channels` a voxel."""
    _march(grid, rays, occupancy, settings, (ZERO,) * channels, num_threads(), *results)


def backward(
    grid: np.ndarray,
    rays: np.ndarray,
    occupancy: np.ndarray,
    settings: Settings,
    upstream: np.ndarray,
    upstream_scalars: np.ndarray,
) -> np.ndarray:
    """The gradient of the flat grid; `upstream` (M, K) has 0 and the features', the other (M, 2) opacity's and depth's."""
    channels = upstream.shape[1]
    rays_at_once = max(1, _BYTES_AT_ONCE // (4 * (channels + 1) * max(1, settings.samples)))
    grad = np.zeros_like(grid)
    _march_back(grid, rays, occupancy, settings, (ZERO,) * channels, num_threads(), upstream.reshape(-1),
                upstream_scalars, min(rays_at_once, max(1, len(rays))), grad)  # fmt: skip
    return grad


@parallel_kernel
def _march(grid, rays, occupancy, settings, lanes, workers, features, opacity, depth):
    blocks = (len(rays) + _RAYS_AT_ONCE - 1) // _RAYS_AT_ONCE
    for worker in prange(workers):
        cell = np.zeros(8 * len(lanes), np.float32)
        for block in range(worker, blocks, workers):
            for m in range(block * _RAYS_AT_ONCE, min((block + 1) * _RAYS_AT_ONCE, len(rays))):
                total, left, length = _look(grid, rays, m, occupancy, settings, lanes, cell)
                for c in range(features.shape[1]):
                    features[m, c] = total[c + 1]
                opacity[m], depth[m] = ONE - left, length


@scalar_kernel
def _look(grid, rays, m, occupancy, settings, lanes, cell):
    """What a ray sees: lanes that have the features behind their first, transmittance, depth."""
    if not _is_finite(rays, m):
        unknown = np.float32(np.nan)
        return add_scaled(lanes, unknown, lanes), unknown, unknown
    px, py, pz, dx, dy, dz = rays[m, 0], rays[m, 1], rays[m, 2], rays[m, 3], rays[m, 4], rays[m, 5]
    begin, step, delta = rays[m, 6], rays[m, 7], rays[m, 8]
    first = m // settings.rays_per_grid * settings.depth * settings.height * settings.width * len(lanes)
    faint = max(settings.stop_below, _NOTHING)
    total, left, depth = lanes, ONE, ZERO
    k, end = _span(rays, m, settings)
    while k < end and not abs(left) < faint:
        x, y, z = px + np.float32(k) * dx, py + np.float32(k) * dy, pz + np.float32(k) * dz
        empty = _empty_steps(x, y, z, dx, dy, dz, occupancy, settings)
        if empty > 0:
            k += empty
            continue
        values = _read(grid, first, x, y, z, settings, lanes, cell)
        alpha, _ = _opacity(values[0], delta, settings)
        if settings.feature_activation == SIGMOID:
            values = _sigmoids(values)
        weight = alpha * left
        total = add_scaled(total, weight, values)
        depth += weight * (begin + np.float32(k) * step)
        left *= ONE - alpha
        k += 1
    return total, left, depth


@parallel_kernel
def _march_back(grid, rays, occupancy, settings, lanes, workers, upstream, upstream_scalars, rays_at_once, grad):
    """First rays make the gradients of their samples, then slabs add up those of their voxels; chunk by chunk."""
    planes = (settings.depth + _SLABS - 1) // _SLABS
    asked = np.empty(rays_at_once * settings.samples * len(lanes), np.float32)
    steps = np.empty((rays_at_once, settings.samples), np.int32)
    pieces = np.empty((rays_at_once, _SLABS, 2), np.int32)
    for chunk in range(0, len(rays), rays_at_once):
        count = min(rays_at_once, len(rays) - chunk)
        blocks = (count + _RAYS_AT_ONCE - 1) // _RAYS_AT_ONCE
        for worker in prange(workers):
            cell, trail = np.zeros(8 * len(lanes), np.float32), np.empty((3, settings.samples), np.float32)
            for block in range(worker, blocks, workers):
                for r in range(block * _RAYS_AT_ONCE, min((block + 1) * _RAYS_AT_ONCE, count)):
                    _look_back(grid, rays, chunk + r, occupancy, settings, lanes, cell, trail, planes,
                               (upstream, upstream_scalars), (asked, r * settings.samples), steps[r], pieces[r])  # fmt: skip
        for parity in range(2):
            for worker in prange(workers):
                cell = np.zeros(8 * len(lanes), np.float32)
                for slab in range(parity + 2 * worker, _SLABS, 2 * workers):
                    for r in range(count):
                        _spread(rays, chunk + r, settings, lanes, cell, asked, r * settings.samples, steps[r],
                                pieces[r, slab, 0], pieces[r, slab, 1], grad)  # fmt: skip


@scalar_kernel
def _look_back(grid, rays, m, occupancy, settings, lanes, cell, trail, planes, upstreams, asked_from, steps, pieces):
    """The gradients of a ray's samples: lanes in `asked`, which samples in `steps`, and each slab's in `pieces`."""
    upstream, scalars = upstreams
    asked, place = asked_from
    pieces[:] = 0
    if not _is_finite(rays, m):
        return
    px, py, pz, dx, dy, dz = rays[m, 0], rays[m, 1], rays[m, 2], rays[m, 3], rays[m, 4], rays[m, 5]
    begin, step, delta = rays[m, 6], rays[m, 7], rays[m, 8]
    first = m // settings.rays_per_grid * settings.depth * settings.height * settings.width * len(lanes)
    wanted = load(upstream, m * len(lanes), lanes)
    of_depth = scalars[m, 1]
    left, entry, slab = ONE, 0, -1
    k, end = _span(rays, m, settings)
    while k < end and not abs(left) < settings.stop_below:
        x, y, z = px + np.float32(k) * dx, py + np.float32(k) * dy, pz + np.float32(k) * dz
        empty = _empty_steps(x, y, z, dx, dy, dz, occupancy, settings)
        if empty > 0:
            k += empty
            continue
        values = _read(grid, first, x, y, z, settings, lanes, cell)
        alpha, slope = _opacity(values[0], delta, settings)
        pull = add_scaled(lanes, alpha * left, wanted)
        if settings.feature_activation == SIGMOID:
            values = _sigmoids(values)
            pull = multiplied(pull, add_scaled(values, -ONE, multiplied(values, values)))
        store(asked, (place + entry) * len(lanes), pull)
        trail[0, entry], trail[1, entry] = alpha, left * slope
        trail[2, entry] = dot(wanted, values) + of_depth * (begin + np.float32(k) * step)
        here = min(max(int(math.floor(z)), 0), settings.depth - 1) // planes
        if here != slab:
            slab = here
            pieces[slab, 0] = entry
        steps[entry] = k
        entry += 1
        pieces[slab, 1] = entry
        left *= ONE - alpha
        k += 1
    behind = -scalars[m, 0]
    for i in range(entry - 1, -1, -1):
        asked[(place + i) * len(lanes)] = trail[1, i] * (trail[2, i] - behind)
        behind += trail[0, i] * (trail[2, i] - behind)


@scalar_kernel
def _spread(rays, m, settings, lanes, cell, asked, place, steps, begin, end, grad):
    """Add a piece of a ray to the voxels of its slab."""
    count = len(lanes)
    row, plane = settings.width * count, settings.height * settings.width * count
    first = m // settings.rays_per_grid * settings.depth * plane
    px, py, pz, dx, dy, dz = rays[m, 0], rays[m, 1], rays[m, 2], rays[m, 3], rays[m, 4], rays[m, 5]
    for entry in range(begin, end):
        k = np.float32(steps[entry])
        x, y, z = px + k * dx, py + k * dy, pz + k * dz
        ix, iy, iz = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
        fx, fy, fz = x - np.float32(ix), y - np.float32(iy), z - np.float32(iz)
        values = load(asked, (place + entry) * count, lanes)
        if _is_inside(ix, iy, iz, settings):
            scatter(grad, first + iz * plane + iy * row + ix * count, row, plane, fx, fy, fz, values)
            continue
        cell[:] = ZERO
        scatter(cell, 0, 2 * count, 4 * count, fx, fy, fz, values)
        for corner in range(8):
            at = _corner(corner, ix, iy, iz, settings)
            if at >= 0:
                for c in range(count):
                    grad[first + at * count + c] += cell[corner * count + c]


@scalar_kernel
def _read(grid, first, x, y, z, settings, lanes, cell):
    """The lanes at a point; voxels outside count as 0."""
    count = len(lanes)
    row, plane = settings.width * count, settings.height * settings.width * count
    ix, iy, iz = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
    fx, fy, fz = x - np.float32(ix), y - np.float32(iy), z - np.float32(iz)
    if _is_inside(ix, iy, iz, settings):
        return gather(grid, first + iz * plane + iy * row + ix * count, row, plane, fx, fy, fz, lanes)
    for corner in range(8):
        at = _corner(corner, ix, iy, iz, settings)
        for c in range(count):
            cell[corner * count + c] = grid[first + at * count + c] if at >= 0 else ZERO
    return gather(cell, 0, 2 * count, 4 * count, fx, fy, fz, lanes)


@scalar_kernel
def _is_inside(ix, iy, iz, settings):
    """Whether all 8 voxels of a cell exist."""
    return (
        ix >= 0 and iy >= 0 and iz >= 0
        and ix < settings.width - 1 and iy < settings.height - 1 and iz < settings.depth - 1
    )  # fmt: skip


@scalar_kernel
def _corner(corner, ix, iy, iz, settings):
    """Which voxel is a corner of a cell; -1 if outside."""
    x, y, z = ix + (corner & 1), iy + (corner >> 1 & 1), iz + (corner >> 2)
    if x < 0 or y < 0 or z < 0 or x >= settings.width or y >= settings.height or z >= settings.depth:
        return -1
    return (z * settings.height + y) * settings.width + x


@scalar_kernel
def _is_finite(rays, m):
    total = ZERO
    for i in range(9):
        total += rays[m, i] * ZERO
    return total == ZERO


@scalar_kernel
def _span(rays, m, settings):
    """The samples [begin, end) that can meet the volume, and at most a few more."""
    margin = ONE if settings.density_activation + settings.feature_activation == 0 else ZERO
    low, high = ZERO, np.float32(settings.samples)
    for axis in range(3):
        size = settings.width if axis == 0 else (settings.height if axis == 1 else settings.depth)
        place, step = rays[m, axis], rays[m, 3 + axis]
        near, far = -margin - place, np.float32(size - 1) + margin - place
        if step == ZERO:
            if near > ZERO or far < ZERO:
                return 0, 0
        else:
            low = max(low, min(near / step, far / step))
            high = min(high, max(near / step, far / step))
    if not low <= high:
        return 0, 0
    return max(0, int(low) - 1), min(settings.samples, int(high) + 2)


@scalar_kernel
def _empty_steps(x, y, z, dx, dy, dz, occupancy, settings):
    """How many steps from a sample are surely empty; 0 if it counts."""
    width, height, depth = settings.width - 1, settings.height - 1, settings.depth - 1
    if settings.density_activation + settings.feature_activation > 0 and not (
        x >= ZERO and y >= ZERO and z >= ZERO
        and x <= np.float32(width) and y <= np.float32(height) and z <= np.float32(depth)
    ):  # fmt: skip
        return 1
    if len(occupancy) == 0:
        return 0
    ix, sx = _cell_along(x, dx, width, occupancy.shape[2])
    iy, sy = _cell_along(y, dy, height, occupancy.shape[1])
    iz, sz = _cell_along(z, dz, depth, occupancy.shape[0])
    if occupancy[iz, iy, ix] != 0:
        return 0
    return max(1, int(min(sx, min(sy, sz))))


@scalar_kernel
def _cell_along(x, dx, last, count):
    """The cell of the occupancy around x, and the steps up to its end, within reason."""
    many = np.float32(1 << 20)
    if last == 0:
        return 0, many
    scale = np.float32(count) / np.float32(last)
    u, du = x * scale, dx * scale
    i = min(max(int(math.floor(u)), 0), count - 1)
    if du == ZERO:
        return i, many
    border = np.float32(i + 1) if du > ZERO else np.float32(i)
    if (du > ZERO and i == count - 1) or (du < ZERO and i == 0):
        return i, many
    return i, min(max((border - u) / du, ZERO), many)


@scalar_kernel
def _opacity(raw, delta, settings):
    """The opacity of a sample, and its derivative with respect to the raw value."""
    if raw != raw:
        return raw, raw
    value, slope = raw, ONE
    if settings.density_activation == SIGMOID:
        value = sigmoid(raw)
        slope = value * (ONE - value)
    elif settings.density_activation == SOFTPLUS:
        value = max(raw, ZERO) + math.log1p(exponential(-abs(raw)))
        slope = sigmoid(raw)
    elif settings.density_activation == EXP:
        value = exponential(raw)
        slope = value
    if settings.is_density:
        passed = exponential(-value * delta)
        return ONE - passed, slope * delta * passed
    return value, slope


@scalar_kernel
def _sigmoids(lanes):
    for c in range(len(lanes)):
        lanes = tuple_setitem(lanes, c, sigmoid(lanes[c]))
    return lanes
