"""A penalty on the angle between neighbouring faces."""

import torch
from torch import Tensor

from rendra.loss.mesh_mean import mean_over_meshes, nothing
from rendra.structures.meshes import Meshes


def mesh_normal_consistency(meshes: Meshes) -> Tensor:
    """Mean over meshes of the mean of 1 - cos(n0, n1) over all pairs of faces with a common edge.

    The normals are taken as if both faces ran through their edge in opposite directions: 0 where a surface is
    flat, 2 where it is folded onto itself, whatever the winding. Where more than two faces meet at an edge,
    all pairs of them count; an edge of one face counts nothing. A face without area has a cosine of 0 to every
    other, and gets no gradient.

    Args:
        meshes: N meshes; one without such a pair counts as 0.

    Returns:
        A scalar in [0, 2]; 0 of shape (1,) if no mesh has a face.
    """
    if meshes.isempty():
        return nothing(meshes)
    topology, cross = meshes.topology, meshes.faces_cross_packed()
    squared = cross.square().sum(1, keepdim=True)
    flat = squared <= torch.finfo(cross.dtype).tiny
    normals = cross * torch.where(flat, 1.0, squared).rsqrt().masked_fill(flat, 0.0)
    # 1 - cos as half of |n0 - n1|^2, which keeps its digits at small angles
    errors = 0.5 * (topology.normal_differences(cross.dtype) @ normals).square().sum(1)
    # a normal that is 0 took its half of the square away
    missing = 0.5 * flat.index_select(0, topology.face_pairs.view(-1)).view(-1, 2).sum(1)
    return mean_over_meshes(errors + missing, topology.face_pairs_to_mesh, len(meshes))
