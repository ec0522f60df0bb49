"""Laplacian matrices of triangle meshes, given as raw tensors: uniform, by cotangents, by edge lengths."""

import torch
from torch import Tensor

from rendra.structures.topology import uniform_laplacian


def laplacian(verts: Tensor, edges: Tensor) -> Tensor:
    """The uniform Laplacian D^-1 A - I, with A the adjacency of the graph and D its degrees.

    Args:
        verts: (V, 3); only their number and type matter.
        edges: (E, 2), every edge once, as `Meshes.edges_packed()`.

    Returns:
        L (V, V) sparse: L[i, j] = 1 / degree(i) for neighbours i, j, and L[i, i] = -1.

    Raises:
        ValueError: another shape.
    """
    _check("edges", edges, "(E, 2)", 2)
    return uniform_laplacian(len(verts), edges, verts.dtype)


def cot_laplacian(verts: Tensor, faces: Tensor, eps: float = 1e-12) -> tuple[Tensor, Tensor]:
    """Cotangent weights of the edges, and what the areas around the vertices are divided by.

    W of Desbrun et al., "Implicit Fairing of Irregular Meshes using Diffusion and Curvature Flow", 1999, Eq. 14:
    sum_j W[i, j] (v_j - v_i) is along the normal. Differentiable with respect to `verts`.

    Args:
        verts: (V, 3).
        faces: (F, 3), rows of `verts`.
        eps: the square of a face's area is at least this, so that faces without area give finite numbers.

    Returns:
        W (V, V) sparse and symmetric: cot a + cot b of the two angles opposite to the edge ij; its diagonal
        is empty. And (V, 1), the inverse of the summed areas of the faces at each vertex, 0 where there is none.

    Raises:
        ValueError: another shape.
    """
    _check("verts", verts, "(V, 3)", 3)
    _check("faces", faces, "(F, 3)", 3)
    cotangents, areas = corner_cotangents(verts, faces, eps)
    opposite = faces[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2)
    weights = _symmetric(opposite, cotangents.reshape(-1), len(verts))
    around = areas.new_zeros(len(verts)).index_add(0, faces.reshape(-1), areas.repeat_interleave(3))
    used = around > 0
    return weights, torch.where(used, torch.where(used, around, 1.0).reciprocal(), 0.0)[:, None]


def norm_laplacian(verts: Tensor, edges: Tensor, eps: float = 1e-12) -> Tensor:
    """Inverse lengths of the edges. Differentiable with respect to `verts`.

    Args:
        verts: (V, 3).
        edges: (E, 2), every edge once.
        eps: added to each length.

    Returns:
        (V, V) sparse and symmetric: 1 / (|v_i - v_j| + eps) for neighbours i, j; its diagonal is empty.

    Raises:
        ValueError: another shape.
    """
    _check("verts", verts, "(V, 3)", 3)
    _check("edges", edges, "(E, 2)", 2)
    v0, v1 = verts.index_select(0, edges.reshape(-1)).view(-1, 2, 3).unbind(1)
    return _symmetric(edges, (torch.linalg.vector_norm(v0 - v1, dim=1) + eps).reciprocal(), len(verts))


def corner_cotangents(verts: Tensor, faces: Tensor, eps: float = 1e-12) -> tuple[Tensor, Tensor]:
    """Cotangents of the angles at the corners of faces (F, 3), and the areas (F,), at least the root of `eps`.

    cot = (b^2 + c^2 - a^2) / (4 area) with a the side opposite to the corner, from products of the sides, which
    keep more digits than their lengths do.
    """
    corners = verts.index_select(0, faces.reshape(-1)).view(-1, 3, 3)
    sides = corners.roll(-1, 1) - corners.roll(1, 1)  # side k, opposite to corner k
    squared = 0.25 * torch.linalg.cross(sides[:, 1], sides[:, 2]).square().sum(1)
    areas = squared.clamp_min(eps).sqrt()
    # at a corner one side ends and one begins, hence the sign
    products = (sides.roll(-1, 1) * sides.roll(1, 1)).sum(2)
    return -0.5 * products / areas[:, None], areas


def _check(name: str, rows: Tensor, expected: str, width: int) -> None:
    if rows.ndim != 2 or rows.shape[1] != width:
        raise ValueError(f"{name} must have shape {expected}, got {tuple(rows.shape)}")


def _symmetric(edges: Tensor, weights: Tensor, num_verts: int) -> Tensor:
    """A sparse (V, V) with the weights (E,) at both places of each edge (E, 2); repeated edges add up."""
    indices = torch.cat([edges, edges.flip(1)]).T
    values = torch.cat([weights, weights])
    return torch.sparse_coo_tensor(indices, values, (num_verts, num_verts), check_invariants=False).coalesce()
