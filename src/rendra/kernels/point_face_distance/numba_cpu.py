"""Nearest faces and points on the CPU: the fast twin of `reference.py`, whose rules are numbered there.

Forward: queries, sorted along a Morton curve, walk a box tree over the targets of their segment, nearest box first;
eight triangles or points are measured at a time. Each query starts from the result of the one before it.
Backward: one thread adds the pairs in their order, a hundredth of the forward pass; so nothing races.
"""

import math

import numpy as np
from numba import prange

from rendra.kernels.box_tree import (
    GROUP,
    STACK,
    build_tree,
    diagonal,
    is_finite,
    push_children,
    spatial_order,
    tree_order,
)
from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel
from rendra.kernels.point_face_distance.lanes import face_to_eight_points, point_to_eight_faces

ZERO = np.float32(0.0)
ONE = np.float32(1.0)
TWO = np.float32(2.0)
HALF = np.float32(0.5)
QUARTER = np.float32(0.25)
TINY = np.float32(1e-37)  # least square of a length or an area that is not zero
INFINITY = np.float32(np.inf)
NAN = np.float32(np.nan)
SLACK = np.float32(1e-6)  # bounds rounding: of a distance, and of an edge as long as the segment's diagonal

_QUERIES_AT_ONCE = 64


def nearest_face(
    points: np.ndarray, points_first: np.ndarray, tris: np.ndarray, tris_first: np.ndarray, min_area: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Squared distance (P,), face (P,) and weights (P, 3) for points (P, 3) and faces (F, 3, 3)."""
    return _nearest(points[:, None], points_first, tris, tris_first, min_area)


def nearest_point(
    points: np.ndarray, points_first: np.ndarray, tris: np.ndarray, tris_first: np.ndarray, min_area: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Squared distance (F,), point (F,) and weights (F, 3) for points (P, 3) and faces (F, 3, 3)."""
    return _nearest(tris, tris_first, points[:, None], points_first, min_area)


def _nearest(
    queries: np.ndarray, queries_first: np.ndarray, targets: np.ndarray, targets_first: np.ndarray, min_area: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    query_ends, target_ends = np.append(queries_first, len(queries)), np.append(targets_first, len(targets))
    order = spatial_order(queries, query_ends)
    tree = build_tree(targets, tree_order(targets, target_ends), target_ends)
    owner = np.repeat(np.arange(len(queries_first)), np.diff(query_ends))
    squared, index = np.empty(len(queries), np.float32), np.empty(len(queries), np.int64)
    weights = np.empty((len(queries), 3), np.float32)
    _walk(queries, order, owner, targets, *tree, np.float32(4 * min_area**2), num_threads(), squared, index, weights)
    return squared, index, weights


def backward(
    points: np.ndarray, tris: np.ndarray, by_point: bool, index: np.ndarray, weights: np.ndarray, upstream: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients of points (P, 3) and faces (F, 3, 3); `by_point` tells whose index, weights and upstream it is."""
    grad_points, grad_tris = np.zeros_like(points), np.zeros_like(tris)
    _scatter(points, tris, by_point, index, weights, upstream, grad_points, grad_tris)
    return grad_points, grad_tris


@scalar_kernel
def inverse(square):
    """1 / square, finite where it vanishes: then what it multiplies is zero, or any foot will do."""
    return ONE / max(square, TINY)


@scalar_kernel
def edge_distance(ax, ay, az, bx, by, bz, ex, ey, ez, at_a, at_b):
    """Rule 1: (squared distance, s) from the arms to both ends, the edge itself and the arms' squares."""
    mx, my, mz = ax + bx, ay + by, az + bz
    s = (mx * ex + my * ey + mz * ez) * inverse(ex * ex + ey * ey + ez * ez)
    s = min(max(s, -ONE), ONE)
    rx, ry, rz = mx - s * ex, my - s * ey, mz - s * ez
    inside = (rx * rx + ry * ry + rz * rz) * QUARTER
    return (at_b if s >= ONE else (at_a if s <= -ONE else inside)), s


@scalar_kernel
def plane_distance(px, py, pz, bx, by, bz, cx, cy, cz, least_square):
    """Rule 2: (squared distance or infinity, v, w) from the arm to a and the edges ab and ac."""
    nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    square = nx * nx + ny * ny + nz * nz
    per_square = inverse(square)
    v = (nx * (py * cz - pz * cy) + ny * (pz * cx - px * cz) + nz * (px * cy - py * cx)) * per_square
    w = (nx * (by * pz - bz * py) + ny * (bz * px - bx * pz) + nz * (bx * py - by * px)) * per_square
    rx, ry, rz = px - v * bx - w * cx, py - v * by - w * cy, pz - v * bz - w * cz
    counts = v >= ZERO and w >= ZERO and v + w <= ONE and square >= least_square
    return (rx * rx + ry * ry + rz * rz if counts else INFINITY), v, w


@scalar_kernel
def candidates(px, py, pz, ax, ay, az, bx, by, bz, cx, cy, cz, least_square):
    """Squared distances to edges ab, bc, ca and the plane, then the places of their feet: s, s, s, v, w."""
    pax, pay, paz = px - ax, py - ay, pz - az
    pbx, pby, pbz = px - bx, py - by, pz - bz
    pcx, pcy, pcz = px - cx, py - cy, pz - cz
    at_a = pax * pax + pay * pay + paz * paz
    at_b = pbx * pbx + pby * pby + pbz * pbz
    at_c = pcx * pcx + pcy * pcy + pcz * pcz
    abx, aby, abz = bx - ax, by - ay, bz - az
    acx, acy, acz = cx - ax, cy - ay, cz - az
    ab, s_ab = edge_distance(pax, pay, paz, pbx, pby, pbz, abx, aby, abz, at_a, at_b)
    bc, s_bc = edge_distance(pbx, pby, pbz, pcx, pcy, pcz, cx - bx, cy - by, cz - bz, at_b, at_c)
    ca, s_ca = edge_distance(pcx, pcy, pcz, pax, pay, paz, -acx, -acy, -acz, at_c, at_a)
    plane, v, w = plane_distance(pax, pay, paz, abx, aby, abz, acx, acy, acz, least_square)
    return ab, bc, ca, plane, s_ab, s_bc, s_ca, v, w


@scalar_kernel
def foot(p, t, least_square):
    """Squared distance, and barycentric weights of the nearest point of triangle t (3, 3) to p (3,)."""
    ab, bc, ca, plane, s_ab, s_bc, s_ca, v, w = candidates(
        p[0], p[1], p[2], t[0, 0], t[0, 1], t[0, 2], t[1, 0], t[1, 1], t[1, 2], t[2, 0], t[2, 1], t[2, 2],
        least_square,
    )  # fmt: skip
    if plane <= min(ab, min(bc, ca)):
        w0, w1, w2 = ONE - (v + w), v, w
    elif ab <= min(bc, ca):
        w0, w1, w2 = (ONE - s_ab) * HALF, (ONE + s_ab) * HALF, ZERO
    elif bc <= ca:
        w0, w1, w2 = ZERO, (ONE - s_bc) * HALF, (ONE + s_bc) * HALF
    else:
        w0, w1, w2 = (ONE + s_ca) * HALF, ZERO, (ONE - s_ca) * HALF
    x, y, z = arm(p, t, w0, w1, w2)
    return x * x + y * y + z * z, w0, w1, w2


@scalar_kernel
def arm(p, t, w0, w1, w2):
    """From the point of triangle t with these weights to p."""
    x = w0 * (p[0] - t[0, 0]) + w1 * (p[0] - t[1, 0]) + w2 * (p[0] - t[2, 0])
    y = w0 * (p[1] - t[0, 1]) + w1 * (p[1] - t[1, 1]) + w2 * (p[1] - t[2, 1])
    z = w0 * (p[2] - t[0, 2]) + w1 * (p[2] - t[1, 2]) + w2 * (p[2] - t[2, 2])
    return x, y, z


@scalar_kernel
def _measure_leaf(query, leaf, least_square, out):
    """Squared distances (8,) of one query to the items of a leaf: a point to triangles, or a triangle to points."""
    if query.shape[0] == 1:
        point_to_eight_faces(leaf, query, least_square, out)
    else:
        face_to_eight_points(leaf, query, least_square, out)


@scalar_kernel
def _limit(best, diag):
    """Squared distance of the boxes that may still hold a nearer item, or an equal one, for all the rounding."""
    reach = math.sqrt(best) * (ONE + SLACK) + SLACK * diag
    return reach * reach + TINY  # never zero: an equal one must be below it


@scalar_kernel
def _bound(query, low, high):
    """Write the box of a query into low (3,) and high (3,)."""
    for axis in range(3):
        low[axis] = high[axis] = query[0, axis]
        for c in range(1, query.shape[0]):
            low[axis] = min(low[axis], query[c, axis])
            high[axis] = max(high[axis], query[c, axis])


@parallel_kernel
def _walk(queries, order, owner, targets, boxes, children, roots, leaves, ids, least_square, workers, squared, index,
          weights):  # fmt: skip
    blocks = (len(order) + _QUERIES_AT_ONCE - 1) // _QUERIES_AT_ONCE
    for worker in prange(workers):
        stack, keys = np.empty(STACK, np.int64), np.empty(STACK, np.float32)
        bounds, low, high = np.empty(GROUP, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
        for block in range(worker, blocks, workers):
            segment, nearest, diag = -1, -1, ZERO
            for k in range(block * _QUERIES_AT_ONCE, min((block + 1) * _QUERIES_AT_ONCE, len(order))):
                i = order[k]
                if owner[i] != segment:
                    segment, nearest = owner[i], -1
                    diag = diagonal(boxes[roots[segment]]) if roots[segment] >= 0 else ZERO
                if roots[segment] >= 0 and is_finite(queries[i]):
                    _bound(queries[i], low, high)
                    nearest = _nearest_of_one(
                        queries[i], low, high, diag, targets, nearest, boxes, children, roots[segment], leaves, ids,
                        least_square, bounds, stack, keys,
                    )  # fmt: skip
                    found = nearest
                else:
                    found = -1
                index[i] = found
                d, w0, w1, w2 = NAN if roots[segment] >= 0 else ZERO, ZERO, ZERO, ZERO
                if found >= 0:
                    d, w0, w1, w2 = _foot_of_pair(queries[i], targets[found], least_square)
                squared[i], weights[i, 0], weights[i, 1], weights[i, 2] = d, w0, w1, w2


@scalar_kernel
def _foot_of_pair(query, target, least_square):
    if query.shape[0] == 1:
        return foot(query[0], target, least_square)
    return foot(target[0], query, least_square)


@scalar_kernel
def _nearest_of_one(query, low, high, diag, targets, guess, boxes, children, root, leaves, ids, least_square, bounds,
                    stack, keys):  # fmt: skip
    """Index of the target nearest to one query, -1 if none is at a finite distance; `guess` is tried first."""
    best, nearest, limit = INFINITY, -1, INFINITY
    if guess >= 0:
        start = _foot_of_pair(query, targets[guess], least_square)[0]
        if start < INFINITY:
            limit = _limit(start, diag)
    top = push_children(boxes[root], children[root], low, high, limit, bounds, stack, keys, 0)
    while top > 0:
        top -= 1
        if not keys[top] < limit:
            continue
        node = stack[top]
        if node >= 0:
            top = push_children(boxes[node], children[node], low, high, limit, bounds, stack, keys, top)
            continue
        _measure_leaf(query, leaves[-1 - node], least_square, bounds)
        for j in range(GROUP):
            d = bounds[j]
            if d < best or (d == best and ids[-1 - node, j] < nearest and d < INFINITY):
                best, nearest = d, ids[-1 - node, j]
                limit = min(limit, _limit(best, diag))
    return nearest


@scalar_kernel
def _scatter(points, tris, by_point, index, weights, upstream, grad_points, grad_tris):
    """Add what every pair asks, in their order: 2 g r of its point, and -w_i 2 g r of the corners of its face."""
    for k in range(len(index)):
        if index[k] >= 0:
            p, f = (k, index[k]) if by_point else (index[k], k)
            w0, w1, w2 = weights[k, 0], weights[k, 1], weights[k, 2]
            r = arm(points[p], tris[f], w0, w1, w2)
            for axis in range(3):
                pull = TWO * upstream[k] * r[axis]
                grad_points[p, axis] += pull
                grad_tris[f, 0, axis] -= w0 * pull
                grad_tris[f, 1, axis] -= w1 * pull
                grad_tris[f, 2, axis] -= w2 * pull
