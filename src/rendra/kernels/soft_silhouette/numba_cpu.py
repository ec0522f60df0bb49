"""Soft silhouette on the CPU: the fast twin of `reference.py`. No fragments are kept.

Forward: faces are binned into bands of rows; one thread draws a band and multiplies its pixels' survival.
Backward: every face gathers its gradient from the pixels of its own box, recomputing distances, so that nothing is
stored and nothing races.
"""

import math

import numpy as np
from numba import prange

from rendra.kernels.binning import BAND_ROWS, bin_faces, face_boxes, padded_columns
from rendra.kernels.geometry import (
    BLOCK,
    ONE,
    TWO,
    ZERO,
    pixel_centre,
    point_segment,
    signed_distance,
    signed_distance_row,
)
from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel

_FACES_AT_ONCE = 32  # faces that a thread takes in turn in the backward pass


def forward(
    face_verts: np.ndarray,
    first_face: np.ndarray,
    num_faces: np.ndarray,
    neighbor: np.ndarray,
    blur_radius: float,
    sigma: float,
    cull: bool,
    survival: np.ndarray,
) -> np.ndarray:
    """Write survival (N, H, W), every element; returns the faces' pixel boxes (F, 4) for the backward pass."""
    _, height, width = survival.shape
    workers = num_threads()
    boxes = face_boxes(face_verts, blur_radius, cull, height, width, workers)
    bins = bin_faces(boxes, np.arange(len(face_verts)), first_face, num_faces, height)
    _draw(face_verts, boxes, *bins, neighbor, np.float32(blur_radius), np.float32(1 / sigma), workers, survival)
    return boxes


def backward(
    face_verts: np.ndarray,
    boxes: np.ndarray,
    first_face: np.ndarray,
    num_faces: np.ndarray,
    neighbor: np.ndarray,
    blur_radius: float,
    sigma: float,
    upstream: np.ndarray,
) -> np.ndarray:
    """Gradient (F, 3, 3); `upstream` (N, H, W) is the gradient of survival times survival."""
    image_of_face = np.repeat(np.arange(len(first_face)), num_faces)
    faces = np.repeat(first_face - np.cumsum(num_faces) + num_faces, num_faces) + np.arange(num_faces.sum())
    grad = np.zeros_like(face_verts)
    _gather(face_verts, boxes, faces, image_of_face, neighbor, np.float32(blur_radius), np.float32(1 / sigma),
            num_threads(), upstream, grad)  # fmt: skip
    return grad


@scalar_kernel
def _sigmoid(x):
    """1 / (1 + exp(-x)): zero, not NaN, where the exponential overflows."""
    return ONE / (ONE + math.exp(-x))


@parallel_kernel
def _draw(face_verts, boxes, starts, faces, neighbor, blur, inverse_sigma, workers, survival):
    images, height, width = survival.shape
    bands = (height + BAND_ROWS - 1) // BAND_ROWS
    for worker in prange(workers):
        columns = padded_columns(height, width)
        row_dists = np.empty(width + BLOCK, np.float32)
        for band in range(worker, images * bands, workers):
            n, row = band // bands, band % bands * BAND_ROWS
            row_end = min(row + BAND_ROWS, height)
            survival[n, row:row_end] = ONE
            for entry in range(starts[band], starts[band + 1]):
                f = faces[entry]
                for y in range(max(boxes[f, 2], row), min(boxes[f, 3], row_end)):
                    py = pixel_centre(y, height, min(height, width))
                    _attenuate_row(face_verts, f, boxes[f], py, columns, neighbor, blur, inverse_sigma,
                                   row_dists, survival[n, y])  # fmt: skip


@scalar_kernel
def _attenuate_row(face_verts, f, box, py, columns, neighbor, blur, inverse_sigma, row_dists, survival):
    """Multiply the survival of one row's pixels by what one face lets through."""
    v = face_verts[f]
    first, end = box[0], box[1]
    signed_distance_row(columns, first, end - first, py, v[0, 0], v[0, 1], v[1, 0], v[1, 1], v[2, 0], v[2, 1],
                        row_dists)  # fmt: skip
    for x in range(first, end):
        d = row_dists[x - first]
        if is_kept(face_verts, f, neighbor[f], columns[x], py, d, blur):
            survival[x] *= _sigmoid(d * inverse_sigma)


@scalar_kernel
def is_kept(face_verts, f, other, px, py, d, blur):
    """Inside or near enough, and not farther than the other half of a clipped face (ties: lower index)."""
    if not (d < ZERO or d < blur):
        return False
    if other < 0:
        return True
    v = face_verts[other]
    rival = signed_distance(px, py, v[0, 0], v[0, 1], v[1, 0], v[1, 1], v[2, 0], v[2, 1])
    return d < rival or (d == rival and f < other)


@parallel_kernel
def _gather(face_verts, boxes, faces, image_of_face, neighbor, blur, inverse_sigma, workers, upstream, grad):
    _, height, width = upstream.shape
    blocks = (len(faces) + _FACES_AT_ONCE - 1) // _FACES_AT_ONCE
    for worker in prange(workers):
        columns = padded_columns(height, width)
        row_dists = np.empty(width + BLOCK, np.float32)
        for block in range(worker, blocks, workers):
            for i in range(block * _FACES_AT_ONCE, min((block + 1) * _FACES_AT_ONCE, len(faces))):
                f = faces[i]
                for y in range(boxes[f, 2], boxes[f, 3]):
                    py = pixel_centre(y, height, min(height, width))
                    _gather_row(face_verts, f, boxes[f], py, columns, neighbor, blur, inverse_sigma, row_dists,
                                upstream[image_of_face[i], y], grad[f])  # fmt: skip


@scalar_kernel
def _gather_row(face_verts, f, box, py, columns, neighbor, blur, inverse_sigma, row_dists, upstream, grad):
    """Add what one row's pixels ask of one face: d survival / d d_f = survival * (1 - sigmoid(d / sigma)) / sigma."""
    v = face_verts[f]
    x0, y0, x1, y1, x2, y2 = v[0, 0], v[0, 1], v[1, 0], v[1, 1], v[2, 0], v[2, 1]
    first, end = box[0], box[1]
    signed_distance_row(columns, first, end - first, py, x0, y0, x1, y1, x2, y2, row_dists)
    for x in range(first, end):
        d = row_dists[x - first]
        if upstream[x] == ZERO or not is_kept(face_verts, f, neighbor[f], columns[x], py, d, blur):
            continue
        px = columns[x]
        gd = upstream[x] * _sigmoid(-d * inverse_sigma) * inverse_sigma
        if d < ZERO:
            gd = -gd
        a, b = 1, 2
        best, t, rx, ry = point_segment(px, py, x1, y1, x2, y2)
        rival, t1, rx1, ry1 = point_segment(px, py, x2, y2, x0, y0)
        if rival < best:
            a, b, best, t, rx, ry = 2, 0, rival, t1, rx1, ry1
        rival, t2, rx2, ry2 = point_segment(px, py, x0, y0, x1, y1)
        if rival < best:
            a, b, t, rx, ry = 0, 1, t2, rx2, ry2
        grad[a, 0] -= TWO * gd * (ONE - t) * rx
        grad[a, 1] -= TWO * gd * (ONE - t) * ry
        grad[b, 0] -= TWO * gd * t * rx
        grad[b, 1] -= TWO * gd * t * ry
