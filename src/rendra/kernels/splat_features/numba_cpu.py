"""Splatting on the CPU: the fast twin of `reference.py`. See README.md for the backward pass.

Points are binned, near first, into tiles of pixels; a tile makes the lists of its pixels, each only as long as it
must be, in memory that its thread uses again for the next tile. A pixel's features are summed from its list. The
backward pass makes the lists again; there a thread owns bands of rows so high that a point reaches two at most, and
even bands come before odd ones.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from rendra.kernels.geometry import ONE, ZERO
from rendra.kernels.parallel import (
    inlined_kernel,
    num_threads,
    parallel_kernel,
    scalar_kernel,
)
from rendra.kernels.splat_features.lanes import dot_rows, pointer, spread_rows, sum_rows

ALPHACOMPOSITE, WSUM, WSUMNORM, NAIVE = range(4)
NEAREST = np.float32(1e-3)  # of the squared distance in radii: what is nearer counts as that near
LEAST = np.float32(1e-4)  # of a sum of weights that is divided by
_ROWS, _COLUMNS = 8, 16  # of a tile
_PIXELS = _ROWS * _COLUMNS
_HALF = np.float32(0.5)
_FARTHEST = 1e18  # pixels; discs beyond are as large: squares and numbers of pixels stay finite


class Settings(NamedTuple):
    """How to splat; the same for all points."""

    height: int
    width: int
    radius: np.float32  # pixels
    most: int  # points of a pixel
    mode: int
    tau: np.float32
    stop_below: np.float32


def settings_of(
    height: int, width: int, radius: float, most: int, mode: int, tau: float, stop_below: float
) -> Settings:
    """Numbers as kernels read them."""
    return Settings(
        height, width, np.float32(min(radius, _FARTHEST)), most, mode, np.float32(tau), np.float32(stop_below)
    )


def forward(
    points: np.ndarray,
    order: np.ndarray,
    features: np.ndarray,
    settings: Settings,
    image: np.ndarray,
    opacity: np.ndarray,
) -> None:
    """Write image (B, H, W, C) and opacity (B, H, W), every element.

    `points` (B P, 2) and `features` (B P, C) are rows of clouds, one after the other; `order` (B, P) int32 lists the
    rows of each cloud, near first, -1 for those that are not drawn.
    """
    starts, entries = _bin(points, order, settings)
    _splat(points, features, starts, entries, settings, _room(starts, settings), num_threads(), image, opacity)


def backward(
    points: np.ndarray,
    order: np.ndarray,
    features: np.ndarray,
    settings: Settings,
    upstream: tuple[np.ndarray, np.ndarray],
    moves: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients of points (B P, 2), zeros if they do not move, and features (B P, C).

    `upstream` are those of the image (B, H, W, C) and the opacity (B, H, W).
    """
    starts, entries = _bin(points, order, settings)
    grads = np.zeros(points.shape, np.float32), np.zeros(features.shape, np.float32)
    room, workers = _room(starts, settings), num_threads()
    _splat_back(points, features, starts, entries, settings, room, workers, upstream, moves, grads)
    return grads


def _room(starts: np.ndarray, settings: Settings) -> int:
    """Length of the longest list that a pixel can have."""
    return max(1, min(settings.most, int(np.diff(starts).max(initial=0))))


@inlined_kernel
def _reach(middle, radius, size):
    """Pixels [begin, end) whose centres may be nearer to `middle` than the radius, along one axis."""
    if not (middle > -radius and middle < np.float32(size) + radius):
        return 0, 0
    begin = int(math.floor(middle - radius - _HALF)) + 1
    return max(begin, 0), min(int(math.ceil(middle + radius - _HALF)), size)


@inlined_kernel
def _tiles(x, y, settings):
    """Tiles [left, right) and [top, bottom) that a point reaches."""
    left, right = _reach(x, settings.radius, settings.width)
    top, bottom = _reach(y, settings.radius, settings.height)
    if left >= right or top >= bottom:
        return 0, 0, 0, 0
    return (
        left // _COLUMNS,
        (right + _COLUMNS - 1) // _COLUMNS,
        top // _ROWS,
        (bottom + _ROWS - 1) // _ROWS,
    )


@inlined_kernel
def _grid(settings):
    """Rows and columns of tiles."""
    return (settings.height + _ROWS - 1) // _ROWS, (settings.width + _COLUMNS - 1) // _COLUMNS


@scalar_kernel
def _bin(points, order, settings):
    """The points of every tile, near first: (starts (B tiles + 1,), entries): count, prefix sum, fill."""
    rows, columns = _grid(settings)
    starts = np.zeros(len(order) * rows * columns + 1, np.int64)
    for b in range(len(order)):
        for k in range(order.shape[1]):
            i = order[b, k]
            if i >= 0:
                left, right, top, bottom = _tiles(points[i, 0], points[i, 1], settings)
                for row in range(top, bottom):
                    for column in range(left, right):
                        starts[(b * rows + row) * columns + column + 1] += 1
    for tile in range(len(starts) - 1):
        starts[tile + 1] += starts[tile]
    cursor = starts[:-1].copy()
    entries = np.empty(starts[-1], np.int32)
    for b in range(len(order)):
        for k in range(order.shape[1]):
            i = order[b, k]
            if i >= 0:
                left, right, top, bottom = _tiles(points[i, 0], points[i, 1], settings)
                for row in range(top, bottom):
                    for column in range(left, right):
                        tile = (b * rows + row) * columns + column
                        entries[cursor[tile]] = i
                        cursor[tile] += 1
    return starts, entries


@inlined_kernel
def _distance(squared):
    """Distance in radii, from its square in pixels and radii."""
    return math.sqrt(max(squared, NEAREST))


@scalar_kernel
def _collect(points, entries, begin, end, top, left, settings, lists):
    """The lists of a tile's pixels: `counts` points each, near first, their rows and alphas."""
    counts, lights, rows, alphas = lists
    bottom, right = min(top + _ROWS, settings.height), min(left + _COLUMNS, settings.width)
    reach = settings.radius * settings.radius
    inverse, dims = ONE / reach, settings.mode == ALPHACOMPOSITE
    counts[:] = 0
    lights[:] = ONE
    open_pixels = (bottom - top) * (right - left)
    for entry in range(begin, end):
        i = entries[entry]
        x, y = points[i, 0], points[i, 1]
        first, last = _reach(x, settings.radius, settings.width)
        low, high = _reach(y, settings.radius, settings.height)
        for row in range(max(low, top), min(high, bottom)):
            dy = np.float32(row) + _HALF - y
            for column in range(max(first, left), min(last, right)):
                dx = np.float32(column) + _HALF - x
                squared = dx * dx + dy * dy
                p = (row - top) * _COLUMNS + column - left
                if squared < reach and lights[p] >= settings.stop_below:
                    alpha = ONE - _distance(squared * inverse)
                    if settings.tau != ONE:
                        alpha **= settings.tau
                    rows[p, counts[p]] = i
                    alphas[p, counts[p]] = alpha
                    counts[p] += 1
                    if dims:
                        lights[p] *= ONE - alpha
                    if counts[p] >= settings.most:
                        lights[p] = -ONE
                    if not lights[p] >= settings.stop_below:
                        open_pixels -= 1
        if open_pixels == 0:
            return


@scalar_kernel
def _weigh(alphas, p, count, mode, weights):
    """Write the weights of a pixel's points; returns their sum, before it is normalised."""
    if mode == NAIVE:
        weights[p, 0] = ONE
        return ONE if count else ZERO
    if mode == ALPHACOMPOSITE:
        light = ONE
        for k in range(count):
            weights[p, k] = alphas[p, k] * light
            light *= ONE - alphas[p, k]
        return ONE - light
    total = ZERO
    for k in range(count):
        total += alphas[p, k]
    share = ONE / max(total, LEAST) if mode == WSUMNORM else ONE
    for k in range(count):
        weights[p, k] = alphas[p, k] * share
    return total


@parallel_kernel
def _splat(points, features, starts, entries, settings, room, workers, image, opacity):
    rows, columns = _grid(settings)
    channels = image.shape[3]
    for worker in prange(workers):
        lists = _lists(room)
        weights = np.empty((_PIXELS, room), np.float32)
        listed = pointer(lists[2]), pointer(weights)
        table, out = pointer(features), pointer(image)
        for tile in range(worker, len(starts) - 1, workers):
            b, top, left = tile // (rows * columns), tile // columns % rows * _ROWS, tile % columns * _COLUMNS
            _collect(points, entries, starts[tile], starts[tile + 1], top, left, settings, lists)
            for y in range(top, min(top + _ROWS, settings.height)):
                for x in range(left, min(left + _COLUMNS, settings.width)):
                    p = (y - top) * _COLUMNS + x - left
                    count = lists[0][p]
                    opacity[b, y, x] = min(_weigh(lists[3], p, count, settings.mode, weights), ONE)
                    place = ((b * settings.height + y) * settings.width + x) * channels
                    sum_rows(table, channels, *listed, p * room, count, out, place)


@scalar_kernel
def _lists(room):
    """Room for the lists of a tile: counts, light that passes, rows, alphas."""
    return (
        np.empty(_PIXELS, np.int64),
        np.empty(_PIXELS, np.float32),
        np.empty((_PIXELS, room), np.int32),
        np.empty((_PIXELS, room), np.float32),
    )


@scalar_kernel
def _slopes(alphas, weights, p, count, total, of_opacity, mode, worths):
    """Turn how much the loss grows with each weight of a pixel into how much it grows with each alpha."""
    if mode == ALPHACOMPOSITE:
        behind, worth = ZERO, ZERO
        for k in range(count - 1, -1, -1):
            worth = worths[p, k] + of_opacity
            light = weights[p, k] / alphas[p, k] if alphas[p, k] > ZERO else ZERO
            worths[p, k] = light * (worth - behind)
            behind += alphas[p, k] * (worth - behind)
        return
    mean, share = ZERO, ONE
    if mode == WSUMNORM:
        share = ONE / max(total, LEAST)
        for k in range(count if total >= LEAST else 0):
            mean += weights[p, k] * worths[p, k]
    for k in range(count):
        worths[p, k] = share * (worths[p, k] - mean) + (of_opacity if total <= ONE else ZERO)


@scalar_kernel
def _pull(points, rows, alphas, slopes, p, count, x, y, settings, grad):
    """Add what a pixel at (x, y) asks of the places of its points."""
    inverse = ONE / (settings.radius * settings.radius)
    for k in range(count):
        i = rows[p, k]
        dx, dy = x - points[i, 0], y - points[i, 1]
        squared = (dx * dx + dy * dy) * inverse
        if squared >= NEAREST and alphas[p, k] > ZERO:
            distance = _distance(squared)
            steepness = ONE
            if settings.tau != ONE:
                steepness = settings.tau * alphas[p, k] / (ONE - distance)
            pull = slopes[p, k] * steepness * inverse / distance
            grad[i, 0] += pull * dx
            grad[i, 1] += pull * dy


@scalar_kernel
def _return(points, lists, weights, worths, b, top, left, settings, tables, upstream, moves, grads):
    """Gradients that the pixels of a tile, whose lists are made, ask of their points."""
    counts, _, rows, alphas = lists
    grad_image, grad_opacity = upstream
    table, grad_table = tables
    channels, room = grad_image.shape[3], rows.shape[1]
    source = pointer(grad_image)
    moves = moves and settings.mode != NAIVE
    for y in range(top, min(top + _ROWS, settings.height)):
        for x in range(left, min(left + _COLUMNS, settings.width)):
            p = (y - top) * _COLUMNS + x - left
            count = counts[p]
            total = _weigh(alphas, p, count, settings.mode, weights)
            place = ((b * settings.height + y) * settings.width + x) * channels
            spread_rows(grad_table, channels, pointer(rows), pointer(weights), p * room, count, source, place)
            if moves:
                dot_rows(table, channels, pointer(rows), pointer(worths), p * room, count, source, place)
                _slopes(alphas, weights, p, count, total, grad_opacity[b, y, x], settings.mode, worths)
                _pull(points, rows, alphas, worths, p, count, np.float32(x) + _HALF, np.float32(y) + _HALF, settings,
                      grads[0])  # fmt: skip


@parallel_kernel
def _splat_back(points, features, starts, entries, settings, room, workers, upstream, moves, grads):
    """Bands are so high that a point reaches two neighbours at most: one even, one odd."""
    rows, columns = _grid(settings)
    high = (int(math.ceil(2 * settings.radius)) + 2 + _ROWS - 1) // _ROWS  # of a band, in tiles
    bands, images = (rows + high - 1) // high, len(upstream[1])
    for parity in range(2):
        number = (bands + 1 - parity) // 2
        for worker in prange(workers):
            lists = _lists(room)
            weights, worths = np.empty((_PIXELS, room), np.float32), np.empty((_PIXELS, room), np.float32)
            tables = pointer(features), pointer(grads[1])
            for turn in range(worker, images * number, workers):
                b, band = turn // number, 2 * (turn % number) + parity
                for tile in range(band * high * columns, min((band + 1) * high, rows) * columns):
                    top, left, of_all = tile // columns * _ROWS, tile % columns * _COLUMNS, b * rows * columns + tile
                    _collect(points, entries, starts[of_all], starts[of_all + 1], top, left, settings, lists)
                    _return(points, lists, weights, worths, b, top, left, settings, tables, upstream, moves, grads)
