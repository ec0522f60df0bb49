"""Encodings on the CPU. See README.md for who owns what, and why the order of every sum is fixed.

Points are taken in chunks, whose features stay in the cache while one level after the other adds its own, and
levels in blocks: first the rows and weights of a block's corners, which runs in vector units, then the table.
Corner c of the i-th point of a block stands at c * _BLOCK + i of `rows` and `weights`; rows count numbers, not rows
of F, so that `rows + f` is feature f.
"""

import numpy as np
from numba import prange

from rendra.kernels.parallel import parallel_kernel, scalar_kernel

_BLOCK = 256
_CHUNK = 2048
_ZERO, _ONE = np.float32(0), np.float32(1)
_PRIME_Y, _PRIME_Z = np.uint32(2654435761), np.uint32(805459861)
_STEP = np.uint32(1)


@scalar_kernel
def _axis(points, first, count, axis, out):
    """One coordinate of a chunk, clamped to [0, 1]; NaN stays."""
    for i in range(count):
        x = points[3 * (first + i) + axis]
        x = _ZERO if x < _ZERO else x
        out[i] = _ONE if x > _ONE else x


@scalar_kernel
def _weigh_cell(i, x, y, z, weights):
    """Trilinear weights; bit 0 of a corner's number is its step along x, bit 1 along y, bit 2 along z."""
    left, front = _ONE - x, _ONE - y
    near = _ONE - z
    w00, w10, w01, w11 = left * front, x * front, left * y, x * y
    weights[i] = w00 * near
    weights[_BLOCK + i] = w10 * near
    weights[2 * _BLOCK + i] = w01 * near
    weights[3 * _BLOCK + i] = w11 * near
    weights[4 * _BLOCK + i] = w00 * z
    weights[5 * _BLOCK + i] = w10 * z
    weights[6 * _BLOCK + i] = w01 * z
    weights[7 * _BLOCK + i] = w11 * z


@scalar_kernel
def _dense_cells(xs, ys, zs, first, count, resolution, base, features, rows, weights):
    """Corners in a grid of (resolution + 1)^3 rows, x fastest."""
    scale, last = np.float32(resolution), np.float32(resolution - 1)
    step_x = np.uint32(features)
    step_y, step_z = np.uint32(features * (resolution + 1)), np.uint32(features * (resolution + 1) ** 2)
    start = np.uint32(base)
    for i in range(count):
        x, y, z = xs[first + i] * scale, ys[first + i] * scale, zs[first + i] * scale
        cell_x, cell_y = np.int32(x if x < last else last), np.int32(y if y < last else last)
        cell_z = np.int32(z if z < last else last)
        _weigh_cell(i, x - np.float32(cell_x), y - np.float32(cell_y), z - np.float32(cell_z), weights)
        row = np.uint32(start + np.uint32(np.uint32(cell_x) * step_x) + np.uint32(np.uint32(cell_y) * step_y))
        row = np.uint32(row + np.uint32(np.uint32(cell_z) * step_z))
        rows[i] = row
        rows[_BLOCK + i] = np.uint32(row + step_x)
        rows[2 * _BLOCK + i] = np.uint32(row + step_y)
        rows[3 * _BLOCK + i] = np.uint32(row + step_x + step_y)
        above = np.uint32(row + step_z)
        rows[4 * _BLOCK + i] = above
        rows[5 * _BLOCK + i] = np.uint32(above + step_x)
        rows[6 * _BLOCK + i] = np.uint32(above + step_y)
        rows[7 * _BLOCK + i] = np.uint32(above + step_x + step_y)


@scalar_kernel
def _hashed_cells(xs, ys, zs, first, count, resolution, size, base, features, rows, weights):
    """Corners in a table of `size` rows, a power of two (Eq. 4)."""
    scale, last = np.float32(resolution), np.float32(resolution - 1)
    mask, width, start = np.uint32(size - 1), np.uint32(features), np.uint32(base)
    for i in range(count):
        x, y, z = xs[first + i] * scale, ys[first + i] * scale, zs[first + i] * scale
        cell_x, cell_y = np.int32(x if x < last else last), np.int32(y if y < last else last)
        cell_z = np.int32(z if z < last else last)
        _weigh_cell(i, x - np.float32(cell_x), y - np.float32(cell_y), z - np.float32(cell_z), weights)
        x0, y0 = np.uint32(cell_x), np.uint32(np.uint32(cell_y) * _PRIME_Y)
        z0 = np.uint32(np.uint32(cell_z) * _PRIME_Z)
        x1, y1, z1 = np.uint32(x0 + _STEP), np.uint32(y0 + _PRIME_Y), np.uint32(z0 + _PRIME_Z)
        a, b, c, d = np.uint32(y0 ^ z0), np.uint32(y1 ^ z0), np.uint32(y0 ^ z1), np.uint32(y1 ^ z1)
        rows[i] = np.uint32(start + np.uint32(np.uint32((x0 ^ a) & mask) * width))
        rows[_BLOCK + i] = np.uint32(start + np.uint32(np.uint32((x1 ^ a) & mask) * width))
        rows[2 * _BLOCK + i] = np.uint32(start + np.uint32(np.uint32((x0 ^ b) & mask) * width))
        rows[3 * _BLOCK + i] = np.uint32(start + np.uint32(np.uint32((x1 ^ b) & mask) * width))
        rows[4 * _BLOCK + i] = np.uint32(start + np.uint32(np.uint32((x0 ^ c) & mask) * width))
        rows[5 * _BLOCK + i] = np.uint32(start + np.uint32(np.uint32((x1 ^ c) & mask) * width))
        rows[6 * _BLOCK + i] = np.uint32(start + np.uint32(np.uint32((x0 ^ d) & mask) * width))
        rows[7 * _BLOCK + i] = np.uint32(start + np.uint32(np.uint32((x1 ^ d) & mask) * width))


@scalar_kernel
def _cells(xs, ys, zs, first, count, resolution, size, base, features, rows, weights):
    if (resolution + 1) ** 3 <= size:
        _dense_cells(xs, ys, zs, first, count, resolution, base, features, rows, weights)
    else:
        _hashed_cells(xs, ys, zs, first, count, resolution, size, base, features, rows, weights)


@scalar_kernel
def _gather_1(corners, table, rows, weights, count, f, out, place, stride):
    for i in range(count):
        p = _ZERO
        for c in range(corners):
            p += weights[c * _BLOCK + i] * table[np.uint64(rows[c * _BLOCK + i]) + np.uint64(f)]
        out[place + i * stride] = p


@scalar_kernel
def _gather_2(corners, table, rows, weights, count, f, out, place, stride):
    for i in range(count):
        p = q = _ZERO
        for c in range(corners):
            row, w = np.uint64(rows[c * _BLOCK + i]) + np.uint64(f), weights[c * _BLOCK + i]
            p += w * table[row]
            q += w * table[row + np.uint64(1)]
        out[place + i * stride], out[place + i * stride + 1] = p, q


@scalar_kernel
def _gather_4(corners, table, rows, weights, count, f, out, place, stride):
    for i in range(count):
        p = q = r = s = _ZERO
        for c in range(corners):
            row, w = np.uint64(rows[c * _BLOCK + i]) + np.uint64(f), weights[c * _BLOCK + i]
            p += w * table[row]
            q += w * table[row + np.uint64(1)]
            r += w * table[row + np.uint64(2)]
            s += w * table[row + np.uint64(3)]
        o = place + i * stride
        out[o], out[o + 1], out[o + 2], out[o + 3] = p, q, r, s


@scalar_kernel
def _gather(corners, table, rows, weights, count, features, out, place, stride):
    """Weighted sums over the corners of a block, `features` numbers a point, at place + i * stride."""
    f = 0
    while f < features:
        if features - f >= 4:
            _gather_4(corners, table, rows, weights, count, f, out, place + f, stride)
            f += 4
        elif features - f >= 2:
            _gather_2(corners, table, rows, weights, count, f, out, place + f, stride)
            f += 2
        else:
            _gather_1(corners, table, rows, weights, count, f, out, place + f, stride)
            f += 1


@scalar_kernel
def _scatter_1(corners, grad, rows, weights, count, f, upstream, place, stride):
    for i in range(count):
        p = upstream[place + i * stride]
        for c in range(corners):
            grad[np.uint64(rows[c * _BLOCK + i]) + np.uint64(f)] += weights[c * _BLOCK + i] * p


@scalar_kernel
def _scatter_2(corners, grad, rows, weights, count, f, upstream, place, stride):
    for i in range(count):
        p, q = upstream[place + i * stride], upstream[place + i * stride + 1]
        for c in range(corners):
            row, w = np.uint64(rows[c * _BLOCK + i]) + np.uint64(f), weights[c * _BLOCK + i]
            a, b = grad[row] + w * p, grad[row + np.uint64(1)] + w * q
            grad[row], grad[row + np.uint64(1)] = a, b


@scalar_kernel
def _scatter_4(corners, grad, rows, weights, count, f, upstream, place, stride):
    for i in range(count):
        o = place + i * stride
        p, q, r, s = upstream[o], upstream[o + 1], upstream[o + 2], upstream[o + 3]
        for c in range(corners):
            row, w = np.uint64(rows[c * _BLOCK + i]) + np.uint64(f), weights[c * _BLOCK + i]
            a, b = grad[row] + w * p, grad[row + np.uint64(1)] + w * q
            d, e = grad[row + np.uint64(2)] + w * r, grad[row + np.uint64(3)] + w * s
            grad[row], grad[row + np.uint64(1)] = a, b
            grad[row + np.uint64(2)], grad[row + np.uint64(3)] = d, e


@scalar_kernel
def _scatter(corners, grad, rows, weights, count, features, upstream, place, stride):
    """The transpose of `_gather`: what is upstream of a point is added to its corners, point after point."""
    f = 0
    while f < features:
        if features - f >= 4:
            _scatter_4(corners, grad, rows, weights, count, f, upstream, place + f, stride)
            f += 4
        elif features - f >= 2:
            _scatter_2(corners, grad, rows, weights, count, f, upstream, place + f, stride)
            f += 2
        else:
            _scatter_1(corners, grad, rows, weights, count, f, upstream, place + f, stride)
            f += 1


@scalar_kernel
def _project(corners, table, rows, count, features, upstream, place, stride, dots):
    """What is upstream of a point times the features of each of its corners: corner c at c * _BLOCK + i."""
    for c in range(corners):
        for i in range(count):
            row, o = np.uint64(rows[c * _BLOCK + i]), place + i * stride
            total = upstream[o] * table[row]
            for f in range(1, features):
                total += upstream[o + f] * table[row + np.uint64(f)]
            dots[c * _BLOCK + i] = total


@parallel_kernel
def encode_grid(points, table, resolutions, offsets, features, out):
    """Chunks of points are owned by threads. All arrays flat."""
    total, stride = len(points) // 3, len(resolutions) * features
    for chunk in prange((total + _CHUNK - 1) // _CHUNK):
        start = chunk * _CHUNK
        size = min(_CHUNK, total - start)
        xs, ys, zs = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
        rows, weights = np.empty(8 * _BLOCK, np.uint32), np.empty(8 * _BLOCK, np.float32)
        _axis(points, start, size, 0, xs)
        _axis(points, start, size, 1, ys)
        _axis(points, start, size, 2, zs)
        for level in range(len(resolutions)):
            base, held = offsets[level] * features, offsets[level + 1] - offsets[level]
            for first in range(0, size, _BLOCK):
                count = min(_BLOCK, size - first)
                _cells(xs, ys, zs, first, count, resolutions[level], held, base, features, rows, weights)
                place = (start + first) * stride + level * features
                _gather(8, table, rows, weights, count, features, out, place, stride)


@parallel_kernel
def table_gradient(points, resolutions, offsets, features, upstream, shares, grad):
    """Levels are owned by threads: row t of `shares` lists those of thread t, -1 behind the last."""
    total, stride = len(points) // 3, len(resolutions) * features
    for share in prange(len(shares)):
        xs, ys, zs = np.empty(_CHUNK, np.float32), np.empty(_CHUNK, np.float32), np.empty(_CHUNK, np.float32)
        rows, weights = np.empty(8 * _BLOCK, np.uint32), np.empty(8 * _BLOCK, np.float32)
        for k in range(shares.shape[1]):
            level = shares[share, k]
            if level >= 0:
                grad[offsets[level] * features : offsets[level + 1] * features] = _ZERO
        for start in range(0, total, _CHUNK):
            size = min(_CHUNK, total - start)
            _axis(points, start, size, 0, xs)
            _axis(points, start, size, 1, ys)
            _axis(points, start, size, 2, zs)
            for k in range(shares.shape[1]):
                level = shares[share, k]
                if level < 0:
                    continue
                base, held = offsets[level] * features, offsets[level + 1] - offsets[level]
                for first in range(0, size, _BLOCK):
                    count = min(_BLOCK, size - first)
                    _cells(xs, ys, zs, first, count, resolutions[level], held, base, features, rows, weights)
                    place = (start + first) * stride + level * features
                    _scatter(8, grad, rows, weights, count, features, upstream, place, stride)


@scalar_kernel
def _differentiate_cell(xs, ys, zs, first, count, resolution, dots, grads):
    """Derivative of the trilinear interpolation of eight numbers, added to grads[axis * _CHUNK + i]."""
    scale, last = np.float32(resolution), np.float32(resolution - 1)
    for i in range(count):
        x, y, z = xs[first + i] * scale, ys[first + i] * scale, zs[first + i] * scale
        x -= np.float32(np.int32(x if x < last else last))
        y -= np.float32(np.int32(y if y < last else last))
        z -= np.float32(np.int32(z if z < last else last))
        d0, d1, d2, d3 = dots[i], dots[_BLOCK + i], dots[2 * _BLOCK + i], dots[3 * _BLOCK + i]
        d4, d5, d6, d7 = dots[4 * _BLOCK + i], dots[5 * _BLOCK + i], dots[6 * _BLOCK + i], dots[7 * _BLOCK + i]
        near_front, near_back = d0 + x * (d1 - d0), d2 + x * (d3 - d2)
        far_front, far_back = d4 + x * (d5 - d4), d6 + x * (d7 - d6)
        near, far = near_front + y * (near_back - near_front), far_front + y * (far_back - far_front)
        slope_near = (d1 - d0) + y * ((d3 - d2) - (d1 - d0))
        slope_far = (d5 - d4) + y * ((d7 - d6) - (d5 - d4))
        grads[first + i] += scale * (slope_near + z * (slope_far - slope_near))
        rise_near, rise_far = near_back - near_front, far_back - far_front
        grads[_CHUNK + first + i] += scale * (rise_near + z * (rise_far - rise_near))
        grads[2 * _CHUNK + first + i] += scale * (far - near)


@scalar_kernel
def _write_gradient(points, start, size, grads, out):
    """Clamped coordinates do not move; NaN is passed on."""
    for axis in range(3):
        for i in range(size):
            x = points[3 * (start + i) + axis]
            out[3 * (start + i) + axis] = _ZERO if x < _ZERO or x > _ONE else grads[axis * _CHUNK + i]


@parallel_kernel
def points_gradient(points, table, resolutions, offsets, features, upstream, grad):
    """Chunks of points are owned by threads, as forward."""
    total, stride = len(points) // 3, len(resolutions) * features
    for chunk in prange((total + _CHUNK - 1) // _CHUNK):
        start = chunk * _CHUNK
        size = min(_CHUNK, total - start)
        xs, ys, zs = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
        rows, weights = np.empty(8 * _BLOCK, np.uint32), np.empty(8 * _BLOCK, np.float32)
        dots, grads = np.empty(8 * _BLOCK, np.float32), np.zeros(3 * _CHUNK, np.float32)
        _axis(points, start, size, 0, xs)
        _axis(points, start, size, 1, ys)
        _axis(points, start, size, 2, zs)
        for level in range(len(resolutions)):
            base, held = offsets[level] * features, offsets[level + 1] - offsets[level]
            for first in range(0, size, _BLOCK):
                count = min(_BLOCK, size - first)
                _cells(xs, ys, zs, first, count, resolutions[level], held, base, features, rows, weights)
                place = (start + first) * stride + level * features
                _project(8, table, rows, count, features, upstream, place, stride, dots)
                _differentiate_cell(xs, ys, zs, first, count, resolutions[level], dots, grads)
        _write_gradient(points, start, size, grads, grad)


@scalar_kernel
def _plane_axes(plane):
    """Planes of (x, y), (x, z), (y, z): the coordinate along a row, and that from row to row."""
    return (0 if plane < 2 else 1), (1 if plane < 1 else 2)


@scalar_kernel
def _plane_cells(us, vs, first, count, side, base, features, rows, weights):
    """Corners in a plane of side^2 rows; bit 0 of a corner's number is its step along u, bit 1 along v."""
    scale, last = np.float32(side - 1), np.float32(side - 2)
    step_u, step_v, start = np.uint32(features), np.uint32(features * side), np.uint32(base)
    for i in range(count):
        u, v = us[first + i] * scale, vs[first + i] * scale
        cell_u, cell_v = np.int32(u if u < last else last), np.int32(v if v < last else last)
        u -= np.float32(cell_u)
        v -= np.float32(cell_v)
        weights[i] = (_ONE - u) * (_ONE - v)
        weights[_BLOCK + i] = u * (_ONE - v)
        weights[2 * _BLOCK + i] = (_ONE - u) * v
        weights[3 * _BLOCK + i] = u * v
        row = np.uint32(start + np.uint32(np.uint32(cell_u) * step_u) + np.uint32(np.uint32(cell_v) * step_v))
        rows[i] = row
        rows[_BLOCK + i] = np.uint32(row + step_u)
        rows[2 * _BLOCK + i] = np.uint32(row + step_v)
        rows[3 * _BLOCK + i] = np.uint32(row + step_u + step_v)


@parallel_kernel
def sample_planes(points, planes, side, features, out):
    """The three planes' features of each point side by side. Chunks of points are owned by threads."""
    total, stride = len(points) // 3, 3 * features
    for chunk in prange((total + _CHUNK - 1) // _CHUNK):
        start = chunk * _CHUNK
        size = min(_CHUNK, total - start)
        us, vs = np.empty(size, np.float32), np.empty(size, np.float32)
        rows, weights = np.empty(4 * _BLOCK, np.uint32), np.empty(4 * _BLOCK, np.float32)
        for plane in range(3):
            axis_u, axis_v = _plane_axes(plane)
            _axis(points, start, size, axis_u, us)
            _axis(points, start, size, axis_v, vs)
            for first in range(0, size, _BLOCK):
                count = min(_BLOCK, size - first)
                _plane_cells(us, vs, first, count, side, plane * side * side * features, features, rows, weights)
                place = (start + first) * stride + plane * features
                _gather(4, planes, rows, weights, count, features, out, place, stride)


@parallel_kernel
def multiply_planes(values, features, out):
    """Product of the three planes' features, point by point."""
    for point in prange(len(out) // features):
        i, o = 3 * features * point, features * point
        for f in range(features):
            out[o + f] = values[i + f] * values[i + features + f] * values[i + 2 * features + f]


@parallel_kernel
def multiply_planes_gradient(values, features, upstream, grad):
    """What is upstream of each plane: the product's gradient times the features of the other two."""
    for point in prange(len(upstream) // features):
        i, o = 3 * features * point, features * point
        for f in range(features):
            a, b, c = values[i + f], values[i + features + f], values[i + 2 * features + f]
            g = upstream[o + f]
            grad[i + f], grad[i + features + f], grad[i + 2 * features + f] = g * b * c, g * a * c, g * a * b


@parallel_kernel
def planes_gradient(points, side, features, upstream, grad):
    """Four features of one plane are owned by a thread."""
    total, stride, groups = len(points) // 3, 3 * features, (features + 3) // 4
    for item in prange(3 * groups):
        plane, f = item // groups, item % groups * 4
        width, base = min(4, features - f), plane * side * side * features
        us, vs = np.empty(_CHUNK, np.float32), np.empty(_CHUNK, np.float32)
        rows, weights = np.empty(4 * _BLOCK, np.uint32), np.empty(4 * _BLOCK, np.float32)
        for row in range(side * side):
            for k in range(f, f + width):
                grad[base + row * features + k] = _ZERO
        axis_u, axis_v = _plane_axes(plane)
        for start in range(0, total, _CHUNK):
            size = min(_CHUNK, total - start)
            _axis(points, start, size, axis_u, us)
            _axis(points, start, size, axis_v, vs)
            for first in range(0, size, _BLOCK):
                count = min(_BLOCK, size - first)
                _plane_cells(us, vs, first, count, side, base + f, features, rows, weights)
                place = (start + first) * stride + plane * features + f
                _scatter(4, grad, rows, weights, count, width, upstream, place, stride)


@scalar_kernel
def _differentiate_plane(us, vs, first, count, side, dots, place_u, place_v, grads):
    """Derivative of the bilinear interpolation of four numbers, added to grads[place + i]."""
    scale, last = np.float32(side - 1), np.float32(side - 2)
    for i in range(count):
        u, v = us[first + i] * scale, vs[first + i] * scale
        u -= np.float32(np.int32(u if u < last else last))
        v -= np.float32(np.int32(v if v < last else last))
        d0, d1, d2, d3 = dots[i], dots[_BLOCK + i], dots[2 * _BLOCK + i], dots[3 * _BLOCK + i]
        grads[place_u + i] += scale * ((d1 - d0) + v * ((d3 - d2) - (d1 - d0)))
        grads[place_v + i] += scale * ((d2 - d0) + u * ((d3 - d1) - (d2 - d0)))


@parallel_kernel
def planes_points_gradient(points, planes, side, features, upstream, grad):
    """Chunks of points are owned by threads, as forward."""
    total, stride = len(points) // 3, 3 * features
    for chunk in prange((total + _CHUNK - 1) // _CHUNK):
        start = chunk * _CHUNK
        size = min(_CHUNK, total - start)
        us, vs = np.empty(size, np.float32), np.empty(size, np.float32)
        rows, weights = np.empty(4 * _BLOCK, np.uint32), np.empty(4 * _BLOCK, np.float32)
        dots, grads = np.empty(4 * _BLOCK, np.float32), np.zeros(3 * _CHUNK, np.float32)
        for plane in range(3):
            axis_u, axis_v = _plane_axes(plane)
            _axis(points, start, size, axis_u, us)
            _axis(points, start, size, axis_v, vs)
            for first in range(0, size, _BLOCK):
                count = min(_BLOCK, size - first)
                _plane_cells(us, vs, first, count, side, plane * side * side * features, features, rows, weights)
                place = (start + first) * stride + plane * features
                _project(4, planes, rows, count, features, upstream, place, stride, dots)
                at_u, at_v = axis_u * _CHUNK + first, axis_v * _CHUNK + first
                _differentiate_plane(us, vs, first, count, side, dots, at_u, at_v, grads)
        _write_gradient(points, start, size, grads, grad)
