"""
Which vertices make which faces and edges: the integer half of a batch of meshes.

It does not depend on where the vertices are, so meshes that differ only in that share one `Topology` and all
that was ever computed from it.
"""

from collections.abc import Sequence
from functools import cached_property

import torch
from torch import Tensor

from rendra.structures.ragged import Lengths, Ragged, lasting


def uniform_laplacian(num_verts: int, edges: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """
    The Laplacian D^-1 A - I of a graph, where A is its adjacency and D its degrees.

    Args:
        num_verts: V.
        edges: (E, 2), every undirected edge once.
        dtype: of the result.

    Returns:
        (V, V) sparse; L[i, j] = 1 / degree(i) for neighbours, L[i, i] = -1, also where there is no neighbour.
    """
    source, target = torch.cat([edges, edges.flip(1)]).unbind(1)
    degree = torch.bincount(source, minlength=num_verts).to(dtype)
    diagonal = torch.arange(num_verts, device=edges.device)
    rows = torch.cat([source, diagonal])
    columns = torch.cat([target, diagonal])
    values = torch.cat([degree.reciprocal()[source], degree.new_full((num_verts,), -1.0)])
    size = (num_verts, num_verts)
    return torch.sparse_coo_tensor(torch.stack([rows, columns]), values, size, check_invariants=False).coalesce()


class Topology:
    """The faces of N meshes, and the edges and indices that follow from them. Treated as immutable."""

    def __init__(self, faces: Ragged, verts: Lengths) -> None:
        """Take each mesh's faces, which count its own vertices from 0, and the numbers of vertices."""
        self.faces = faces
        self.verts = verts
        self._extended: tuple[int, Topology] | None = None
        self._laplacian: Tensor | None = None

    def __len__(self) -> int:
        return len(self.verts)

    @cached_property
    @lasting()
    def faces_packed(self) -> Tensor:
        """Faces that count all vertices of the batch. (sum F, 3)"""
        faces = self.faces.packed()
        if len(self) < 2:
            return faces
        return faces + self.verts.first_idx[self.faces.lengths.item_idx, None]

    @cached_property
    @lasting()
    def valid(self) -> Tensor:
        """Which meshes have at least one face. (N,) bool"""
        return self.faces.lengths.counts > 0

    @cached_property
    @lasting()
    def _edges_of_faces(self) -> tuple[Tensor, Tensor]:
        # edge k of a face lies opposite to its vertex k
        sides = self.faces_packed[:, [[1, 2], [2, 0], [0, 1]]]  # (F, 3, 2)
        low, high = torch.aminmax(sides, dim=2)
        num_verts = max(self.verts.total, 1)
        keys, face_edges = torch.unique(low * num_verts + high, return_inverse=True)
        edges = torch.stack([keys.div(num_verts, rounding_mode="floor"), keys % num_verts], dim=1)
        return edges, face_edges.view(-1, 3)

    @property
    def edges(self) -> Tensor:
        """Every edge once, v0 < v1, in lexicographic order. (E, 2)"""
        return self._edges_of_faces[0]

    @property
    def faces_to_edges(self) -> Tensor:
        """Of each face the edges opposite to its three vertices. (sum F, 3)"""
        return self._edges_of_faces[1]

    @cached_property
    @lasting()
    def edges_to_mesh(self) -> Tensor:
        """The mesh of each edge. (E,)"""
        return self.verts.item_idx[self.edges[:, 0]]

    @cached_property
    @lasting()
    def edge_counts(self) -> Tensor:
        """The number of edges of each mesh. (N,)"""
        return torch.bincount(self.edges_to_mesh, minlength=len(self))

    @lasting()
    def laplacian(self, dtype: torch.dtype) -> Tensor:
        """The uniform Laplacian of all vertices. (sum V, sum V) sparse"""
        if self._laplacian is None or self._laplacian.dtype != dtype:
            self._laplacian = uniform_laplacian(self.verts.total, self.edges, dtype)
        return self._laplacian

    def select(self, indices: Sequence[int]) -> "Topology":
        """Some of the meshes, repetition allowed."""
        return Topology(self.faces.select(indices), self.verts.select(indices))

    @lasting()
    def extended(self, repeats: int) -> "Topology":
        """Every mesh `repeats` times in a row; remembered, since a fit asks for the same at each step."""
        if self._extended is None or self._extended[0] != repeats:
            self._extended = repeats, self.select([i for i in range(len(self)) for _ in range(repeats)])
        return self._extended[1]

    def to(self, device: torch.device) -> "Topology":
        """A copy on another device."""
        return Topology(self.faces.apply(lambda f: f.to(device)), self.verts.to(device))

    def clone(self) -> "Topology":
        """A copy with memory of its own."""
        return Topology(self.faces.apply(torch.clone), self.verts)
