"""Crossing pairs of triangles on the CPU: the fast twin of `reference.py`, whose rules are numbered there.

Every face walks a box tree over all faces. Pairs are counted, summed and filled, so that no room is ever short; only
faces that have a pair are walked twice. Geometry is float64 as in the reference: a few products of float32 numbers
decide between touching and crossing.
"""

import math

import numpy as np
from numba import prange

from rendra.kernels.box_tree import GROUP, STACK, build_tree, is_finite, push_children, spatial_order
from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel

_FACES_AT_ONCE = 64
_SMALLEST = np.float32(1e-45)  # boxes meet where their squared distance is below it


def crossing_pairs(tris: np.ndarray, tolerance: float) -> np.ndarray:
    """Pairs (K, 2) of faces (F, 3, 3)."""
    first = np.array([0, len(tris)])
    order = spatial_order(tris, first)
    boxes, children, _, _, ids = build_tree(tris, order, first)
    starts = np.zeros(len(tris) + 1, np.int64)
    if not len(tris):
        return np.empty((0, 2), np.int64)
    _find(tris, order, boxes, children, ids, tolerance, num_threads(), False, starts, np.empty((0, 2), np.int64))
    np.cumsum(starts, out=starts)
    pairs = np.empty((starts[-1], 2), np.int64)
    _find(tris, order, boxes, children, ids, tolerance, num_threads(), True, starts, pairs)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


@parallel_kernel
def _find(tris, order, boxes, children, ids, tolerance, workers, fill, starts, pairs):
    """Count the pairs of face i into starts[i + 1]; or, with their sums there, write them."""
    blocks = (len(order) + _FACES_AT_ONCE - 1) // _FACES_AT_ONCE
    for worker in prange(workers):
        stack, keys = np.empty(STACK, np.int64), np.empty(STACK, np.float32)
        bounds, low, high = np.empty(GROUP, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
        for block in range(worker, blocks, workers):
            for k in range(block * _FACES_AT_ONCE, min((block + 1) * _FACES_AT_ONCE, len(order))):
                i = order[k]
                if not is_finite(tris[i]) or (fill and starts[i] == starts[i + 1]):
                    continue
                for axis in range(3):
                    low[axis] = min(tris[i, 0, axis], min(tris[i, 1, axis], tris[i, 2, axis]))
                    high[axis] = max(tris[i, 0, axis], max(tris[i, 1, axis], tris[i, 2, axis]))
                number = _pairs_of_one(tris, i, low, high, boxes, children, ids, tolerance, fill, starts[i], pairs,
                                       bounds, stack, keys)  # fmt: skip
                if not fill:
                    starts[i + 1] = number


@scalar_kernel
def _pairs_of_one(tris, i, low, high, boxes, children, ids, tolerance, fill, start, pairs, bounds, stack, keys):
    """Number of faces above i that cross it; with `fill` also written from pairs[start] on."""
    number, root = 0, len(boxes) - 1
    top = push_children(boxes[root], children[root], low, high, _SMALLEST, bounds, stack, keys, 0)
    while top > 0:
        top -= 1
        node = stack[top]
        if node >= 0:
            top = push_children(boxes[node], children[node], low, high, _SMALLEST, bounds, stack, keys, top)
            continue
        for slot in range(GROUP):
            j = ids[-1 - node, slot]
            if j > i and _boxes_meet(tris[j], low, high) and _cross_each_other(tris[i], tris[j], tolerance):
                if fill:
                    pairs[start + number, 0], pairs[start + number, 1] = i, j
                number += 1
    return number


@scalar_kernel
def _boxes_meet(t, low, high):
    for axis in range(3):
        if not (
            min(t[0, axis], min(t[1, axis], t[2, axis])) <= high[axis]
            and max(t[0, axis], max(t[1, axis], t[2, axis])) >= low[axis]
        ):
            return False
    return True


@scalar_kernel
def _corner(t, c):
    return np.float64(t[c, 0]), np.float64(t[c, 1]), np.float64(t[c, 2])


@scalar_kernel
def _minus(x, y):
    return x[0] - y[0], x[1] - y[1], x[2] - y[2]


@scalar_kernel
def _cross(x, y):
    return x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]


@scalar_kernel
def _dot(x, y):
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


@scalar_kernel
def _unit(x):
    """The vector divided by its length, zero if it has none; and the length."""
    length = math.sqrt(_dot(x, x))
    scale = 1.0 / length if length > 0.0 else 0.0
    return (x[0] * scale, x[1] * scale, x[2] * scale), length


@scalar_kernel
def _normal(t, tolerance):
    """Unit normal, and whether the triangle is higher than the tolerance."""
    a, b, c = _corner(t, 0), _corner(t, 1), _corner(t, 2)
    ab, bc, ca = _minus(b, a), _minus(c, b), _minus(a, c)
    normal, twice_area = _unit(_cross(ab, _minus(c, a)))
    longest = math.sqrt(max(_dot(ab, ab), max(_dot(bc, bc), _dot(ca, ca))))
    return normal, twice_area > tolerance * longest


@scalar_kernel
def _side(t, c, other, normal, tolerance):
    """Signed distance of corner c of t to the plane of `other`; zero within the tolerance or if they share it."""
    for k in range(3):
        if t[c, 0] == other[k, 0] and t[c, 1] == other[k, 1] and t[c, 2] == other[k, 2]:
            return 0.0
    distance = _dot(_minus(_corner(t, c), _corner(other, 0)), normal)
    return distance if abs(distance) > tolerance else 0.0


@scalar_kernel
def _sides(t, other, normal, tolerance):
    """The three signed distances, and whether they lie strictly on both sides."""
    x, y, z = (
        _side(t, 0, other, normal, tolerance), _side(t, 1, other, normal, tolerance),
        _side(t, 2, other, normal, tolerance),
    )  # fmt: skip
    return (x, y, z), min(x, min(y, z)) < 0.0 and max(x, max(y, z)) > 0.0


@scalar_kernel
def _piece(t, sides, origin, line):
    """Where, along the line, a triangle passes through the other's plane: from, to."""
    low, high = math.inf, -math.inf
    for k in range(3):
        here, there = sides[k], sides[(k + 1) % 3]
        x = _dot(_minus(_corner(t, k), origin), line)
        if here * there < 0.0:
            y = _dot(_minus(_corner(t, (k + 1) % 3), origin), line)
            x += (y - x) * here / (here - there)
        elif here != 0.0:
            continue
        low, high = min(low, x), max(high, x)
    return low, high


@scalar_kernel
def _cross_each_other(a, b, tolerance):
    """Rules 1 and 2."""
    normal_b, is_thick = _normal(b, tolerance)
    sides_a, straddles = _sides(a, b, normal_b, tolerance)
    if not (is_thick and straddles):
        return False
    normal_a, is_thick = _normal(a, tolerance)
    sides_b, straddles = _sides(b, a, normal_a, tolerance)
    if not (is_thick and straddles):
        return False
    line, _ = _unit(_cross(normal_a, normal_b))
    low_a, high_a = _piece(a, sides_a, _corner(a, 0), line)
    low_b, high_b = _piece(b, sides_b, _corner(a, 0), line)
    return min(high_a, high_b) - max(low_a, low_b) > tolerance
