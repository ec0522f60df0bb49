"""Overlapping balls on the CPU: sort and sweep along the widest axis, pair of groups by pair of groups.

Threads own bodies. Pairs are counted, summed and filled, so that no room is ever short. Distances are float64, with
the squares summed as in `reference.py`.
"""

import numpy as np
from numba import prange

from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel

_INFINITY = np.inf
_SLACK = 1e-15  # of the ends of an interval: rounding must not hide a pair from the test that decides


def sphere_pairs(
    centers: np.ndarray, radii: np.ndarray, groups: np.ndarray, group_pairs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Starts (N + 1,) and pairs (M, 2)."""
    count, size = radii.shape
    first = np.zeros(count + 1, np.int64)
    if not count * size * len(group_pairs):
        return first, np.empty((0, 2), np.int64)
    num_groups = int(groups.max()) + 1
    members = np.argsort(groups, kind="stable")
    group_first = np.searchsorted(groups[members], np.arange(num_groups + 1))
    tasks = np.unique(np.sort(group_pairs[(group_pairs < num_groups).all(1)], axis=1), axis=0)
    workers = min(num_threads(), count)
    order, spans = np.empty((count, size), np.int64), np.empty((count, size, 2))
    _sort(centers, radii, members, group_first, workers, order, spans)
    body = (centers, radii, order, spans, group_first, tasks, workers)
    _find(*body, False, first, np.empty(0, np.int64))
    np.cumsum(first, out=first)
    keys = np.empty(first[-1], np.int64)
    if len(keys):
        _find(*body, True, first, keys)
    return first, np.stack(np.divmod(keys, size), axis=1)


@parallel_kernel
def _sort(centers, radii, members, group_first, workers, order, spans):
    """Order the balls of each group of each body by where they begin; write where each one there begins and ends."""
    size = len(members)
    for worker in prange(workers):
        starts = np.empty(size)
        for body in range(worker, len(centers), workers):
            axis = _widest_axis(centers[body], radii[body])
            for place in range(size):
                ball = members[place]
                starts[place] = _INFINITY
                if _is_finite(centers[body], radii[body], ball):
                    starts[place] = np.float64(centers[body, ball, axis]) - np.float64(radii[body, ball])
            for group in range(len(group_first) - 1):
                begin, end = group_first[group], group_first[group + 1]
                if begin < end:
                    ranks = np.argsort(starts[begin:end])
                    for rank in range(end - begin):
                        order[body, begin + rank] = members[begin + ranks[rank]]
            for place in range(size):
                ball = order[body, place]
                spans[body, place, 0], spans[body, place, 1] = _INFINITY, -_INFINITY
                if _is_finite(centers[body], radii[body], ball):
                    x, r = np.float64(centers[body, ball, axis]), np.float64(radii[body, ball])
                    slack = _SLACK * (abs(x) + r)
                    spans[body, place, 0], spans[body, place, 1] = x - r - slack, x + r + slack


@scalar_kernel
def _is_finite(centers, radii, ball):
    total = np.float64(radii[ball])
    for axis in range(3):
        total += np.float64(centers[ball, axis])
    return np.isfinite(total)


@scalar_kernel
def _widest_axis(centers, radii):
    best, widest = 0, -1.0
    for axis in range(3):
        low, high = _INFINITY, -_INFINITY
        for ball in range(len(centers)):
            if _is_finite(centers, radii, ball):
                low, high = min(low, centers[ball, axis]), max(high, centers[ball, axis])
        if high - low > widest:
            best, widest = axis, high - low
    return best


@parallel_kernel
def _find(centers, radii, order, spans, group_first, tasks, workers, fill, first, keys):
    """Count the pairs of body n into first[n + 1]; or write them, ball i < j as i S + j, in order."""
    for worker in prange(workers):
        for body in range(worker, len(centers), workers):
            if fill and first[body] == first[body + 1]:
                continue
            start, number = first[body], 0
            balls = (centers[body], radii[body], order[body], spans[body])
            for task in range(len(tasks)):
                a, b = tasks[task, 0], tasks[task, 1]
                begin_a, end_a, begin_b, end_b = (
                    group_first[a],
                    group_first[a + 1],
                    group_first[b],
                    group_first[b + 1],
                )
                if begin_a == end_a or begin_b == end_b:
                    continue
                room = start + number if fill else 0
                number += _sweep(balls, begin_a, end_a, begin_b, end_b, True, fill, room, keys)
                if a != b:
                    room = start + number if fill else 0
                    number += _sweep(balls, begin_b, end_b, begin_a, end_a, False, fill, room, keys)
            if fill:
                keys[start : start + number].sort()
            else:
                first[body + 1] = number


@scalar_kernel
def _sweep(balls, begin_a, end_a, begin_b, end_b, with_ties, fill, room, keys):
    """Number of pairs of a ball of A with one of B that begins inside it, or with it if ties count; keys from `room`.

    A and B the same: those that stand after it in the order.
    """
    centers, radii, order, spans = balls
    number, next_b = 0, begin_b
    for a in range(begin_a, end_a):
        low, high = spans[a, 0], spans[a, 1]
        if begin_a == begin_b:
            next_b = a + 1
        else:
            while next_b < end_b and (spans[next_b, 0] < low or (spans[next_b, 0] == low and not with_ties)):
                next_b += 1
        b = next_b
        while b < end_b and spans[b, 0] < high:
            i, j = order[a], order[b]
            if _overlap(centers, radii, i, j):
                if fill:
                    keys[room + number] = min(i, j) * len(order) + max(i, j)
                number += 1
            b += 1
    return number


@scalar_kernel
def _overlap(centers, radii, i, j):
    x = np.float64(centers[i, 0]) - np.float64(centers[j, 0])
    y = np.float64(centers[i, 1]) - np.float64(centers[j, 1])
    z = np.float64(centers[i, 2]) - np.float64(centers[j, 2])
    reach = np.float64(radii[i]) + np.float64(radii[j])
    return x * x + y * y + z * z < reach * reach
