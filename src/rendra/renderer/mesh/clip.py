"""Triangles cut at a plane of depth before they are rasterised, and the results mapped back.

A face that crosses the plane z = z_clip_value has vertices behind the camera or near it, where projection turns
over or explodes. Its visible part is one triangle (two corners behind) or a quadrilateral (one corner behind),
which becomes two triangles. Every new corner is a barycentric combination of the old ones, so the whole step is
one matrix per new triangle, which also maps rasterised barycentrics back and lets gradients through.

Notation: N meshes, F faces before, G faces after, T cut triangles among these.
"""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass
class ClipFrustum:
    """The part of space that is kept. A bound of None does not bound.

    left, right, top, bottom: bounds in NDC; `left` and `top` are the smaller ones.
    znear, zfar: bounds of view depth.
    perspective_correct: whether x and y were divided by depth, so that edges are straight before the division.
    cull: whether faces that lie wholly beyond one of the bounds are dropped.
    z_clip_value: view depth of the plane at which faces are cut; what is nearer goes.
    """

    left: float | None = None
    right: float | None = None
    top: float | None = None
    bottom: float | None = None
    znear: float | None = None
    zfar: float | None = None
    perspective_correct: bool = False
    cull: bool = True
    z_clip_value: float | None = None


@dataclass
class ClippedFaces:
    """Packed faces after clipping, and where they come from; the last four are None where nothing was clipped.

    face_verts: (G, 3, 3).
    mesh_to_face_first_idx, num_faces_per_mesh: (N,) int64.
    faces_clipped_to_unclipped_idx: (G,) int64, index of the face before clipping.
    barycentric_conversion: (T, 3, 3), row i is corner i of a cut triangle in barycentrics of the original face.
    faces_clipped_to_conversion_idx: (G,) int64, row of `barycentric_conversion`, -1 for faces left whole.
    clipped_faces_neighbor_idx: (G,) int64, the other triangle of a face cut in two, -1 if none.
    """

    face_verts: Tensor
    mesh_to_face_first_idx: Tensor
    num_faces_per_mesh: Tensor
    faces_clipped_to_unclipped_idx: Tensor | None = None
    barycentric_conversion: Tensor | None = None
    faces_clipped_to_conversion_idx: Tensor | None = None
    clipped_faces_neighbor_idx: Tensor | None = None


def clip_faces(
    face_verts_unclipped: Tensor,
    mesh_to_face_first_idx: Tensor,
    num_faces_per_mesh: Tensor,
    frustum: ClipFrustum,
) -> ClippedFaces:
    """Drop the faces outside the frustum and cut those that cross its clipping plane.

    Faces keep their order and, where they are not cut, their exact coordinates. Differentiable with respect to
    the vertices.

    Args:
        face_verts_unclipped: (F, 3, 3) packed faces; x, y in NDC, z the view depth.
        mesh_to_face_first_idx: (N,) int64, first face of each mesh.
        num_faces_per_mesh: (N,) int64.
        frustum: what is kept.
    """
    behind = _behind(face_verts_unclipped, frustum.z_clip_value)  # (F, 3)
    num_behind = behind.sum(1)
    pieces = (num_behind < 3).long() + (num_behind == 1).long()  # triangles left of each face: 0, 1 or 2
    if frustum.cull:
        pieces = pieces * ~_outside(face_verts_unclipped, frustum)
    if not bool(((pieces != 1) | (num_behind > 0)).any()):
        return ClippedFaces(face_verts_unclipped, mesh_to_face_first_idx, num_faces_per_mesh)

    ends = torch.cat((pieces.new_zeros(1), pieces.cumsum(0)))  # pieces before each face
    source = torch.repeat_interleave(torch.arange(len(pieces), device=pieces.device), pieces)  # (G,)
    is_second = torch.arange(len(source), device=source.device) > ends[source]
    cut = (num_behind[source] > 0).nonzero()[:, 0]  # (T,)
    face_verts, conversion = _cut(
        face_verts_unclipped.index_select(0, source), cut, behind[source[cut]], is_second[cut], frustum
    )
    conversion_idx = torch.full_like(source, -1).index_copy(0, cut, torch.arange(len(cut), device=cut.device))
    first = ends[mesh_to_face_first_idx]
    return ClippedFaces(
        face_verts,
        first,
        ends[mesh_to_face_first_idx + num_faces_per_mesh] - first,
        source,
        conversion,
        conversion_idx,
        _neighbors(pieces[source], is_second),
    )


def convert_clipped_rasterization_to_original_faces(
    pix_to_face_clipped: Tensor, bary_coords_clipped: Tensor, clipped_faces: ClippedFaces
) -> tuple[Tensor, Tensor]:
    """Express what was rasterised from clipped faces in faces and barycentrics before clipping.

    Args:
        pix_to_face_clipped: (N, H, W, K) int64, indices of clipped faces, -1 where empty.
        bary_coords_clipped: (N, H, W, K, 3), in the clipped faces.
        clipped_faces: what `clip_faces` returned.

    Returns:
        pix_to_face (N, H, W, K) and barycentrics (N, H, W, K, 3) of the original faces.
    """
    origin = clipped_faces.faces_clipped_to_unclipped_idx
    conversion, conversion_idx = (
        clipped_faces.barycentric_conversion,
        clipped_faces.faces_clipped_to_conversion_idx,
    )
    if origin is None or conversion is None or conversion_idx is None:
        return pix_to_face_clipped, bary_coords_clipped
    # one more row than faces: index -1 finds "no face" there
    none = origin.new_full((1,), -1)
    pix_to_face = torch.cat((origin, none))[pix_to_face_clipped]
    rows = torch.cat((conversion_idx, none))[pix_to_face_clipped].reshape(-1)
    slots = (rows >= 0).nonzero()[:, 0]
    bary = bary_coords_clipped.reshape(-1, 3)
    converted = torch.bmm(bary[slots][:, None], conversion[rows[slots]])[:, 0]
    return pix_to_face, bary.index_copy(0, slots, converted).view_as(bary_coords_clipped)


def _behind(face_verts: Tensor, z_clip_value: float | None) -> Tensor:
    """Which corners (F, 3) lie nearer than the clipping plane."""
    depth = face_verts[..., 2]
    return depth < (-torch.inf if z_clip_value is None else z_clip_value)


def _outside(face_verts: Tensor, frustum: ClipFrustum) -> Tensor:
    """Which faces (F,) lie wholly beyond one bound.

    Where a corner is behind the camera, x and y have lost their sign and only the depths are judged.
    """
    x, y, z = face_verts.unbind(-1)
    projected = (z > 0).all(1)
    lower = ((x, frustum.left), (y, frustum.top), (z, frustum.znear))
    upper = ((x, frustum.right), (y, frustum.bottom), (z, frustum.zfar))
    outside = torch.zeros_like(projected)
    for sign, bounds in ((1, lower), (-1, upper)):
        for value, bound in bounds:
            if bound is not None:
                beyond = (sign * value < sign * bound).all(1)
                outside |= beyond if value is z else beyond & projected
    return outside


def _cut(
    face_verts: Tensor, cut: Tensor, behind: Tensor, is_second: Tensor, frustum: ClipFrustum
) -> tuple[Tensor, Tensor]:
    """Replace the T faces `cut` of (G, 3, 3) by their visible pieces; also the pieces' (T, 3, 3) corners."""
    whole = face_verts[cut]
    conversion = _corners(whole[..., 2], behind, is_second, frustum.z_clip_value or 0.0)
    xy, z = whole[..., :2], whole[..., 2:]
    scale = z if frustum.perspective_correct else torch.ones_like(z)
    new_z = conversion @ z
    new_scale = new_z if frustum.perspective_correct else torch.ones_like(z)
    pieces = torch.cat((conversion @ (xy * scale) / new_scale, new_z), dim=-1)
    return face_verts.index_copy(0, cut, pieces), conversion


def _corners(z: Tensor, behind: Tensor, is_second: Tensor, z_clip: float) -> Tensor:
    """Corners of the pieces in barycentrics of their faces: (T, 3, 3).

    With the corners turned so that `a` is the one alone on its side of the plane, and ab, ac the points where its
    edges meet the plane, the visible part is (a, ab, ac) or the quadrilateral (ab, b, c, ac). Both keep the
    winding of (a, b, c).
    """
    one_behind = behind.sum(1) == 1
    alone = (behind == one_behind[:, None]).int().argmax(1)
    turned = (alone[:, None] + torch.arange(3, device=z.device)) % 3
    a, b, c = torch.eye(3, dtype=z.dtype, device=z.device)[turned].unbind(1)  # (T, 3) each
    z_a, z_b, z_c = z.gather(1, turned)[..., None].unbind(1)  # (T, 1) each
    ab = a + (z_a - z_clip) / (z_a - z_b) * (b - a)
    ac = a + (z_a - z_clip) / (z_a - z_c) * (c - a)
    tip = torch.stack((a, ab, ac), dim=1)
    first, second = torch.stack((ab, b, c), dim=1), torch.stack((ab, c, ac), dim=1)
    quadrilateral = torch.where(is_second[:, None, None], second, first)
    return torch.where(one_behind[:, None, None], quadrilateral, tip)


def _neighbors(num_pieces: Tensor, is_second: Tensor) -> Tensor:
    """For each triangle (G,) the index of its other half, -1 where it has none."""
    index = torch.arange(len(is_second), device=is_second.device)
    return torch.where(num_pieces == 2, torch.where(is_second, index - 1, index + 1), -1)
