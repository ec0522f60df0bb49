"""Linear blend skinning on the CPU: the fast twin of `reference.py`, and its derivative.

A block of vertices of one body belongs to one thread, and has sums of its own of the gradients of the joints'
transforms; they are added up block after block. So nothing depends on the number of threads. See README.md.
"""

import numpy as np
from numba import prange

from rendra.kernels.geometry import ZERO
from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel

_BLOCK = 1024  # vertices


def forward(
    verts: np.ndarray, moves: np.ndarray, joints: np.ndarray, weights: np.ndarray, skinned: np.ndarray
) -> None:
    """Write the vertices (B, V, 3)."""
    _skin(verts, moves, joints, weights, num_threads(), skinned)


def backward(
    verts: np.ndarray, moves: np.ndarray, joints: np.ndarray, weights: np.ndarray, upstream: np.ndarray,
    grad_verts: np.ndarray, grad_moves: np.ndarray,
) -> None:  # fmt: skip
    """Write the gradients of the vertices (B, V, 3) and of the transforms (B, J, 12)."""
    blocks = (verts.shape[1] + _BLOCK - 1) // _BLOCK
    parts = np.empty((len(verts), blocks, *moves.shape[1:]), np.float32)
    _differentiate(verts, moves, joints, weights, upstream, num_threads(), grad_verts, parts)
    _add_up(parts, num_threads(), grad_moves)


@scalar_kernel
def _push(verts, moves, joints, weights, first, end, skinned):
    """Some vertices of one body; weights fall, and none follows a zero."""
    for v in range(first, end):
        x, y, z = verts[v, 0], verts[v, 1], verts[v, 2]
        to_x, to_y, to_z = ZERO, ZERO, ZERO
        for k in range(joints.shape[1]):
            weight = weights[v, k]
            if weight == ZERO:
                break
            m = moves[joints[v, k]]
            to_x += weight * (m[0] * x + m[1] * y + m[2] * z + m[3])
            to_y += weight * (m[4] * x + m[5] * y + m[6] * z + m[7])
            to_z += weight * (m[8] * x + m[9] * y + m[10] * z + m[11])
        skinned[v, 0], skinned[v, 1], skinned[v, 2] = to_x, to_y, to_z


@parallel_kernel
def _skin(verts, moves, joints, weights, workers, skinned):
    bodies, num_verts = verts.shape[:2]
    blocks = (num_verts + _BLOCK - 1) // _BLOCK
    for worker in prange(workers):
        for task in range(worker, bodies * blocks, workers):
            b = task // blocks
            first = (task - b * blocks) * _BLOCK
            _push(verts[b], moves[b], joints, weights, first, min(first + _BLOCK, num_verts), skinned[b])


@scalar_kernel
def _pull(verts, moves, joints, weights, upstream, first, end, grad_verts, part):
    """The gradients of some vertices of one body and, in `part` (J, 12), of the transforms that move them."""
    part[:] = ZERO
    for v in range(first, end):
        x, y, z = verts[v, 0], verts[v, 1], verts[v, 2]
        gx, gy, gz = upstream[v, 0], upstream[v, 1], upstream[v, 2]
        of_x, of_y, of_z = ZERO, ZERO, ZERO
        for k in range(joints.shape[1]):
            weight = weights[v, k]
            if weight == ZERO:
                break
            m, row = moves[joints[v, k]], part[joints[v, k]]
            wx, wy, wz = weight * gx, weight * gy, weight * gz
            of_x += m[0] * wx + m[4] * wy + m[8] * wz
            of_y += m[1] * wx + m[5] * wy + m[9] * wz
            of_z += m[2] * wx + m[6] * wy + m[10] * wz
            row[0] += wx * x
            row[1] += wx * y
            row[2] += wx * z
            row[3] += wx
            row[4] += wy * x
            row[5] += wy * y
            row[6] += wy * z
            row[7] += wy
            row[8] += wz * x
            row[9] += wz * y
            row[10] += wz * z
            row[11] += wz
        grad_verts[v, 0], grad_verts[v, 1], grad_verts[v, 2] = of_x, of_y, of_z


@parallel_kernel
def _differentiate(verts, moves, joints, weights, upstream, workers, grad_verts, parts):
    bodies, num_verts = verts.shape[:2]
    blocks = (num_verts + _BLOCK - 1) // _BLOCK
    for worker in prange(workers):
        for task in range(worker, bodies * blocks, workers):
            b = task // blocks
            block = task - b * blocks
            first = block * _BLOCK
            end = min(first + _BLOCK, num_verts)
            _pull(verts[b], moves[b], joints, weights, upstream[b], first, end, grad_verts[b], parts[b, block])


@parallel_kernel
def _add_up(parts, workers, grad_moves):
    bodies, blocks = parts.shape[:2]
    for worker in prange(workers):
        for b in range(worker, bodies, workers):
            grad_moves[b] = ZERO
            for block in range(blocks):
                grad_moves[b] += parts[b, block]
