"""Subdivision of every triangle into four, at the middle of its edges."""

import torch
from torch import Tensor, nn

from rendra.structures.meshes import Meshes


class SubdivideMeshes(nn.Module):
    """Cuts every face at the mid-points m of its edges; a mesh keeps its shape.

    (v0, v1, v2) becomes (v0, m01, m02), (v1, m12, m01), (v2, m02, m12) and (m12, m02, m01), so the winding stays.
    Each mesh lists its old vertices, then one for each edge in the order of `edges_packed`; and the first
    quarter of all its faces, then the second, and so on. Textures are not carried over.
    """

    _edges: Tensor
    _faces: Tensor

    def __init__(self, meshes: Meshes | None = None) -> None:
        """Take a mesh whose topology all meshes to come share, so that the integer work is done once.

        Args:
            meshes: only the first of them is read; None if every call may bring other topologies.
        """
        super().__init__()
        self._num_verts = -1
        if meshes is not None:
            template = meshes[0]
            self._num_verts = len(template.verts_packed())
            self.register_buffer("_edges", template.edges_packed(), persistent=False)
            self.register_buffer("_faces", _split_faces(template)[0], persistent=False)

    def forward(self, meshes: Meshes, feats: Tensor | None = None) -> Meshes | tuple[Meshes, Tensor]:
        """Subdivide.

        Args:
            meshes: N meshes, each with the vertices and faces of the template if the constructor got one.
            feats: (sum V, D), values at the vertices; mid-points get the mean of their edge's two.

        Returns:
            The new meshes; with `feats` also their values (sum V', D). Differentiable in vertices and `feats`.

        Raises:
            ValueError: `feats` has not one row for each vertex, or a mesh does not fit the template.
        """
        verts = meshes.verts_packed()
        if feats is not None and (feats.ndim != 2 or len(feats) != len(verts)):
            raise ValueError(f"feats must have shape ({len(verts)}, D), got {tuple(feats.shape)}")
        subdivide = self._with_template if self._num_verts >= 0 else self._without_template
        return subdivide(meshes, feats)

    def _with_template(self, meshes: Meshes, feats: Tensor | None) -> Meshes | tuple[Meshes, Tensor]:
        verts, faces = meshes.verts_padded(), meshes.faces_padded()
        if not meshes.equisized or verts.shape[1] != self._num_verts or 4 * faces.shape[1] != len(self._faces):
            raise ValueError(
                f"every mesh must have the {self._num_verts} vertices and {len(self._faces) // 4} faces that "
                f"SubdivideMeshes was built for, got {meshes.num_verts_per_mesh().tolist()} and "
                f"{meshes.num_faces_per_mesh().tolist()}"
            )
        new_verts = self._refined(verts)
        subdivided = meshes.__class__(verts=new_verts, faces=self._faces.expand(len(meshes), -1, -1))
        if feats is None:
            return subdivided
        return subdivided, self._refined(feats.view(len(meshes), self._num_verts, -1)).flatten(0, 1)

    def _refined(self, values: Tensor) -> Tensor:
        """Values (N, V, D) at the vertices, then their means at the edges. (N, V + E, D)"""
        ends = values.index_select(1, self._edges.reshape(-1)).unflatten(1, (-1, 2))
        return torch.cat([values, ends.mean(dim=2)], dim=1)

    @staticmethod
    def _without_template(meshes: Meshes, feats: Tensor | None) -> Meshes | tuple[Meshes, Tensor]:
        order, sizes = _vertex_order(meshes)
        new_verts = _with_midpoints(meshes.verts_packed(), meshes, order).split(sizes)
        subdivided = meshes.__class__(verts=list(new_verts), faces=_split_faces(meshes))
        return subdivided if feats is None else (subdivided, _with_midpoints(feats, meshes, order))


def _vertex_order(meshes: Meshes) -> tuple[Tensor, list[int]]:
    """Which row of all vertices followed by all mid-points comes at each new place, and each mesh's number."""
    owner = torch.cat([meshes.verts_packed_to_mesh_idx(), meshes.edges_packed_to_mesh_idx()])
    sizes = meshes.num_verts_per_mesh() + meshes.num_edges_per_mesh()
    return owner.argsort(stable=True), sizes.tolist()


def _with_midpoints(values: Tensor, meshes: Meshes, order: Tensor) -> Tensor:
    """Values (sum V, D) at the vertices, and their means at the edges, in the new order."""
    ends = values.index_select(0, meshes.edges_packed().reshape(-1)).view(-1, 2, values.shape[1])
    every = torch.cat([values, ends.mean(dim=1)])
    return every if len(meshes) == 1 else every.index_select(0, order)


def _split_faces(meshes: Meshes) -> list[Tensor]:
    """The faces of each subdivided mesh, counting its own vertices."""
    first_edge = meshes.mesh_to_edges_packed_first_idx()[meshes.faces_packed_to_mesh_idx(), None]
    counts = meshes.num_faces_per_mesh().tolist()
    edges_by_mesh = (meshes.faces_packed_to_edges_packed() - first_edge).split(counts) if counts else ()
    return [
        _quarters(faces, edges + len(verts))
        for verts, faces, edges in zip(meshes.verts_list(), meshes.faces_list(), edges_by_mesh, strict=True)
    ]


def _quarters(faces: Tensor, midpoints: Tensor) -> Tensor:
    """Four times as many faces, from corners (F, 3) and the mid-points (F, 3) opposite to them."""
    v0, v1, v2 = faces.unbind(1)
    m12, m02, m01 = midpoints.unbind(1)
    quarters = [(v0, m01, m02), (v1, m12, m01), (v2, m02, m12), (m12, m02, m01)]
    return torch.cat([torch.stack(quarter, dim=1) for quarter in quarters])
