"""Where a surface passes through itself. Beside the public API."""

import torch
from torch import Tensor

from rendra.kernels.self_intersections import crossing_pairs
from rendra.structures.meshes import Meshes


@torch.no_grad()
def self_intersections(mesh: Meshes, tolerance: float = 1e-6) -> Tensor:
    """The pairs of faces of a mesh that cross each other.

    Two faces cross if each has corners on both sides of the other's plane, and the line that they share is longer
    than the tolerance. Faces that only touch, lie in one plane, or meet at a common corner or edge do not, even where
    the mesh holds that corner twice; nor does a face thinner than the tolerance.

    Args:
        mesh: one mesh.
        tolerance: length below which all is touching, as a part of the diagonal of the mesh's bounding box. Float32
            coordinates are exact to about 1e-7 of their size.

    Returns:
        (K, 2) int64, indices of faces, the lower one first, in lexicographic order.

    Raises:
        ValueError: not one mesh, or a tolerance that is not positive.
    """
    if len(mesh) != 1:
        raise ValueError(f"self_intersections looks at one mesh, got {len(mesh)}")
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance must be a part of the mesh's diagonal between 0 and 1, got {tolerance}")
    verts, faces = mesh.verts_packed(), mesh.faces_packed()
    tris = verts.index_select(0, faces.reshape(-1)).view(-1, 3, 3)
    corners = tris.reshape(-1, 3)
    corners = corners[corners.isfinite().all(1)]
    if not len(corners):
        return faces.new_empty((0, 2))
    diagonal = float((corners.amax(0) - corners.amin(0)).norm())
    return crossing_pairs(tris, tolerance * diagonal)
