"""Samples of rays in the occupied cells of a box, on the CPU: the fast twin of `reference.py`.

Rounding is monotone: along a ray the cell of a sample's middle never turns back. So if two samples lie in one cell,
or in one block of cells, all samples between them do; a jump over an empty block is checked at its two ends, and the
result is that of asking every sample. Blocks of 4^3 and 16^3 cells without an occupied one are crossed at once. Runs
of samples are noted while a ray is walked, so that most rays are walked only once.
"""

import math

import numpy as np
from numba import prange

from rendra.kernels.geometry import HALF, INFINITY, ONE, ZERO
from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel

LATTICE_END = 2**24  # from here on float32 cannot count
_MOST_SAMPLES = 2**28
_RAYS_AT_ONCE = 64
_RUNS = 16  # of samples, noted for each ray; a ray with more is walked again
_LEAST = np.float32(1e-30)  # a slope below it is none, where a guess will do
_STEPS = np.float32(LATTICE_END)


def forward(
    origins: np.ndarray,
    directions: np.ndarray,
    nearest: np.ndarray,
    farthest: np.ndarray,
    offset: np.ndarray,
    occupied: np.ndarray,
    box: np.ndarray,
    step: float,
    growth: float,
    max_samples: int,
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
    workers, num_rays = num_threads(), len(origins)
    runs = np.empty((num_rays, 2 * _RUNS), np.int32)
    num_runs, ray_first = np.zeros(num_rays, np.int64), np.zeros(num_rays + 1, np.int64)
    rays = origins, directions, nearest, farthest, offset
    if bounds[0] <= bounds[1]:
        _walk_all(rays, pace, grid, levels, bounds, max_samples, workers, runs, num_runs, ray_first[1:])
    np.cumsum(ray_first, out=ray_first)
    total = int(ray_first[-1])
    if total > _MOST_SAMPLES:
        raise ValueError(f"a step of {step} asks for {total:,} samples; at most {_MOST_SAMPLES:,} are given at once")
    starts, ends, ray = np.empty(total, np.float32), np.empty(total, np.float32), np.empty(total, np.int64)
    _fill_all(rays, pace, grid, levels, bounds, workers, runs, num_runs, ray_first, starts, ends, ray)
    return ray_first, starts, ends, ray


def _pace(step: float, growth: float) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """The step, the steps in one unit, where steps begin to grow, and their rate."""
    knee, rate = (np.float32(step / growth), np.float32(math.log1p(growth) / step)) if growth else (INFINITY, ZERO)
    return np.float32(step), np.float32(1 / step), knee, rate


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
    _, _, knee, rate = pace
    return knee * math.exp((place - knee) * rate) if place > knee else place


@scalar_kernel
def _place(distance, pace):
    """The inverse of `_distance`."""
    _, _, knee, rate = pace
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
def _crossing(plane, origin, direction, low, scale):
    """Roughly where a ray meets a plane between cells along one axis; infinite if it does not."""
    return (plane / scale + low - origin) / direction if abs(direction) > _LEAST else INFINITY


@scalar_kernel
def _sample_at(distance, lattice, pace, total):
    """Roughly the first sample whose middle is at that distance or beyond: a number in [0, total]."""
    base, offset, _ = lattice
    guess = np.ceil((_place(distance, pace) - base) * pace[1] - offset - HALF)
    return np.int64(min(max(guess, ZERO), np.float32(total)))


@scalar_kernel
def _entry(ray, lattice, pace, grid, bounds, total):
    """The first of the samples, all of them in order, that is not before the bounds; and its cell."""
    low, high = -1, total
    cell = _cells(0, ray, lattice, pace, grid)
    if not _is_before(cell, ray, bounds):
        return 0, cell
    distance = ZERO
    for axis in range(3):
        if abs(ray[3 + axis]) > _LEAST:
            plane = np.float32(bounds[2 * axis] if ray[3 + axis] > ZERO else bounds[2 * axis + 1] + 1)
            distance = max(distance, _crossing(plane, ray[axis], ray[3 + axis], grid[axis], grid[3 + axis]))
    probe, turn, low = _sample_at(distance, lattice, pace, total), 0, 0
    while high - low > 1:
        probe = min(max(probe, low + 1), high - 1)
        here = _cells(probe, ray, lattice, pace, grid)
        if _is_before(here, ray, bounds):
            low, probe = probe, probe + 1
        else:
            high, cell, probe = probe, here, probe - 1
        turn += 1
        if turn > 2:
            probe = (low + high) // 2
    return high, cell


@scalar_kernel
def _leave(k, cell, shift, ray, lattice, pace, grid, total):
    """The first sample after k that is in another block of 2^shift cells a side; and its cell."""
    distance = INFINITY
    for axis in range(3):
        direction = ray[3 + axis]
        side = (cell[axis] >> shift) + (1 if direction > ZERO else 0)
        crossing = _crossing(np.float32(side << shift), ray[axis], direction, grid[axis], grid[3 + axis])
        distance = min(distance, crossing)
    low, high, beyond = k, total, cell
    probe, turn = _sample_at(distance, lattice, pace, total), 0
    while high - low > 1:
        probe = min(max(probe, low + 1), high - 1)
        here = _cells(probe, ray, lattice, pace, grid)
        x, y, z = here[0] ^ cell[0], here[1] ^ cell[1], here[2] ^ cell[2]
        if (x | y | z) >> shift == 0:
            low, probe = probe, probe + 1
        else:
            high, beyond, probe = probe, here, probe - 1
        turn += 1
        if turn > 2:
            probe = (low + high) // 2
    return high, beyond


@scalar_kernel
def _size_of_lattice(lattice, pace):
    """How many samples a ray has wherever they lie: those that begin before its end."""
    base, offset, farthest = lattice
    guess = np.ceil((_place(farthest, pace) - base) * pace[1] - offset)
    total = np.int64(min(max(guess, ZERO), _STEPS))
    while total > 0 and _start(total - 1, lattice, pace) >= farthest:
        total -= 1
    while total < LATTICE_END and _start(total, lattice, pace) < farthest:
        total += 1
    return total


@scalar_kernel
def _emptiness(cell, levels):
    """Logarithm of the side of the largest empty block around a cell; -1 if the cell is occupied."""
    cells, blocks, regions = levels
    x, y, z = cell
    if regions[z >> 4, y >> 4, x >> 4] == 0:
        return 4
    if blocks[z >> 2, y >> 2, x >> 2] == 0:
        return 2
    return 0 if cells[z, y, x] == 0 else -1


@scalar_kernel
def _walk(ray, lattice, pace, grid, levels, bounds, most, runs):
    """Note runs [begin, end) of samples in `runs`, as many as it holds: the number of samples, and of runs."""
    total = _size_of_lattice(lattice, pace)
    if total == 0:
        return 0, 0
    k, cell = _entry(ray, lattice, pace, grid, bounds, total)
    count, num_runs, last = 0, 0, -1
    while k < total and count < most and _is_inside(cell, bounds):
        shift = _emptiness(cell, levels)
        beyond, next_cell = _leave(k, cell, max(shift, 0), ray, lattice, pace, grid, total)
        if shift < 0:
            end = min(beyond, k + most - count)
            count += end - k
            if k != last:
                num_runs += 1
                if 2 * num_runs <= len(runs):
                    runs[2 * num_runs - 2] = k
            if 2 * num_runs <= len(runs):
                runs[2 * num_runs - 1] = end
            last = beyond
        k, cell = beyond, next_cell
    return count, num_runs


@scalar_kernel
def _ray_of(rays, r, pace):
    """Origin and direction, lattice, and whether they are such that anything can be seen."""
    origins, directions, nearest, farthest, offset = rays
    ox, oy, oz = origins[r, 0], origins[r, 1], origins[r, 2]
    dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
    near = nearest[r]
    lattice = (_place(near, pace), offset[r], farthest[r])
    total = abs(ox) + abs(oy) + abs(oz) + abs(dx) + abs(dy) + abs(dz) + abs(near)
    is_ray = math.isfinite(total) and near < farthest[r] and (dx != ZERO or dy != ZERO or dz != ZERO)
    return (ox, oy, oz, dx, dy, dz), lattice, is_ray


@parallel_kernel
def _walk_all(rays, pace, grid, levels, bounds, most, workers, runs, num_runs, counts):
    num_rays = len(num_runs)
    for worker in prange(workers):
        for block in range(worker, (num_rays + _RAYS_AT_ONCE - 1) // _RAYS_AT_ONCE, workers):
            for r in range(block * _RAYS_AT_ONCE, min((block + 1) * _RAYS_AT_ONCE, num_rays)):
                ray, lattice, is_ray = _ray_of(rays, r, pace)
                if is_ray:
                    counts[r], num_runs[r] = _walk(ray, lattice, pace, grid, levels, bounds, most, runs[r])


@parallel_kernel
def _fill_all(rays, pace, grid, levels, bounds, workers, runs, num_runs, ray_first, starts, ends, index):
    num_rays = len(num_runs)
    for worker in prange(workers):
        for block in range(worker, (num_rays + _RAYS_AT_ONCE - 1) // _RAYS_AT_ONCE, workers):
            for r in range(block * _RAYS_AT_ONCE, min((block + 1) * _RAYS_AT_ONCE, num_rays)):
                if num_runs[r] == 0:
                    continue
                ray, lattice, _ = _ray_of(rays, r, pace)
                noted = runs[r]
                if num_runs[r] > _RUNS:
                    noted = np.empty(2 * num_runs[r], np.int32)
                    most = ray_first[r + 1] - ray_first[r]
                    _walk(ray, lattice, pace, grid, levels, bounds, most, noted)
                m = ray_first[r]
                for n in range(num_runs[r]):
                    end = _start(np.int64(noted[2 * n]), lattice, pace)
                    for k in range(noted[2 * n], noted[2 * n + 1]):
                        starts[m], index[m] = end, r
                        end = _start(k + 1, lattice, pace)
                        ends[m] = min(end, lattice[2])
                        m += 1
