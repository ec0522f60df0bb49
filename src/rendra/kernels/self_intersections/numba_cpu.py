"""Crossing pairs of triangles on the CPU: the fast twin of `reference.py`, whose rules are numbered there.

Every leaf of eight faces walks a box tree; eight faces at a time are sieved before the exact test. Pairs are counted,
summed and filled, so that no room is ever short; only leaves that have a pair are walked twice. Geometry
is float64 as in the reference: a few products of float32 numbers decide between touching and crossing.
"""

import math

import numpy as np
from numba import prange

from rendra.kernels.box_tree import GROUP, STACK, build_tree, is_finite, push_children, side_of_group, tree_order
from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel

_ZERO = np.float32(0.0)
_INFINITY = np.float32(np.inf)
_SMALLEST = np.float32(1e-45)  # boxes meet where their squared distance is below it


def crossing_pairs(tris: np.ndarray, tolerance: float) -> np.ndarray:
    """Pairs (K, 2) of faces (F, 3, 3)."""
    if not len(tris):
        return np.empty((0, 2), np.int64)
    first = np.array([0, len(tris)])
    boxes, children, _, corners, ids = build_tree(tris, tree_order(tris, first), first)
    tree, workers = (boxes, children, corners, ids, *_measure(tris, ids, tolerance)), num_threads()
    starts = np.zeros(len(ids) + 1, np.int64)
    _find(tris, tree, tolerance, workers, False, starts, np.empty(0, np.int64))
    np.cumsum(starts, out=starts)
    pairs = np.empty(starts[-1], np.int64)
    if len(pairs):
        _find(tris, tree, tolerance, workers, True, starts, pairs)
        pairs.sort()
    return np.stack(np.divmod(pairs, len(tris)), axis=1)


@scalar_kernel
def _measure(tris, ids, tolerance):
    """The boxes (L, 6 * 8) of each leaf's faces, as those of a group, and their unit normals (L, 3 * 8), x y z each.

    A face that crosses nothing has the normal NaN.
    """
    bounds = np.full((len(ids), 6 * GROUP), _INFINITY)
    bounds[:, 3 * GROUP :] = -_INFINITY
    normals = np.full((len(ids), 3 * GROUP), math.nan)
    for leaf in range(len(ids)):
        for slot in range(GROUP):
            i = ids[leaf, slot]
            if i < 0 or not is_finite(tris[i]):
                continue
            normal, is_thick = _normal(tris[i], tolerance)
            for axis in range(3):
                x, y, z = tris[i, 0, axis], tris[i, 1, axis], tris[i, 2, axis]
                bounds[leaf, axis * GROUP + slot] = min(x, min(y, z))
                bounds[leaf, (axis + 3) * GROUP + slot] = max(x, max(y, z))
                if is_thick:
                    normals[leaf, axis * GROUP + slot] = normal[axis]
    return bounds, normals


@parallel_kernel
def _find(tris, tree, tolerance, workers, fill, starts, pairs):
    """Count the pairs of leaf l with itself and those after it into starts[l + 1]; or write them."""
    boxes, children, _, ids, bounds, _ = tree
    for worker in prange(workers):
        stack, keys = np.empty(STACK, np.int64), np.empty(STACK, np.float32)
        gaps, margins = np.empty(GROUP, np.float32), np.empty(GROUP, np.float64)
        low, high = np.empty(3, np.float32), np.empty(3, np.float32)
        for leaf in range(worker, len(ids), workers):
            if fill and starts[leaf] == starts[leaf + 1]:
                continue
            for axis in range(3):
                low[axis], high[axis] = side_of_group(bounds[leaf], axis)
            start, number, root = starts[leaf], 0, len(boxes) - 1
            top = push_children(boxes[root], children[root], low, high, _SMALLEST, gaps, stack, keys, 0)
            while top > 0:
                top -= 1
                node = stack[top]
                if node >= 0:
                    top = push_children(boxes[node], children[node], low, high, _SMALLEST, gaps, stack, keys, top)
                elif -1 - node >= leaf:
                    number += _pairs_of_leaves(tris, tree, leaf, -1 - node, tolerance, fill, start + number, pairs,
                                               gaps, margins)  # fmt: skip
            if not fill:
                starts[leaf + 1] = number


@scalar_kernel
def _pairs_of_leaves(tris, tree, leaf, other, tolerance, fill, start, pairs, gaps, margins):
    """Number of crossing pairs between two leaves; with `fill`, pair i < j is written as i F + j from `start` on."""
    _, _, corners, ids, bounds, normals = tree
    number = 0
    for slot in range(GROUP):
        i = ids[leaf, slot]
        if i < 0 or not _measure_gaps(bounds[leaf], slot, bounds[other], gaps):
            continue
        _measure_margins(tris[i], corners[other], normals[other], margins)
        for place in range(slot + 1 if leaf == other else 0, GROUP):
            if not (gaps[place] <= _ZERO and margins[place] > tolerance):
                continue
            j = ids[other, place]
            normal_i, normal_j = _normal_of(normals[leaf], slot), _normal_of(normals[other], place)
            if i < j:
                crosses = _cross_each_other(tris[i], tris[j], normal_i, normal_j, tolerance)
            else:
                crosses = _cross_each_other(tris[j], tris[i], normal_j, normal_i, tolerance)
            if crosses:
                if fill:
                    pairs[start + number] = min(i, j) * len(tris) + max(i, j)
                number += 1
    return number


@scalar_kernel
def _normal_of(normals, slot):
    return normals[slot], normals[GROUP + slot], normals[2 * GROUP + slot]


@scalar_kernel
def _measure_gaps(box, slot, others, gaps):
    """Write how far the slot's box is from eight others, at most zero where they meet; whether it meets any."""
    ax, ay, az = box[slot], box[GROUP + slot], box[2 * GROUP + slot]
    bx, by, bz = box[3 * GROUP + slot], box[4 * GROUP + slot], box[5 * GROUP + slot]
    least = _INFINITY
    for j in range(GROUP):
        x = max(others[j] - bx, ax - others[j + 24])
        y = max(others[j + 8] - by, ay - others[j + 32])
        z = max(others[j + 16] - bz, az - others[j + 40])
        gaps[j] = max(x, max(y, z))
    for j in range(GROUP):
        least = min(least, gaps[j])
    return least <= _ZERO


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
def _measure_margins(t, corners, normals, margins):
    """Write how far t reaches through the planes of eight faces: the lesser of its distances to both sides.

    As in `_side`, but that shared corners are not zero: where this is within the tolerance, rule 1 does not hold.
    """
    a, b, c = _corner(t, 0), _corner(t, 1), _corner(t, 2)
    for j in range(GROUP):
        origin = np.float64(corners[j]), np.float64(corners[j + 8]), np.float64(corners[j + 16])
        normal = normals[j], normals[j + 8], normals[j + 16]
        x, y, z = _dot(_minus(a, origin), normal), _dot(_minus(b, origin), normal), _dot(_minus(c, origin), normal)
        margins[j] = min(max(x, max(y, z)), -min(x, min(y, z)))


@scalar_kernel
def _cross_each_other(a, b, normal_a, normal_b, tolerance):
    """Rules 1 and 2, for triangles higher than the tolerance."""
    sides_a, straddles = _sides(a, b, normal_b, tolerance)
    if not straddles:
        return False
    sides_b, straddles = _sides(b, a, normal_a, tolerance)
    if not straddles:
        return False
    line, _ = _unit(_cross(normal_a, normal_b))
    low_a, high_a = _piece(a, sides_a, _corner(a, 0), line)
    low_b, high_b = _piece(b, sides_b, _corner(a, 0), line)
    return min(high_a, high_b) - max(low_a, low_b) > tolerance
