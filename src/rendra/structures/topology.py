"""
Which vertices make which faces and edges: the integer half of a batch of meshes.

It does not depend on where the vertices are, so meshes that differ only in that share one `Topology` and all
that was ever computed from it.
"""

from collections.abc import Callable, Sequence
from functools import cached_property

import torch
from torch import Tensor

from rendra.structures.ragged import Lengths, Ragged, lasting
from rendra.structures.sparse_matrix import SparseMatrix


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
        self._matrices: dict[tuple[str, torch.dtype], SparseMatrix] = {}

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

    @cached_property
    @lasting()
    def face_pairs(self) -> Tensor:
        """Every two faces with an edge in common, once for each such edge. (P, 2)

        Two faces make one pair; k faces at an edge, as where sheets of a surface meet, make k (k - 1) / 2.
        """
        return self._pairs_of_sides.div(3, rounding_mode="floor")

    @cached_property
    @lasting()
    def face_pairs_to_mesh(self) -> Tensor:
        """The mesh of each pair of faces. (P,)"""
        return self.faces.lengths.item_idx[self.face_pairs[:, 0]]

    @cached_property
    @lasting()
    def _pairs_of_sides(self) -> Tensor:
        """Both sides of each pair in `face_pairs`, as rows of `faces_to_edges.view(-1)`. (P, 2)"""
        edge, side = self.faces_to_edges.reshape(-1).sort(stable=True)
        sharing = torch.bincount(edge, minlength=len(self.edges))
        place = torch.arange(len(side), device=side.device)
        first = (sharing.cumsum(0) - sharing)[edge]
        # the side at rank r among those of its edge meets the r sides before it
        rank = place - first
        second = place.repeat_interleave(rank)
        behind = torch.arange(len(second), device=side.device) - (rank.cumsum(0) - rank)[second]
        return torch.stack([side[first[second] + behind], side[second]], dim=1)

    @lasting()
    def _matrix(self, name: str, dtype: torch.dtype, make: Callable[[], SparseMatrix]) -> SparseMatrix:
        if (name, dtype) not in self._matrices:
            self._matrices[name, dtype] = make()
        return self._matrices[name, dtype]

    def laplacian_matrix(self, dtype: torch.dtype) -> SparseMatrix:
        """`laplacian` in the form for many products with vertices. (sum V, sum V)"""

        def make() -> SparseMatrix:
            laplacian = self.laplacian(dtype)
            rows, columns = laplacian.indices()
            return SparseMatrix(rows, columns, laplacian.values(), (self.verts.total, self.verts.total))

        return self._matrix("laplacian", dtype, make)

    def neighbours(self, dtype: torch.dtype) -> SparseMatrix:
        """Takes rows at the vertices to their sums over the ends of all edges at a vertex. (sum V, sum V)"""

        def make() -> SparseMatrix:
            rows, columns = torch.cat([self.edges, self.edges.flip(1)]).unbind(1)
            ones = torch.ones_like(rows, dtype=dtype)
            return SparseMatrix(rows, columns, ones, (self.verts.total, self.verts.total), symmetric=True)

        return self._matrix("neighbours", dtype, make)

    def edge_differences(self, dtype: torch.dtype) -> SparseMatrix:
        """Takes vertices to the vectors v1 - v0 of all edges. (E, sum V)"""
        return self._matrix("differences", dtype, lambda: self._at_edge_ends(-1.0, dtype))

    def edge_sums(self, dtype: torch.dtype) -> SparseMatrix:
        """Takes vertices to the sums over both ends of all edges. (E, sum V)"""
        return self._matrix("sums", dtype, lambda: self._at_edge_ends(1.0, dtype))

    def _at_edge_ends(self, first_entry: float, dtype: torch.dtype) -> SparseMatrix:
        num_edges = len(self.edges)
        entries = torch.ones(num_edges, 2, dtype=dtype, device=self.edges.device)
        entries[:, 0] = first_entry
        rows = torch.arange(num_edges, device=self.edges.device).repeat_interleave(2)
        return SparseMatrix(rows, self.edges.reshape(-1), entries.reshape(-1), (num_edges, self.verts.total))

    def corners_to_edges(self, dtype: torch.dtype) -> SparseMatrix:
        """Takes a number at each corner of all faces to the sum at the edge opposite to it. (E, 3 sum F)"""
        return self._matrix(
            "opposite", dtype, lambda: self._from_corners(self.faces_to_edges, len(self.edges), dtype)
        )

    def corners_to_verts(self, dtype: torch.dtype) -> SparseMatrix:
        """Takes a number at each corner of all faces to the sum at its vertex. (sum V, 3 sum F)"""
        return self._matrix("corners", dtype, lambda: self._from_corners(self.faces_packed, self.verts.total, dtype))

    @staticmethod
    def _from_corners(target: Tensor, num_targets: int, dtype: torch.dtype) -> SparseMatrix:
        rows = target.reshape(-1)
        corners = torch.arange(len(rows), device=rows.device)
        return SparseMatrix(rows, corners, torch.ones_like(rows, dtype=dtype), (num_targets, len(rows)))

    def normal_differences(self, dtype: torch.dtype) -> SparseMatrix:
        """Takes normals of faces to n0 - n1 of all pairs, where n1 is turned around if the faces disagree. (P, sum F)

        They agree if they run through their common edge in opposite directions.
        """

        def make() -> SparseMatrix:
            start, end = self.faces_packed[:, [1, 2, 0]].reshape(-1), self.faces_packed[:, [2, 0, 1]].reshape(-1)
            upwards = (start < end)[self._pairs_of_sides]  # (P, 2)
            agree = upwards[:, 0] != upwards[:, 1]
            entries = torch.stack([torch.ones_like(agree, dtype=dtype), 1 - 2 * agree.to(dtype)], dim=1)
            rows = torch.arange(len(agree), device=agree.device).repeat_interleave(2)
            shape = (len(agree), self.faces.lengths.total)
            return SparseMatrix(rows, self.face_pairs.reshape(-1), entries.reshape(-1), shape)

        return self._matrix("normals", dtype, make)

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
