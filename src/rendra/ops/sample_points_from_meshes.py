"""Random points on the surface of meshes, evenly spread over its area.

Letters: N meshes, S samples of each, V and F packed vertices and faces, C channels of a texture.
"""

from types import SimpleNamespace
from typing import Any, Literal, overload

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.structures.meshes import Meshes


@overload
def sample_points_from_meshes(
    meshes: Meshes,
    num_samples: int = ...,
    return_normals: Literal[False] = False,
    return_textures: Literal[False] = False,
    *,
    generator: torch.Generator | None = None,
) -> Tensor: ...


@overload
def sample_points_from_meshes(
    meshes: Meshes,
    num_samples: int = ...,
    return_normals: bool = False,
    return_textures: bool = False,
    *,
    generator: torch.Generator | None = None,
) -> Tensor | tuple[Tensor, ...]: ...


def sample_points_from_meshes(
    meshes: Meshes,
    num_samples: int = 10000,
    return_normals: bool = False,
    return_textures: bool = False,
    *,
    generator: torch.Generator | None = None,
) -> Tensor | tuple[Tensor, ...]:
    """Draw points from the surfaces, with equal probability for equal areas.

    A face is drawn by its share of its mesh's area, and a point on it with barycentric coordinates
    (1 - sqrt(u), sqrt(u) (1 - v), sqrt(u) v) for u, v uniform in [0, 1) (Osada et al., "Shape Distributions",
    ACM TOG 2002). Differentiable with respect to vertices and textures, for the faces and coordinates
    that were drawn.

    Args:
        meshes: N meshes. Where one has faces but no area, its faces are equally likely.
        num_samples: S, points from each mesh.
        return_normals: also return the normals of the faces.
        return_textures: also return the texture at the points.
        generator: source of the random numbers, on the device of the meshes; None is torch's own.

    Returns:
        Points (N, S, 3), in the frame and units of the vertices. With `return_normals` a tuple in which unit
        normals (N, S, 3) follow, 0 where the face has no area. With `return_textures` a tuple whose last
        member are the texels (N, S, C). All are 0 for a mesh without faces.

    Raises:
        ValueError: no mesh has a face, a vertex is NaN or infinite, `num_samples` is negative, or there is no
            texture to return.
    """
    _check(meshes, num_samples, return_textures)
    faces = _draw_faces(meshes, num_samples, generator)  # (N, S)
    verts = meshes.verts_packed()
    weights = _draw_barycentrics(faces.shape, verts, generator)  # (N, S, 3)
    drawn = meshes.valid[:, None]
    corners = meshes.faces_packed().index_select(0, faces.reshape(-1))  # (N S, 3)
    points = _WeightedRows.apply(verts, corners, (weights * drawn[..., None]).view(-1, 3))
    results = [points.view(*faces.shape, 3)]
    if return_normals:
        results.append(_normals(verts, corners).view(*faces.shape, 3) * drawn[..., None])
    if return_textures:
        results.append(_texels(meshes, torch.where(drawn, faces, -1), weights))
    return results[0] if len(results) == 1 else tuple(results)


def _check(meshes: Meshes, num_samples: int, return_textures: bool) -> None:
    if meshes.isempty():
        raise ValueError("Meshes are empty.")
    if num_samples < 0:
        raise ValueError(f"num_samples must not be negative, got {num_samples}")
    if not torch.isfinite(meshes.verts_packed()).all():
        raise ValueError("Meshes contain nan or inf.")
    if return_textures and meshes.textures is None:
        raise ValueError("Meshes do not contain textures.")


def _draw_faces(meshes: Meshes, num_samples: int, generator: torch.Generator | None) -> Tensor:
    """Packed faces by their share of the area of their mesh; 0 for meshes that have none. (N, S)"""
    owner, counts = meshes.faces_packed_to_mesh_idx(), meshes.num_faces_per_mesh()
    shares = _shares_of_mesh(meshes.faces_areas_packed().detach().double(), owner, len(meshes))
    # one after another, each mesh takes an interval of length 1; double precision tells a million faces apart
    bounds = torch.cat([shares.new_zeros(1), shares.cumsum(0)])
    first = meshes.mesh_to_faces_packed_first_idx()
    start, end = bounds[first, None], bounds[first + counts, None]
    picks = torch.rand(len(meshes), num_samples, dtype=bounds.dtype, device=bounds.device, generator=generator)
    faces = torch.searchsorted(bounds[1:], start + picks * (end - start), right=True)
    last = (first + counts - 1)[:, None]
    return torch.where(counts[:, None] > 0, torch.minimum(faces, last), 0)


def _shares_of_mesh(areas: Tensor, owner: Tensor, num_meshes: int) -> Tensor:
    """Areas (sum F,) as parts of their mesh's; equal parts where that has none."""
    totals = areas.new_zeros(num_meshes).index_add(0, owner, areas)
    areas = torch.where(totals[owner] > 0, areas, 1.0)
    return areas / areas.new_zeros(num_meshes).index_add(0, owner, areas)[owner]


def _draw_barycentrics(shape: torch.Size, like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Coordinates of points spread evenly over a triangle. (*shape, 3)"""
    u, v = torch.rand(2, *shape, dtype=like.dtype, device=like.device, generator=generator)
    root = u.sqrt_()
    return torch.stack([1 - root, root * (1 - v), root * v], dim=-1)


def _normals(verts: Tensor, corners: Tensor) -> Tensor:
    """Unit normals of faces with the given corners (M, 3), 0 where the area is. (M, 3)"""
    v0, v1, v2 = verts.index_select(0, corners.reshape(-1)).view(-1, 3, 3).unbind(1)
    cross = torch.linalg.cross(v1 - v0, v2 - v1)
    return F.normalize(cross, dim=1, eps=torch.finfo(verts.dtype).tiny ** 0.5)


def _texels(meshes: Meshes, faces: Tensor, weights: Tensor) -> Tensor:
    """Texture at points of the given faces (N, S), negative for none, with weights (N, S, 3). (N, S, C)"""
    points = SimpleNamespace(pix_to_face=faces[:, :, None, None], bary_coords=weights[:, :, None, None])
    return meshes.sample_textures(points)[:, :, 0, 0]


class _WeightedRows(torch.autograd.Function):
    """`out[m] = sum_i weights[m, i] rows[index[m, i]]`, without the (M, 3, D) temporary."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, index: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(index, weights)
        ctx.num_rows = len(rows)
        if index.numel() == 0:
            return rows.new_zeros(len(index), rows.shape[1])
        return F.embedding_bag(index, rows, per_sample_weights=weights, mode="sum")

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        index, weights = ctx.saved_tensors
        shares = (weights[..., None] * grads[0][:, None]).flatten(0, 1)  # (3 M, D)
        return shares.new_zeros(ctx.num_rows, shares.shape[1]).index_add(0, index.view(-1), shares), None, None
