"""Marching rays through a grid on the CPU: the fast twin of `reference.py`. See README.md for the backward pass.

A ray is 9 numbers here: the place of sample 0 and the step between samples, in voxels, then the length of sample 0,
the step in length and delta. The grid is flat; the K channels of a voxel are `lanes`. Arrays go to small functions
as pointers, so all of them are made by `forward` and `backward`, which keep them alive.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import prange
from numba.cpython.unsafe.tuple import tuple_setitem

from rendra.kernels.geometry import ONE, ZERO, exponential, sigmoid
from rendra.kernels.march_volume.lanes import add_scaled, dot, gather, load, multiplied, pointer, scatter, store
from rendra.kernels.parallel import inlined_kernel, num_threads, parallel_kernel, scalar_kernel

SIGMOID, SOFTPLUS, EXP = 1, 2, 3  # activations; 0 is none
_FAR = np.float32(1e30)
_MANY = np.float32(1 << 20)
_NOTHING = np.float32(1e-20)  # light so faint that a picture needs none of it
_RAYS_AT_ONCE = 64  # that a thread takes in turn
_SLABS = 8  # of planes along z: what threads own in the backward pass
_BYTES_AT_ONCE = 2**25  # of gradients of samples, on their way from rays to slabs


class Settings(NamedTuple):
    """How to march; the same for all rays."""

    depth: int  # voxels
    height: int
    width: int
    cells_depth: int  # of the occupancy; 0 where there is none
    cells_height: int
    cells_width: int
    rays_per_grid: int
    samples: int
    is_density: bool
    is_bounded: bool  # by the outermost centres, instead of fading
    density_activation: int
    feature_activation: int
    stop_below: np.float32


class _Chunk(NamedTuple):
    """What rays leave for slabs: for each of `rays` rays, room for all of its samples."""

    asked: np.ndarray  # (rays, S, K) gradients of samples
    steps: np.ndarray  # (rays, S) which samples
    pieces: np.ndarray  # (rays, slabs, 2) which of them are in a slab: begin, end
    trails: np.ndarray  # (workers, 3, S) what a ray needs on its way back


def forward(
    grid: np.ndarray,
    rays: np.ndarray,
    occupancy: np.ndarray,
    settings: Settings,
    channels: int,
    results: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Write features (M, C), opacity (M,) and depth (M,) of M rays through a flat grid of `channels` a voxel."""
    workers = num_threads()
    cells = np.zeros((workers, 8 * channels), np.float32)
    _march(grid, rays, occupancy, settings, (ZERO,) * channels, cells, *results)


def backward(
    grid: np.ndarray,
    rays: np.ndarray,
    occupancy: np.ndarray,
    settings: Settings,
    upstream: np.ndarray,
    of_scalars: np.ndarray,
) -> np.ndarray:
    """The gradient of the flat grid.

    `upstream` (M, K) is the gradient of 0 and the features, `of_scalars` (M, 2) that of opacity and depth.
    """
    channels, samples, workers = upstream.shape[1], settings.samples, num_threads()
    rays_at_once = min(max(1, _BYTES_AT_ONCE // (4 * (channels + 1) * max(1, samples))), max(1, len(rays)))
    cells = np.zeros((workers, 8 * channels), np.float32)
    chunk = _Chunk(
        np.empty((rays_at_once, samples, channels), np.float32),
        np.empty((rays_at_once, samples), np.int32),
        np.empty((rays_at_once, _SLABS, 2), np.int32),
        np.empty((workers, 3, samples), np.float32),
    )
    grad = np.zeros_like(grid)
    _march_back(grid, rays, occupancy, settings, (ZERO,) * channels, cells, upstream, of_scalars, *chunk, grad)
    return grad


@parallel_kernel
def _march(grid, rays, occupancy, settings, lanes, cells, features, opacity, depth):
    workers, blocks = len(cells), (len(rays) + _RAYS_AT_ONCE - 1) // _RAYS_AT_ONCE
    for worker in prange(workers):
        inputs = pointer(grid), pointer(rays), pointer(occupancy)
        cell = pointer(cells[worker])
        for block in range(worker, blocks, workers):
            for m in range(block * _RAYS_AT_ONCE, min((block + 1) * _RAYS_AT_ONCE, len(rays))):
                total, left, length = _look(inputs, m, settings, lanes, cell)
                for c in range(features.shape[1]):
                    features[m, c] = total[c + 1]
                opacity[m], depth[m] = ONE - left, length


@scalar_kernel
def _look(inputs, m, settings, lanes, cell):
    """What a ray sees: lanes that have the features behind their first, transmittance, depth."""
    grid, rays, occupancy = inputs
    px, py, pz, dx, dy, dz, begin, step, delta = _ray(rays, m)
    if not _is_finite(rays, m):
        unknown = np.float32(np.nan)
        return add_scaled(lanes, unknown, lanes), unknown, unknown
    first = _first(m, settings, lanes)
    faint = max(settings.stop_below, _NOTHING)
    total, left, depth = lanes, ONE, ZERO
    cells = _in_cells(dx, dy, dz, settings)
    k, end = _span(rays, m, settings)
    while k < end and not abs(left) < faint:
        i = np.float32(k)
        x, y, z = px + i * dx, py + i * dy, pz + i * dz
        empty = _empty_steps(x, y, z, cells, occupancy, settings)
        if empty > 0:
            k += empty
            continue
        values = _read(grid, first, x, y, z, settings, lanes, cell)
        alpha, _ = _opacity(values[0], delta, settings)
        if settings.feature_activation == SIGMOID:
            values = _sigmoids(values)
        weight = alpha * left
        total = add_scaled(total, weight, values)
        depth += weight * (begin + i * step)
        left *= ONE - alpha
        k += 1
    return total, left, depth


@parallel_kernel
def _march_back(
    grid, rays, occupancy, settings, lanes, cells, upstream, of_scalars, asked, steps, pieces, trails, grad
):
    """First rays make the gradients of their samples, then slabs add up those of their voxels; chunk by chunk."""
    workers, at_once = len(cells), len(steps)
    for chunk in range(0, len(rays), at_once):
        count = min(at_once, len(rays) - chunk)
        blocks = (count + _RAYS_AT_ONCE - 1) // _RAYS_AT_ONCE
        for worker in prange(workers):
            inputs = pointer(grid), pointer(rays), pointer(occupancy)
            upstreams = pointer(upstream), pointer(of_scalars)
            notes = pointer(asked), pointer(steps), pointer(pieces), pointer(trails[worker])
            cell = pointer(cells[worker])
            for block in range(worker, blocks, workers):
                for r in range(block * _RAYS_AT_ONCE, min((block + 1) * _RAYS_AT_ONCE, count)):
                    _look_back(inputs, chunk + r, settings, lanes, cell, upstreams, notes, r)
        for parity in range(2):
            for worker in prange(workers):
                notes = pointer(asked), pointer(steps), pointer(pieces), pointer(trails[worker])
                cell = pointer(cells[worker])
                for slab in range(parity + 2 * worker, _SLABS, 2 * workers):
                    for r in range(count):
                        _spread(pointer(rays), chunk + r, settings, lanes, cell, notes, r, slab, pointer(grad))


@scalar_kernel
def _look_back(inputs, m, settings, lanes, cell, upstreams, notes, r):
    """The gradients of the samples of ray m, the r-th of its chunk."""
    grid, rays, occupancy = inputs
    upstream, of_scalars = upstreams
    asked, steps, pieces, trail = notes
    count, samples = len(lanes), settings.samples
    for i in range(2 * _SLABS):
        pieces[2 * _SLABS * r + i] = np.int32(0)
    if not _is_finite(rays, m):
        return
    px, py, pz, dx, dy, dz, begin, step, delta = _ray(rays, m)
    first, place = _first(m, settings, lanes), r * samples
    wanted = load(upstream, m * count, lanes)
    planes = (settings.depth + _SLABS - 1) // _SLABS
    left, entry, slab, low, high = ONE, 0, -1, ZERO, ZERO
    cells = _in_cells(dx, dy, dz, settings)
    k, end = _span(rays, m, settings)
    while k < end and not abs(left) < settings.stop_below:
        i = np.float32(k)
        x, y, z = px + i * dx, py + i * dy, pz + i * dz
        empty = _empty_steps(x, y, z, cells, occupancy, settings)
        if empty > 0:
            k += empty
            continue
        values = _read(grid, first, x, y, z, settings, lanes, cell)
        alpha, slope = _opacity(values[0], delta, settings)
        pull = add_scaled(lanes, alpha * left, wanted)
        if settings.feature_activation == SIGMOID:
            values = _sigmoids(values)
            pull = multiplied(pull, add_scaled(values, -ONE, multiplied(values, values)))
        store(asked, (place + entry) * count, pull)
        trail[entry], trail[samples + entry] = alpha, left * slope
        trail[2 * samples + entry] = dot(wanted, values) + of_scalars[2 * m + 1] * (begin + i * step)
        if slab < 0 or z < low or z >= high:
            slab = min(max(_floor(z), 0), settings.depth - 1) // planes
            low = np.float32(slab * planes) if slab > 0 else -_FAR
            high = np.float32((slab + 1) * planes) if (slab + 1) * planes < settings.depth else _FAR
            pieces[2 * (_SLABS * r + slab)] = np.int32(entry)
        steps[place + entry] = np.int32(k)
        entry += 1
        pieces[2 * (_SLABS * r + slab) + 1] = np.int32(entry)
        left *= ONE - alpha
        k += 1
    behind = -of_scalars[2 * m]
    for j in range(entry - 1, -1, -1):
        gain = trail[2 * samples + j] - behind
        asked[(place + j) * count] = trail[samples + j] * gain
        behind += trail[j] * gain


@inlined_kernel
def _spread(rays, m, settings, lanes, cell, notes, r, slab, grad):
    """Add the piece of a ray that is in a slab to its voxels."""
    asked, steps, pieces, _ = notes
    begin, end = pieces[2 * (_SLABS * r + slab)], pieces[2 * (_SLABS * r + slab) + 1]
    if begin == end:
        return
    count, place = len(lanes), r * settings.samples
    row, plane, first = settings.width * count, settings.height * settings.width * count, _first(m, settings, lanes)
    px, py, pz, dx, dy, dz, _, _, _ = _ray(rays, m)
    for entry in range(begin, end):
        i = np.float32(steps[place + entry])
        x, y, z = px + i * dx, py + i * dy, pz + i * dz
        values = load(asked, (place + entry) * count, lanes)
        if _is_between(x, y, z, settings):
            ix, iy, iz = int(x), int(y), int(z)
            at = first + iz * plane + iy * row + ix * count
            fx, fy, fz = x - np.float32(ix), y - np.float32(iy), z - np.float32(iz)
            scatter(grad, at, row, plane, fx, fy, fz, values)
        else:
            _spread_at_border(grad, first, x, y, z, settings, values, cell)


@scalar_kernel
def _spread_at_border(grad, first, x, y, z, settings, values, cell):
    count = len(values)
    ix, iy, iz = _floor(x), _floor(y), _floor(z)
    for c in range(8 * count):
        cell[c] = ZERO
    scatter(cell, 0, 2 * count, 4 * count, x - np.float32(ix), y - np.float32(iy), z - np.float32(iz), values)
    for corner in range(8):
        at = _corner(corner, ix, iy, iz, settings)
        if at >= 0:
            for c in range(count):
                grad[first + at * count + c] += cell[corner * count + c]


@inlined_kernel
def _ray(rays, m):
    at = 9 * m
    return (
        rays[at], rays[at + 1], rays[at + 2], rays[at + 3], rays[at + 4], rays[at + 5],
        rays[at + 6], rays[at + 7], rays[at + 8],
    )  # fmt: skip


@inlined_kernel
def _first(m, settings, lanes):
    """Where the grid of a ray begins."""
    return m // settings.rays_per_grid * settings.depth * settings.height * settings.width * len(lanes)


@inlined_kernel
def _floor(x):
    """The integer below; a library call is slower than a sample."""
    i = int(x)
    return i - 1 if x < np.float32(i) else i


@inlined_kernel
def _read(grid, first, x, y, z, settings, lanes, cell):
    """The lanes at a point; voxels outside count as 0."""
    if not _is_between(x, y, z, settings):
        return _read_at_border(grid, first, x, y, z, settings, lanes, cell)
    count = len(lanes)
    row, plane = settings.width * count, settings.height * settings.width * count
    ix, iy, iz = int(x), int(y), int(z)
    fx, fy, fz = x - np.float32(ix), y - np.float32(iy), z - np.float32(iz)
    return gather(grid, first + iz * plane + iy * row + ix * count, row, plane, fx, fy, fz, lanes)


@scalar_kernel
def _read_at_border(grid, first, x, y, z, settings, lanes, cell):
    count = len(lanes)
    ix, iy, iz = _floor(x), _floor(y), _floor(z)
    for corner in range(8):
        at = _corner(corner, ix, iy, iz, settings)
        for c in range(count):
            cell[corner * count + c] = grid[first + at * count + c] if at >= 0 else ZERO
    fx, fy, fz = x - np.float32(ix), y - np.float32(iy), z - np.float32(iz)
    return gather(cell, 0, 2 * count, 4 * count, fx, fy, fz, lanes)


@inlined_kernel
def _is_between(x, y, z, settings):
    """Whether all 8 voxels around a point exist."""
    return (
        min(x, min(y, z)) >= ZERO
        and x < np.float32(settings.width - 1) and y < np.float32(settings.height - 1)
        and z < np.float32(settings.depth - 1)
    )  # fmt: skip


@inlined_kernel
def _corner(corner, ix, iy, iz, settings):
    """Which voxel is a corner of a cell; -1 if outside."""
    x, y, z = ix + (corner & 1), iy + (corner >> 1 & 1), iz + (corner >> 2)
    if x < 0 or y < 0 or z < 0 or x >= settings.width or y >= settings.height or z >= settings.depth:
        return -1
    return (z * settings.height + y) * settings.width + x


@inlined_kernel
def _is_finite(rays, m):
    total = ZERO
    for i in range(9):
        total += rays[9 * m + i] * ZERO
    return total == ZERO


@inlined_kernel
def _span(rays, m, settings):
    """The samples [begin, end) that can meet the volume, and at most a few more."""
    margin = ZERO if settings.is_bounded else ONE
    low, high = ZERO, np.float32(settings.samples)
    for axis in range(3):
        size = settings.width if axis == 0 else (settings.height if axis == 1 else settings.depth)
        place, step = rays[9 * m + axis], rays[9 * m + 3 + axis]
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


@inlined_kernel
def _empty_steps(x, y, z, cells, occupancy, settings):
    """How many steps from a sample are surely empty; 0 if it counts."""
    if settings.is_bounded and not (
        min(x, min(y, z)) >= ZERO
        and x <= np.float32(settings.width - 1) and y <= np.float32(settings.height - 1)
        and z <= np.float32(settings.depth - 1)
    ):  # fmt: skip
        return 1
    if settings.cells_depth == 0:
        return 0
    u, v, w = x * cells[0], y * cells[1], z * cells[2]
    i = min(max(_floor(u), 0), settings.cells_width - 1)
    j = min(max(_floor(v), 0), settings.cells_height - 1)
    k = min(max(_floor(w), 0), settings.cells_depth - 1)
    if occupancy[(k * settings.cells_height + j) * settings.cells_width + i] != 0:
        return 0
    steps = min(
        _steps_to_border(u, i, settings.cells_width, cells[3]),
        min(
            _steps_to_border(v, j, settings.cells_height, cells[4]),
            _steps_to_border(w, k, settings.cells_depth, cells[5]),
        ),
    )
    return max(1, int(steps))


@inlined_kernel
def _in_cells(dx, dy, dz, settings):
    """Cells of the occupancy a voxel along each axis, and steps a cell; 0 where there is no motion."""
    sx = np.float32(settings.cells_width) / np.float32(max(settings.width - 1, 1))
    sy = np.float32(settings.cells_height) / np.float32(max(settings.height - 1, 1))
    sz = np.float32(settings.cells_depth) / np.float32(max(settings.depth - 1, 1))
    return sx, sy, sz, _inverse(dx * sx), _inverse(dy * sy), _inverse(dz * sz)


@inlined_kernel
def _inverse(x):
    return ONE / x if x != ZERO else ZERO


@inlined_kernel
def _steps_to_border(u, i, count, steps_a_cell):
    """Steps from u to the end of its cell i; the outermost cells have none outwards."""
    if steps_a_cell == ZERO or i == (count - 1 if steps_a_cell > ZERO else 0):
        return _MANY
    border = np.float32(i + 1) if steps_a_cell > ZERO else np.float32(i)
    return min(max((border - u) * steps_a_cell, ZERO), _MANY)


@inlined_kernel
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


@inlined_kernel
def _sigmoids(lanes):
    for c in range(len(lanes)):
        lanes = tuple_setitem(lanes, c, sigmoid(lanes[c]))
    return lanes
