"""Triangles to fragments on the CPU: the fast twin of `reference.py`.

Forward: faces are binned into bands of rows; a band is drawn by one thread, face by face, so that each (face, pixel)
pair of a bounding box is looked at once. One layer without blur keeps a depth buffer; several layers keep, in the
output itself, the K nearest hits of each pixel in order. Backward: hits are recomputed from their face index, and
each of a fixed number of chunks of rows sums into a buffer of its own.
"""

import numpy as np
from numba import prange

from rendra.kernels.binning import BAND_ROWS, bin_faces, face_boxes, padded_columns
from rendra.kernels.geometry import (
    AREA_EPS,
    BLOCK,
    CLIP_EPS,
    ONE,
    TWO,
    ZERO,
    barycentric,
    clip_barycentric,
    edge_function,
    face_row,
    perspective_barycentric,
    pixel_centre,
    point_segment,
    signed_distance,
    surface_point,
    whole_blocks,
)
from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel

_CHUNKS = 8  # row groups of an image that sum gradients apart; fixed, so that results never depend on threads
_MAX_CHUNK_FLOATS = 2**26


def forward(
    face_verts: np.ndarray,
    first_face: np.ndarray,
    num_faces: np.ndarray,
    neighbor: np.ndarray,
    size: tuple[int, int],
    blur_radius: float,
    layers: int,
    flags: tuple[bool, bool, bool],
    outputs: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Write pix_to_face, zbuf, bary_coords and dists, every element; `flags` = (perspective, clip, cull)."""
    perspective, clip, cull = flags
    height, width = size
    workers = num_threads()
    boxes = face_boxes(face_verts, blur_radius, cull, height, width, workers)
    blur = np.float32(blur_radius)
    if layers == 1 and blur_radius == 0.0 and not (neighbor >= 0).any():
        order = np.arange(len(face_verts))
        bins = bin_faces(boxes, order, first_face, num_faces, height)
        _draw_nearest(face_verts, boxes, *bins, perspective, clip, workers, *outputs)
    else:
        order = _front_to_back(face_verts, first_face, num_faces)
        bins = bin_faces(boxes, order, first_face, num_faces, height)
        _draw_layers(face_verts, boxes, *bins, neighbor, blur, perspective, clip, workers, *outputs)


def _front_to_back(face_verts: np.ndarray, first_face: np.ndarray, num_faces: np.ndarray) -> np.ndarray:
    """Faces of each image by their nearest corner: then most hits arrive in the order in which they are kept."""
    nearest = face_verts[:, :, 2].min(axis=1) if len(face_verts) else np.zeros(0, np.float32)
    order = np.arange(len(face_verts))
    for first, count in zip(first_face.tolist(), num_faces.tolist(), strict=True):
        order[first : first + count] = first + np.argsort(nearest[first : first + count], kind="stable")
    return order


@parallel_kernel
def _draw_nearest(
    face_verts, boxes, starts, faces, perspective, clip, workers, pix_to_face, zbuf, bary_coords, dists
):
    images, height, width, _ = pix_to_face.shape
    bands = (height + BAND_ROWS - 1) // BAND_ROWS
    short = min(height, width)
    for worker in prange(workers):
        columns = padded_columns(height, width)
        for band in range(worker, images * bands, workers):
            n, row = band // bands, band % bands * BAND_ROWS
            row_end = min(row + BAND_ROWS, height)
            pix_to_face[n, row:row_end] = -1
            zbuf[n, row:row_end] = -ONE
            bary_coords[n, row:row_end] = -ONE
            dists[n, row:row_end] = -ONE
            for entry in range(starts[band], starts[band + 1]):
                f = faces[entry]
                _fill_depth(face_verts[f], f, boxes[f], row, row_end, columns, short, perspective, clip,
                            pix_to_face[n], zbuf[n])  # fmt: skip
            for y in range(row, row_end):
                py = pixel_centre(y, height, short)
                for x in range(width):
                    f = pix_to_face[n, y, x, 0]
                    if f >= 0:
                        _describe_hit(face_verts[f], columns[x], py, perspective, clip,
                                      bary_coords[n, y, x, 0], dists[n, y, x], 0)  # fmt: skip


@scalar_kernel
def _fill_depth(v, f, box, row, row_end, columns, short, perspective, clip, pix_to_face, zbuf):
    """Depth test of one face in the rows of a band; the lower face index wins a tie."""
    height = pix_to_face.shape[0]
    x0, y0, z0, x1, y1, z1 = v[0, 0], v[0, 1], v[0, 2], v[1, 0], v[1, 1], v[1, 2]
    x2, y2, z2 = v[2, 0], v[2, 1], v[2, 2]
    s = ONE if edge_function(x2, y2, x0, y0, x1, y1) + AREA_EPS > ZERO else -ONE
    for y in range(max(box[2], row), min(box[3], row_end)):
        py = pixel_centre(y, height, short)
        for x in range(box[0], box[1]):
            px = columns[x]
            if (
                edge_function(px, py, x1, y1, x2, y2) * s > ZERO
                and edge_function(px, py, x2, y2, x0, y0) * s > ZERO
                and edge_function(px, py, x0, y0, x1, y1) * s > ZERO
            ):
                z = surface_point(px, py, x0, y0, z0, x1, y1, z1, x2, y2, z2, perspective, clip)[3]
                if z >= ZERO and (pix_to_face[y, x, 0] < 0 or z < zbuf[y, x, 0]):
                    zbuf[y, x, 0] = z
                    pix_to_face[y, x, 0] = f


@scalar_kernel
def _describe_hit(v, px, py, perspective, clip, bary, dists, k):
    """Barycentric coordinates and signed distance of a hit that was kept."""
    x0, y0, x1, y1, x2, y2 = v[0, 0], v[0, 1], v[1, 0], v[1, 1], v[2, 0], v[2, 1]
    w0, w1, w2, _ = surface_point(px, py, x0, y0, v[0, 2], x1, y1, v[1, 2], x2, y2, v[2, 2], perspective, clip)
    bary[0], bary[1], bary[2] = w0, w1, w2
    dists[k] = signed_distance(px, py, x0, y0, x1, y1, x2, y2)


@parallel_kernel
def _draw_layers(
    face_verts, boxes, starts, faces, neighbor, blur, perspective, clip, workers,
    pix_to_face, zbuf, bary_coords, dists,
):  # fmt: skip
    images, height, width, layers = pix_to_face.shape
    bands = (height + BAND_ROWS - 1) // BAND_ROWS
    short = min(height, width)
    for worker in prange(workers):
        columns = padded_columns(height, width)
        row_dists, rivals = np.empty(width + BLOCK, np.float32), np.empty(width + BLOCK, np.float32)
        counts = np.empty((BAND_ROWS, width), np.int32)
        for band in range(worker, images * bands, workers):
            n, row = band // bands, band % bands * BAND_ROWS
            row_end = min(row + BAND_ROWS, height)
            counts[:] = 0
            for entry in range(starts[band], starts[band + 1]):
                f = faces[entry]
                for y in range(max(boxes[f, 2], row), min(boxes[f, 3], row_end)):
                    _collect_row(face_verts, f, boxes[f], pixel_centre(y, height, short), columns, neighbor,
                                 blur, perspective, clip, row_dists, rivals, counts[y - row],
                                 pix_to_face[n, y], zbuf[n, y])  # fmt: skip
            for y in range(row, row_end):
                py = pixel_centre(y, height, short)
                for x in range(width):
                    count = counts[y - row, x]
                    for k in range(count):
                        v = face_verts[pix_to_face[n, y, x, k]]
                        _describe_hit(v, columns[x], py, perspective, clip, bary_coords[n, y, x, k],
                                      dists[n, y, x], k)  # fmt: skip
                    pix_to_face[n, y, x, count:] = -1
                    zbuf[n, y, x, count:] = -ONE
                    bary_coords[n, y, x, count:] = -ONE
                    dists[n, y, x, count:] = -ONE


@scalar_kernel
def _collect_row(
    face_verts,
    f,
    box,
    py,
    columns,
    neighbor,
    blur,
    perspective,
    clip,
    row_dists,
    rivals,
    counts,
    pix_to_face,
    zbuf,
):
    """Offer the hits of one face in one row to the sorted lists of their pixels."""
    v = face_verts[f]
    x0, y0, z0, x1, y1, z1 = v[0, 0], v[0, 1], v[0, 2], v[1, 0], v[1, 1], v[1, 2]
    x2, y2, z2 = v[2, 0], v[2, 1], v[2, 2]
    first, end = box[0], box[1]
    face_row(face_verts, f, neighbor[f], whole_blocks(columns, first, end), py, row_dists, rivals)
    for x in range(first, end):
        if row_dists[x - first] < blur:
            px = columns[x]
            z = surface_point(px, py, x0, y0, z0, x1, y1, z1, x2, y2, z2, perspective, clip)[3]
            if z >= ZERO:
                counts[x] = _insert(z, f, counts[x], pix_to_face[x], zbuf[x])


@scalar_kernel
def _insert(z, f, count, pix_to_face, zbuf):
    """Keep the list of a pixel sorted by (depth, face index) and no longer than its layers; returns its length."""
    layers = len(zbuf)
    if count == layers:
        last = zbuf[layers - 1]
        if z > last or (z == last and f > pix_to_face[layers - 1]):
            return count
        count -= 1
    slot = count
    while slot > 0 and (zbuf[slot - 1] > z or (zbuf[slot - 1] == z and pix_to_face[slot - 1] > f)):
        zbuf[slot] = zbuf[slot - 1]
        pix_to_face[slot] = pix_to_face[slot - 1]
        slot -= 1
    zbuf[slot] = z
    pix_to_face[slot] = f
    return count + 1


def backward(
    face_verts: np.ndarray,
    pix_to_face: np.ndarray,
    flags: tuple[bool, bool],
    grads: tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None],
) -> np.ndarray:
    """Gradient (F, 3, 3) from those of zbuf, bary_coords and dists, None where nothing flows."""
    grad_zbuf, grad_bary, grad_dists = grads
    images, height, _, _ = pix_to_face.shape
    chunks = max(1, min(_CHUNKS, height, _MAX_CHUNK_FLOATS // max(1, 9 * len(face_verts))))
    partial = np.zeros((chunks, len(face_verts), 3, 3), np.float32)
    _gather_gradients(
        face_verts, pix_to_face, *flags, num_threads(),
        grad_zbuf is not None, grad_bary is not None, grad_dists is not None,
        np.zeros((1, 1, 1, 1), np.float32) if grad_zbuf is None else grad_zbuf,
        np.zeros((1, 1, 1, 1, 3), np.float32) if grad_bary is None else grad_bary,
        np.zeros((1, 1, 1, 1), np.float32) if grad_dists is None else grad_dists,
        partial,
    )  # fmt: skip
    return partial.sum(axis=0)


@parallel_kernel
def _gather_gradients(
    face_verts, pix_to_face, perspective, clip, workers,
    has_zbuf, has_bary, has_dists, grad_zbuf, grad_bary, grad_dists, partial,
):  # fmt: skip
    images, height, width, layers = pix_to_face.shape
    chunks = partial.shape[0]
    short = min(height, width)
    for worker in prange(workers):
        columns = padded_columns(height, width)
        for piece in range(worker, images * chunks, workers):
            n, chunk = piece // chunks, piece % chunks
            # rows are dealt out in turn, so that chunks are about equally full
            for y in range(chunk, height, chunks):
                py = pixel_centre(y, height, short)
                for x in range(width):
                    for k in range(layers):
                        f = pix_to_face[n, y, x, k]
                        if f < 0:
                            break
                        grad = partial[chunk, f]
                        if has_zbuf or has_bary:
                            gz = grad_zbuf[n, y, x, k] if has_zbuf else ZERO
                            g0 = grad_bary[n, y, x, k, 0] if has_bary else ZERO
                            g1 = grad_bary[n, y, x, k, 1] if has_bary else ZERO
                            g2 = grad_bary[n, y, x, k, 2] if has_bary else ZERO
                            if gz != ZERO or g0 != ZERO or g1 != ZERO or g2 != ZERO:
                                _surface_gradient(face_verts[f], columns[x], py, perspective, clip,
                                                  gz, g0, g1, g2, grad)  # fmt: skip
                        if has_dists and grad_dists[n, y, x, k] != ZERO:
                            _distance_gradient(face_verts[f], columns[x], py, grad_dists[n, y, x, k], grad)


@scalar_kernel
def _surface_gradient(v, px, py, perspective, clip, gz, g0, g1, g2, grad):
    """Add the gradient of depth (gz) and barycentrics (g0, g1, g2) at p; the README derives each stage."""
    x0, y0, z0, x1, y1, z1 = v[0, 0], v[0, 1], v[0, 2], v[1, 0], v[1, 1], v[1, 2]
    x2, y2, z2 = v[2, 0], v[2, 1], v[2, 2]
    w0, w1, w2 = barycentric(px, py, x0, y0, x1, y1, x2, y2)
    p0, p1, p2 = w0, w1, w2
    if perspective:
        p0, p1, p2 = perspective_barycentric(w0, w1, w2, z0, z1, z2)
    c0, c1, c2 = p0, p1, p2
    if clip:
        c0, c1, c2 = clip_barycentric(p0, p1, p2)
    grad[0, 2] += gz * c0
    grad[1, 2] += gz * c1
    grad[2, 2] += gz * c2
    g0, g1, g2 = g0 + gz * z0, g1 + gz * z1, g2 + gz * z2
    if clip:
        total = max(p0, ZERO) + max(p1, ZERO) + max(p2, ZERO)
        mean = g0 * c0 + g1 * c1 + g2 * c2 if total > CLIP_EPS else ZERO
        total = max(total, CLIP_EPS)
        g0 = (g0 - mean) / total if p0 > ZERO else ZERO
        g1 = (g1 - mean) / total if p1 > ZERO else ZERO
        g2 = (g2 - mean) / total if p2 > ZERO else ZERO
    if perspective:
        total = w0 * z1 * z2 + z0 * w1 * z2 + z0 * z1 * w2
        mean = g0 * p0 + g1 * p1 + g2 * p2 if total > AREA_EPS else ZERO
        total = max(total, AREA_EPS)
        t0, t1, t2 = (g0 - mean) / total, (g1 - mean) / total, (g2 - mean) / total
        grad[0, 2] += t1 * w1 * z2 + t2 * w2 * z1
        grad[1, 2] += t0 * w0 * z2 + t2 * w2 * z0
        grad[2, 2] += t0 * w0 * z1 + t1 * w1 * z0
        g0, g1, g2 = t0 * z1 * z2, t1 * z0 * z2, t2 * z0 * z1
    area = edge_function(x2, y2, x0, y0, x1, y1) + AREA_EPS
    shared = -(g0 * w0 + g1 * w1 + g2 * w2) / area
    g0, g1, g2 = g0 / area, g1 / area, g2 / area
    # e0 = edge(p; v1, v2), e1 = edge(p; v2, v0), e2 = edge(p; v0, v1), area = edge(v2; v0, v1)
    grad[0, 0] += g1 * (y2 - py) + g2 * (py - y1) + shared * (y2 - y1)
    grad[0, 1] += g1 * (px - x2) + g2 * (x1 - px) + shared * (x1 - x2)
    grad[1, 0] += g0 * (py - y2) + g2 * (y0 - py) + shared * (y0 - y2)
    grad[1, 1] += g0 * (x2 - px) + g2 * (px - x0) + shared * (x2 - x0)
    grad[2, 0] += g0 * (y1 - py) + g1 * (py - y0) + shared * (y1 - y0)
    grad[2, 1] += g0 * (px - x1) + g1 * (x0 - px) + shared * (x0 - x1)


@scalar_kernel
def _distance_gradient(v, px, py, gd, grad):
    """Add the gradient of the signed squared distance: minus twice the arm from the foot, shared by t."""
    x0, y0, x1, y1, x2, y2 = v[0, 0], v[0, 1], v[1, 0], v[1, 1], v[2, 0], v[2, 1]
    if signed_distance(px, py, x0, y0, x1, y1, x2, y2) < ZERO:
        gd = -gd
    a, b = 1, 2
    best, t, rx, ry = point_segment(px, py, x1, y1, x2, y2)
    d, t1, rx1, ry1 = point_segment(px, py, x2, y2, x0, y0)
    if d < best:
        a, b, best, t, rx, ry = 2, 0, d, t1, rx1, ry1
    d, t2, rx2, ry2 = point_segment(px, py, x0, y0, x1, y1)
    if d < best:
        a, b, t, rx, ry = 0, 1, t2, rx2, ry2
    grad[a, 0] -= TWO * gd * (ONE - t) * rx
    grad[a, 1] -= TWO * gd * (ONE - t) * ry
    grad[b, 0] -= TWO * gd * t * rx
    grad[b, 1] -= TWO * gd * t * ry
