"""Exact binning of faces into horizontal bands of the image: count, prefix sum, fill; nothing can overflow.

A band is BAND_ROWS full rows of one image of the batch. Bands are numbered through the batch, and each is owned by
one thread, so that nothing races and no result depends on the number of threads.
"""

import math

import numpy as np
from numba import prange

from rendra.kernels.geometry import (
    AREA_EPS,
    BLOCK,
    DEPTH_EPS,
    edge_function,
    pixel_centre,
    pixel_span,
)
from rendra.kernels.parallel import parallel_kernel, scalar_kernel

BAND_ROWS = 8


@scalar_kernel
def padded_columns(height, width):
    """NDC x of every column, with one block to spare for `signed_distance_row`."""
    columns = np.empty(width + BLOCK, np.float32)
    for x in range(width + BLOCK):
        columns[x] = pixel_centre(x, width, min(height, width))
    return columns


@scalar_kernel
def face_is_drawn(corners, cull_backfaces):
    """False for degenerate, non-finite or culled faces and those with a corner at or behind the camera."""
    # each for itself: the minimum of a number and NaN may be the number
    if not (corners[0, 2] >= DEPTH_EPS and corners[1, 2] >= DEPTH_EPS and corners[2, 2] >= DEPTH_EPS):
        return False
    x0, y0, x1, y1, x2, y2 = (
        corners[0, 0], corners[0, 1], corners[1, 0], corners[1, 1], corners[2, 0], corners[2, 1],
    )  # fmt: skip
    area = edge_function(x2, y2, x0, y0, x1, y1)
    if not (abs(area) > AREA_EPS and math.isfinite(area)):
        return False
    return area > 0 or not cull_backfaces


@scalar_kernel
def pixel_box(corners, margin, height, width):
    """Columns [x_begin, x_end) and rows [y_begin, y_end) whose centres lie in the face's grown bounding box."""
    short = min(height, width)
    low = min(corners[0, 0], min(corners[1, 0], corners[2, 0])) - margin
    high = max(corners[0, 0], max(corners[1, 0], corners[2, 0])) + margin
    x_begin, x_end = pixel_span(low, high, width, short)
    low = min(corners[0, 1], min(corners[1, 1], corners[2, 1])) - margin
    high = max(corners[0, 1], max(corners[1, 1], corners[2, 1])) + margin
    y_begin, y_end = pixel_span(low, high, height, short)
    return x_begin, x_end, y_begin, y_end


@parallel_kernel
def face_boxes(face_verts, blur_radius, cull_backfaces, height, width, workers):
    """Pixel boxes (F, 4) of all faces, empty for those that are not drawn."""
    num_faces = face_verts.shape[0]
    boxes = np.zeros((num_faces, 4), np.int32)
    margin = np.float32(math.sqrt(blur_radius))
    for worker in prange(workers):
        for f in range(worker * num_faces // workers, (worker + 1) * num_faces // workers):
            if face_is_drawn(face_verts[f], cull_backfaces):
                boxes[f] = pixel_box(face_verts[f], margin, height, width)
    return boxes


@scalar_kernel
def bin_faces(boxes, order, first_face, num_faces, height):
    """The faces of every band, in the order given: (starts (bands + 1,), faces (entries,)).

    `order` (F,) lists the packed faces so that those of one image stand together, as in the packed order.
    """
    bands = (height + BAND_ROWS - 1) // BAND_ROWS
    starts = np.zeros(len(first_face) * bands + 1, np.int64)
    for n in range(len(first_face)):
        for f in range(first_face[n], first_face[n] + num_faces[n]):
            if boxes[f, 1] > boxes[f, 0]:
                for band in range(boxes[f, 2] // BAND_ROWS, (boxes[f, 3] + BAND_ROWS - 1) // BAND_ROWS):
                    starts[n * bands + band + 1] += 1
    for band in range(len(starts) - 1):
        starts[band + 1] += starts[band]
    cursor = starts[:-1].copy()
    faces = np.empty(starts[-1], np.int32)
    for n in range(len(first_face)):
        for i in range(first_face[n], first_face[n] + num_faces[n]):
            f = order[i]
            if boxes[f, 1] > boxes[f, 0]:
                for band in range(boxes[f, 2] // BAND_ROWS, (boxes[f, 3] + BAND_ROWS - 1) // BAND_ROWS):
                    faces[cursor[n * bands + band]] = f
                    cursor[n * bands + band] += 1
    return starts, faces
