"""Distance of points to the surface of a mesh, and where on the surface it is measured. Beside the public API."""

from typing import NamedTuple

import torch
from torch import Tensor

from rendra.kernels.point_face_distance import nearest_face
from rendra.structures.meshes import Meshes


class SurfacePoints(NamedTuple):
    """The nearest point of a surface for each of P points."""

    distance: Tensor  # (P,) not squared, not signed
    face: Tensor  # (P,) int64, index into faces_packed
    point: Tensor  # (P, 3) on that face


@torch.no_grad()
def distance_to_surface(points: Tensor, mesh: Meshes) -> SurfacePoints:
    """How far points are from a surface, exactly, however small its faces.

    Args:
        points: (P, 3) in the frame of the mesh.
        mesh: one mesh with at least one face.

    Returns:
        Distance, face and nearest point, without gradient (`rendra.loss.point_mesh_distance` has those of squared
        distances). Equal distances go to the lower face. NaN, face -1 and the origin where a point or all faces are
        not finite.

    Raises:
        ValueError: not one mesh, a mesh without faces, or points that do not fit.
    """
    if len(mesh) != 1 or not len(mesh.faces_packed()):
        raise ValueError(
            f"distance_to_surface measures against one mesh with faces, got {len(mesh)} with "
            f"{mesh.num_faces_per_mesh().tolist()} faces"
        )
    verts, faces = mesh.verts_packed(), mesh.faces_packed()
    tris = verts.index_select(0, faces.reshape(-1)).view(-1, 3, 3)
    first = torch.zeros(1, dtype=torch.int64, device=verts.device)
    squared, face, weights = nearest_face(points, first, tris, first)
    nearest = (weights[..., None] * tris.index_select(0, face.clamp(min=0))).sum(1)
    return SurfacePoints(squared.sqrt(), face, nearest)
