"""The walk down a tree of boxes for 16 queries at once: one nearest point each.

The queries of a leaf lie close together, so that they look at much the same leaves. One walk serves them all: a box
is entered if it may matter to any, and of the points of a leaf each meets all 16 queries in one vector. Whatever the
order, each query ends with its smallest pair of distance and index, as in `search.py`.
"""

from typing import NamedTuple

import numpy as np

from rendra.kernels.knn.lanes import (
    LANES,
    box_for_queries,
    box_for_queries_l1,
    boxes_for_box,
    boxes_for_box_l1,
    first_bit,
    float_of_bits,
    leaf_for_queries,
    leaf_for_queries_l1,
    read_float,
    read_int32,
    read_int64,
    worst_of,
    write_float,
    write_int32,
    write_int64,
)
from rendra.kernels.knn.search import promising_lane
from rendra.kernels.knn.tree import BLOCK, MAX_LEVELS, NOTHING
from rendra.kernels.parallel import scalar_kernel

GROUP_SCRATCH = 3 * MAX_LEVELS + 2 * LANES  # int64 numbers that a walk needs

_INFINITY = np.float32(np.inf)
_UNTOUCHABLE = np.float32(-1)


class Group(NamedTuple):
    """The scratch of one thread, by address: that of `search.Walk`, what the queries found, the box about them."""

    roots: int
    blocks: int
    masks: int
    best: int  # 16 float32 distances, 16 int32 indices, 16 int32 slots
    box: int  # low corner, high corner


@scalar_kernel
def group_at(address):
    """The scratch that starts at an address."""
    step = 8 * MAX_LEVELS
    best = address + 3 * step
    return Group(address, address + step, address + 2 * step, best, best + 4 * 3 * LANES)


@scalar_kernel
def nearest_of_group(queries, count, tree, levels, norm, seed, group):
    """Leave in `group.best` what is nearest to each of the first `count` queries, at an address as in a leaf.

    The leaf `seed` is looked at first, if it is not negative. Queries that stand at -infinity keep a distance of -1.
    Returns how many times 16 queries looked at a leaf.
    """
    chosen = _enclose(queries, count, group)
    worst, worst_index = worst_of(group.best)
    if worst < 0:
        return 0
    looked_at = 0
    if seed >= 0:
        _improve(queries, tree, seed, norm, group)
        worst, worst_index = worst_of(group.best)
        looked_at = 1
    xyz = read_float(queries, chosen), read_float(queries, chosen + LANES), read_float(queries, chosen + 2 * LANES)
    level, block = levels, np.int64(0)
    mask = _near_boxes(tree, read_int64(group.roots, level), worst, worst_index, norm, group)
    while True:
        if mask == 0:
            if level == levels:
                return looked_at
            level += 1
            block, mask = read_int64(group.blocks, level), read_int64(group.masks, level)
            continue
        first = read_int64(group.roots, level) + block
        lane = promising_lane(tree, first, xyz, mask, norm) if level > 1 else first_bit(mask)
        mask &= ~(np.int64(1) << lane)
        if not _matters(queries, tree, first, lane, norm, group):
            continue
        child = block * LANES + lane
        if level > 1:
            write_int64(group.masks, level, mask)
            write_int64(group.blocks, level, block)
            level, block = level - 1, child
            mask = _near_boxes(tree, read_int64(group.roots, level) + child, worst, worst_index, norm, group)
        elif child != seed:
            looked_at += 1
            if _improve(queries, tree, child, norm, group):
                worst, worst_index = worst_of(group.best)


@scalar_kernel
def found_by(group, lane):
    """Distance, index and slot of what one query found: infinity and zeros if it is not finite."""
    dist = read_float(group.best, lane)
    if dist < 0:
        return _INFINITY, np.int32(0), np.int32(0)
    return dist, read_int32(group.best, LANES + lane), read_int32(group.best, 2 * LANES + lane)


@scalar_kernel
def _enclose(queries, count, group):
    """Start with nothing found, and with the box of the queries that are finite; returns one of these."""
    chosen = np.int64(0)
    for axis in range(3):
        low, high = _INFINITY, -_INFINITY
        for lane in range(count):
            value = read_float(queries, axis * LANES + lane)
            if value > -_INFINITY:
                low, high, chosen = min(low, value), max(high, value), lane
        write_float(group.box, axis, low)
        write_float(group.box, 3 + axis, high)
    for lane in range(LANES):
        finite = lane < count and read_float(queries, lane) > -_INFINITY
        write_float(group.best, lane, _INFINITY if finite else _UNTOUCHABLE)
        write_int32(group.best, LANES + lane, NOTHING)
    return chosen


@scalar_kernel
def _improve(queries, tree, leaf, norm, group):
    if norm == 1:
        return leaf_for_queries_l1(queries, group.best, tree.leaves, tree.indices, leaf)
    return leaf_for_queries(queries, group.best, tree.leaves, tree.indices, leaf)


@scalar_kernel
def _matters(queries, tree, block, lane, norm, group):
    place, lowest = block * BLOCK + lane, read_int32(tree.lowest, block * LANES + lane)
    if norm == 1:
        return box_for_queries_l1(queries, group.best, tree.boxes, place, lowest)
    return box_for_queries(queries, group.best, tree.boxes, place, lowest)


@scalar_kernel
def _near_boxes(tree, block, worst, worst_index, norm, group):
    cut = float_of_bits(worst)
    if norm == 1:
        return boxes_for_box_l1(tree.boxes, block * BLOCK, tree.lowest, block * LANES, group.box, cut, worst_index)
    return boxes_for_box(tree.boxes, block * BLOCK, tree.lowest, block * LANES, group.box, cut, worst_index)
