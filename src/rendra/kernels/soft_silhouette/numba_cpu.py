"""Soft silhouette on the CPU: the fast twin of `reference.py`. No fragments are kept.

Forward: faces are binned into bands of rows; one thread draws a band and multiplies its pixels' survival.
Backward: every face gathers its gradient from the pixels of its own box, recomputing distances, so that nothing is
stored and nothing races.
"""

import numpy as np
from numba import prange

from rendra.kernels.binning import BAND_ROWS, bin_faces, face_boxes, padded_columns
from rendra.kernels.geometry import (
    BLOCK,
    ONE,
    TWO,
    ZERO,
    face_row,
    inverse_square,
    pixel_centre,
    sigmoid,
    whole_blocks,
)
from rendra.kernels.parallel import num_threads, parallel_kernel, reassociating_kernel, scalar_kernel

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


@parallel_kernel
def _draw(face_verts, boxes, starts, faces, neighbor, blur, inverse_sigma, workers, survival):
    images, height, width = survival.shape
    bands = (height + BAND_ROWS - 1) // BAND_ROWS
    for worker in prange(workers):
        columns = padded_columns(height, width)
        dists, rivals = np.empty(width + BLOCK, np.float32), np.empty(width + BLOCK, np.float32)
        for band in range(worker, images * bands, workers):
            n, row = band // bands, band % bands * BAND_ROWS
            row_end = min(row + BAND_ROWS, height)
            survival[n, row:row_end] = ONE
            for entry in range(starts[band], starts[band + 1]):
                f = faces[entry]
                first, end = boxes[f, 0], boxes[f, 1]
                for y in range(max(boxes[f, 2], row), min(boxes[f, 3], row_end)):
                    py = pixel_centre(y, height, min(height, width))
                    face_row(face_verts, f, neighbor[f], whole_blocks(columns, first, end), py, dists, rivals)
                    _attenuate(dists[: end - first], blur, inverse_sigma, survival[n, y, first:end])


@scalar_kernel
def _attenuate(dists, blur, inverse_sigma, survival):
    """Multiply the survival of one row's pixels by what one face lets through."""
    for i in range(len(dists)):
        passed = sigmoid(dists[i] * inverse_sigma)
        survival[i] *= passed if dists[i] < blur else ONE


@parallel_kernel
def _gather(face_verts, boxes, faces, image_of_face, neighbor, blur, inverse_sigma, workers, upstream, grad):
    _, height, width = upstream.shape
    blocks = (len(faces) + _FACES_AT_ONCE - 1) // _FACES_AT_ONCE
    for worker in prange(workers):
        columns = padded_columns(height, width)
        dists, rivals = np.empty(width + BLOCK, np.float32), np.empty(width + BLOCK, np.float32)
        for block in range(worker, blocks, workers):
            for i in range(block * _FACES_AT_ONCE, min((block + 1) * _FACES_AT_ONCE, len(faces))):
                f = faces[i]
                first, end = boxes[f, 0], boxes[f, 1]
                for y in range(boxes[f, 2], boxes[f, 3]):
                    py = pixel_centre(y, height, min(height, width))
                    face_row(face_verts, f, neighbor[f], whole_blocks(columns, first, end), py, dists, rivals)
                    _pull(face_verts[f], columns[first:end], py, dists, blur, inverse_sigma,
                          upstream[image_of_face[i], y, first:end], grad[f])  # fmt: skip


@reassociating_kernel
def _pull(v, pixel_x, py, dists, blur, inverse_sigma, upstream, grad):
    """Add what one row's pixels ask of one face.

    d survival / d d_f = survival (1 - sigmoid(d_f / sigma)) / sigma, and the squared distance to the nearest edge
    moves with its ends by -2 (1 - t) r and -2 t r, r the arm from the foot at t to the pixel.
    """
    x0, y0, x1, y1, x2, y2 = v[0, 0], v[0, 1], v[1, 0], v[1, 1], v[2, 0], v[2, 1]
    ax, ay, bx, by, cx, cy = x1 - x0, y1 - y0, x2 - x1, y2 - y1, x0 - x2, y0 - y2
    ia, ib, ic = inverse_square(ax, ay), inverse_square(bx, by), inverse_square(cx, cy)
    g0x, g0y, g1x, g1y, g2x, g2y = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    for i in range(len(pixel_x)):
        d = dists[i]
        gain = upstream[i] * sigmoid(-d * inverse_sigma) * inverse_sigma
        gain = gain if d < blur else ZERO
        gain = -TWO * (-gain if d < ZERO else gain)
        dx0, dx1, dx2 = pixel_x[i] - x0, pixel_x[i] - x1, pixel_x[i] - x2
        dy0, dy1, dy2 = py - y0, py - y1, py - y2
        ta = min(max((dx0 * ax + dy0 * ay) * ia, ZERO), ONE)
        tb = min(max((dx1 * bx + dy1 * by) * ib, ZERO), ONE)
        tc = min(max((dx2 * cx + dy2 * cy) * ic, ZERO), ONE)
        rax, ray = dx0 - ta * ax, dy0 - ta * ay
        rbx, rby = dx1 - tb * bx, dy1 - tb * by
        rcx, rcy = dx2 - tc * cx, dy2 - tc * cy
        da, db, dc = rax * rax + ray * ray, rbx * rbx + rby * rby, rcx * rcx + rcy * rcy
        # ties in the reference's order: edge (v1, v2), then (v2, v0), then (v0, v1)
        is_b = db <= dc and db <= da
        is_c = not is_b and dc <= da
        rx, ry = (rbx, rby) if is_b else ((rcx, rcy) if is_c else (rax, ray))
        t = tb if is_b else (tc if is_c else ta)
        fx, fy = gain * (ONE - t) * rx, gain * (ONE - t) * ry
        sx, sy = gain * t * rx, gain * t * ry
        g0x += ZERO if is_b else (sx if is_c else fx)
        g0y += ZERO if is_b else (sy if is_c else fy)
        g1x += fx if is_b else (ZERO if is_c else sx)
        g1y += fy if is_b else (ZERO if is_c else sy)
        g2x += sx if is_b else (fx if is_c else ZERO)
        g2y += sy if is_b else (fy if is_c else ZERO)
    grad[0, 0] += g0x
    grad[0, 1] += g0y
    grad[1, 0] += g1x
    grad[1, 1] += g1y
    grad[2, 0] += g2x
    grad[2, 1] += g2y
