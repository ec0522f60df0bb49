"""Areas and normals of triangles given as raw tensors."""

import torch
from torch import Tensor
from torch.nn import functional as F

_NORMAL_EPS = 1e-6  # shorter cross products are divided by this instead of by their length


def mesh_face_areas_normals(verts: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Area and unit normal of every face, from (v1 - v0) x (v2 - v0). Differentiable; gradients are finite.

    Args:
        verts: (V, 3), for instance `Meshes.verts_packed()`.
        faces: (F, 3) integers, rows of `verts`.

    Returns:
        areas (F,) in squared units of `verts`, and normals (F, 3), which point at whom sees the corners run
        counter-clockwise. A face without area has the normal 0.

    Raises:
        ValueError: another shape.
    """
    if verts.ndim != 2 or verts.shape[1] != 3:
        raise ValueError(f"verts must have shape (V, 3), got {tuple(verts.shape)}")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces must have shape (F, 3), got {tuple(faces.shape)}")
    v0, v1, v2 = verts.index_select(0, faces.reshape(-1)).view(-1, 3, 3).unbind(1)
    cross = torch.linalg.cross(v1 - v0, v2 - v0)
    return 0.5 * torch.linalg.vector_norm(cross, dim=1), F.normalize(cross, eps=_NORMAL_EPS, dim=1)
