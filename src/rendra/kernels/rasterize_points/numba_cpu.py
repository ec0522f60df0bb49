"""Points to fragments on the CPU: the fast twin of `reference.py`.

Forward: points are sorted by depth and binned, in that order, into bands of rows; a band is drawn by one thread,
point by point, so that a pixel's list grows by appending and is complete when it is full. Backward: each of a fixed
number of chunks of rows sums into a buffer of its own.
"""

import numpy as np
from numba import prange

from rendra.kernels.binning import BAND_ROWS, bin_faces, padded_columns
from rendra.kernels.geometry import BLOCK, ONE, TWO, pixel_centre
from rendra.kernels.parallel import inlined_kernel, num_threads, parallel_kernel
from rendra.kernels.point_binning import front_to_back, point_boxes

_CHUNKS = 8  # row groups of an image that sum gradients apart; fixed, so that results never depend on threads
_MAX_CHUNK_FLOATS = 2**26
_NOTHING = np.zeros((1, 1, 1, 1), np.float32)


def forward(
    points: np.ndarray,
    radius: np.ndarray,
    first_point: np.ndarray,
    num_points: np.ndarray,
    outputs: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Write idx, zbuf and dists, every element."""
    _, height, width, _ = outputs[0].shape
    workers = num_threads()
    boxes = point_boxes(points, radius, height, width, workers)
    order = front_to_back(points[:, 2], first_point, num_points)
    starts, entries = bin_faces(boxes, order, first_point, num_points, height)
    _draw(points, radius, boxes, starts, entries, workers, *outputs)


@parallel_kernel
def _draw(points, radius, boxes, starts, entries, workers, idx, zbuf, dists):
    images, height, width, layers = idx.shape
    bands = (height + BAND_ROWS - 1) // BAND_ROWS
    for worker in prange(workers):
        columns = padded_columns(height, width)
        counts = np.empty(BAND_ROWS * width, np.int64)
        for band in range(worker, images * bands, workers):
            n, row = band // bands, band % bands * BAND_ROWS
            row_end = min(row + BAND_ROWS, height)
            slots = (
                idx[n, row:row_end].reshape(-1),
                zbuf[n, row:row_end].reshape(-1),
                dists[n, row:row_end].reshape(-1),
            )
            counts[:] = 0
            for entry in range(starts[band], starts[band + 1]):
                p = entries[entry]
                _append(points, radius, boxes, p, row, row_end, height, layers, columns, counts, slots)
            for pixel in range((row_end - row) * width):
                for slot in range(pixel * layers + counts[pixel], (pixel + 1) * layers):
                    slots[0][slot] = -1
                    slots[1][slot] = -ONE
                    slots[2][slot] = -ONE


@inlined_kernel
def _append(points, radius, boxes, p, row, row_end, height, layers, columns, counts, slots):
    """Put point p behind what the pixels of a band [row, row_end) have already seen."""
    idx, zbuf, dists = slots
    width = len(columns) - BLOCK
    short = min(height, width)
    x, y, z, limit = points[p, 0], points[p, 1], points[p, 2], radius[p] * radius[p]
    begin, end = boxes[p, 0], boxes[p, 1]
    for v in range(max(boxes[p, 2], row), min(boxes[p, 3], row_end)):
        dy = pixel_centre(v, height, short) - y
        first = (v - row) * width
        for u in range(begin, end):
            dx = columns[u] - x
            d = dx * dx + dy * dy
            k = counts[first + u]
            if d < limit and k < layers:
                slot = (first + u) * layers + k
                idx[slot] = p
                zbuf[slot] = z
                dists[slot] = d
                counts[first + u] = k + 1


def backward(
    points: np.ndarray, idx: np.ndarray, grad_zbuf: np.ndarray | None, grad_dists: np.ndarray | None
) -> np.ndarray:
    """Gradient (P, 3) from those of zbuf and dists, None where nothing flows."""
    chunks = max(1, min(_CHUNKS, idx.shape[1], _MAX_CHUNK_FLOATS // max(1, points.size)))
    partial = np.zeros((chunks, *points.shape), np.float32)
    _gather_gradients(
        points, idx, num_threads(), grad_zbuf is not None, grad_dists is not None,
        _NOTHING if grad_zbuf is None else grad_zbuf, _NOTHING if grad_dists is None else grad_dists, partial,
    )  # fmt: skip
    return partial.sum(axis=0)


@parallel_kernel
def _gather_gradients(points, idx, workers, has_zbuf, has_dists, grad_zbuf, grad_dists, partial):
    images, height, width, layers = idx.shape
    chunks = partial.shape[0]
    short = min(height, width)
    for worker in prange(workers):
        columns = padded_columns(height, width)
        for piece in range(worker, images * chunks, workers):
            n, chunk = piece // chunks, piece % chunks
            # rows are dealt out in turn, so that chunks are about equally full
            for v in range(chunk, height, chunks):
                py = pixel_centre(v, height, short)
                for u in range(width):
                    for k in range(layers):
                        p = idx[n, v, u, k]
                        if p < 0:
                            break
                        if has_zbuf:
                            partial[chunk, p, 2] += grad_zbuf[n, v, u, k]
                        if has_dists:
                            slope = -TWO * grad_dists[n, v, u, k]
                            partial[chunk, p, 0] += slope * (columns[u] - points[p, 0])
                            partial[chunk, p, 1] += slope * (py - points[p, 1])
