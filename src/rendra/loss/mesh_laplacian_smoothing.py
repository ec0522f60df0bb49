"""A penalty on how far vertices lie from their neighbours' mean, or how much the surface is bent there.

Notation: v the vertices, w_ij = cot a + cot b with a and b the angles opposite to the edge ij,
A_i the summed areas of the faces at vertex i.
"""

import torch
from torch import Tensor

from rendra.loss.mesh_mean import mean_over_meshes, nothing
from rendra.ops.laplacian_matrices import corner_cotangents
from rendra.structures.meshes import Meshes

_METHODS = ("uniform", "cot", "cotcurv")


def mesh_laplacian_smoothing(meshes: Meshes, method: str = "uniform") -> Tensor:
    """Mean over meshes of the mean over vertices of |Laplacian of v|.

    | method | Laplacian at vertex i |
    |---|---|
    | uniform | mean of the neighbours - v_i |
    | cot | sum_j w_ij v_j / sum_j w_ij - v_i |
    | cotcurv | sum_j w_ij (v_j - v_i) / (4 A_i): along the normal, its length the mean curvature over 3 |

    See Nealen et al., "Laplacian Mesh Optimization", 2006, and Desbrun et al., "Implicit Fairing of Irregular
    Meshes using Diffusion and Curvature Flow", 1999. The weights w and areas A get no gradient. A vertex
    without neighbours, or whose weights do not sum to a positive number, counts |v_i| in `uniform` and `cot`.

    Args:
        meshes: N meshes; one without vertices counts as 0.
        method: "uniform", "cot" or "cotcurv".

    Returns:
        A scalar, in units of the vertices (cotcurv: their inverse); 0 of shape (1,) if no mesh has a face.

    Raises:
        ValueError: another method.
    """
    if method not in _METHODS:
        raise ValueError(f"Method should be one of {{uniform, cot, cotcurv}}, got {method!r}")
    if meshes.isempty():
        return nothing(meshes)
    if method == "uniform":
        verts = meshes.verts_packed()
        laplacian = meshes.topology.laplacian_matrix(verts.dtype) @ verts
    else:
        laplacian = _cotangent(meshes, curvature=method == "cotcurv")
    errors = torch.linalg.vector_norm(laplacian, dim=1)
    return mean_over_meshes(errors, meshes.verts_packed_to_mesh_idx(), len(meshes))


def _cotangent(meshes: Meshes, curvature: bool) -> Tensor:
    """The Laplacian of "cotcurv", or else of "cot". (sum V, 3)"""
    verts, topology = meshes.verts_packed(), meshes.topology
    differences = topology.edge_differences(verts.dtype)
    weights, areas = _edge_weights(meshes)
    pulls = differences.transposed @ (weights * (differences @ verts))  # sum_j w_ij (v_i - v_j)
    if curvature:
        corner_areas = areas[:, None].expand(-1, 3).reshape(-1, 1)
        vert_areas = topology.corners_to_verts(verts.dtype) @ corner_areas
        return pulls * torch.where(vert_areas > 0, -0.25 / vert_areas, 0.0)
    total = topology.edge_sums(verts.dtype).transposed @ weights
    weighted = total > 0
    return torch.where(weighted, -pulls / torch.where(weighted, total, 1.0), -verts)


@torch.no_grad()
def _edge_weights(meshes: Meshes) -> tuple[Tensor, Tensor]:
    """The weights w of all edges (E, 1), and the area of every face (sum F,)."""
    verts = meshes.verts_packed()
    cotangents, areas = corner_cotangents(verts, meshes.faces_packed())
    return meshes.topology.corners_to_edges(verts.dtype) @ cotangents.view(-1, 1), areas
