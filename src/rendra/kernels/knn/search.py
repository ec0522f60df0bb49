"""The walk down a tree of boxes that collects the best candidates of one query.

A candidate is one int64 key: for the nearest points its distance above its index, for points in a ball its index
above its distance. Keys order as the rules of the reference ask, ties included, so that the result does not depend on
the order of the walk. The K smallest are kept in a heap whose root is the largest.
"""

from typing import NamedTuple

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
    read_float,
    read_int32,
    read_int64,
    write_int64,
)
from rendra.kernels.knn.tree import BLOCK, INDEX_BITS, INDEX_MASK, LEAF, MAX_LEVELS, NOTHING
from rendra.kernels.parallel import scalar_kernel

EMPTY = np.int64(0x7F800000) << INDEX_BITS | np.int64(NOTHING)  # infinitely far, above every index
EMPTY_IN_BALL = np.int64(NOTHING) << INDEX_BITS
SCRATCH = 3 * MAX_LEVELS  # numbers that a walk needs beside its heap

_INFINITY = np.float32(np.inf)
_NONE = np.int32(-1)
_FEW = 4  # as many boxes are not worth finding the nearest of


class Tree(NamedTuple):
    """Where the tree of one cloud lies, by address; see `tree.py`."""

    leaves: int
    indices: int
    boxes: int
    lowest: int


class Question(NamedTuple):
    """What is asked of every query."""

    norm: int
    D: int
    radius: float  # squared; negative asks for the nearest points
    size: int  # K


class Walk(NamedTuple):
    """The scratch of one thread, int64, by address: the levels' first blocks, those visited, their masks; keys."""

    roots: int
    blocks: int
    masks: int
    heap: int


@scalar_kernel
def walk_at(address):
    """The scratch that starts at an address: SCRATCH numbers, then the heap."""
    step = 8 * MAX_LEVELS
    return Walk(address, address + step, address + 2 * step, address + 3 * step)


@scalar_kernel
def tree_at(trees, leaves, blocks, n):
    """The tree of cloud n of a batch whose clouds have so many leaves and blocks each."""
    return Tree(
        trees[0] + 4 * LEAF * leaves * n,
        trees[1] + 4 * LANES * leaves * n,
        trees[2] + 4 * BLOCK * blocks * n,
        trees[3] + 4 * LANES * blocks * n,
    )


@scalar_kernel
def find_roots(length, roots):
    """Write the first block of every level above the leaves; returns the number of levels."""
    count, first, levels = (length + LANES - 1) // LANES, 0, 0
    while count > 1 or levels == 0:
        count = (count + LANES - 1) // LANES
        levels += 1
        write_int64(roots, levels, first)
        first += count
    return levels


@scalar_kernel
def query_at(leaves, slot):
    """Coordinates of a place in the leaves, as a query: +infinity where it stands at -infinity."""
    place = slot // LANES * LEAF + slot % LANES
    x, y, z = read_float(leaves, place), read_float(leaves, place + LANES), read_float(leaves, place + 2 * LANES)
    return (_INFINITY, _INFINITY, _INFINITY) if x == -_INFINITY else (x, y, z)


@scalar_kernel
def distance(first, second, norm, D):
    """Of two points (D,) at two addresses, rounded as the vectors round it; infinite where it is not a number."""
    total = np.float32(0)
    for axis in range(D):
        apart = read_float(second, axis) - read_float(first, axis)
        total += abs(apart) if norm == 1 else apart * apart
    return total if total <= _INFINITY else _INFINITY


@scalar_kernel
def leaf_distance(leaves, slot, xyz, norm):
    """From a query of at most three coordinates to a place in the leaves, rounded as the vectors round it."""
    place = slot // LANES * LEAF + slot % LANES
    dx = read_float(leaves, place) - xyz[0]
    dy = read_float(leaves, place + LANES) - xyz[1]
    dz = read_float(leaves, place + 2 * LANES) - xyz[2]
    return abs(dx) + abs(dy) + abs(dz) if norm == 1 else dx * dx + dy * dy + dz * dz


@scalar_kernel
def near_key(dist, index):
    """The key of a candidate for the nearest."""
    return np.int64(float_bits(dist)) << INDEX_BITS | np.int64(index)


@scalar_kernel
def collect(row, xyz, points, tree, levels, ask, bound, walk):
    """Put the smallest keys below `bound` into the heap, which the caller has filled, with EMPTY or candidates.

    `row` is the address of the query, of which the tree knows xyz, and `points` that of the candidates (*, D).
    Returns how many leaves were looked at, and where in the leaves the last key that was kept stands, or -1.
    """
    cut = _limits(read_int64(walk.heap, 0), bound, ask.radius)
    level, looked_at, slot, block = levels, 0, np.int64(-1), np.int64(0)
    mask = _near_boxes(tree, read_int64(walk.roots, level), xyz, cut, ask.norm)
    while True:
        if mask == 0:
            if level == levels:
                return looked_at, slot
            level += 1
            block, mask = read_int64(walk.blocks, level), read_int64(walk.masks, level)
            if slot >= 0 and mask & (mask - 1):  # what was found below may have ruled out others here
                mask &= _near_boxes(tree, read_int64(walk.roots, level) + block, xyz, cut, ask.norm)
            continue
        if level > 1:
            lane = promising_lane(tree, read_int64(walk.roots, level) + block, xyz, mask, ask.norm)
            write_int64(walk.masks, level, mask & ~(np.int64(1) << lane))
            write_int64(walk.blocks, level, block)
            level -= 1
            block = block * LANES + lane
            mask = _near_boxes(tree, read_int64(walk.roots, level) + block, xyz, cut, ask.norm)
            continue
        leaf = block * LANES + first_bit(mask)
        mask &= mask - 1
        looked_at += 1
        found = _near_points(tree, leaf, xyz, cut, ask.norm)
        while found:
            place = leaf * LANES + first_bit(found)
            found &= found - 1
            if _offer(row, xyz, points, tree, place, ask, bound, walk.heap):
                cut = _limits(read_int64(walk.heap, 0), bound, ask.radius)
                slot = place


@scalar_kernel
def _offer(row, xyz, points, tree, slot, ask, bound, heap):
    """Put a candidate into the heap if it belongs there; whether it does."""
    index = np.int64(read_int32(tree.indices, slot))
    if ask.D <= 3:
        dist = leaf_distance(tree.leaves, slot, xyz, ask.norm)
    else:
        dist = distance(row, points + 4 * ask.D * index, ask.norm, ask.D)
    if ask.radius >= 0:
        key = index << INDEX_BITS | np.int64(float_bits(dist))
        keep = dist < ask.radius and key < read_int64(heap, 0)
    else:
        key = near_key(dist, index)
        keep = key < min(read_int64(heap, 0), bound)
    if keep:
        _replace_root(heap, ask.size, key)
    return keep


@scalar_kernel
def sort_heap(heap, size):
    """Turn the heap into ascending order, in place."""
    for end in range(size - 1, 0, -1):
        last = read_int64(heap, end)
        write_int64(heap, end, read_int64(heap, 0))
        _replace_root(heap, end, last)


@scalar_kernel
def upper_bound(row, points, ask, keys):
    """A key above the nearest of a query: those of another query, measured from here."""
    worst = np.int64(-1)
    for k in range(ask.size):
        index = read_int64(keys, k) & INDEX_MASK
        if index == NOTHING:
            return EMPTY
        worst = max(worst, near_key(distance(row, points + 4 * ask.D * index, ask.norm, ask.D), index))
    return worst + 1


@scalar_kernel
def _limits(worst, bound, radius):
    """What a candidate must beat: a distance, an index at this distance, an index at any distance."""
    if radius >= 0:
        return radius, _NONE, np.int32(worst >> INDEX_BITS)
    key = min(worst, bound)
    return float_of_bits(np.int32(key >> INDEX_BITS)), np.int32(key & INDEX_MASK), NOTHING


@scalar_kernel
def _near_boxes(tree, block, xyz, cut, norm):
    if norm == 1:
        return near_boxes_l1(tree.boxes, block * BLOCK, tree.lowest, block * LANES, *xyz, *cut)
    return near_boxes(tree.boxes, block * BLOCK, tree.lowest, block * LANES, *xyz, *cut)


@scalar_kernel
def _near_points(tree, leaf, xyz, cut, norm):
    if norm == 1:
        return near_points_l1(tree.leaves, leaf * LEAF, tree.indices, leaf * LANES, *xyz, *cut)
    return near_points(tree.leaves, leaf * LEAF, tree.indices, leaf * LANES, *xyz, *cut)


@scalar_kernel
def promising_lane(tree, block, xyz, mask, norm):
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
        dx, dy, dz = (
            _outside(tree.boxes, place, xyz[0]),
            _outside(tree.boxes, place + LANES, xyz[1]),
            _outside(tree.boxes, place + 2 * LANES, xyz[2]),
        )
        apart = dx + dy + dz if norm == 1 else dx * dx + dy * dy + dz * dz
        if apart < least:
            least, nearest = apart, lane
    return nearest


@scalar_kernel
def _outside(boxes, place, q):
    """How far a coordinate lies outside a box, along its axis."""
    return max(max(read_float(boxes, place) - q, q - read_float(boxes, place + 3 * LANES)), np.float32(0))


@scalar_kernel
def _replace_root(heap, size, key):
    """Put a key in the place of the largest."""
    place = 0
    while True:
        child = 2 * place + 1
        if child >= size:
            break
        if child + 1 < size and read_int64(heap, child + 1) > read_int64(heap, child):
            child += 1
        if read_int64(heap, child) <= key:
            break
        write_int64(heap, place, read_int64(heap, child))
        place = child
    write_int64(heap, place, key)
