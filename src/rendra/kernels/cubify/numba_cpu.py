"""Surface of voxels on the CPU: the fast twin of `reference.py`. Count, prefix-sum, fill, sixty voxels at a time.

A column of voxels along z is a row of bits, so that neighbours are compared by shifts and masks. Sixty bits a word:
one more may be shifted in and an int64 stays positive. `occupied` is padded by one empty column on each side; a
vertex's number is the number of vertices in the words before its own and in the lower bits of its own.
"""

import numpy as np
from numba import prange

from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel

_BITS = 60
_FULL = (1 << _BITS) - 1
_ROWS_AT_ONCE = 8  # rows of voxels that a thread packs together, so that it reads long runs of memory
_BYTES_1, _BYTES_2 = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
_BYTES_4, _BYTES_8 = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x0101010101010101)
_S1, _S2, _S4, _S56 = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(56)
# The quad on each of a voxel's sides; corner 4 dy + 2 dx + dz of the voxel lies (dy, dx, dz) from its first.
_SIDES = np.array([[0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6], [0, 4, 6, 2], [1, 3, 7, 5]])


def forward(
    voxels: np.ndarray, thresh: float, x: np.ndarray, y: np.ndarray, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), faces (F, 3), voxel behind each quad (F / 2,), and how many of both each grid has."""
    n, depth, height, width = voxels.shape
    words, workers = depth // _BITS + 1, num_threads()
    occupied = np.zeros((n, words, height + 2, width + 2), np.int64)
    used = np.empty((n, height + 1, width + 1, words), np.int64)
    counts = np.empty((2, used.size), np.int64)
    _pack(voxels.reshape(n, depth, height * width), np.float32(thresh), workers, occupied)
    _survey(occupied, workers, used, counts[0], counts[1])
    ends = np.cumsum(counts, axis=1)
    num_verts, num_quads = counts.reshape(2, n, (height + 1) * (width + 1) * words).sum(axis=2)
    verts = np.empty((num_verts.sum(), 3), np.float32)
    faces = np.empty((2 * num_quads.sum(), 3), np.int64)
    voxel_of_quad = np.empty(len(faces) // 2, np.int64)
    firsts = ends - counts
    _fill(occupied, used, firsts[0], firsts[1], np.cumsum(num_verts) - num_verts, (x, y, z), workers, verts, faces,
          voxel_of_quad)  # fmt: skip
    return verts, faces, voxel_of_quad, num_verts, 2 * num_quads


@parallel_kernel
def _pack(voxels, thresh, workers, occupied):
    """Compare voxels (N, D, H W) and write their bits."""
    n, depth, _ = voxels.shape
    words, height, width = occupied.shape[1], occupied.shape[2] - 2, occupied.shape[3] - 2
    blocks = (height + _ROWS_AT_ONCE - 1) // _ROWS_AT_ONCE
    for worker in prange(workers):
        packed = np.empty(_ROWS_AT_ONCE * width, np.int64)
        for task in range(worker, n * blocks * words, workers):
            grid, row, m = task // words // blocks, task // words % blocks * _ROWS_AT_ONCE, task % words
            end = min(row + _ROWS_AT_ONCE, height)
            packed[:] = 0
            for k in range(m * _BITS, min((m + 1) * _BITS, depth)):
                _pack_layer(voxels[grid, k, row * width : end * width], thresh, k % _BITS, packed)
            for j in range(row, end):
                for i in range(width):
                    occupied[grid, m, j + 1, i + 1] = packed[(j - row) * width + i]


@scalar_kernel
def _pack_layer(values, thresh, bit, packed):
    """One long loop: the columns of several rows, side by side."""
    for i in range(len(values)):
        packed[i] |= np.int64(values[i] >= thresh) << bit


@scalar_kernel
def _ones(word):
    """How many bits of a word are set (Warren, "Hacker's Delight", Fig. 5-2; compiled to one instruction)."""
    w = np.uint64(word)
    w -= (w >> _S1) & _BYTES_1
    w = (w & _BYTES_2) + ((w >> _S2) & _BYTES_2)
    w = (w + (w >> _S4)) & _BYTES_4
    return np.int64((w * _BYTES_8) >> _S56)


@scalar_kernel
def _raised(word, before):
    """The bits moved one up; the last of the word before comes in."""
    return ((word << 1) & _FULL) | (before >> (_BITS - 1))


@scalar_kernel
def _touched(columns, m, j, i):
    """Voxels along z of which any, and of which all, of the four columns around a vertex are kept."""
    if m < 0:
        return 0, 0
    a, b, c, d = columns[m, j, i], columns[m, j, i + 1], columns[m, j + 1, i], columns[m, j + 1, i + 1]
    return a | b | c | d, a & b & c & d


@scalar_kernel
def _bare(columns, m, j, i):
    """The six masks of voxels whose side is bare; j, i count the padded columns."""
    here = columns[m, j, i]
    before = columns[m - 1, j, i] if m > 0 else 0
    after = columns[m + 1, j, i] if m + 1 < len(columns) else 0
    below, above = _raised(here, before), (here >> 1) | ((after & 1) << (_BITS - 1))
    return (
        here & ~columns[m, j, i - 1],
        here & ~columns[m, j, i + 1],
        here & ~columns[m, j - 1, i],
        here & ~columns[m, j + 1, i],
        here & ~below,
        here & ~above,
    )


@parallel_kernel
def _survey(occupied, workers, used, num_verts, num_quads):
    """Which vertices each word uses, and how many vertices and quads it makes."""
    n, height, width, words = used.shape
    for worker in prange(workers):
        for row in range(worker, n * height, workers):
            columns, j = occupied[row // height], row % height
            for i in range(width):
                for m in range(words):
                    some, every = _touched(columns, m, j, i)
                    some_before, every_before = _touched(columns, m - 1, j, i)
                    word = (some | _raised(some, some_before)) & ~(every & _raised(every, every_before))
                    entry = (row * width + i) * words + m
                    used[row // height, j, i, m] = word
                    num_verts[entry] = _ones(word)
                    num_quads[entry] = 0
                    if j < height - 1 and i < width - 1:
                        for side in _bare(columns, m, j + 1, i + 1):
                            num_quads[entry] += _ones(side)


@parallel_kernel
def _fill(occupied, used, first_vert, first_quad, first_of_grid, planes, workers, verts, faces, voxel_of_quad):
    n, height, width, words = used.shape
    depth, flat = len(planes[2]) - 1, used.reshape(-1)
    for worker in prange(workers):
        corners = np.empty(8, np.int64)
        for row in range(worker, n * height, workers):
            grid, j = row // height, row % height
            columns, first = occupied[grid], first_of_grid[grid]
            for i in range(width):
                for m in range(words):
                    entry = (row * width + i) * words + m
                    _place(flat[entry], first_vert[entry], planes, i, j, m * _BITS, verts)
                    if j == height - 1 or i == width - 1:
                        continue
                    sides, quad = _bare(columns, m, j + 1, i + 1), first_quad[entry]
                    left = sides[0] | sides[1] | sides[2] | sides[3] | sides[4] | sides[5]
                    while left != 0:
                        bit = _ones((left & -left) - 1)
                        left &= left - 1
                        _number_corners(flat, first_vert, entry, width * words, words, bit, first, corners)
                        voxel = ((grid * depth + m * _BITS + bit) * (height - 1) + j) * (width - 1) + i
                        bare = _sides_at(sides, bit)
                        while bare != 0:
                            _join(corners, _ones((bare & -bare) - 1), quad, faces)
                            bare &= bare - 1
                            voxel_of_quad[quad] = voxel
                            quad += 1


@scalar_kernel
def _sides_at(sides, bit):
    """Which of one voxel's six sides are bare, as bits: without branches, which nothing could predict."""
    low = ((sides[0] >> bit) & 1) | (((sides[1] >> bit) & 1) << 1) | (((sides[2] >> bit) & 1) << 2)
    return low | (((sides[3] >> bit) & 1) << 3) | (((sides[4] >> bit) & 1) << 4) | (((sides[5] >> bit) & 1) << 5)


@scalar_kernel
def _place(word, vert, planes, i, j, k, verts):
    """Write the vertices of one word, from number `vert` on."""
    while word != 0:
        verts[vert, 0] = planes[0][i]
        verts[vert, 1] = planes[1][j]
        verts[vert, 2] = planes[2][k + _ones((word & -word) - 1)]
        word &= word - 1
        vert += 1


@scalar_kernel
def _number_corners(used, first_vert, entry, row_stride, stride, bit, first, corners):
    """Numbers, within the grid, of a voxel's eight corners; of those that are not used, any."""
    for column in range(4):
        there = entry + (column >> 1) * row_stride + (column & 1) * stride
        vert = first_vert[there] + _ones(used[there] & ((1 << bit) - 1)) - first
        corners[2 * column] = vert
        corners[2 * column + 1] = vert + ((used[there] >> bit) & 1)  # right across the end of a word, too


@scalar_kernel
def _join(corners, side, quad, faces):
    """Write the two triangles of one quad."""
    a, b = corners[_SIDES[side, 0]], corners[_SIDES[side, 1]]
    c, d = corners[_SIDES[side, 2]], corners[_SIDES[side, 3]]
    faces[2 * quad, 0], faces[2 * quad, 1], faces[2 * quad, 2] = a, b, c
    faces[2 * quad + 1, 0], faces[2 * quad + 1, 1], faces[2 * quad + 1, 2] = a, c, d
