"""The walk down a tree of boxes that collects the best candidates of one query.

A candidate is one int64 key: for the nearest points its distance above its index, for points in a ball its index above
its distance. Keys order as the rules of the reference ask, ties included, so that the result does not depend on the
order of the walk. The K smallest are kept in a heap whose root is the largest.
"""

import numpy as np

from rendra.kernels.knn.lanes import (
    LANES,
    first_bit,
    float_bits,
    float_of_bits,
    near_boxes,
    near_boxes_l1,
    near_points,
    near_points_l1,
)
from rendra.kernels.knn.tree import BLOCK, INDEX_BITS, INDEX_MASK, LEAF, NOTHING
from rendra.kernels.parallel import scalar_kernel

EMPTY = np.int64(0x7F800000) << INDEX_BITS | np.int64(NOTHING)  # infinitely far, above every index
EMPTY_IN_BALL = np.int64(NOTHING) << INDEX_BITS

_INFINITY = np.float32(np.inf)
_NONE = np.int32(-1)
_FEW = 4  # as many boxes are not worth finding the nearest of


@scalar_kernel
def distance(p1, i, p2, j, norm):
    """Of two points of (*, D) arrays, rounded as the vectors round it; infinite where it is not a number."""
    total = np.float32(0)
    for axis in range(p1.shape[1]):
        apart = p2[j, axis] - p1[i, axis]
        total += abs(apart) if norm == 1 else apart * apart
    return total if total <= _INFINITY else _INFINITY


@scalar_kernel
def collect(p1, i, x, y, z, p2, base, norm, radius, bound, tree, roots, levels, heap, size, blocks, masks):
    """Put the smallest keys below `bound` into heap[:size], which the caller has filled, with EMPTY or candidates.

    Returns the number of leaves that were looked at, and where in the leaves the last key that was kept stands, or -1.

    The query is point i of `p1` (*, D), of which the tree knows x, y, z; the candidates are those of `p2` (*, D) from
    `base` on. `roots` tells the first leaf and the first block of each level; a negative squared `radius` asks for the
    nearest points; `blocks` and `masks` (MAX_LEVELS,) are scratch. No array is sliced here: views count references.
    """
    leaves, indices, boxes, lowest = tree
    in_ball, is_flat = radius >= 0, p1.shape[1] <= 3
    cut, cut_index, limit = _limits(heap[0], bound, radius)
    level, looked_at, slot = levels, 0, np.int64(-1)
    blocks[level] = roots[level]
    masks[level] = _near_boxes(boxes, blocks[level], lowest, x, y, z, cut, cut_index, limit, norm)
    while True:
        mask = masks[level]
        if mask == 0:
            level += 1
            if level > levels:
                return looked_at, slot
            rest = masks[level]
            if slot >= 0 and rest & (rest - 1):  # what was found below may have ruled out others here
                masks[level] &= _near_boxes(boxes, blocks[level], lowest, x, y, z, cut, cut_index, limit, norm)
            continue
        lane = first_bit(mask) if level == 1 else _promising_lane(boxes, blocks[level], x, y, z, mask, norm)
        masks[level] = mask & ~(np.int64(1) << lane)
        child = roots[level - 1] + (blocks[level] - roots[level]) * LANES + lane
        if level > 1:
            level -= 1
            blocks[level] = child
            masks[level] = _near_boxes(boxes, child, lowest, x, y, z, cut, cut_index, limit, norm)
            continue
        looked_at += 1
        found = _near_points(leaves, child, indices, x, y, z, cut, cut_index, limit, norm)
        while found:
            lane = first_bit(found)
            found &= found - 1
            index = indices[child * LANES + lane]
            if is_flat:
                dist = leaf_distance(leaves, child * LANES + lane, x, y, z, norm)
            else:
                dist = distance(p1, i, p2, base + index, norm)
            if in_ball:
                key = np.int64(index) << INDEX_BITS | np.int64(float_bits(dist))
                keep = dist < radius and key < heap[0]
            else:
                key = np.int64(float_bits(dist)) << INDEX_BITS | np.int64(index)
                keep = key < min(heap[0], bound)
            if keep:
                _replace_root(heap, size, key)
                cut, cut_index, limit = _limits(heap[0], bound, radius)
                slot = child * LANES + lane


@scalar_kernel
def leaf_distance(leaves, slot, x, y, z, norm):
    """From a query of two or three coordinates to a place in the leaves, rounded as the vectors round it."""
    place = slot // LANES * LEAF + slot % LANES
    dx, dy, dz = leaves[place] - x, leaves[place + LANES] - y, leaves[place + 2 * LANES] - z
    return abs(dx) + abs(dy) + abs(dz) if norm == 1 else dx * dx + dy * dy + dz * dz


@scalar_kernel
def key_above(dist, index):
    """The least key that is larger than that of a candidate."""
    return (np.int64(float_bits(dist)) << INDEX_BITS | np.int64(index)) + 1


@scalar_kernel
def sort_heap(heap, size):
    """Turn the heap into ascending order, in place."""
    for end in range(size - 1, 0, -1):
        last = heap[end]
        heap[end] = heap[0]
        _replace_root(heap, end, last)


@scalar_kernel
def upper_bound(p1, i, p2, base, norm, keys, size):
    """A key above the nearest of point i: those of another query, keys[:size], measured from here."""
    worst = np.int64(-1)
    for k in range(size):
        index = keys[k] & INDEX_MASK
        if index == NOTHING:
            return EMPTY
        worst = max(worst, key_above(distance(p1, i, p2, base + index, norm), index))
    return worst


@scalar_kernel
def _limits(worst, bound, radius):
    """What a candidate must beat: a distance, an index at this distance, an index at any distance."""
    if radius >= 0:
        return radius, _NONE, np.int32(worst >> INDEX_BITS)
    key = min(worst, bound)
    return float_of_bits(np.int32(key >> INDEX_BITS)), np.int32(key & INDEX_MASK), NOTHING


@scalar_kernel
def _near_boxes(boxes, block, lowest, x, y, z, cut, cut_index, limit, norm):
    if norm == 1:
        return near_boxes_l1(boxes, block * BLOCK, lowest, block * LANES, x, y, z, cut, cut_index, limit)
    return near_boxes(boxes, block * BLOCK, lowest, block * LANES, x, y, z, cut, cut_index, limit)


@scalar_kernel
def _near_points(leaves, leaf, indices, x, y, z, cut, cut_index, limit, norm):
    if norm == 1:
        return near_points_l1(leaves, leaf * LEAF, indices, leaf * LANES, x, y, z, cut, cut_index, limit)
    return near_points(leaves, leaf * LEAF, indices, leaf * LANES, x, y, z, cut, cut_index, limit)


@scalar_kernel
def _promising_lane(boxes, block, x, y, z, mask, norm):
    """The nearest box of the mask if there are many, else any: then the search is well bounded already."""
    many = mask
    for _ in range(_FEW):
        many &= many - 1
    lane = first_bit(mask)
    if many == 0:
        return lane
    least, nearest = _INFINITY, lane
    while mask:
        lane = first_bit(mask)
        mask &= mask - 1
        place = block * BLOCK + lane
        dx = _outside(boxes[place], boxes[place + 3 * LANES], x)
        dy = _outside(boxes[place + LANES], boxes[place + 4 * LANES], y)
        dz = _outside(boxes[place + 2 * LANES], boxes[place + 5 * LANES], z)
        apart = dx + dy + dz if norm == 1 else dx * dx + dy * dy + dz * dz
        if apart < least:
            least, nearest = apart, lane
    return nearest


@scalar_kernel
def _outside(low, high, q):
    return max(max(low - q, q - high), np.float32(0))


@scalar_kernel
def _replace_root(heap, size, key):
    """Put a key in the place of the largest."""
    place = 0
    while True:
        child = 2 * place + 1
        if child >= size:
            break
        if child + 1 < size and heap[child + 1] > heap[child]:
            child += 1
        if heap[child] <= key:
            break
        heap[place] = heap[child]
        place = child
    heap[place] = key
