"""A penalty on the lengths of edges, which keeps a deforming mesh from being torn."""

import torch
from torch import Tensor

from rendra.loss.mesh_mean import mean_over_meshes, nothing
from rendra.structures.meshes import Meshes


def mesh_edge_loss(meshes: Meshes, target_length: float = 0.0) -> Tensor:
    """Mean over meshes of the mean over edges of (length - target_length)^2.

    Every edge counts once, however many faces share it. An edge of length 0 has the gradient 0.

    Args:
        meshes: N meshes; one without edges counts as 0.
        target_length: the wanted length, in units of the vertices.

    Returns:
        A scalar in squared units of the vertices; 0 of shape (1,) if no mesh has a face.
    """
    if meshes.isempty():
        return nothing(meshes)
    verts = meshes.verts_packed()
    vectors = meshes.topology.edge_differences(verts.dtype) @ verts  # (E, 3)
    if target_length == 0:
        errors = vectors.square().sum(1)
    else:
        errors = (torch.linalg.vector_norm(vectors, dim=1) - target_length).square()
    return mean_over_meshes(errors, meshes.edges_packed_to_mesh_idx(), len(meshes))
