"""Scalar geometry of triangles in NDC, written once for every kernel.

All arguments are scalars of one float type (float32 in the kernels: a bare literal would promote to float64, hence
the named constants). Notation: p pixel centre, v0 v1 v2 corners, e_i the edge function opposite to corner i,
w barycentric coordinates. Sources of the semantics: the reference of `rasterize_meshes`.
"""

import math

import numpy as np
from numba import types
from numba.extending import intrinsic

from rendra.kernels.parallel import scalar_kernel

ZERO = np.float32(0.0)
ONE = np.float32(1.0)
TWO = np.float32(2.0)
HALF = np.float32(0.5)
AREA_EPS = np.float32(1e-8)  # added to the area; smaller faces are skipped
DEPTH_EPS = np.float32(1e-8)  # faces with a nearer corner are skipped
CLIP_EPS = np.float32(1e-5)  # least sum of clipped barycentrics
TINY = np.float32(1e-37)  # keeps the sign of "inside" where the distance is zero
INFINITY = np.float32(np.inf)

BLOCK = 8  # float32 numbers in one AVX2 vector

# `exponential`: ln 2 is split so that n * LN_2_HIGH is exact; adding and subtracting ROUNDER rounds to an integer
EXP_LIMIT = np.float32(87.0)
LOG2_E = np.float32(1.4426950408889634)
LN_2_HIGH = np.float32(0.693359375)
LN_2_LOW = np.float32(-2.12194440e-4)
ROUNDER = np.float32(12582912.0)
T2, T3, T4, T5, T6 = (np.float32(1.0 / math.factorial(k)) for k in range(2, 7))


@scalar_kernel
def edge_function(px, py, ax, ay, bx, by):
    """Twice the signed area of (a, b, p)."""
    return (px - ax) * (by - ay) - (py - ay) * (bx - ax)


@scalar_kernel
def barycentric(px, py, x0, y0, x1, y1, x2, y2):
    """Screen-space barycentric coordinates of p."""
    area = edge_function(x2, y2, x0, y0, x1, y1) + AREA_EPS
    w0 = edge_function(px, py, x1, y1, x2, y2) / area
    w1 = edge_function(px, py, x2, y2, x0, y0) / area
    w2 = edge_function(px, py, x0, y0, x1, y1) / area
    return w0, w1, w2


@scalar_kernel
def perspective_barycentric(w0, w1, w2, z0, z1, z2):
    """Barycentric coordinates on the surface in space: w_i / z_i, normalised."""
    t0 = w0 * z1 * z2
    t1 = z0 * w1 * z2
    t2 = z0 * z1 * w2
    total = max(t0 + t1 + t2, AREA_EPS)
    return t0 / total, t1 / total, t2 / total


@scalar_kernel
def clip_barycentric(w0, w1, w2):
    """Negative coordinates become zero; the rest is normalised."""
    c0, c1, c2 = max(w0, ZERO), max(w1, ZERO), max(w2, ZERO)
    total = max(c0 + c1 + c2, CLIP_EPS)
    return c0 / total, c1 / total, c2 / total


@scalar_kernel
def surface_point(px, py, x0, y0, z0, x1, y1, z1, x2, y2, z2, perspective_correct, clip):
    """Barycentric coordinates and depth that a face shows at p: (w0, w1, w2, z)."""
    w0, w1, w2 = barycentric(px, py, x0, y0, x1, y1, x2, y2)
    if perspective_correct:
        w0, w1, w2 = perspective_barycentric(w0, w1, w2, z0, z1, z2)
    if clip:
        w0, w1, w2 = clip_barycentric(w0, w1, w2)
    return w0, w1, w2, w0 * z0 + w1 * z1 + w2 * z2


@scalar_kernel
def inverse_square(x, y):
    """1 / (x^2 + y^2), or 0 for the zero vector: a degenerate segment is its first end."""
    square = x * x + y * y
    return ONE / square if square > ZERO else ZERO


@scalar_kernel
def point_segment(px, py, ax, ay, bx, by):
    """Squared distance of p to segment (a, b), its foot's parameter t and the vector from the foot to p."""
    dx, dy = px - ax, py - ay
    sx, sy = bx - ax, by - ay
    t = min(max((dx * sx + dy * sy) * inverse_square(sx, sy), ZERO), ONE)
    rx, ry = dx - t * sx, dy - t * sy
    return rx * rx + ry * ry, t, rx, ry


@scalar_kernel
def signed_distance(px, py, x0, y0, x1, y1, x2, y2):
    """Squared distance of p to the nearest edge, negative inside."""
    d0, _, _, _ = point_segment(px, py, x1, y1, x2, y2)
    d1, _, _, _ = point_segment(px, py, x2, y2, x0, y0)
    d2, _, _, _ = point_segment(px, py, x0, y0, x1, y1)
    d = min(d0, min(d1, d2))
    s = edge_function(x2, y2, x0, y0, x1, y1) + AREA_EPS
    inside = (
        edge_function(px, py, x1, y1, x2, y2) * s > ZERO
        and edge_function(px, py, x2, y2, x0, y0) * s > ZERO
        and edge_function(px, py, x0, y0, x1, y1) * s > ZERO
    )
    return -max(d, TINY) if inside else d


@scalar_kernel
def signed_distance_row(pixel_x, py, x0, y0, x1, y1, x2, y2, out):
    """`signed_distance` for the pixels of a row, into out[0:len(pixel_x)].

    Written without branches, so that it compiles to vector code: give it whole blocks of pixels. An edge function
    times the orientation's sign keeps its exact sign.
    """
    s = ONE if edge_function(x2, y2, x0, y0, x1, y1) + AREA_EPS > ZERO else -ONE
    ax, ay, bx, by, cx, cy = x1 - x0, y1 - y0, x2 - x1, y2 - y1, x0 - x2, y0 - y2
    ia, ib, ic = inverse_square(ax, ay), inverse_square(bx, by), inverse_square(cx, cy)
    dy0, dy1, dy2 = py - y0, py - y1, py - y2
    for i in range(len(pixel_x)):
        px = pixel_x[i]
        dx0, dx1, dx2 = px - x0, px - x1, px - x2
        ta = min(max((dx0 * ax + dy0 * ay) * ia, ZERO), ONE)
        tb = min(max((dx1 * bx + dy1 * by) * ib, ZERO), ONE)
        tc = min(max((dx2 * cx + dy2 * cy) * ic, ZERO), ONE)
        rax, ray = dx0 - ta * ax, dy0 - ta * ay
        rbx, rby = dx1 - tb * bx, dy1 - tb * by
        rcx, rcy = dx2 - tc * cx, dy2 - tc * cy
        d = min(rax * rax + ray * ray, min(rbx * rbx + rby * rby, rcx * rcx + rcy * rcy))
        e2 = (dx0 * ay - dy0 * ax) * s
        e0 = (dx1 * by - dy1 * bx) * s
        e1 = (dx2 * cy - dy2 * cx) * s
        out[i] = -max(d, TINY) if min(e0, min(e1, e2)) > ZERO else d


@scalar_kernel
def whole_blocks(columns, first, end):
    """The columns from `first` up to `end` or a little further: a multiple of BLOCK, for vector code."""
    return columns[first : first + (end - first + BLOCK - 1) // BLOCK * BLOCK]


@scalar_kernel
def face_row(face_verts, f, other, pixel_x, py, out, rivals):
    """Signed distances of one face along a row; infinite where `other`, its clipped half, keeps the pixel.

    Of the two halves of a clipped face only the nearer one counts: lower signed distance, then lower index. So a
    pixel is hit exactly where out[i] < blur_radius, which holds inside for every radius.
    """
    v = face_verts[f]
    signed_distance_row(pixel_x, py, v[0, 0], v[0, 1], v[1, 0], v[1, 1], v[2, 0], v[2, 1], out)
    if other >= 0:
        v = face_verts[other]
        signed_distance_row(pixel_x, py, v[0, 0], v[0, 1], v[1, 0], v[1, 1], v[2, 0], v[2, 1], rivals)
        for i in range(len(pixel_x)):
            if out[i] > rivals[i] or (out[i] == rivals[i] and f > other):
                out[i] = INFINITY


@intrinsic
def _float32_of_bits(typingctx, bits):
    """The float32 whose IEEE 754 representation is the int32 given."""

    def codegen(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.float32))

    return types.float32(types.int32), codegen


@scalar_kernel
def exponential(x):
    """exp(x) in float32 to 2e-7 relative for |x| <= 87, clamped beyond; arithmetic alone, so that it vectorises.

    x = n ln 2 + r with |r| <= ln 2 / 2; exp(r) by its Taylor series to the 6th order; 2^n by its bits.
    """
    x = min(max(x, -EXP_LIMIT), EXP_LIMIT)
    n = (x * LOG2_E + ROUNDER) - ROUNDER
    r = (x - n * LN_2_HIGH) - n * LN_2_LOW
    series = ONE + r * (ONE + r * (T2 + r * (T3 + r * (T4 + r * (T5 + r * T6)))))
    return series * _float32_of_bits(np.int32((np.int32(n) + np.int32(127)) << np.int32(23)))


@scalar_kernel
def sigmoid(x):
    """1 / (1 + exp(-x)) in float32."""
    return ONE / (ONE + exponential(-x))


@scalar_kernel
def pixel_centre(i, size, short):
    """NDC of pixel i along an axis of `size` pixels: +X left and +Y up, the short side spans [-1, 1]."""
    return np.float32(size - 1 - 2 * i) / np.float32(short)


@scalar_kernel
def pixel_span(low, high, size, short):
    """The pixels [begin, end) whose centres lie in the NDC interval [low, high]."""
    guess = (np.float32(size - 1) - high * np.float32(short)) * HALF
    begin = int(math.ceil(min(max(guess, ZERO), np.float32(size))))
    while begin > 0 and pixel_centre(begin - 1, size, short) <= high:
        begin -= 1
    while begin < size and pixel_centre(begin, size, short) > high:
        begin += 1
    guess = (np.float32(size - 1) - low * np.float32(short)) * HALF
    end = int(math.ceil(min(max(guess, ZERO), np.float32(size))))
    while end < size and pixel_centre(end, size, short) >= low:
        end += 1
    while end > begin and pixel_centre(end - 1, size, short) < low:
        end -= 1
    return begin, max(begin, end)
