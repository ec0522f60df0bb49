"""Smoothing of meshes without the shrinking that plain averaging brings."""

import torch
from torch import Tensor

from rendra.structures.meshes import Meshes
from rendra.structures.topology import Topology

_LENGTH_EPS = 1e-12


def taubin_smoothing(meshes: Meshes, lambd: float = 0.53, mu: float = -0.53, num_iter: int = 10) -> Meshes:
    """Low-pass filter: each iteration smooths by `lambd` and then inflates by `mu`.

    Taubin, "Curve and Surface Smoothing without Shrinkage", ICCV 1995. A step by s moves every vertex by s times
    the way to the mean of its neighbours, weighted by the inverse lengths of the edges to them.

    Args:
        meshes: N meshes.
        lambd: the smoothing step, in [0, 1].
        mu: the inflating step, negative; about -lambd.
        num_iter: number of pairs of steps.

    Returns:
        Meshes with the same faces and textures, differentiable with respect to the vertices. A vertex without
        neighbours stays.
    """
    verts = meshes.verts_packed()
    for _ in range(num_iter):
        for step in (lambd, mu):
            verts = verts + step * _to_neighbors(verts, meshes.topology)
    padded = verts.new_zeros(meshes.verts_padded().shape)
    rows = meshes.verts_padded_to_packed_idx()
    return meshes.update_padded(padded.view(-1, 3).index_copy(0, rows, verts).view_as(padded))


def _to_neighbors(verts: Tensor, topology: Topology) -> Tensor:
    """From each vertex to the weighted mean of its neighbours, 0 without any. (sum V, 3)"""
    differences = topology.edge_differences(verts.dtype)
    vectors = differences @ verts
    weights = 1 / (torch.linalg.vector_norm(vectors, dim=1, keepdim=True) + _LENGTH_EPS)
    total = topology.edge_sums(verts.dtype).transposed @ weights
    return -(differences.transposed @ (weights * vectors)) / torch.where(total > 0, total, 1.0)
