"""Marching rays through a grid on the CPU: the fast twin of `reference.py`. See README.md for the backward pass.

A ray is 9 numbers here: the place of sample 0 and the step between samples, in voxels, then the length of sample 0,
the step in length and delta. The grid is flat; the K channels of a voxel are `lanes`. Arrays go to small functions
as pointers, so all of them are made by `forward` and `backward`, which keep them alive.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from rendra.kernels.geometry import ONE, TWO, ZERO, exponential, sigmoid
from rendra.kernels.march_volume.lanes import (
    BLOCK,
    add_scaled,
    dot,
    gather,
    load,
    multiplied,
    pointer,
    scatter,
    store,
    weighted_sum,
)
from rendra.kernels.parallel import inlined_kernel, num_threads, parallel_kernel, scalar_kernel

SIGMOID, SOFTPLUS, EXP = 1, 2, 3  # activations; 0 is none
_MANY = 1 << 31  # more than steps and voxels along an axis
_MOST_OFF = 3  # samples by which a clipped ray is usually too long, at either end
_NOTHING = np.float32(1e-20)  # light so faint that a picture needs none of it
A3, A5, A7, A9, A11, A13 = (np.float32(1.0 / k) for k in range(3, 14, 2))
_AT, _LEVEL = 2 * BLOCK, 3 * BLOCK  # where voxels and planes are in the whole numbers of a bench, behind samples
_RAW, _ALPHA, _SLOPE, _WEIGHT, _VALUES = (i * BLOCK for i in range(5, 10))  # in the others; weights are first
_RAYS_AT_ONCE, _SLABS = 64, 8  # that a thread takes in turn; of planes along z, that it owns in the backward pass
_NOTED = 2 * _SLABS + 2  # numbers that a ray leaves for slabs
_BYTES_AT_ONCE = 2**22  # of gradients of samples, on their way from rays to slabs


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
    steps: np.ndarray  # (rays S + a block) which samples
    pieces: (
        np.ndarray
    )  # (rays, 2 slabs + 2) which of them are in a slab, and which samples not at a border: begin, end
    trails: np.ndarray  # (workers, 4, S) what a ray needs on its way back


def forward(
    grid: np.ndarray,
    rays: np.ndarray,
    occupancy: np.ndarray,
    settings: Settings,
    channels: int,
    results: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Write features (M, C), opacity (M,) and depth (M,) of M rays through a flat grid of `channels` a voxel."""
    _march(grid, rays, occupancy, settings, (ZERO,) * channels, *_benches(channels), *results)


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
    chunk = _Chunk(
        np.empty((rays_at_once, samples, channels), np.float32),
        np.zeros(rays_at_once * samples + BLOCK, np.int32),
        np.empty((rays_at_once, _NOTED), np.int32),
        np.empty((workers, 4, samples), np.float32),
    )
    grad = np.zeros(grid.shape, np.float32)
    _march_back(
        grid, rays, occupancy, settings, (ZERO,) * channels, *_benches(channels), upstream, of_scalars, *chunk, grad
    )
    return grad


def _benches(channels: int) -> tuple[np.ndarray, np.ndarray]:
    """For each thread what a block of samples needs: whole numbers, and others."""
    workers = num_threads()
    return (
        np.zeros((workers, 4 * BLOCK), np.int32),
        np.zeros((workers, _VALUES + (BLOCK + 8) * channels), np.float32),
    )


@parallel_kernel
def _march(grid, rays, occupancy, settings, lanes, places, scratch, features, opacity, depth):
    workers, blocks = len(scratch), (len(rays) + _RAYS_AT_ONCE - 1) // _RAYS_AT_ONCE
    for worker in prange(workers):
        inputs = pointer(grid), pointer(rays), pointer(occupancy)
        bench = pointer(places[worker]), pointer(scratch[worker])
        for block in range(worker, blocks, workers):
            for m in range(block * _RAYS_AT_ONCE, min((block + 1) * _RAYS_AT_ONCE, len(rays))):
                total, left, length = _look(inputs, m, settings, lanes, bench)
                for c in range(features.shape[1]):
                    features[m, c] = total[c + 1]
                opacity[m], depth[m] = ONE - left, length


@scalar_kernel
def _look(inputs, m, settings, lanes, bench):
    """What a ray sees: lanes that have the features behind their first, transmittance, depth."""
    rays, (places, scratch) = inputs[1], bench
    if not _is_finite(rays, m):
        unknown = np.float32(np.nan)
        return add_scaled(lanes, unknown, lanes), unknown, unknown
    ray = _ray(rays, m)
    faint = max(settings.stop_below, _NOTHING)
    total, left, depth = lanes, ONE, ZERO
    cells = _in_cells(ray, settings)
    k, end = _span(ray, settings)
    between = _between(ray, k, end, settings)
    while k < end and not abs(left) < faint:
        count, k = _next_samples(places, ray, k, end, cells, inputs[2], settings)
        _read(inputs, m, ray, count, between, settings, lanes, bench)
        _opacities(scratch, ray[8], settings)
        if settings.feature_activation == SIGMOID:
            _sigmoids(scratch, lanes)
        seen = count
        for j in range(count):
            weight = scratch[_ALPHA + j] * left
            scratch[_WEIGHT + j] = weight
            depth += weight * (ray[6] + np.float32(places[j]) * ray[7])
            left *= ONE - scratch[_ALPHA + j]
            if abs(left) < faint:
                seen = j + 1
                break
        total = weighted_sum(total, scratch, _WEIGHT, _VALUES, seen)
    return total, left, depth


@parallel_kernel
def _march_back(
    grid, rays, occupancy, settings, lanes, places, scratch, upstream, of_scalars, asked, steps, pieces, trails, grad
):
    """First rays make the gradients of their samples, then slabs add up those of their voxels; chunk by chunk."""
    workers, at_once = len(scratch), len(asked)
    for chunk in range(0, len(rays), at_once):
        count = min(at_once, len(rays) - chunk)
        blocks = (count + _RAYS_AT_ONCE - 1) // _RAYS_AT_ONCE
        for worker in prange(workers):
            inputs = pointer(grid), pointer(rays), pointer(occupancy)
            upstreams = pointer(upstream), pointer(of_scalars)
            notes = pointer(asked), pointer(steps), pointer(pieces), pointer(trails[worker])
            bench = pointer(places[worker]), pointer(scratch[worker])
            for block in range(worker, blocks, workers):
                for r in range(block * _RAYS_AT_ONCE, min((block + 1) * _RAYS_AT_ONCE, count)):
                    _look_back(inputs, chunk + r, settings, lanes, bench, upstreams, notes, r)
        for parity in range(2):
            for worker in prange(workers):
                notes = pointer(asked), pointer(steps), pointer(pieces), pointer(trails[worker])
                bench = pointer(places[worker]), pointer(scratch[worker])
                for slab in range(parity + 2 * worker, _SLABS, 2 * workers):
                    for r in range(count):
                        _spread(pointer(rays), chunk + r, settings, lanes, bench, notes, r, slab, pointer(grad))


@scalar_kernel
def _look_back(inputs, m, settings, lanes, bench, upstreams, notes, r):
    """The gradients of the samples of ray m, the r-th of its chunk."""
    rays, (places, scratch) = inputs[1], bench
    upstream, of_scalars = upstreams
    asked, steps, pieces, trail = notes
    count, samples = len(lanes), settings.samples
    piece = _NOTED * r
    for i in range(_NOTED):
        pieces[piece + i] = np.int32(0)
    if not _is_finite(rays, m):
        return
    ray = _ray(rays, m)
    place = r * samples
    wanted = load(upstream, m * count, lanes)
    of_length = of_scalars[2 * m + 1]
    left, entry, last, low, high = ONE, 0, -1, 0, 0
    planes = (settings.depth + _SLABS - 1) // _SLABS
    cells = _in_cells(ray, settings)
    k, end = _span(ray, settings)
    between = _between(ray, k, end, settings)
    pieces[piece + 2 * _SLABS], pieces[piece + 2 * _SLABS + 1] = np.int32(between[0]), np.int32(between[1])
    while k < end and not abs(left) < settings.stop_below:
        found, k = _next_samples(places, ray, k, end, cells, inputs[2], settings)
        _read(inputs, m, ray, found, between, settings, lanes, bench)
        _opacities(scratch, ray[8], settings)
        if settings.feature_activation == SIGMOID:
            _sigmoids(scratch, lanes)
        kept = found
        for j in range(found):
            alpha = scratch[_ALPHA + j]
            scratch[_WEIGHT + j] = alpha * left
            trail[entry + j], trail[samples + entry + j] = ONE - alpha, left * scratch[_SLOPE + j]
            left *= ONE - alpha
            if abs(left) < settings.stop_below:
                kept = j + 1
                break
        for j in range(kept):
            worth = dot(wanted, load(scratch, _VALUES + j * count, lanes))
            worth += of_length * (ray[6] + np.float32(places[j]) * ray[7])
            trail[2 * samples + entry + j], trail[3 * samples + entry + j] = worth, worth * scratch[_ALPHA + j]
        _ask(scratch, kept, wanted, settings, lanes, asked, (place + entry) * count)
        for j in range(kept):
            steps[place + entry + j] = places[j]
            level = places[_LEVEL + j]
            if not low <= level < high:
                slab = min(max(level, 0), settings.depth - 1) // planes
                low = slab * planes if slab > 0 else -_MANY
                high = (slab + 1) * planes if (slab + 1) * planes < settings.depth else _MANY
                pieces[piece + 2 * slab] = np.int32(entry + j)
                if last >= 0:
                    pieces[piece + 2 * last + 1] = np.int32(entry + j)
                last = slab
        entry += kept
    if last >= 0:
        pieces[piece + 2 * last + 1] = np.int32(entry)
    behind = -of_scalars[2 * m]
    for j in range(entry - 1, -1, -1):
        asked[(place + j) * count] = trail[samples + j] * (trail[2 * samples + j] - behind)
        behind = trail[3 * samples + j] + trail[j] * behind


@inlined_kernel
def _ask(scratch, number, wanted, settings, lanes, asked, at):
    """The gradients of samples' raw features: those of the ray times their weights, through the activation."""
    count = len(lanes)
    if settings.feature_activation == SIGMOID:
        for c in range(BLOCK * count):
            value = scratch[_VALUES + c]
            scratch[_VALUES + c] = value - value * value
        for j in range(number):
            pull = add_scaled(lanes, scratch[_WEIGHT + j], wanted)
            store(asked, at + j * count, multiplied(pull, load(scratch, _VALUES + j * count, lanes)))
    else:
        for j in range(number):
            store(asked, at + j * count, add_scaled(lanes, scratch[_WEIGHT + j], wanted))


@inlined_kernel
def _spread(rays, m, settings, lanes, bench, notes, r, slab, grad):
    """Add the piece of a ray that is in a slab to its voxels."""
    asked, steps, pieces, _ = notes
    places, scratch = bench
    piece = _NOTED * r
    begin, end = pieces[piece + 2 * slab], pieces[piece + 2 * slab + 1]
    if begin == end:
        return
    count, place = len(lanes), r * settings.samples
    row, plane, first = settings.width * count, settings.height * settings.width * count, _first(m, settings, lanes)
    ray = _ray(rays, m)
    low, high = pieces[piece + 2 * _SLABS], pieces[piece + 2 * _SLABS + 1]
    for entry in range(begin, end, BLOCK):
        for j in range(BLOCK):
            places[j] = steps[place + entry + j]
        _place(places, scratch, ray, settings)
        for j in range(min(BLOCK, end - entry)):
            values = load(asked, (place + entry + j) * count, lanes)
            if low <= places[j] < high:
                at = first + np.int64(places[_AT + j]) * count
                scatter(grad, at, row, plane, scratch, j, values)
            else:
                _spread_at_border(grad, first, _floors(ray, places[j]), settings, values, scratch, j)


@scalar_kernel
def _spread_at_border(grad, first, corner, settings, values, scratch, j):
    count = len(values)
    cell = _VALUES + BLOCK * count
    for c in range(8 * count):
        scratch[cell + c] = ZERO
    scatter(scratch, cell, 2 * count, 4 * count, scratch, j, values)
    for i in range(8):
        at = _corner(i, corner, settings)
        if at >= 0:
            for c in range(count):
                grad[first + at * count + c] += scratch[cell + i * count + c]


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
def _point(ray, k):
    """Where sample k is."""
    i = np.float32(k)
    return ray[0] + i * ray[3], ray[1] + i * ray[4], ray[2] + i * ray[5]


@inlined_kernel
def _floors(ray, k):
    """The first voxel of the cell of sample k."""
    x, y, z = _point(ray, k)
    return _floor(x), _floor(y), _floor(z)


@inlined_kernel
def _next_samples(places, ray, k, end, cells, occupancy, settings):
    """Note the next samples that count, a block of them if there are so many; their number, and where to go on."""
    if settings.cells_depth == 0:
        _count_up(places, 0, k)
        count = min(BLOCK, end - k)
        return count, k + count
    count = 0
    while k < end and count < BLOCK:
        steps, is_occupied = _steps_in_cell(_point(ray, k), cells, occupancy, settings)
        steps = min(steps, end - k)
        if is_occupied:
            steps = min(steps, BLOCK - count)
            _count_up(places, count, k)
            count += steps
        k += steps
    return count, k


@inlined_kernel
def _count_up(places, first, k):
    for j in range(BLOCK):
        places[first + j] = np.int32(k + j)


@inlined_kernel
def _place(places, scratch, ray, settings):
    """Cells and weights of the block of samples in `places`."""
    width, height = np.int32(settings.width), np.int32(settings.height)
    for j in range(BLOCK):
        x, y, z = _point(ray, places[j])
        ix, iy, iz = _floor_32(x), _floor_32(y), _floor_32(z)
        places[_AT + j] = np.int32(np.int32(np.int32(np.int32(iz * height) + iy) * width) + ix)
        places[_LEVEL + j] = iz
        y, z = y - np.float32(iy), z - np.float32(iz)
        scratch[j] = x - np.float32(ix)
        scratch[BLOCK + j] = (ONE - y) * (ONE - z)
        scratch[2 * BLOCK + j] = y * (ONE - z)
        scratch[3 * BLOCK + j] = (ONE - y) * z
        scratch[4 * BLOCK + j] = y * z


@inlined_kernel
def _floor_32(x):
    i = np.int32(x)
    return np.int32(i - np.int32(x < np.float32(i)))


@inlined_kernel
def _read(inputs, m, ray, found, between, settings, lanes, bench):
    """The raw values of a block of samples; voxels outside count as 0."""
    grid, (places, scratch), count = inputs[0], bench, len(lanes)
    row, plane, first = settings.width * count, settings.height * settings.width * count, _first(m, settings, lanes)
    _place(places, scratch, ray, settings)
    low, high = between
    for j in range(found):
        if low <= places[j] < high:
            values = gather(grid, first + np.int64(places[_AT + j]) * count, row, plane, scratch, j, lanes)
        else:
            values = _read_at_border(grid, first, _floors(ray, places[j]), settings, lanes, scratch, j)
        store(scratch, _VALUES + j * count, values)
        scratch[_RAW + j] = values[0]


@scalar_kernel
def _read_at_border(grid, first, corner, settings, lanes, scratch, j):
    count = len(lanes)
    cell = _VALUES + BLOCK * count
    for i in range(8):
        at = _corner(i, corner, settings)
        for c in range(count):
            scratch[cell + i * count + c] = grid[first + at * count + c] if at >= 0 else ZERO
    return gather(scratch, cell, 2 * count, 4 * count, scratch, j, lanes)


@inlined_kernel
def _is_between(ray, k, settings):
    """Whether all 8 voxels around sample k exist."""
    x, y, z = _point(ray, k)
    return (
        min(x, min(y, z)) >= ZERO
        and x < np.float32(settings.width - 1) and y < np.float32(settings.height - 1)
        and z < np.float32(settings.depth - 1)
    )  # fmt: skip


@inlined_kernel
def _is_within(ray, k, settings):
    """Whether sample k is in the box of the outermost centres."""
    x, y, z = _point(ray, k)
    return (
        min(x, min(y, z)) >= ZERO
        and x <= np.float32(settings.width - 1) and y <= np.float32(settings.height - 1)
        and z <= np.float32(settings.depth - 1)
    )  # fmt: skip


@inlined_kernel
def _corner(corner, cell, settings):
    """Which voxel is a corner of a cell; -1 if outside."""
    x, y, z = cell[0] + (corner & 1), cell[1] + (corner >> 1 & 1), cell[2] + (corner >> 2)
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
def _span(ray, settings):
    """The samples [begin, end) of a ray that count, or see voxels outside fade and at most a few more."""
    if not settings.is_bounded:
        return _clip(ray, ONE, settings)
    begin, end = _clip(ray, ZERO, settings)
    for _ in range(_MOST_OFF):
        begin += begin < end and not _is_within(ray, begin, settings)
        end -= begin < end and not _is_within(ray, end - 1, settings)
    if begin < end and not (_is_within(ray, begin, settings) and _is_within(ray, end - 1, settings)):
        return _trimmed(ray, begin, end, settings)
    return begin, end


@scalar_kernel
def _trimmed(ray, begin, end, settings):
    """The same sample by sample, for rays with so many steps a voxel that rounding counts."""
    while begin < end and not _is_within(ray, begin, settings):
        begin += 1
    while begin < end and not _is_within(ray, end - 1, settings):
        end -= 1
    return begin, end


@inlined_kernel
def _between(ray, begin, end, settings):
    """Where in [begin, end) all 8 voxels around samples exist: nearly all of that interval, as axes are monotone.

    The others are read voxel by voxel, which is right everywhere.
    """
    low, high = _clip(ray, ZERO, settings)
    low, high = max(low, begin), min(high, end)
    for _ in range(_MOST_OFF):
        low += low < high and not _is_between(ray, low, settings)
        high -= low < high and not _is_between(ray, high - 1, settings)
    if low < high and _is_between(ray, low, settings) and _is_between(ray, high - 1, settings):
        return low, high
    return 0, 0


@inlined_kernel
def _clip(ray, margin, settings):
    """The samples [begin, end) in the box of the outermost centres and a margin, and at most a few more."""
    low, high = ZERO, np.float32(settings.samples)
    for axis in range(3):
        size = settings.width if axis == 0 else (settings.height if axis == 1 else settings.depth)
        near, far = -margin - ray[axis], np.float32(size - 1) + margin - ray[axis]
        step = ray[3 + axis]
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
def _steps_in_cell(point, cells, occupancy, settings):
    """How many steps, one at least, are surely in the same cell of the occupancy, and whether that counts."""
    u, v, w = point[0] * cells[0], point[1] * cells[1], point[2] * cells[2]
    i = min(max(_floor(u), 0), settings.cells_width - 1)
    j = min(max(_floor(v), 0), settings.cells_height - 1)
    k = min(max(_floor(w), 0), settings.cells_depth - 1)
    steps = min(
        _steps_to_border(u, i, settings.cells_width, cells[3]),
        min(
            _steps_to_border(v, j, settings.cells_height, cells[4]),
            _steps_to_border(w, k, settings.cells_depth, cells[5]),
        ),
    )
    is_occupied = occupancy[(k * settings.cells_height + j) * settings.cells_width + i] != 0
    return max(1, int(steps)), is_occupied


@inlined_kernel
def _in_cells(ray, settings):
    """Cells of the occupancy a voxel along each axis, and steps a cell; 0 where there is no motion."""
    sx = np.float32(settings.cells_width) / np.float32(max(settings.width - 1, 1))
    sy = np.float32(settings.cells_height) / np.float32(max(settings.height - 1, 1))
    sz = np.float32(settings.cells_depth) / np.float32(max(settings.depth - 1, 1))
    return sx, sy, sz, _inverse(ray[3] * sx), _inverse(ray[4] * sy), _inverse(ray[5] * sz)


@inlined_kernel
def _inverse(x):
    return ONE / x if x != ZERO else ZERO


@inlined_kernel
def _steps_to_border(u, i, count, steps_a_cell):
    """Steps from u to the end of its cell i; the outermost cells have none outwards."""
    if steps_a_cell == ZERO or i == (count - 1 if steps_a_cell > ZERO else 0):
        return np.float32(_MANY)
    border = np.float32(i + 1) if steps_a_cell > ZERO else np.float32(i)
    return min(max((border - u) * steps_a_cell, ZERO), np.float32(_MANY))


@inlined_kernel
def _opacities(scratch, delta, settings):
    """The opacities of a block of samples, and their derivatives with respect to the raw values."""
    for j in range(BLOCK):
        scratch[_ALPHA + j], scratch[_SLOPE + j] = scratch[_RAW + j], ONE
    if settings.density_activation == SIGMOID:
        for j in range(BLOCK):
            value = sigmoid(scratch[_RAW + j])
            scratch[_ALPHA + j], scratch[_SLOPE + j] = value, value * (ONE - value)
    elif settings.density_activation == SOFTPLUS:
        for j in range(BLOCK):
            scratch[_ALPHA + j], scratch[_SLOPE + j] = _softplus(scratch[_RAW + j])
    elif settings.density_activation == EXP:
        for j in range(BLOCK):
            value = exponential(scratch[_RAW + j])
            scratch[_ALPHA + j], scratch[_SLOPE + j] = value, value
    if settings.is_density:
        for j in range(BLOCK):
            passed = exponential(-scratch[_ALPHA + j] * delta)
            scratch[_ALPHA + j] = ONE - passed
            scratch[_SLOPE + j] = scratch[_SLOPE + j] * delta * passed
    if settings.is_density or settings.density_activation != 0:  # what limits exponents, hides what is not a number
        for j in range(BLOCK):
            raw = scratch[_RAW + j]
            scratch[_ALPHA + j] += raw - raw if raw != raw else ZERO


@inlined_kernel
def _softplus(x):
    """log(1 + exp(x)) in float32 to 2e-8 relative, and its derivative: see README.md."""
    e = exponential(-abs(x))
    s = e / (TWO + e)
    q = s * s
    series = ONE + q * (A3 + q * (A5 + q * (A7 + q * (A9 + q * (A11 + q * A13)))))
    slope = ONE / (ONE + e)
    return max(x, ZERO) + TWO * s * series, slope if x >= ZERO else e * slope


@inlined_kernel
def _sigmoids(scratch, lanes):
    """All channels of a block of samples through a sigmoid."""
    for c in range(BLOCK * len(lanes)):
        scratch[_VALUES + c] = sigmoid(scratch[_VALUES + c])
