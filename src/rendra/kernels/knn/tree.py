"""A tree of boxes over a cloud: points along a Hilbert curve, 16 to a leaf, 16 boxes to a block, blocks of blocks.

The curve runs through a grid of 256 cells along the longest side of the cloud's box. Where many points share a cell
(clusters, an outlier that stretches the box), their run is sorted again along a curve through a box of its own, until
runs are short or their points coincide: each time the box shrinks 256 times, so that no spread of float32 numbers
makes the tree bad or the work quadratic.

A point with a coordinate that is not finite has all coordinates -infinity and stands at the end; as a query it has
+infinity, so that no difference is NaN and each distance is infinite. The lanes of the last leaf and of the last
block of a level that hold nothing are -infinity too, with the index NOTHING.
"""

import math

import numpy as np

from rendra.kernels.knn.lanes import LANES, highest_of, lowest_index_of, lowest_of
from rendra.kernels.parallel import scalar_kernel

NOTHING = np.int32(2**31 - 1)
LEAF = 3 * LANES  # numbers of a leaf
BLOCK = 6 * LANES  # numbers of a block of boxes
MAX_LEVELS = 9  # 16^8 leaves are more than an index can name
INDEX_BITS = 32
INDEX_MASK = 2**INDEX_BITS - 1

_BITS = 8  # of the grid, along each axis
_CELLS = 1 << _BITS
_LONG_RUN = 4 * LANES  # of points in one cell
_FAR = np.float32(-np.inf)


@scalar_kernel
def tree_size(num_points):
    """Leaves and blocks that the tree of a cloud needs, at most; one of each at least."""
    leaves = max(1, (num_points + LANES - 1) // LANES)
    blocks, level = 0, leaves
    while level > 1 or blocks == 0:
        level = (level + LANES - 1) // LANES
        blocks += level
    return leaves, blocks


@scalar_kernel
def build_tree(points, length, axes, leaves, indices, boxes, lowest):
    """Fill the leaves (points and indices) and the blocks (boxes and lowest index below each) of one cloud.

    points (P, D); `axes` (3,) names the coordinates that the tree knows, -1 for zero.
    """
    coords = np.empty((3, length), np.float32)
    for i in range(length):
        coords[0, i], coords[1, i], coords[2, i] = _place(points, i, axes)
    codes = _along_the_curve(coords, length)
    num_leaves = (length + LANES - 1) // LANES
    for i in range(num_leaves * LANES):
        place = i // LANES * LEAF + i % LANES
        index = codes[i] & INDEX_MASK if i < length else np.int64(NOTHING)
        for axis in range(3):
            leaves[place + axis * LANES] = coords[axis, index] if i < length else _FAR
        indices[i] = index
    _box_leaves(leaves, indices, num_leaves, boxes, lowest)
    level, count = 0, (num_leaves + LANES - 1) // LANES
    while count > 1:
        _box_blocks(boxes, lowest, level, count)
        level += count
        count = (count + LANES - 1) // LANES


@scalar_kernel
def _place(points, i, axes):
    """The three coordinates that the tree knows, or -infinity thrice."""
    x = points[i, axes[0]] if axes[0] >= 0 else np.float32(0)
    y = points[i, axes[1]] if axes[1] >= 0 else np.float32(0)
    z = points[i, axes[2]] if axes[2] >= 0 else np.float32(0)
    finite = math.isfinite(x) and math.isfinite(y) and math.isfinite(z)
    return (x, y, z) if finite else (_FAR, _FAR, _FAR)


@scalar_kernel
def _along_the_curve(coords, length):
    """Indices (length,) of the points in the order of the tree, in the low bits; equal points by index."""
    codes, spare = np.empty(length, np.int64), np.empty(length, np.int64)
    cells, counts = np.empty((3, length), np.int32), np.empty((3, _CELLS), np.int64)
    end = 0
    for i in range(length):
        if coords[0, i] > _FAR:
            codes[end] = i
            end += 1
        else:
            spare[i - end] = i
    for i in range(end, length):
        codes[i] = spare[i - end]
    starts, ends = np.empty(length // _LONG_RUN + 2, np.int64), np.empty(length // _LONG_RUN + 2, np.int64)
    starts[0], ends[0], waiting = 0, end, 1
    while waiting:
        waiting -= 1
        begin, end = starts[waiting], ends[waiting]
        if not _sort_range(coords, codes, spare, cells, counts, begin, end):
            continue
        run = begin
        for i in range(begin + 1, end + 1):
            if i == end or codes[i] >> INDEX_BITS != codes[run] >> INDEX_BITS:
                if i - run > _LONG_RUN:
                    starts[waiting], ends[waiting] = run, i
                    waiting += 1
                run = i
    return codes


@scalar_kernel
def _sort_range(coords, codes, spare, cells, counts, begin, end):
    """Sort codes[begin:end] along a curve through their box; False where all points coincide."""
    low_x = low_y = low_z = np.float32(np.inf)
    high_x = high_y = high_z = _FAR
    for i in range(begin, end):
        index = codes[i] & INDEX_MASK
        x, y, z = coords[0, index], coords[1, index], coords[2, index]
        low_x, low_y, low_z = min(low_x, x), min(low_y, y), min(low_z, z)
        high_x, high_y, high_z = max(high_x, x), max(high_y, y), max(high_z, z)
    # in float64: the difference of two float32 numbers may overflow
    extent = max(np.float64(high_x) - low_x, max(np.float64(high_y) - low_y, np.float64(high_z) - low_z))
    if begin == end or not extent > 0:
        return False
    scale = (_CELLS - 0.001) / extent
    for i in range(begin, end):
        index = codes[i] & INDEX_MASK
        x, y, z = coords[0, index], coords[1, index], coords[2, index]
        cells[0, i] = np.int32((np.float64(x) - low_x) * scale)
        cells[1, i] = np.int32((np.float64(y) - low_y) * scale)
        cells[2, i] = np.int32((np.float64(z) - low_z) * scale)
    for i in range(begin, end):
        key = _hilbert(np.int64(cells[0, i]), np.int64(cells[1, i]), np.int64(cells[2, i]))
        spare[i] = key << INDEX_BITS | codes[i] & INDEX_MASK
    counts[:] = 0
    for i in range(begin, end):
        key = spare[i] >> INDEX_BITS
        counts[0, key & (_CELLS - 1)] += 1
        counts[1, key >> _BITS & (_CELLS - 1)] += 1
        counts[2, key >> 2 * _BITS] += 1
    _radix_pass(spare, codes, counts, 0, begin, end)
    _radix_pass(codes, spare, counts, 1, begin, end)
    _radix_pass(spare, codes, counts, 2, begin, end)
    return True


@scalar_kernel
def _radix_pass(source, target, counts, digit, begin, end):
    """Move source[begin:end] to `target`, in the order of one digit of which `counts` tells the frequencies."""
    total, shift = begin, INDEX_BITS + digit * _BITS
    for value in range(_CELLS):
        count = counts[digit, value]
        counts[digit, value] = total
        total += count
    for i in range(begin, end):
        value = source[i] >> shift & (_CELLS - 1)
        target[counts[digit, value]] = source[i]
        counts[digit, value] += 1


@scalar_kernel
def _hilbert(x, y, z):
    """Place of a cell on the Hilbert curve, 24 bits (Skilling, "Programming the Hilbert curve", 2004)."""
    for k in range(_BITS - 1, 0, -1):
        rest = (1 << k) - 1
        x ^= rest & -(x >> k & 1)
        is_set = -(y >> k & 1)
        swap = (x ^ y) & rest & ~is_set
        x ^= rest & is_set | swap
        y ^= swap
        is_set = -(z >> k & 1)
        swap = (x ^ z) & rest & ~is_set
        x ^= rest & is_set | swap
        z ^= swap
    y ^= x
    z ^= y
    # where bit k of z is set, all bits below k flip: from the highest down, a prefix of exclusive ors
    flip = z >> 1
    flip ^= flip >> 1
    flip ^= flip >> 2
    flip ^= flip >> 4
    return _spread(x ^ flip) << 2 | _spread(y ^ flip) << 1 | _spread(z ^ flip)


@scalar_kernel
def _spread(bits):
    """Eight bits, two zeros between each."""
    bits = (bits | bits << 8) & 0x00F00F
    bits = (bits | bits << 4) & 0x0C30C3
    return (bits | bits << 2) & 0x249249


@scalar_kernel
def _box_leaves(leaves, indices, num_leaves, boxes, lowest):
    """The blocks right above the leaves."""
    _clear(boxes, lowest, 0, (num_leaves + LANES - 1) // LANES)
    points, ids = leaves.ctypes.data, indices.ctypes.data
    for leaf in range(num_leaves):
        place = leaf // LANES * BLOCK + leaf % LANES
        for axis in range(3):
            boxes[place + axis * LANES] = lowest_of(points, leaf * LEAF + axis * LANES, ids, leaf * LANES, NOTHING)
            boxes[place + (3 + axis) * LANES] = highest_of(points, leaf * LEAF + axis * LANES)
        lowest[leaf] = lowest_index_of(ids, leaf * LANES)


@scalar_kernel
def _box_blocks(boxes, lowest, level, count):
    """The blocks above the `count` blocks of a level that starts at block `level`."""
    above = level + count
    _clear(boxes, lowest, above, (count + LANES - 1) // LANES)
    numbers, ids = boxes.ctypes.data, lowest.ctypes.data
    for child in range(count):
        source = (level + child) * BLOCK
        place = (above + child // LANES) * BLOCK + child % LANES
        first = (level + child) * LANES
        for axis in range(3):
            low, high = source + axis * LANES, source + (3 + axis) * LANES
            boxes[place + axis * LANES] = lowest_of(numbers, low, ids, first, NOTHING)
            boxes[place + (3 + axis) * LANES] = highest_of(numbers, high)
        lowest[above * LANES + child] = lowest_index_of(ids, first)


@scalar_kernel
def _clear(boxes, lowest, first, count):
    """Make the boxes of some blocks infinitely far, of nothing."""
    boxes[first * BLOCK : (first + count) * BLOCK] = _FAR
    lowest[first * LANES : (first + count) * LANES] = NOTHING
