"""Farthest point sampling on the CPU: the fast twin of `reference.py`. Threads share the clouds out among themselves.

A cloud is cut into buckets of neighbouring points. A new sample is compared with the points of a bucket only if it
comes nearer to the bucket's box than the bucket's farthest point is to the samples before: otherwise no distance in
there can shrink. `README.md` says why that is exact in floating point.
"""

import numpy as np
from numba import prange

from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel

_BUCKET = 128  # points; a smaller bucket saves distances and costs boxes
_BUCKETS_PER_SAMPLE = 8  # finer than that is not worth the cutting
_INF, _ZERO, _HALF = np.float32(np.inf), np.float32(0), np.float32(0.5)
_NO_INDEX = np.int64(2**62)


def forward(
    points: np.ndarray, lengths: np.ndarray, num_samples: np.ndarray, start: np.ndarray, picked: np.ndarray
) -> None:
    """Write the indices taken into the rows of `picked` (N, K), and leave the rest of a row as it is."""
    _sample_all(points, lengths, num_samples, start, num_threads(), picked)


@parallel_kernel
def _sample_all(points, lengths, num_samples, start, workers, picked):
    for worker in prange(workers):
        for n in range(worker, len(points), workers):
            number = min(num_samples[n], lengths[n])
            if number > 0:
                _sample(points[n], lengths[n], number, start[n], picked[n])


@scalar_kernel
def _sample(cloud, length, number, first, picked):
    picked[0] = first
    if number == 1:
        return
    dims = cloud.shape[1]
    largest = max(_BUCKET, length // (_BUCKETS_PER_SAMPLE * number))
    order, starts = _cut(cloud, length, largest)
    buckets = len(starts) - 1
    axes, lows, highs = (
        np.empty((dims, length), np.float32),
        np.empty((dims, buckets), np.float32),
        np.empty((dims, buckets), np.float32),
    )
    for d in range(dims):
        _sort_axis(cloud, d, order, starts, axes[d], lows[d], highs[d])
    nearest, squared, bounds = np.full(length, _INF), np.empty(length, np.float32), np.empty(buckets, np.float32)
    farthest, farthest_index = np.full(buckets, _INF), order[starts[:-1]]
    # what is not negative compares as the integer of its bits does, and that is how the compiler vectorises a maximum
    nearest_bits, farthest_bits = nearest.view(np.int32), farthest.view(np.int32)
    here = np.int64(first)
    for i in range(1, number):
        bounds[:] = _ZERO
        for d in range(dims):
            _add_gaps(lows[d], highs[d], cloud[here, d], bounds)
        for b in range(buckets):
            if bounds[b] < farthest[b]:
                begin, end = starts[b], starts[b + 1]
                squared[begin:end] = _ZERO
                for d in range(dims):
                    _add_squares(axes[d], cloud[here, d], begin, end, squared)
                _shrink(squared, begin, end, nearest)
                farthest_index[b] = _first_largest(nearest_bits, order, begin, end)
                farthest_bits[b] = _largest(nearest_bits, begin, end)
        here = _first_largest(farthest_bits, farthest_index, 0, buckets)
        picked[i] = here


@scalar_kernel
def _cut(cloud, length, largest):
    """Point indices bucket by bucket, rising within each, and where each bucket starts and the last one ends.

    What holds more than `largest` points is halved at the middle of the longest side of its box.
    """
    order, spare = np.empty(length, np.int64), np.empty(length, np.int64)
    for i in range(length):
        order[i] = i
    starts, ends = np.empty(length + 1, np.int64), np.empty(length, np.int64)
    buckets, waiting = 0, 1  # ends: of what still has to be cut, the nearest one last
    starts[0], ends[0] = 0, length
    while waiting > 0:
        begin, end = starts[buckets], ends[waiting - 1]
        axis, low, high = 0, _ZERO, _ZERO
        if end - begin > largest:
            axis, low, high = _longest_side(cloud, order, begin, end)
        if low == high:
            waiting -= 1
            buckets += 1
            starts[buckets] = end
        else:
            middle = _HALF * low + _HALF * high
            middle = low if middle >= high else middle
            ends[waiting] = _part(cloud, axis, middle, order, spare, begin, end)
            waiting += 1
    return order, starts[: buckets + 1]


@scalar_kernel
def _longest_side(cloud, order, begin, end):
    axis, low, high = 0, _ZERO, _ZERO
    for d in range(cloud.shape[1]):
        least = most = cloud[order[begin], d]
        for i in range(begin + 1, end):
            value = cloud[order[i], d]
            least = min(least, value)
            most = max(most, value)
        if _HALF * most - _HALF * least > _HALF * high - _HALF * low or (low == high and least < most):
            axis, low, high = d, least, most
    return axis, low, high


@scalar_kernel
def _part(cloud, axis, middle, order, spare, begin, end):
    """Put what lies up to `middle` before the rest, both in their order; returns where the rest starts."""
    kept, moved = begin, 0
    for i in range(begin, end):
        index = order[i]
        if cloud[index, axis] <= middle:
            order[kept] = index
            kept += 1
        else:
            spare[moved] = index
            moved += 1
    for i in range(moved):
        order[kept + i] = spare[i]
    return kept


@scalar_kernel
def _sort_axis(cloud, d, order, starts, axis, lows, highs):
    """One coordinate of the points, bucket by bucket, and its range in each."""
    for b in range(len(starts) - 1):
        least, most = _INF, -_INF
        for i in range(starts[b], starts[b + 1]):
            value = cloud[order[i], d]
            axis[i] = value
            least = min(least, value)
            most = max(most, value)
        lows[b], highs[b] = least, most


@scalar_kernel
def _add_gaps(lows, highs, value, bounds):
    for b in range(len(bounds)):
        gap = max(max(lows[b] - value, value - highs[b]), _ZERO)
        bounds[b] += gap * gap


@scalar_kernel
def _add_squares(axis, value, begin, end, squared):
    for i in range(begin, end):
        step = axis[i] - value
        squared[i] += step * step


@scalar_kernel
def _shrink(squared, begin, end, nearest):
    for i in range(begin, end):
        nearest[i] = min(nearest[i], squared[i])


@scalar_kernel
def _largest(bits, begin, end):
    most = np.int32(0)
    for i in range(begin, end):
        most = max(most, bits[i])
    return most


@scalar_kernel
def _first_largest(bits, indices, begin, end):
    """The lowest of the indices at which the largest value stands."""
    most, lowest = _largest(bits, begin, end), _NO_INDEX
    for i in range(begin, end):
        lowest = min(lowest, indices[i] if bits[i] == most else _NO_INDEX)
    return lowest
