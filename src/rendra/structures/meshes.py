"""
Batches of triangle meshes with different numbers of vertices and faces.

Letters: N meshes, V vertices and F faces of the largest one, sum V and sum F of all together, E edges of all.
List: one tensor a mesh. Padded: (N, V, 3), filled up with 0, faces with -1. Packed: all rows in one tensor,
where faces and edges count the vertices of the whole batch.
Frame: the caller's. A face whose vertices run counter-clockwise looks at the viewer, and its normal
(v1 - v0) x (v2 - v0) points there.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.structures.mesh_input import normals_for, rows_from_lists, rows_from_padded
from rendra.structures.ragged import Ragged, batch_indices, consecutive_parts, each_repeated, lasting
from rendra.structures.topology import Topology

_NORMAL_EPS = 1e-6  # shorter vectors are divided by this instead of by their length


class Meshes:
    """
    N triangle meshes, their textures, and everything that follows from vertices and faces.

    Derived tensors are computed when first asked for and kept. Change vertices with `offset_verts`,
    `scale_verts` or `update_padded`, not in place: those share the faces, the edges and every index tensor
    with the mesh that they start from. Vertices that are leaves requiring grad may be changed by an
    optimiser; nothing that depends on them is kept.

    Attributes:
        device: where all tensors lie.
        equisized: all meshes have as many vertices and as many faces as each other.
        valid: (N,) bool, which meshes have a face.
    """

    def __init__(
        self,
        verts: Sequence[Tensor] | Tensor,
        faces: Sequence[Tensor] | Tensor,
        textures: Any = None,
        *,
        verts_normals: Sequence[Tensor] | Tensor | None = None,
    ) -> None:
        """
        Take vertices and faces, both as lists or both padded.

        Args:
            verts: N tensors (V_i, 3), or one (N, V, 3).
            faces: N integer tensors (F_i, 3), or one (N, F, 3) filled up with -1 at the end. Each mesh
                counts its own vertices from 0. Rows that contain -1 are dropped from lists.
            textures: a `rendra.renderer.TexturesBase` for these meshes.
            verts_normals: in the form of `verts`; computed from the faces if None.

        Raises:
            ValueError: forms, shapes, devices or numbers do not fit together, or a face refers to a vertex
                that does not exist.
        """
        if isinstance(verts, (list, tuple)) and isinstance(faces, (list, tuple)):
            vert_rows, face_rows = rows_from_lists(verts, faces)
        elif isinstance(verts, Tensor) and isinstance(faces, Tensor):
            vert_rows, face_rows = rows_from_padded(verts, faces)
        else:
            raise ValueError(
                "Verts and Faces must be either a list or a tensor with shape (batch_size, N, 3) where N is "
                "either the maximum number of verts or faces respectively; "
                f"got {type(verts)} and {type(faces)}"
            )
        normals = None if verts_normals is None else normals_for(vert_rows, verts_normals)
        self._set(vert_rows, Topology(face_rows, vert_rows.lengths), normals)
        self.textures = textures

    def _set(self, verts: Ragged, topology: Topology, normals: Ragged | None) -> None:
        self._verts = verts
        self._topology = topology
        self._normals = normals
        self._derived: dict[str, Any] = {}

    def _replaced(
        self,
        verts: Ragged,
        topology: Topology | None = None,
        normals: Ragged | None = None,
        textures: Any = None,
    ) -> "Meshes":
        """Meshes of this class from parts that are known to fit."""
        new = self.__class__.__new__(self.__class__)
        new._set(verts, self._topology if topology is None else topology, normals)
        new._textures = textures
        return new

    def _derive(self, name: str, derive: Callable[[], Any]) -> Any:
        """What follows from the vertices, from memory where it may be."""
        if name in self._derived:
            return self._derived[name]
        with lasting():
            value = derive()
        if self._verts.is_lasting:
            self._derived[name] = value
        return value

    @property
    def device(self) -> torch.device:
        """Where all tensors lie."""
        return self._topology.verts.device

    @property
    def equisized(self) -> bool:
        """All meshes have as many vertices, and as many faces, as each other."""
        sizes = zip(self._topology.verts.sizes, self._topology.faces.lengths.sizes, strict=True)
        return len(set(sizes)) == 1

    @property
    def valid(self) -> Tensor:
        """Which meshes have a face. (N,) bool"""
        return self._topology.valid

    @property
    def topology(self) -> Topology:
        """What does not depend on where the vertices are; shared by all meshes that differ only in that."""
        return self._topology

    @property
    def textures(self) -> Any:
        """The textures, or None."""
        return self._textures

    @textures.setter
    def textures(self, textures: Any) -> None:
        if textures is not None:
            if not hasattr(textures, "sample_textures") or not hasattr(textures, "check_shapes"):
                raise ValueError(f"Expected textures to be an instance of type TexturesBase; got {type(textures)}")
            verts, faces = self._topology.verts, self._topology.faces.lengths
            if not textures.check_shapes(len(self), verts.padded_size, faces.padded_size):
                raise ValueError(
                    f"Textures do not match the dimensions of Meshes: {len(self)} meshes with up to "
                    f"{verts.padded_size} vertices and {faces.padded_size} faces"
                )
            textures = textures.fit_to(verts, faces)
        self._textures = textures

    def __len__(self) -> int:
        """The number of meshes N."""
        return len(self._topology)

    def __getitem__(self, index: Any) -> "Meshes":
        """
        Pick meshes by an int, a slice, a list of ints, or a 1-D tensor of integers or booleans.

        Raises:
            IndexError: another kind of index, or one out of range.
        """
        picked = batch_indices(index, len(self))
        normals = None if self._normals is None else self._normals.select(picked)
        textures = None if self.textures is None else self.textures[picked]
        return self._replaced(self._verts.select(picked), self._topology.select(picked), normals, textures)

    def isempty(self) -> bool:
        """Whether no mesh has a face."""
        return self._topology.faces.lengths.total == 0

    # -- vertices

    def verts_list(self) -> list[Tensor]:
        """Vertices of each mesh. N of (V_i, 3)"""
        return self._verts.items()

    def verts_padded(self) -> Tensor:
        """Vertices, filled up with 0. (N, V, 3)"""
        return self._verts.padded()

    def verts_packed(self) -> Tensor:
        """Vertices of all meshes. (sum V, 3)"""
        return self._verts.packed()

    def num_verts_per_mesh(self) -> Tensor:
        """Number of vertices of each mesh. (N,)"""
        return self._topology.verts.counts

    def verts_packed_to_mesh_idx(self) -> Tensor:
        """The mesh of each packed vertex. (sum V,)"""
        return self._topology.verts.item_idx

    def mesh_to_verts_packed_first_idx(self) -> Tensor:
        """The packed index of each mesh's first vertex. (N,)"""
        return self._topology.verts.first_idx

    def verts_padded_to_packed_idx(self) -> Tensor:
        """Which row of `verts_padded().view(-1, 3)` each packed vertex is. (sum V,)"""
        return self._topology.verts.padded_idx

    # -- faces

    def faces_list(self) -> list[Tensor]:
        """Faces of each mesh, counting its own vertices. N of (F_i, 3)"""
        return self._topology.faces.items()

    def faces_padded(self) -> Tensor:
        """Faces of each mesh, counting its own vertices, filled up with -1. (N, F, 3)"""
        return self._topology.faces.padded()

    def faces_packed(self) -> Tensor:
        """Faces of all meshes, counting the packed vertices. (sum F, 3)"""
        return self._topology.faces_packed

    def num_faces_per_mesh(self) -> Tensor:
        """Number of faces of each mesh. (N,)"""
        return self._topology.faces.lengths.counts

    def faces_packed_to_mesh_idx(self) -> Tensor:
        """The mesh of each packed face. (sum F,)"""
        return self._topology.faces.lengths.item_idx

    def mesh_to_faces_packed_first_idx(self) -> Tensor:
        """The packed index of each mesh's first face. (N,)"""
        return self._topology.faces.lengths.first_idx

    def get_mesh_verts_faces(self, index: int) -> tuple[Tensor, Tensor]:
        """
        Vertices (V_i, 3) and faces (F_i, 3) of one mesh.

        Raises:
            ValueError: `index` is not an integer in [0, N).
        """
        if not isinstance(index, int):
            raise ValueError(f"Mesh index must be an integer, got {type(index)}")
        if not 0 <= index < len(self):
            raise ValueError(f"Mesh index must be in the range [0, {len(self)}), got {index}")
        return self.verts_list()[index], self.faces_list()[index]

    # -- edges

    def edges_packed(self) -> Tensor:
        """Every edge once, v0 < v1 among the packed vertices, in lexicographic order. (E, 2)"""
        return self._topology.edges

    def edges_packed_to_mesh_idx(self) -> Tensor:
        """The mesh of each edge. (E,)"""
        return self._topology.edges_to_mesh

    def mesh_to_edges_packed_first_idx(self) -> Tensor:
        """The index of each mesh's first edge. (N,)"""
        counts = self._topology.edge_counts
        return counts.cumsum(0) - counts

    def num_edges_per_mesh(self) -> Tensor:
        """Number of edges of each mesh. (N,)"""
        return self._topology.edge_counts

    def faces_packed_to_edges_packed(self) -> Tensor:
        """Of each face the edges opposite to its vertices: (v1, v2), (v2, v0), (v0, v1). (sum F, 3)"""
        return self._topology.faces_to_edges

    def laplacian_packed(self) -> Tensor:
        """The uniform Laplacian D^-1 A - I of all meshes. (sum V, sum V) sparse"""
        return self._topology.laplacian(self.verts_packed().dtype)

    # -- areas and normals

    def faces_cross_packed(self) -> Tensor:
        """(v1 - v0) x (v2 - v0): along the normal, twice the area long. (sum F, 3)"""

        def cross() -> Tensor:
            corners = self.verts_packed().index_select(0, self.faces_packed().reshape(-1))
            v0, v1, v2 = corners.view(-1, 3, 3).unbind(1)
            return torch.linalg.cross(v1 - v0, v2 - v0)

        return self._derive("cross", cross)

    def faces_areas_packed(self) -> Tensor:
        """Area of each face, in squared units of the vertices. (sum F,)"""
        return self._derive("areas", lambda: 0.5 * torch.linalg.vector_norm(self.faces_cross_packed(), dim=1))

    def _faces_normals(self) -> Ragged:
        def normals() -> Ragged:
            unit = F.normalize(self.faces_cross_packed(), eps=_NORMAL_EPS, dim=1)
            return Ragged(self._topology.faces.lengths, packed=unit)

        return self._derive("faces_normals", normals)

    def faces_normals_packed(self) -> Tensor:
        """Unit normal of each face, 0 for a face without area. (sum F, 3)"""
        return self._faces_normals().packed()

    def faces_normals_list(self) -> list[Tensor]:
        """Unit normals of each mesh's faces. N of (F_i, 3)"""
        return self._faces_normals().items()

    def faces_normals_padded(self) -> Tensor:
        """Unit normals of the faces, filled up with 0. (N, F, 3)"""
        return self._faces_normals().padded()

    def has_verts_normals(self) -> bool:
        """Whether vertex normals were given, or computed before."""
        return self._normals is not None or "verts_normals" in self._derived

    @property
    def has_given_normals(self) -> bool:
        """Whether vertex normals were given; what is computed from the faces does not count."""
        return self._normals is not None

    def _verts_normals(self) -> Ragged:
        if self._normals is not None:
            return self._normals

        def normals() -> Ragged:
            cross, verts = self.faces_cross_packed(), self.verts_packed()
            summed = torch.zeros_like(verts)
            for corner in self.faces_packed().unbind(1):
                summed = summed.index_add(0, corner, cross)
            return Ragged(self._topology.verts, packed=F.normalize(summed, eps=_NORMAL_EPS, dim=1))

        return self._derive("verts_normals", normals)

    def verts_normals_packed(self) -> Tensor:
        """Unit normal of each vertex: as given, or its faces' mean weighted by area. (sum V, 3)"""
        return self._verts_normals().packed()

    def verts_normals_list(self) -> list[Tensor]:
        """Unit normals of each mesh's vertices. N of (V_i, 3)"""
        return self._verts_normals().items()

    def verts_normals_padded(self) -> Tensor:
        """Unit normals of the vertices, filled up with 0. (N, V, 3)"""
        return self._verts_normals().padded()

    def get_bounding_boxes(self) -> Tensor:
        """Smallest and largest coordinates of each mesh; (inf, -inf) without vertices. (N, 3, 2)"""
        return self._verts.bounds()

    # -- copies

    def clone(self) -> "Meshes":
        """A copy with memory of its own, still part of the autograd graph."""
        normals = None if self._normals is None else self._normals.apply(torch.clone)
        textures = None if self.textures is None else self.textures.clone()
        return self._replaced(self._verts.apply(torch.clone), self._topology.clone(), normals, textures)

    def detach(self) -> "Meshes":
        """The same values, cut from the autograd graph; shares memory."""
        normals = None if self._normals is None else self._normals.apply(torch.detach)
        textures = None if self.textures is None else self.textures.detach()
        return self._replaced(self._verts.apply(torch.detach), None, normals, textures)

    def to(self, device: torch.device | str, copy: bool = False) -> "Meshes":
        """The meshes on `device`: themselves if they are there already and `copy` is False."""
        target = torch.empty(0, device=device).device  # "cuda" names the current CUDA device
        if target == self.device:
            return self.clone() if copy else self
        normals = None if self._normals is None else self._normals.apply(lambda t: t.to(target))
        textures = None if self.textures is None else self.textures.to(target)
        verts = self._verts.apply(lambda t: t.to(target))
        return self._replaced(verts, self._topology.to(target), normals, textures)

    def cpu(self) -> "Meshes":
        """The meshes on the CPU."""
        return self.to("cpu")

    def cuda(self) -> "Meshes":
        """The meshes on the current CUDA device."""
        return self.to("cuda")

    # -- moving vertices

    def offset_verts_(self, vert_offsets_packed: Tensor) -> "Meshes":
        """Add offsets to the vertices of this object; see `offset_verts`."""
        moved = self.offset_verts(vert_offsets_packed)
        self._set(moved._verts, moved._topology, moved._normals)
        return self

    def offset_verts(self, vert_offsets_packed: Tensor) -> "Meshes":
        """
        Meshes with the same faces and textures and moved vertices.

        Args:
            vert_offsets_packed: (sum V, 3), or (3,) for all. Normals that were given survive only the latter.

        Raises:
            ValueError: another shape.
        """
        verts = self.verts_packed()
        rigid = vert_offsets_packed.shape == (3,)
        if not rigid and vert_offsets_packed.shape != verts.shape:
            raise ValueError(
                f"Verts offsets must have dimension (all_v, 3) = {tuple(verts.shape)} or (3,), "
                f"got {tuple(vert_offsets_packed.shape)}"
            )
        moved = Ragged(self._topology.verts, packed=verts + vert_offsets_packed)
        return self._replaced(moved, None, self._normals if rigid else None, self.textures)

    def scale_verts_(self, scale: float | Tensor) -> "Meshes":
        """Scale the vertices of this object; see `scale_verts`."""
        scaled = self.scale_verts(scale)
        self._set(scaled._verts, scaled._topology, scaled._normals)
        return self

    def scale_verts(self, scale: float | Tensor) -> "Meshes":
        """
        Meshes with the same faces and textures and vertices scaled about the origin.

        Args:
            scale: a number, or (N,) one for each mesh.

        Raises:
            ValueError: another shape.
        """
        return self._replaced(self._verts.scaled(scale), None, self._normals, self.textures)

    def update_padded(self, new_verts_padded: Tensor) -> "Meshes":
        """
        Meshes with the same faces and textures and other vertices.

        Args:
            new_verts_padded: (N, V, 3) as `verts_padded()`; what lies in the padding is ignored.

        Raises:
            ValueError: another shape.
        """
        expected = (len(self), self._topology.verts.padded_size, 3)
        if new_verts_padded.shape != expected:
            raise ValueError(
                f"new values must have the same batch dimension and number of vertices, {expected}; got "
                f" {tuple(new_verts_padded.shape)}"
            )
        verts = Ragged.from_padded(self._topology.verts, new_verts_padded)
        return self._replaced(verts, textures=self.textures)

    # -- other batches of the same meshes

    def extend(self, N: int) -> "Meshes":
        """
        Every mesh N times in a row, with gradients to this one.

        Raises:
            ValueError: N is not a positive integer.
        """
        repeated = each_repeated(len(self), N)
        normals = None if self._normals is None else self._normals.select(repeated)
        textures = None if self.textures is None else self.textures.extend(N)
        return self._replaced(self._verts.select(repeated), self._topology.extended(N), normals, textures)

    def split(self, split_sizes: list[int]) -> list["Meshes"]:
        """
        Cut the batch into consecutive batches of the given sizes.

        Raises:
            ValueError: `split_sizes` is not a list of integers that sum to N.
        """
        return [self[part] for part in consecutive_parts(split_sizes, len(self), "meshes")]

    def submeshes(self, face_indices: Sequence[Sequence[Tensor]]) -> "Meshes":
        """
        Meshes made of some faces of these, and of the vertices that those use.

        Args:
            face_indices: for each mesh a list of submeshes, each a 1-D tensor of its faces' numbers. One
                tensor (S, F') for a mesh gives S submeshes.

        Returns:
            All submeshes of mesh 0, then those of mesh 1, and so on, with textures.

        Raises:
            ValueError: not one list for each mesh.
        """
        if len(face_indices) != len(self):
            raise ValueError(
                f"You must specify exactly one set of submeshes for each of the {len(self)} meshes, "
                f"got {len(face_indices)}"
            )
        verts, faces, vert_ids, normals = [], [], [], []
        given = self._normals.items() if self._normals is not None else None
        for i, (own_verts, own_faces) in enumerate(zip(self.verts_list(), self.faces_list(), strict=True)):
            used = [torch.unique(own_faces[chosen], return_inverse=True) for chosen in face_indices[i]]
            vert_ids.append([ids for ids, _ in used])
            verts += [own_verts[ids] for ids, _ in used]
            faces += [renumbered.view(-1, 3) for _, renumbered in used]
            normals += [given[i][ids] for ids, _ in used] if given else []
        textures = None if self.textures is None else self.textures.submeshes(vert_ids, face_indices)
        return self._from_parts(verts, faces, normals if given else None, textures)

    def _from_parts(
        self, verts: list[Tensor], faces: list[Tensor], normals: list[Tensor] | None, textures: Any
    ) -> "Meshes":
        """Meshes of this class and device from lists that are known to be right."""
        vert_rows = Ragged.from_list(verts, self.verts_packed())
        topology = Topology(Ragged.from_list(faces, self.faces_packed(), pad_value=-1), vert_rows.lengths)
        normal_rows = None if normals is None else Ragged.from_list(normals, self.verts_packed())
        return self._replaced(vert_rows, topology, normal_rows, textures)

    def sample_textures(self, fragments: Any) -> Tensor:
        """
        Colours (N, H, W, K, C) at the points that `fragments` of these meshes name; 0 where there is none.

        Raises:
            ValueError: the meshes have no textures.
        """
        if self.textures is None:
            raise ValueError("Meshes does not have textures")
        return self.textures.sample_textures(fragments, faces_packed=self.faces_packed())


def join_meshes_as_batch(meshes: Sequence[Meshes], include_textures: bool = True) -> Meshes:
    """
    One batch of all meshes of several batches, in order.

    Args:
        meshes: batches on one device. Normals that were given survive if all batches have them.
        include_textures: False leaves the textures away.

    Raises:
        ValueError: not a list of `Meshes`, different devices, or only some of them have textures.
    """
    if isinstance(meshes, Meshes) or not meshes or not all(isinstance(m, Meshes) for m in meshes):
        raise ValueError("Wrong first argument to join_meshes_as_batch: expected a non-empty list of Meshes")
    if len({m.device for m in meshes}) > 1:
        raise ValueError(f"All meshes must be on the same device, got {sorted({str(m.device) for m in meshes})}")
    verts = [v for m in meshes for v in m.verts_list()]
    faces = [f for m in meshes for f in m.faces_list()]
    normals = None
    if all(m._normals is not None for m in meshes):
        normals = [n for m in meshes for n in m.verts_normals_list()]
    textures = _joined_textures([m.textures for m in meshes]) if include_textures else None
    return meshes[0]._from_parts(verts, faces, normals, textures)


def _joined_textures(textures: list[Any]) -> Any:
    if all(t is None for t in textures):
        return None
    if any(t is None for t in textures):
        raise ValueError("Inconsistent textures in join_meshes_as_batch: some meshes have none.")
    if len({type(t) for t in textures}) > 1:
        raise ValueError("All meshes in the batch must have the same type of texture.")
    return textures[0].join_batch(textures[1:])


def join_meshes_as_scene(meshes: Meshes | Sequence[Meshes], include_textures: bool = True) -> Meshes:
    """
    One mesh that holds all vertices and faces of a batch, or of several.

    Args:
        meshes: a batch or a list of batches.
        include_textures: False leaves the textures away; True joins them as their class documents.

    Returns:
        A batch of one mesh.

    Raises:
        ValueError: see `join_meshes_as_batch`.
    """
    batch = meshes if isinstance(meshes, Meshes) else join_meshes_as_batch(meshes, include_textures)
    keeps_textures = include_textures and batch.textures is not None
    textures = batch.textures.join_scene() if keeps_textures else None
    normals = None if batch._normals is None else [batch._normals.packed()]
    return batch._from_parts([batch.verts_packed()], [batch.faces_packed()], normals, textures)
