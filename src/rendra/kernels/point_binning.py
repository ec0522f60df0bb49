"""What kernels that draw discs need before they draw: which pixels a disc may reach, and which disc is nearer.

`binning.bin_faces` takes both: boxes of points are boxes, as those of faces are.
"""

import math

import numpy as np
from numba import prange

from rendra.kernels.geometry import INFINITY, ZERO, pixel_span
from rendra.kernels.parallel import parallel_kernel

_SLACK = np.float32(2.0**-20)  # eight units of the last place: no pixel of a disc is lost by rounding its border


@parallel_kernel
def point_boxes(points, radius, height, width, workers):
    """Pixel boxes (P, 4) around all discs, empty for points that are not finite, not in front, or without a radius.

    A box holds every pixel whose centre is nearer than the radius, and may hold a few that are not.
    """
    boxes = np.zeros((len(radius), 4), np.int32)
    short = min(height, width)
    for worker in prange(workers):
        for p in range(worker * len(radius) // workers, (worker + 1) * len(radius) // workers):
            x, y, z, r = points[p, 0], points[p, 1], points[p, 2], radius[p]
            if z > ZERO and z < INFINITY and math.isfinite(x) and math.isfinite(y) and r > ZERO:
                reach = r + (r + abs(x)) * _SLACK
                x_begin, x_end = pixel_span(x - reach, x + reach, width, short)
                reach = r + (r + abs(y)) * _SLACK
                y_begin, y_end = pixel_span(y - reach, y + reach, height, short)
                if x_end > x_begin and y_end > y_begin:
                    boxes[p, 0], boxes[p, 1], boxes[p, 2], boxes[p, 3] = x_begin, x_end, y_begin, y_end
    return boxes


def front_to_back(depth: np.ndarray, first_point: np.ndarray, num_points: np.ndarray) -> np.ndarray:
    """Packed indices (P,), those of each image by depth, then by index; in any order where depth is not positive.

    Positive floats are ordered as their bits are, and bits with the index below them make keys without ties, which
    NumPy sorts several times faster than it does floats stably.
    """
    bits = np.ascontiguousarray(depth).view(np.uint32).astype(np.uint64)
    keys = (bits << np.uint64(32)) | np.arange(len(depth), dtype=np.uint64)
    for first, count in zip(first_point.tolist(), num_points.tolist(), strict=True):
        keys[first : first + count].sort()
    return (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)
