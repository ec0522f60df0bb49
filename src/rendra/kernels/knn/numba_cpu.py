"""Nearest points on the CPU: the fast twin of `reference.py`.

Each cloud is sorted along a curve, 16 points to a leaf; queries walk down the tree of the other cloud in the order of
their own curve, so that the neighbours of one bound the search of the next, and 16 at once where only the nearest is
asked for in at most three dimensions. Gradients are gathered by the points that receive them. Notation: N clouds, P1
and P2 points, D coordinates, K neighbours; a slot is a place in the leaves.
"""

import math

import numpy as np
from numba import prange

from rendra.kernels.knn.group import GROUP_SCRATCH, found_by, group_at, nearest_of_group
from rendra.kernels.knn.lanes import (
    LANES,
    float_of_bits,
    read_int32,
    read_int64,
    write_float,
    write_int64,
)
from rendra.kernels.knn.search import (
    EMPTY,
    EMPTY_IN_BALL,
    SCRATCH,
    Question,
    collect,
    find_roots,
    query_at,
    sort_heap,
    tree_at,
    upper_bound,
    walk_at,
)
from rendra.kernels.knn.tree import INDEX_BITS, INDEX_MASK, LEAF, NOTHING, build_tree, tree_size
from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel

_SLOTS_AT_ONCE = 4 * LANES  # whose points a thread asks for in turn
_GROUPED_AT_ONCE = 16 * LANES  # the same where 16 ask at once
_POINTS_AT_ONCE = 512  # whose gradients a thread gathers in turn

_Tree = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def search(
    clouds: tuple[np.ndarray, np.ndarray],
    lengths: tuple[np.ndarray, np.ndarray],
    axes: np.ndarray,
    norm: int,
    radius: float,
    dists: np.ndarray,
    idx: np.ndarray,
) -> int:
    """Write dists and idx (N, P1, K) where there are neighbours; returns how many looks at a leaf that took.

    A negative radius asks for the nearest points. `axes` (3,) names the coordinates that the trees know, -1 for none.
    """
    first, second = (_grow(cloud) for cloud in clouds)
    workers, K = num_threads(), dists.shape[2]
    scratch = np.empty((workers, SCRATCH + K), np.int64)
    squared = np.float32(radius) * np.float32(radius) if radius >= 0 else np.float32(-1)
    _build(*clouds, *lengths, axes, first, second, workers)
    if K == 1 and radius < 0 and clouds[0].shape[2] <= 3:
        grouped = np.empty((workers, GROUP_SCRATCH), np.int64)
        trees = _addresses(*first), _addresses(*second)
        return int(_search_one(*lengths, norm, clouds[1].shape[1], *trees, dists, idx, grouped, grouped.ctypes.data))
    return int(
        _search(
            (clouds[0].shape[1], clouds[1].shape[1], clouds[0].shape[2], K), *lengths, norm, squared,
            _addresses(*clouds), _addresses(*first), _addresses(*second), _addresses(dists, idx), scratch,
            scratch.ctypes.data,
        )
    )  # fmt: skip


def backward(
    clouds: tuple[np.ndarray, np.ndarray], norm: int, idx: np.ndarray, upstream: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients of both clouds; `upstream` (N, P1, K) is that of the distances, idx (N, P1, K) may be negative."""
    grads = np.empty_like(clouds[0]), np.empty_like(clouds[1])
    _pull(*clouds, norm, idx, upstream, *grads, num_threads())
    return grads


def nearest_sums(
    clouds: tuple[np.ndarray, np.ndarray],
    lengths: tuple[np.ndarray, np.ndarray],
    weights: tuple[np.ndarray, np.ndarray],
    axes: np.ndarray,
    norm: int,
    grads: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, int]:
    """Sums (N,) both ways, and how many looks at a leaf that took; D at most 3.

    Writes the gradients, every element; one that is not wanted has no elements.
    """
    first, second = (_grow(cloud) for cloud in clouds)
    slots = max(first[1].shape[1], second[1].shape[1])
    sums = np.zeros((2, len(clouds[0]), -(-slots // _GROUPED_AT_ONCE)))
    match = np.empty((2, len(clouds[0]), slots), np.int32)
    workers = num_threads()
    scratch = np.empty((workers, GROUP_SCRATCH), np.int64)
    _build(*clouds, *lengths, axes, first, second, workers)
    looked_at = _match(
        *lengths, *weights, norm, (clouds[0].shape[1], clouds[1].shape[1]), _addresses(*first), _addresses(*second),
        match, sums, scratch, scratch.ctypes.data,
    )  # fmt: skip
    if any(grad.size for grad in grads):
        _pull_matched(*lengths, *weights, norm, first, second, match, *grads, workers)
    totals = sums.sum(2)
    return (weights[0] * totals[0] + weights[1] * totals[1]).astype(np.float32), int(looked_at)


def _grow(points: np.ndarray) -> _Tree:
    """Room for the trees of a batch: leaves, indices, boxes, lowest indices, one row a cloud."""
    leaves, blocks = tree_size(points.shape[1])
    return (
        np.empty((len(points), leaves * LEAF), np.float32),
        np.empty((len(points), leaves * LANES), np.int32),
        np.empty((len(points), blocks * 2 * LEAF), np.float32),
        np.empty((len(points), blocks * LANES), np.int32),
    )


def _addresses(*arrays: np.ndarray) -> tuple[int, ...]:
    """Of arrays that the caller keeps alive."""
    return tuple(array.ctypes.data for array in arrays)


@parallel_kernel
def _build(p1, p2, lengths1, lengths2, axes, first, second, workers):
    clouds = len(lengths1)
    for worker in prange(workers):
        for cloud in range(worker, 2 * clouds, workers):
            n = cloud // 2
            points, length = (p1[n], lengths1[n]) if cloud % 2 == 0 else (p2[n], lengths2[n])
            leaves, indices, boxes, lowest = first if cloud % 2 == 0 else second
            build_tree(points, length, axes, leaves[n], indices[n], boxes[n], lowest[n])


@parallel_kernel
def _search(shape, lengths1, lengths2, norm, radius, clouds, first, second, outputs, scratch, scratch_address):
    """Returns how many leaves were looked at; clouds, trees and outputs (dists, idx) by address."""
    P1, P2, D, K = shape
    slots, (leaves, blocks) = _num_slots(P1), tree_size(P2)
    chunks = (slots + _SLOTS_AT_ONCE - 1) // _SLOTS_AT_ONCE
    workers, batch, looked_at = len(scratch), len(lengths1), 0
    for worker in prange(workers):
        walk = walk_at(scratch_address + 8 * scratch.shape[1] * worker)
        seen = 0
        for chunk in range(worker, batch * chunks, workers):
            n = chunk // chunks
            ask = Question(norm, D, radius, min(K, lengths2[n]))
            tree, levels = tree_at(second, leaves, blocks, n), find_roots(lengths2[n], walk.roots)
            own, order = first[0] + 4 * 3 * slots * n, first[1] + 4 * slots * n
            points = clouds[1] + 4 * D * P2 * n
            begin = chunk % chunks * _SLOTS_AT_ONCE
            for slot in range(begin, min(begin + _SLOTS_AT_ONCE, lengths1[n]) if ask.size else begin):
                i = P1 * n + read_int32(order, slot)
                row, bound = clouds[0] + 4 * D * i, EMPTY
                if slot > begin and radius < 0:
                    bound = upper_bound(row, points, ask, walk.heap)
                for k in range(ask.size):
                    write_int64(walk.heap, k, EMPTY if radius < 0 else EMPTY_IN_BALL)
                looks, _ = collect(row, query_at(own, slot), points, tree, levels, ask, bound, walk)
                seen += looks
                sort_heap(walk.heap, ask.size)
                _write(walk.heap, ask, outputs[0] + 4 * K * i, outputs[1] + 8 * K * i)
        looked_at += seen
    return looked_at


@parallel_kernel
def _search_one(lengths1, lengths2, norm, P2, first, second, dists, idx, scratch, scratch_address):
    """The same for the nearest point alone, in at most three dimensions: 16 queries at once."""
    batch, P1, _ = dists.shape
    slots, (leaves, blocks) = _num_slots(P1), tree_size(P2)
    chunks = (slots + _GROUPED_AT_ONCE - 1) // _GROUPED_AT_ONCE
    workers, looked_at = len(scratch), 0
    for worker in prange(workers):
        group = group_at(scratch_address + 8 * scratch.shape[1] * worker)
        seen = 0
        for chunk in range(worker, batch * chunks, workers):
            n = chunk // chunks
            tree, levels = tree_at(second, leaves, blocks, n), find_roots(lengths2[n], group.roots)
            own, order = first[0] + 4 * 3 * slots * n, first[1] + 4 * slots * n
            begin, seed = chunk % chunks * _GROUPED_AT_ONCE, np.int64(-1)
            end = min(begin + _GROUPED_AT_ONCE, lengths1[n]) if lengths2[n] else begin
            for slot in range(begin, end, LANES):
                count, place = min(LANES, end - slot), np.int32(0)
                seen += nearest_of_group(own + 4 * 3 * slot, count, tree, levels, norm, seed, group)
                for lane in range(count):
                    dist, index, place = found_by(group, lane)
                    i = read_int32(order, slot + lane)
                    dists[n, i, 0], idx[n, i, 0] = dist, index
                seed = np.int64(place) // LANES
        looked_at += seen
    return looked_at


@scalar_kernel
def _num_slots(num_points):
    leaves, _ = tree_size(num_points)
    return leaves * LANES


@scalar_kernel
def _write(keys, ask, dists, idx):
    """Take sorted keys apart; places without a neighbour are left as they are."""
    for k in range(ask.size):
        key = read_int64(keys, k)
        high, low = key >> INDEX_BITS, key & INDEX_MASK
        index, bits = (low, high) if ask.radius < 0 else (high, low)
        if index != NOTHING:
            write_int64(idx, k, index)
            write_float(dists, k, float_of_bits(np.int32(bits)))


@parallel_kernel
def _match(lengths1, lengths2, weights1, weights2, norm, shape, first, second, match, sums, scratch, scratch_address):
    """The nearest slot of the other cloud for each slot, both ways, and the sums of the distances of every chunk."""
    _, batch, chunks = sums.shape
    workers, looked_at = len(scratch), 0
    for worker in prange(workers):
        group = group_at(scratch_address + 8 * scratch.shape[1] * worker)
        seen = 0
        for task in range(worker, 2 * batch * chunks, workers):
            way, n, chunk = task // chunks // batch, task // chunks % batch, task % chunks
            length, num_others = (lengths1[n], lengths2[n]) if way == 0 else (lengths2[n], lengths1[n])
            weight = weights1[n] if way == 0 else weights2[n]
            leaves, blocks = tree_size(shape[1 - way])
            tree = tree_at(second if way == 0 else first, leaves, blocks, n)
            own = (first[0] if way == 0 else second[0]) + 4 * 3 * _num_slots(shape[way]) * n
            levels = find_roots(num_others, group.roots)
            begin, end = chunk * _GROUPED_AT_ONCE, min((chunk + 1) * _GROUPED_AT_ONCE, length)
            total, seed = 0.0, np.int64(-1)
            for slot in range(begin, end if num_others and weight != 0 else begin, LANES):
                count = min(LANES, end - slot)
                seen += nearest_of_group(own + 4 * 3 * slot, count, tree, levels, norm, seed, group)
                for lane in range(count):
                    dist, _, place = found_by(group, lane)
                    match[way, n, slot + lane] = place
                    total += dist
                seed = np.int64(match[way, n, slot + count - 1]) // LANES
            sums[way, n, chunk] = total
        looked_at += seen
    return looked_at


@parallel_kernel
def _pull_matched(lengths1, lengths2, weights1, weights2, norm, first, second, match, grad1, grad2, workers):
    """Gradients of both clouds: each slot gathers from its match and from the slots that matched it."""
    _, clouds, slots = match.shape
    starts, sources = np.empty((2, clouds, slots + 2), np.int64), np.empty((2, clouds, slots), np.int64)
    for worker in prange(workers):
        for task in range(worker, 2 * clouds, workers):
            way, n = task % 2, task // 2
            from_length, to_length = (lengths1[n], lengths2[n]) if way == 0 else (lengths2[n], lengths1[n])
            weight = weights1[n] if way == 0 else weights2[n]
            wanted = (grad2.size if way == 0 else grad1.size) and weight != 0 and to_length
            _invert(match[way, n], from_length if wanted else 0, starts[way, n, : to_length + 2], sources[way, n])
    chunks = (slots + _POINTS_AT_ONCE - 1) // _POINTS_AT_ONCE
    for worker in prange(workers):
        for task in range(worker, 2 * clouds * chunks, workers):
            way, n, chunk = task // chunks // clouds, task // chunks % clouds, task % chunks
            grad = grad1 if way == 0 else grad2
            own, other = (first, second) if way == 0 else (second, first)
            length, num_others = (lengths1[n], lengths2[n]) if way == 0 else (lengths2[n], lengths1[n])
            there, back = (weights1[n], weights2[n]) if way == 0 else (weights2[n], weights1[n])
            if grad.size:
                begin, end = chunk * _POINTS_AT_ONCE, (chunk + 1) * _POINTS_AT_ONCE
                _gather(own[0][n], own[1][n], other[0][n], match[way, n], starts[1 - way, n], sources[1 - way, n],
                        begin, min(end, length), there if num_others else np.float32(0), back, norm,
                        grad[n])  # fmt: skip
                grad[n, max(begin, length) : max(begin, min(end, grad.shape[1]))] = 0


@scalar_kernel
def _gather(own, indices, other, match, starts, sources, begin, end, there, back, norm, grad):
    """Gradients of the slots [begin, end), written to the points that stand there."""
    for slot in range(begin, end):
        place = slot // LANES * LEAF + slot % LANES
        x, y, z = own[place], own[place + LANES], own[place + 2 * LANES]
        gx = gy = gz = np.float32(0)
        if there != 0:
            gx, gy, gz = _pull_of(other, match[slot], x, y, z, there, norm)
        for entry in range(starts[slot], starts[slot + 1]):
            px, py, pz = _pull_of(other, sources[entry], x, y, z, back, norm)
            gx, gy, gz = gx + px, gy + py, gz + pz
        index = indices[slot]
        grad[index, 0] = gx
        if grad.shape[1] > 1:
            grad[index, 1] = gy
        if grad.shape[1] > 2:
            grad[index, 2] = gz


@scalar_kernel
def _pull_of(leaves, slot, x, y, z, weight, norm):
    """Derivative of weight * distance with respect to x, y, z; zero if a difference is not finite."""
    place = slot // LANES * LEAF + slot % LANES
    dx, dy, dz = x - leaves[place], y - leaves[place + LANES], z - leaves[place + 2 * LANES]
    if not (math.isfinite(dx) and math.isfinite(dy) and math.isfinite(dz)):
        return np.float32(0), np.float32(0), np.float32(0)
    return _slope(dx, norm) * weight, _slope(dy, norm) * weight, _slope(dz, norm) * weight


@scalar_kernel
def _slope(difference, norm):
    """Derivative of one axis' share of the distance."""
    if norm == 1:
        return np.float32(1) if difference > 0 else (np.float32(-1) if difference < 0 else np.float32(0))
    return difference + difference


@parallel_kernel
def _pull(p1, p2, norm, idx, upstream, grad1, grad2, workers):
    """Gradients of both clouds: each point gathers from its neighbours, or from those whose neighbour it is."""
    clouds, num_queries, neighbours = idx.shape
    num_points = p2.shape[1]
    starts = np.empty((clouds, num_points + 2), np.int64)
    sources = np.empty((clouds, num_queries * neighbours), np.int64)
    for worker in prange(workers):
        for n in range(worker, clouds, workers):
            _invert(idx[n].reshape(-1), num_queries * neighbours, starts[n], sources[n])
    chunks = (max(num_queries, num_points) + _POINTS_AT_ONCE - 1) // _POINTS_AT_ONCE
    for worker in prange(workers):
        for task in range(worker, clouds * chunks, workers):
            n, begin = task // chunks, task % chunks * _POINTS_AT_ONCE
            for i in range(begin, min(begin + _POINTS_AT_ONCE, num_queries)):
                grad1[n, i] = 0
                for k in range(neighbours):
                    if idx[n, i, k] >= 0:
                        _add_pull(p1, i, p2, idx[n, i, k], n, upstream[n, i, k], norm, grad1, i)
            for j in range(begin, min(begin + _POINTS_AT_ONCE, num_points)):
                grad2[n, j] = 0
                for entry in range(starts[n, j], starts[n, j + 1]):
                    i, k = sources[n, entry] // neighbours, sources[n, entry] % neighbours
                    _add_pull(p2, j, p1, i, n, upstream[n, i, k], norm, grad2, j)


@scalar_kernel
def _add_pull(own, i, other, j, n, gain, norm, grad, target):
    """Add gain * derivative of the distance with respect to own[n, i]."""
    for axis in range(own.shape[2]):
        if not math.isfinite(own[n, i, axis] - other[n, j, axis]):
            return
    for axis in range(own.shape[2]):
        grad[n, target, axis] += gain * _slope(own[n, i, axis] - other[n, j, axis], norm)


@scalar_kernel
def _invert(targets, count, starts, sources):
    """Who names whom: targets[sources[starts[j] : starts[j + 1]]] are j, in their order; negative ones are nobody."""
    starts[:] = 0
    for i in range(count):
        if targets[i] >= 0:
            starts[targets[i] + 2] += 1
    for j in range(2, len(starts)):
        starts[j] += starts[j - 1]
    # starts[j + 1] is where j begins; filling moves it to where j ends, which is where j + 1 begins
    for i in range(count):
        if targets[i] >= 0:
            sources[starts[targets[i] + 1]] = i
            starts[targets[i] + 1] += 1
