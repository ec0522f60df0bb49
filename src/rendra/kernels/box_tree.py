"""A tree of bounding boxes, eight children a node, over points or triangles of a packed batch.

Items are halved at the median of their longest side until eight are left; these make a leaf, eight leaves a node,
and so on, segment by segment (one for each cloud or mesh). A *group* is eight boxes side by side, so that one pass of
vector code bounds them all. Items are (I, k, 3) arrays: k = 1 for points, k = 3 for triangles. What is not finite is
in no box. Those who ask come along a Morton curve, so that neighbours follow each other: sorting them so is faster
than halving, but makes boxes that overlap.

Bentley, "Multidimensional binary search trees", 1975; Morton, "A computer oriented geodetic data base", IBM 1966;
Wald, Benthin and Boulos, "Getting rid of packets", 2008.
"""

import math

import numpy as np

from rendra.kernels.parallel import scalar_kernel

GROUP = 8
STACK = 8 * 12  # entries that a walk may need: seven siblings left over on each of at most twelve levels

_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_INFINITY = np.float32(np.inf)
_AXIS_BITS = 18
_CELLS = np.float32(2**_AXIS_BITS - 1)
_DIGIT_BITS = 11
_HALVINGS = 64  # parts that wait to be split: at most one more than splits on the way to a leaf
_PASSES = 5  # 55 bits hold three times 18


@scalar_kernel
def is_finite(item):
    """Whether all coordinates of an item (k, 3) are."""
    for c in range(item.shape[0]):
        for axis in range(3):
            if not math.isfinite(item[c, axis]):
                return False
    return True


@scalar_kernel
def _spread(cell):
    """The bits of an integer below 2^21, two zeros after each."""
    x = np.uint64(cell)
    x = (x | (x << np.uint64(32))) & np.uint64(0x001F00000000FFFF)
    x = (x | (x << np.uint64(16))) & np.uint64(0x001F0000FF0000FF)
    x = (x | (x << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    x = (x | (x << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (x | (x << np.uint64(2))) & np.uint64(0x1249249249249249)


@scalar_kernel
def _morton_codes(items, begin, end, codes):
    """Codes of the items' centres in the cube around the finite ones of the segment."""
    corners = items.shape[1]
    low, high = np.full(3, _INFINITY), np.full(3, -_INFINITY)
    for i in range(begin, end):
        if is_finite(items[i]):
            for c in range(corners):
                for axis in range(3):
                    low[axis] = min(low[axis], items[i, c, axis])
                    high[axis] = max(high[axis], items[i, c, axis])
    extent = max(high[0] - low[0], max(high[1] - low[1], high[2] - low[2]))
    per_unit = _CELLS / (extent * np.float32(corners)) if extent > _ZERO else _ZERO
    for i in range(begin, end):
        code = np.uint64(0)
        for axis in range(3):
            total = _ZERO
            for c in range(corners):
                total += items[i, c, axis] - low[axis]
            cell = total * per_unit
            cell = min(cell, _CELLS) if cell > _ZERO else _ZERO  # NaN goes to the first cell
            code |= _spread(int(cell)) << np.uint64(axis)
        codes[i] = code


@scalar_kernel
def spatial_order(items, first):
    """Indices (I,) of the items, each segment [first[n], first[n + 1]) sorted along its Morton curve; stable."""
    order = np.arange(len(items))
    spare, codes = np.empty_like(order), np.empty(len(items), np.uint64)
    histogram = np.empty((1 << _DIGIT_BITS) + 1, np.int64)
    mask = np.uint64((1 << _DIGIT_BITS) - 1)
    for n in range(len(first) - 1):
        _morton_codes(items, first[n], first[n + 1], codes)
        for turn in range(_PASSES):
            shift = np.uint64(turn * _DIGIT_BITS)
            histogram[:] = 0
            for k in range(first[n], first[n + 1]):
                histogram[np.int64((codes[order[k]] >> shift) & mask) + 1] += 1
            histogram[0] = first[n]
            for digit in range(len(histogram) - 1):
                histogram[digit + 1] += histogram[digit]
            for k in range(first[n], first[n + 1]):
                digit = np.int64((codes[order[k]] >> shift) & mask)
                spare[histogram[digit]] = order[k]
                histogram[digit] += 1
            order[first[n] : first[n + 1]] = spare[first[n] : first[n + 1]]
    return order


@scalar_kernel
def _centres(items, begin, end, order, centres):
    """Write the centres (I, 3) of a segment, and the items into `order`: returns where those not finite begin."""
    share = np.float32(1.0) / np.float32(items.shape[1])  # before the sum: that may overflow
    finite, last = begin, end
    for i in range(begin, end):
        if not is_finite(items[i]):
            last -= 1
            order[last] = i
            continue
        order[finite] = i
        finite += 1
        for axis in range(3):
            total = _ZERO
            for c in range(items.shape[1]):
                total += items[i, c, axis] * share
            centres[i, axis] = total
    return finite


@scalar_kernel
def _widest_axis(centres, order, begin, end):
    axis, widest = 0, -_ONE
    for candidate in range(3):
        low, high = _INFINITY, -_INFINITY
        for k in range(begin, end):
            low = min(low, centres[order[k], candidate])
            high = max(high, centres[order[k], candidate])
        if high - low > widest:
            axis, widest = candidate, high - low
    return axis


@scalar_kernel
def _part(keys, order, begin, end, middle):
    """Move the smaller keys of [begin, end) before `middle`, and `order` along (Hoare, "Find", 1961)."""
    low, high, chance = begin, end - 1, 1
    while low < high:
        chance = (chance * 1103515245 + 12345) & 0x7FFFFFFF  # no order of the items can make this quadratic
        pivot = keys[low + (chance >> 8) % (high - low + 1)]
        i, j = low, high
        while i <= j:
            while keys[i] < pivot:
                i += 1
            while keys[j] > pivot:
                j -= 1
            if i <= j:
                keys[i], keys[j] = keys[j], keys[i]
                order[i], order[j] = order[j], order[i]
                i, j = i + 1, j - 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@scalar_kernel
def tree_order(items, first):
    """Indices (I,) of the items, each segment [first[n], first[n + 1]) in the order of the tree's leaves."""
    order, keys = np.empty(len(items), np.int64), np.empty(len(items), np.float32)
    centres = np.empty((len(items), 3), np.float32)
    begins, ends = np.empty(_HALVINGS, np.int64), np.empty(_HALVINGS, np.int64)
    for n in range(len(first) - 1):
        begins[0], ends[0] = first[n], _centres(items, first[n], first[n + 1], order, centres)
        waiting = 1
        while waiting:
            waiting -= 1
            begin, end = begins[waiting], ends[waiting]
            size = end - begin
            if size <= GROUP:
                continue
            whole = GROUP  # items below a full box of the level that is split
            while whole * GROUP < size:
                whole *= GROUP
            middle = begin + ((size + whole - 1) // whole + 1) // 2 * whole
            axis = _widest_axis(centres, order, begin, end)
            for k in range(begin, end):
                keys[k] = centres[order[k], axis]
            _part(keys, order, begin, end, middle)
            begins[waiting], ends[waiting] = begin, middle
            begins[waiting + 1], ends[waiting + 1] = middle, end
            waiting += 2
    return order


@scalar_kernel
def _count_groups(first):
    """Groups of boxes and leaves that all segments need."""
    boxes, leaves = 0, 0
    for n in range(len(first) - 1):
        width = (first[n + 1] - first[n] + GROUP - 1) // GROUP
        leaves += width
        while width > 0:
            groups = (width + GROUP - 1) // GROUP
            boxes += groups
            width = groups if groups > 1 else 0
    return boxes, leaves


@scalar_kernel
def _grow(boxes, group, place, point):
    """Make one box of a group hold a point (3,)."""
    for axis in range(3):
        low, high = axis * GROUP + place, (axis + 3) * GROUP + place
        boxes[group, low] = min(boxes[group, low], point[axis])
        boxes[group, high] = max(boxes[group, high], point[axis])


@scalar_kernel
def _fill_leaves(items, order, begin, end, leaf, group, boxes, children, leaves, ids):
    """Copy a segment's items into its leaves, and box the leaves."""
    for k in range(begin, end):
        at, place = leaf + (k - begin) // GROUP, (k - begin) % GROUP
        item = items[order[k]]
        ids[at, place] = order[k]
        box, box_place = group + (at - leaf) // GROUP, (at - leaf) % GROUP
        children[box, box_place] = -1 - at
        for c in range(items.shape[1] if is_finite(item) else 0):
            _grow(boxes, box, box_place, item[c])
            for axis in range(3):
                leaves[at, (3 * c + axis) * GROUP + place] = item[c, axis]


@scalar_kernel
def build_tree(items, order, first):
    """The boxes of all segments, from the leaves up.

    Returns:
        boxes: (G, 6 * 8) low x y z and high x y z of each group; the low side is infinite where there is no box.
            Flat, since vector code wants neighbours that it knows to be in one array.
        children: (G, 8) the group below each box; -1 - l for leaf l.
        roots: (N,) the topmost group of each segment, -1 where it is empty.
        leaves: (L, 3k * 8) coordinates of eight items, x y z of each corner in turn; NaN where there is
            none, or none that is finite.
        ids: (L, 8) their indices, -1 where there is none.
    """
    num_groups, num_leaves = _count_groups(first)
    boxes = np.full((num_groups, 6 * GROUP), _INFINITY)
    boxes[:, 3 * GROUP :] = -_INFINITY
    children = np.zeros((num_groups, GROUP), np.int64)
    roots = np.full(len(first) - 1, -1)
    leaves = np.full((num_leaves, 3 * items.shape[1] * GROUP), np.float32(np.nan))
    ids = np.full((num_leaves, GROUP), -1)
    group, leaf = 0, 0
    for n in range(len(first) - 1):
        width = (first[n + 1] - first[n] + GROUP - 1) // GROUP
        _fill_leaves(items, order, first[n], first[n + 1], leaf, group, boxes, children, leaves, ids)
        leaf += width
        while width > GROUP:
            groups = (width + GROUP - 1) // GROUP
            for below in range(groups):
                box, place = group + groups + below // GROUP, below % GROUP
                children[box, place] = group + below
                for axis in range(3):
                    low, high = side_of_group(boxes[group + below], axis)
                    boxes[box, axis * GROUP + place], boxes[box, (axis + 3) * GROUP + place] = low, high
            group, width = group + groups, groups
        if width > 0:
            roots[n] = group
            group += 1
    return boxes, children, roots, leaves, ids


@scalar_kernel
def side_of_group(box, axis):
    """Lowest and highest coordinate of a group (48,) along an axis."""
    low, high = _INFINITY, -_INFINITY
    for j in range(GROUP):
        low = min(low, box[axis * GROUP + j])
        high = max(high, box[(axis + 3) * GROUP + j])
    return low, high


@scalar_kernel
def diagonal(box):
    """Length of the diagonal of the box around a group (48,); 0 where nothing is in it."""
    square = _ZERO
    for axis in range(3):
        low, high = side_of_group(box, axis)
        side = max(high - low, _ZERO)
        square += side * side
    return np.sqrt(square)


@scalar_kernel
def push_children(box, children, low, high, limit, bounds, stack, keys, top):
    """Put the boxes of a group that come nearer than `limit` on the stack, the nearest last; returns the new top.

    Args:
        box: (48,) and children (8,): the group.
        low, high: (3,) the box that is asked about.
        limit: squared distance from which on a box is left out.
        bounds: (8,) room for the squared distances between boxes.
        stack, keys: (STACK,) children to visit and their squared distances, filled up to `top`.
    """
    ax, ay, az, bx, by, bz = low[0], low[1], low[2], high[0], high[1], high[2]
    for j in range(GROUP):
        dx = max(max(box[j] - bx, ax - box[j + 24]), _ZERO)
        dy = max(max(box[j + 8] - by, ay - box[j + 32]), _ZERO)
        dz = max(max(box[j + 16] - bz, az - box[j + 40]), _ZERO)
        bounds[j] = dx * dx + dy * dy + dz * dz
    base = top
    for j in range(GROUP):
        key = bounds[j]
        if key < limit:
            place = top
            while place > base and keys[place - 1] < key:
                keys[place], stack[place] = keys[place - 1], stack[place - 1]
                place -= 1
            keys[place], stack[place] = key, children[j]
            top += 1
    return top
