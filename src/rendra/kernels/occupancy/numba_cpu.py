"""Samples of rays in the occupied cells of a box, on the CPU: the fast twin of `reference.py`.

Rounding is monotone: along a ray the cell of a sample's middle never turns back. So if two samples lie in one cell,
or in one block of cells, all samples between them do; a jump over an empty block is checked at its two ends, and the
result is that of asking every sample. Blocks of 4^3 and 16^3 cells without an occupied one are crossed at once. Where
a jump must end is computed with a bound on its rounding error, and asked only if that leaves two answers. Runs of
samples are noted while a ray is walked, and filled in when their number is known. Transmittance is carried in
float64, sample by sample, as `composite` does.
"""

import math

import numpy as np
from numba import prange

from rendra.kernels.geometry import HALF, INFINITY, ONE, ZERO
from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel

LATTICE_END = 2**24  # from here on float32 cannot count
_MOST_SAMPLES = 2**28
_RAYS_AT_ONCE = 64
_RUNS = 32  # of samples, noted for each ray; if one has more, rays are walked again
_LEAST = np.float32(1e-30)  # a slope below it is none, where a guess will do
_STEPS = np.float32(LATTICE_END)
_ROUNDING = np.float32(2.0**-20)  # sixteen roundings: more than there are between a ray and the cell of a sample
_CLEAR = np.zeros((1, 1, 1), np.float32)


Rays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Origins and directions (R, 3), nearest, farthest and offset (R,)."""


def forward(
    rays: Rays,
    occupied: np.ndarray,
    box: np.ndarray,
    step: float,
    growth: float,
    max_samples: int,
    opacity: np.ndarray | None,
    stop_below: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """First sample of each ray (R + 1,), and starts, ends and ray (M,) of the samples.

    Raises:
        ValueError: there are more samples than anyone can have meant.
    """
    levels = _levels(occupied)
    bounds, size = _bounds(levels[1], occupied.shape)
    scale = size.astype(np.float32) / (box[1] - box[0])
    grid = (*box[0], *scale, *size.astype(np.float32))
    pace = _pace(step, growth)
    light = (_CLEAR, 0.0) if opacity is None else (opacity, stop_below)
    workers, num_rays = num_threads(), len(rays[0])
    num_runs, ray_first = np.zeros(num_rays, np.int64), np.zeros(num_rays + 1, np.int64)
    noted = 0 if bounds[0] > bounds[1] else _RUNS  # nothing to walk to in an empty grid
    runs = np.empty((num_rays, 2 * noted), np.int32)
    while noted:
        _walk_all(rays, pace, grid, *levels, bounds, max_samples, light, workers, runs, num_runs, ray_first[1:])
        noted = int(num_runs.max(initial=0))
        if 2 * noted <= runs.shape[1]:
            break
        runs = np.empty((num_rays, 2 * noted), np.int32)
    np.cumsum(ray_first, out=ray_first)
    total = int(ray_first[-1])
    if total > _MOST_SAMPLES:
        raise ValueError(f"a step of {step} asks for {total:,} samples; at most {_MOST_SAMPLES:,} are given at once")
    starts, ends, ray = np.empty(total, np.float32), np.empty(total, np.float32), np.empty(total, np.int64)
    _fill_all(rays, pace, workers, runs, num_runs, ray_first, starts, ends, ray)
    return ray_first, starts, ends, ray


def _pace(step: float, growth: float) -> tuple[np.float32, ...]:
    """The step, the steps in one unit, where steps begin to grow, their rate, and how far middles are then off."""
    knee, rate = (np.float32(step / growth), np.float32(math.log1p(growth) / step)) if growth else (INFINITY, ZERO)
    return np.float32(step), np.float32(1 / step), knee, rate, np.float32(growth / 2)


def _levels(occupied: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The cells (D, H, W) as bytes, and whether blocks of 4^3 and of 16^3 hold an occupied one."""
    cells = occupied.view(np.uint8)
    blocks = _coarser(cells)
    return cells, blocks, _coarser(blocks)


def _coarser(cells: np.ndarray) -> np.ndarray:
    """Whether each block of 4^3 cells holds one; four bytes of a row are read as one number."""
    depth, height, width = ((n + 3) // 4 for n in cells.shape)
    if cells.shape[2] % 4:
        cells = np.pad(cells, ((0, 0), (0, 0), (0, 4 * width - cells.shape[2])))
    blocks = np.empty((depth, height, width), np.uint8)
    _any_of_blocks(cells.view(np.uint32), num_threads(), blocks)
    return blocks


def _bounds(blocks: np.ndarray, shape: tuple[int, ...]) -> tuple[tuple[int, ...], np.ndarray]:
    """First and last cell along x, y, z of the blocks that hold one (first > last if none does); the grid's size."""
    bounds = []
    for axis in (2, 1, 0):
        used = np.flatnonzero(blocks.any(axis=tuple({0, 1, 2} - {axis})))
        bounds += [4 * int(used[0]), min(4 * int(used[-1]) + 3, shape[axis] - 1)] if len(used) else [1, 0]
    return tuple(bounds), np.array(shape[::-1])


@parallel_kernel
def _any_of_blocks(words, workers, blocks):
    depth, height, width = blocks.shape
    for worker in prange(workers):
        seen = np.empty(width, np.uint32)
        for task in range(worker, depth * height, workers):
            z, y = task // height, task % height
            seen[:] = 0
            for k in range(4 * z, min(4 * z + 4, words.shape[0])):
                for j in range(4 * y, min(4 * y + 4, words.shape[1])):
                    for i in range(width):
                        seen[i] |= words[k, j, i]
            for i in range(width):
                blocks[z, y, i] = seen[i] != 0


@scalar_kernel
def _distance(place, pace):
    """Distance along the ray of a place on the scale on which all steps are equally long."""
    _, _, knee, rate, _ = pace
    return knee * math.exp((place - knee) * rate) if place > knee else place


@scalar_kernel
def _place(distance, pace):
    """The inverse of `_distance`."""
    _, _, knee, rate, _ = pace
    return knee + math.log(distance / knee) / rate if distance > knee else distance


@scalar_kernel
def _start(k, lattice, pace):
    """Where sample k of a ray begins."""
    base, offset, _ = lattice
    return _distance(base + (offset + np.float32(k)) * pace[0], pace)


@scalar_kernel
def _cell(along, origin, direction, low, scale, size):
    """The cell along one axis; -1 and `size` are all that lies outside."""
    return np.int64(np.floor(min(max((origin + along * direction - low) * scale, -ONE), size)))


@scalar_kernel
def _cells(k, ray, lattice, pace, grid):
    """The cell (x, y, z) in which the middle of sample k lies."""
    ox, oy, oz, dx, dy, dz = ray
    lx, ly, lz, sx, sy, sz, nx, ny, nz = grid
    along = HALF * (_start(k, lattice, pace) + min(_start(k + 1, lattice, pace), lattice[2]))
    x, y, z = _cell(along, ox, dx, lx, sx, nx), _cell(along, oy, dy, ly, sy, ny), _cell(along, oz, dz, lz, sz, nz)
    return x, y, z


@scalar_kernel
def _is_ahead(cell, first, last, direction):
    """Whether cells [first, last] are still to come along an axis; forever, if the ray runs beside them."""
    return (cell < first and direction >= ZERO) or (cell > last and direction <= ZERO)


@scalar_kernel
def _is_before(cell, ray, bounds):
    """Whether the ray has still to enter the bounds along some axis."""
    _, _, _, dx, dy, dz = ray
    x, y, z = cell
    x0, x1, y0, y1, z0, z1 = bounds
    return _is_ahead(x, x0, x1, dx) or _is_ahead(y, y0, y1, dy) or _is_ahead(z, z0, z1, dz)


@scalar_kernel
def _is_inside(cell, bounds):
    x, y, z = cell
    x0, x1, y0, y1, z0, z1 = bounds
    return x0 <= x and x <= x1 and y0 <= y and y <= y1 and z0 <= z and z <= z1


@scalar_kernel
def _crossings(origin, direction, low, high, scale):
    """Of planes at p cells along one axis: the ray meets them at p * slope + at, give or take an error."""
    if abs(direction) < _LEAST:
        return ZERO, INFINITY, ZERO
    inverse = ONE / direction
    error = _ROUNDING * (abs(origin) + abs(low) + abs(high)) * abs(inverse)
    return inverse / scale, (low - origin) * inverse, error


@scalar_kernel
def _sample_at(distance, lattice, pace):
    """The first sample whose middle is at that distance or beyond, as a number not yet rounded up."""
    base, offset, _ = lattice
    return (_place(distance, pace) - base) * pace[1] - offset - HALF


@scalar_kernel
def _narrowed(low, high, probe, is_low, turn):
    """One step of a search between two numbers: the neighbour of a guess is asked next, and halves after three."""
    if is_low:
        low, probe = probe, probe + 1
    else:
        high, probe = probe, probe - 1
    if turn > 1:
        probe = (low + high) // 2
    return low, high, min(max(probe, low + 1), high - 1), turn + 1


@scalar_kernel
def _entry(ray, lattice, pace, grid, bounds, total):
    """The first of all samples that is not before the bounds; and its cell."""
    ox, oy, oz, dx, dy, dz = ray
    lx, ly, lz, sx, sy, sz, _, _, _ = grid
    low, high = 0, total
    cell = _cells(0, ray, lattice, pace, grid)
    if not _is_before(cell, ray, bounds):
        return low, cell
    distance = max(_entry_along(ox, dx, lx, sx, bounds[0], bounds[1]), ZERO)
    distance = max(_entry_along(oy, dy, ly, sy, bounds[2], bounds[3]), distance)
    distance = max(_entry_along(oz, dz, lz, sz, bounds[4], bounds[5]), distance)
    guess = np.ceil(_sample_at(distance, lattice, pace))
    probe, turn = np.int64(min(max(guess, ONE), np.float32(total - 1))), 0
    while high - low > 1:
        is_before = _is_before(_cells(probe, ray, lattice, pace, grid), ray, bounds)
        low, high, probe, turn = _narrowed(low, high, probe, is_before, turn)
    return high, _cells(high, ray, lattice, pace, grid)


@scalar_kernel
def _entry_along(origin, direction, low, scale, first, last):
    """Roughly where a ray meets the bounds along one axis."""
    plane = np.float32(first if direction > ZERO else last + 1)
    return (plane / scale + low - origin) / direction if abs(direction) > _LEAST else ZERO


@scalar_kernel
def _search(k, cell, shift, probe, ray, lattice, pace, grid, total):
    """The first sample after k that is in another block of 2^shift cells a side, by asking: first at a guess."""
    low, high, probe, turn = k, total, min(probe, total - 1), 0
    x, y, z = cell
    while high - low > 1:
        i, j, l = _cells(probe, ray, lattice, pace, grid)
        low, high, probe, turn = _narrowed(low, high, probe, ((x ^ i) | (y ^ j) | (z ^ l)) >> shift == 0, turn)
    return high


@scalar_kernel
def _size_of_lattice(lattice, pace):
    """How many samples a ray has wherever they lie: those that begin before its end."""
    base, offset, farthest = lattice
    guess = np.ceil((_place(farthest, pace) - base) * pace[1] - offset)
    low, high = -1, LATTICE_END
    probe, turn = np.int64(min(max(guess, ZERO), _STEPS - ONE)), 0
    while high - low > 1:
        low, high, probe, turn = _narrowed(low, high, probe, _start(probe, lattice, pace) < farthest, turn)
    return high


@scalar_kernel
def _dimmed(first, last, alpha, clear, stop):
    """The end of the samples from `first` to `last` of one cell that light reaches, and what is left behind them."""
    past = 1.0 - np.float64(alpha)
    while first < last and clear >= stop:
        clear *= past
        first += 1
    return first, clear


@scalar_kernel
def _walk(ray, lattice, pace, grid, cells, blocks, regions, bounds, most, light, r, runs):
    """Note runs [begin, end) of samples in `runs`, as many as it holds: the number of samples, and of runs."""
    total = _size_of_lattice(lattice, pace)
    if total == 0:
        return 0, 0
    ox, oy, oz, dx, dy, dz = ray
    lx, ly, lz, sx, sy, sz, nx, ny, nz = grid
    slope_x, at_x, error_x = _crossings(ox, dx, lx, lx + nx / sx, sx)
    slope_y, at_y, error_y = _crossings(oy, dy, ly, ly + ny / sy, sy)
    slope_z, at_z, error_z = _crossings(oz, dz, lz, lz + nz / sz, sz)
    ahead_x, ahead_y, ahead_z = np.int64(dx > ZERO), np.int64(dy > ZERO), np.int64(dz > ZERO)
    end_of_lattice, blur = np.float32(total), _ROUNDING * abs(lattice[0])
    k, cell = _entry(ray, lattice, pace, grid, bounds, total)
    count, num_runs, last, (opacity, stop), clear = 0, 0, -1, light, 1.0
    while k < total and count < most and _is_inside(cell, bounds):
        x, y, z = cell
        is_occupied, shift = False, 0
        if regions[z >> 4, y >> 4, x >> 4] == 0:
            shift = 4
        elif blocks[z >> 2, y >> 2, x >> 2] == 0:
            shift = 2
        else:
            is_occupied = cells[z, y, x] != 0
        leave_x = np.float32(((x >> shift) + ahead_x) << shift) * slope_x + at_x
        leave_y = np.float32(((y >> shift) + ahead_y) << shift) * slope_y + at_y
        leave_z = np.float32(((z >> shift) + ahead_z) << shift) * slope_z + at_z
        early = min(leave_x - error_x, min(leave_y - error_y, leave_z - error_z))
        late = min(leave_x + error_x, min(leave_y + error_y, leave_z + error_z))
        early, late = early - _ROUNDING * abs(early) - blur, late + _ROUNDING * abs(late) + blur
        early = np.ceil(_sample_at(early, lattice, pace) - pace[4])
        late = np.ceil(_sample_at(late, lattice, pace) + pace[4])
        beyond = np.int64(min(max(late, np.float32(k + 1)), end_of_lattice))
        if early < end_of_lattice and (early != late or beyond == total - 1):  # the last middle is nearer
            beyond = _search(k, cell, shift, beyond, ray, lattice, pace, grid, total)
        if is_occupied:
            end = min(beyond, k + most - count)
            if stop > 0.0:
                end, clear = _dimmed(k, end, opacity[z, y, x], clear, stop)
            count += end - k
            if k != last:
                num_runs += 1
                if 2 * num_runs <= runs.shape[1]:
                    runs[r, 2 * num_runs - 2] = k
            if 2 * num_runs <= runs.shape[1]:
                runs[r, 2 * num_runs - 1] = end
            last = beyond
            if not clear >= stop:
                break
        k, cell = beyond, _cells(beyond, ray, lattice, pace, grid)
    return count, num_runs


@scalar_kernel
def _ray_of(rays, r, pace):
    """Origin and direction, lattice, and whether they are such that anything can be seen."""
    origins, directions, nearest, farthest, offset = rays
    ox, oy, oz = origins[r, 0], origins[r, 1], origins[r, 2]
    dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
    near = nearest[r]
    lattice = (_place(near, pace), offset[r], farthest[r])
    is_finite = math.isfinite(ox) and math.isfinite(oy) and math.isfinite(oz) and math.isfinite(near)
    is_finite = is_finite and math.isfinite(dx) and math.isfinite(dy) and math.isfinite(dz)
    is_ray = is_finite and near < farthest[r] and (dx != ZERO or dy != ZERO or dz != ZERO)
    return (ox, oy, oz, dx, dy, dz), lattice, is_ray


@parallel_kernel
def _walk_all(rays, pace, grid, cells, blocks, regions, bounds, most, light, workers, runs, num_runs, counts):
    num_rays = len(num_runs)
    for worker in prange(workers):
        for block in range(worker, (num_rays + _RAYS_AT_ONCE - 1) // _RAYS_AT_ONCE, workers):
            for r in range(block * _RAYS_AT_ONCE, min((block + 1) * _RAYS_AT_ONCE, num_rays)):
                ray, lattice, is_ray = _ray_of(rays, r, pace)
                if is_ray:
                    counts[r], num_runs[r] = _walk(
                        ray, lattice, pace, grid, cells, blocks, regions, bounds, most, light, r, runs
                    )


@parallel_kernel
def _fill_all(rays, pace, workers, runs, num_runs, ray_first, starts, ends, index):
    num_rays = len(num_runs)
    for worker in prange(workers):
        for block in range(worker, (num_rays + _RAYS_AT_ONCE - 1) // _RAYS_AT_ONCE, workers):
            for r in range(block * _RAYS_AT_ONCE, min((block + 1) * _RAYS_AT_ONCE, num_rays)):
                _, lattice, _ = _ray_of(rays, r, pace)
                m = ray_first[r]
                for n in range(num_runs[r]):
                    start = _start(np.int64(runs[r, 2 * n]), lattice, pace)
                    for k in range(runs[r, 2 * n], runs[r, 2 * n + 1]):
                        end = _start(k + 1, lattice, pace)
                        starts[m], ends[m], index[m] = start, min(end, lattice[2]), r
                        start = end
                        m += 1
