"""Textures of meshes: a colour or a feature vector for every point of their surface.

Letters: N meshes, V vertices and F faces of the largest, C channels, K layers of a pixel, M filled slots
among the N * H * W * K of the fragments. Colours are what the caller puts in, usually sRGB in [0, 1].
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.renderer.mesh.texture_packing import Sampling, pack_maps
from rendra.renderer.mesh.texture_rows import (
    Hits,
    SubmeshIds,
    as_one_item,
    checked_maps,
    concatenated,
    fit_rows,
    picked,
    require_same_class,
    resized,
    rows_of,
)
from rendra.structures.ragged import Lengths, Ragged, batch_indices


class TexturesBase(ABC):
    """What `Meshes` asks of its textures."""

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Where the textures lie."""

    @abstractmethod
    def __len__(self) -> int:
        """The number of meshes N."""

    @abstractmethod
    def sample_textures(self, fragments: Any, faces_packed: Tensor | None = None) -> Tensor:
        """Texture at every slot of `fragments` (`pix_to_face`, `bary_coords`), 0 where that is empty.

        Args:
            fragments: with `pix_to_face` (N, H, W, K), -1 for empty slots, and `bary_coords` (N, H, W, K, 3).
            faces_packed: (sum F, 3), the faces of the meshes.

        Returns:
            (N, H, W, K, C).
        """

    @abstractmethod
    def faces_verts_textures_packed(self, faces_packed: Tensor | None = None) -> Tensor:
        """Texture at the three vertices of every face. (sum F, 3, C)"""

    @abstractmethod
    def check_shapes(self, batch_size: int, max_num_verts: int, max_num_faces: int) -> bool:
        """Whether these can be the textures of meshes of this size."""

    @abstractmethod
    def submeshes(self, vertex_ids_list: SubmeshIds, faces_ids_list: SubmeshIds) -> "TexturesBase":
        """Textures of submeshes: for each mesh the vertices and the faces of each submesh."""

    @abstractmethod
    def join_batch(self, textures: list[Any]) -> "TexturesBase":
        """Textures of the batch that holds these meshes and then those of `textures`."""

    @abstractmethod
    def join_scene(self) -> "TexturesBase":
        """Textures of the one mesh that joins all meshes of the batch."""

    @abstractmethod
    def _apply(self, fn: Callable[[Tensor], Tensor]) -> "TexturesBase":
        """The same textures with `fn` done to every tensor."""

    @abstractmethod
    def _select(self, indices: list[int]) -> "TexturesBase":
        """The textures of some of the meshes, repetition allowed."""

    def fit_to(self, verts: Lengths, faces: Lengths) -> "TexturesBase":
        """These textures, knowing how many rows of theirs belong to each mesh and which are padding.

        Raises:
            ValueError: the numbers do not fit.
        """
        return self

    def isempty(self) -> bool:
        """Whether there is no mesh."""
        return len(self) == 0

    def clone(self) -> Any:
        """A copy with memory of its own, still part of the autograd graph."""
        return self._apply(torch.clone)

    def detach(self) -> Any:
        """The same values, cut from the autograd graph."""
        return self._apply(torch.detach)

    def to(self, device: torch.device | str) -> Any:
        """The textures on another device."""
        return self._apply(lambda tensor: tensor.to(device))

    def extend(self, N: int) -> Any:
        """The textures of every mesh N times in a row, with gradients to these.

        Raises:
            ValueError: N is not a positive integer.
        """
        if not isinstance(N, int) or N <= 0:
            raise ValueError(f"N must be an integer > 0, got {N!r}")
        return self._select([i for i in range(len(self)) for _ in range(N)])

    def __getitem__(self, index: Any) -> Any:
        """Pick textures by an int, a slice, a list of ints, or a 1-D tensor of integers or booleans."""
        return self._select(batch_indices(index, len(self)))


class TexturesVertex(TexturesBase):
    """A feature vector at every vertex, interpolated over the faces."""

    def __init__(self, verts_features: Sequence[Tensor] | Tensor) -> None:
        """Take features: N tensors (V_i, C), or one (N, V, C).

        Raises:
            ValueError: another type or shape.
        """
        self._features = rows_of(verts_features, "verts_features", ("C",))

    @classmethod
    def _of(cls, features: Ragged) -> "TexturesVertex":
        new = cls.__new__(cls)
        new._features = features
        return new

    @property
    def device(self) -> torch.device:
        """Where the features lie."""
        return self._features.lengths.device

    def __len__(self) -> int:
        """The number of meshes N."""
        return len(self._features)

    def verts_features_list(self) -> list[Tensor]:
        """Features of each mesh. N of (V_i, C)"""
        return self._features.items()

    def verts_features_padded(self) -> Tensor:
        """Features, filled up with 0. (N, V, C)"""
        return self._features.padded()

    def verts_features_packed(self) -> Tensor:
        """Features of all vertices. (sum V, C)"""
        return self._features.packed()

    def faces_verts_textures_packed(self, faces_packed: Tensor | None = None) -> Tensor:
        """Features at the three vertices of every face. (sum F, 3, C)

        Raises:
            ValueError: `faces_packed` is missing.
        """
        if faces_packed is None:
            raise ValueError("TexturesVertex needs faces_packed, the (sum F, 3) faces of the meshes")
        features = self.verts_features_packed()
        rows = features.index_select(0, faces_packed.reshape(-1))
        return rows.view(-1, 3, features.shape[1])

    def sample_textures(self, fragments: Any, faces_packed: Tensor | None = None) -> Tensor:
        """Features interpolated with the barycentrics, 0 in empty slots. (N, H, W, K, C)"""
        hits = Hits(fragments)
        return hits.spread(hits.interpolate(self.faces_verts_textures_packed(faces_packed)))

    def check_shapes(self, batch_size: int, max_num_verts: int, max_num_faces: int) -> bool:
        """Whether there is one row for each vertex of the largest mesh."""
        lengths = self._features.lengths
        return (len(lengths), lengths.padded_size) == (batch_size, max_num_verts)

    def fit_to(self, verts: Lengths, faces: Lengths) -> "TexturesVertex":
        """These features, knowing which rows are padding."""
        fitted = fit_rows(self._features, verts, "verts_features")
        return self if fitted is self._features else self._of(fitted)

    def submeshes(self, vertex_ids_list: SubmeshIds, faces_ids_list: SubmeshIds) -> "TexturesVertex":
        """The features of the submeshes' vertices."""
        return self._of(picked(self._features, vertex_ids_list))

    def join_batch(self, textures: list[Any]) -> "TexturesVertex":
        """The features of several batches in order.

        Raises:
            ValueError: textures of another class.
        """
        require_same_class(self, textures)
        return self._of(concatenated([self._features, *(t._features for t in textures)]))

    def join_scene(self) -> "TexturesVertex":
        """The features of all meshes as those of one."""
        return self._of(as_one_item(self._features))

    def _apply(self, fn: Callable[[Tensor], Tensor]) -> "TexturesVertex":
        return self._of(self._features.apply(fn))

    def _select(self, indices: list[int]) -> "TexturesVertex":
        return self._of(self._features.select(indices))


class TexturesAtlas(TexturesBase):
    """A small square map of R x R texels for every face.

    The face is cut into R^2 congruent triangles. With w0, w1 the barycentrics of its first two vertices, the
    triangle that has its right angle at (i, j) / R in the (w0, w1) plane reads texel [j, i]; the one that
    completes it to a parallelogram reads the texel mirrored at the centre, [R-1-j, R-1-i] (the layout of
    SoftRasterizer, Liu et al., ICCV 2019). Texels are not interpolated: no gradient reaches the barycentrics.
    """

    def __init__(self, atlas: Sequence[Tensor] | Tensor) -> None:
        """Take texels: N tensors (F_i, R, R, C), or one (N, F, R, R, C).

        Raises:
            ValueError: another type or shape.
        """
        self._atlas = rows_of(atlas, "atlas", ("R", "R", "C"))
        shape = self._atlas.packed().shape
        if shape[1] != shape[2]:
            raise ValueError(f"atlas must have square maps (F, R, R, C), got {tuple(shape)}")

    @classmethod
    def _of(cls, atlas: Ragged) -> "TexturesAtlas":
        new = cls.__new__(cls)
        new._atlas = atlas
        return new

    @property
    def device(self) -> torch.device:
        """Where the texels lie."""
        return self._atlas.lengths.device

    def __len__(self) -> int:
        """The number of meshes N."""
        return len(self._atlas)

    def atlas_list(self) -> list[Tensor]:
        """Texels of each mesh's faces. N of (F_i, R, R, C)"""
        return self._atlas.items()

    def atlas_padded(self) -> Tensor:
        """Texels, filled up with 0. (N, F, R, R, C)"""
        return self._atlas.padded()

    def atlas_packed(self) -> Tensor:
        """Texels of all faces. (sum F, R, R, C)"""
        return self._atlas.packed()

    def faces_verts_textures_packed(self, faces_packed: Tensor | None = None) -> Tensor:
        """Texel at the three vertices of every face. (sum F, 3, C)"""
        atlas = self.atlas_packed()
        return torch.stack([atlas[:, 0, -1], atlas[:, -1, 0], atlas[:, 0, 0]], dim=1)

    def sample_textures(self, fragments: Any, faces_packed: Tensor | None = None) -> Tensor:
        """The texel that each point lies in, 0 in empty slots. (N, H, W, K, C)"""
        hits = Hits(fragments)
        atlas = self.atlas_packed()
        size = atlas.shape[1]
        inside = hits.bary.detach().clamp_min(0)  # blurred edges reach beyond the face
        scaled = inside[:, :2] / inside.sum(1, keepdim=True) * size
        cell = scaled.long().clamp(0, size - 1)  # (M, 2) as column, row
        beyond_diagonal = scaled.sum(1) - cell.sum(1) > 1
        column, row = torch.where(beyond_diagonal[:, None], size - 1 - cell, cell).unbind(1)
        texels = atlas.flatten(0, 2).index_select(0, (hits.faces * size + row) * size + column)
        return hits.spread(texels)

    def check_shapes(self, batch_size: int, max_num_verts: int, max_num_faces: int) -> bool:
        """Whether there is one map for each face of the largest mesh."""
        lengths = self._atlas.lengths
        return (len(lengths), lengths.padded_size) == (batch_size, max_num_faces)

    def fit_to(self, verts: Lengths, faces: Lengths) -> "TexturesAtlas":
        """These maps, knowing which are padding."""
        fitted = fit_rows(self._atlas, faces, "atlas")
        return self if fitted is self._atlas else self._of(fitted)

    def submeshes(self, vertex_ids_list: SubmeshIds, faces_ids_list: SubmeshIds) -> "TexturesAtlas":
        """The maps of the submeshes' faces."""
        return self._of(picked(self._atlas, faces_ids_list))

    def join_batch(self, textures: list[Any]) -> "TexturesAtlas":
        """The maps of several batches in order.

        Raises:
            ValueError: textures of another class.
        """
        require_same_class(self, textures)
        return self._of(concatenated([self._atlas, *(t._atlas for t in textures)]))

    def join_scene(self) -> "TexturesAtlas":
        """The maps of all meshes as those of one."""
        return self._of(as_one_item(self._atlas))

    def _apply(self, fn: Callable[[Tensor], Tensor]) -> "TexturesAtlas":
        return self._of(self._atlas.apply(fn))

    def _select(self, indices: list[int]) -> "TexturesAtlas":
        return self._of(self._atlas.select(indices))


class TexturesUV(TexturesBase):
    """Images, and for every corner of a face the place where it lies in its mesh's image.

    Coordinates run from 0 to 1 from the bottom left corner; row 0 of a map is its top. They are interpolated
    with the barycentrics, then the map is read as `torch.nn.functional.grid_sample` does.

    Attributes:
        padding_mode: "border", "zeros" or "reflection", what lies outside of [0, 1].
        align_corners: whether 0 and 1 are the centres of the outermost texels, or their outer edges.
        sampling_mode: "bilinear" or "nearest".
    """

    def __init__(
        self,
        maps: Sequence[Tensor] | Tensor,
        faces_uvs: Sequence[Tensor] | Tensor,
        verts_uvs: Sequence[Tensor] | Tensor,
        *,
        maps_ids: Sequence[Tensor] | Tensor | None = None,
        padding_mode: str = "border",
        align_corners: bool = True,
        sampling_mode: str = "bilinear",
    ) -> None:
        """Take maps and coordinates, each as a list of N tensors or as one padded tensor.

        Args:
            maps: (N, H, W, C), or N of (H_i, W_i, C). With `maps_ids` several a mesh: (N, M, H, W, C).
            faces_uvs: (N, F, 3) integers, or N of (F_i, 3); rows of `verts_uvs`, filled up with -1.
            verts_uvs: (N, T, 2), or N of (T_i, 2).
            maps_ids: (N, F) integers, or N of (F_i,); which of its mesh's M maps a face reads.
            padding_mode: see the class.
            align_corners: see the class.
            sampling_mode: see the class.

        Raises:
            ValueError: types, shapes, numbers or options do not fit.
        """
        if padding_mode not in ("border", "zeros", "reflection"):
            raise ValueError(f"padding_mode must be border, zeros or reflection, got {padding_mode!r}")
        if sampling_mode not in ("bilinear", "nearest"):
            raise ValueError(f"sampling_mode must be bilinear or nearest, got {sampling_mode!r}")
        self.padding_mode = padding_mode
        self.align_corners = align_corners
        self.sampling_mode = sampling_mode
        self._faces_uvs = rows_of(faces_uvs, "faces_uvs", (3,), pad_value=-1)
        self._verts_uvs = rows_of(verts_uvs, "verts_uvs", (2,))
        self._maps_ids = None if maps_ids is None else rows_of(maps_ids, "maps_ids", ())
        self._maps = checked_maps(maps, "(M, H, W, C)" if self.multi_map else "(H, W, C)")
        sizes = {"maps": len(maps), "faces_uvs": len(self._faces_uvs), "verts_uvs": len(self._verts_uvs)}
        if len(set(sizes.values())) > 1:
            raise ValueError(f"maps, faces_uvs and verts_uvs must have one entry for each mesh, got {sizes}")
        self._check_indices()

    def _check_indices(self) -> None:
        for i, (faces, verts) in enumerate(zip(self.faces_uvs_list(), self.verts_uvs_list(), strict=True)):
            if faces.numel() and int(faces.max()) >= len(verts):
                raise ValueError(
                    f"faces_uvs[{i}] refers to row {int(faces.max())}, but verts_uvs[{i}] has {len(verts)} rows"
                )
        if self._maps_ids is None:
            return
        if self._maps_ids.lengths.sizes != self._faces_uvs.lengths.sizes:
            raise ValueError("maps_ids must have one entry for each face of faces_uvs")
        for i, (ids, maps) in enumerate(zip(self._maps_ids.items(), self.maps_list(), strict=True)):
            if ids.numel() and not 0 <= int(ids.min()) <= int(ids.max()) < len(maps):
                raise ValueError(f"maps_ids[{i}] must lie in [0, {len(maps)})")

    def _with(self, maps: list[Tensor] | Tensor, faces: Ragged, verts: Ragged, ids: Ragged | None) -> "TexturesUV":
        new = self.__class__.__new__(self.__class__)
        new.padding_mode, new.align_corners = self.padding_mode, self.align_corners
        new.sampling_mode = self.sampling_mode
        new._maps, new._faces_uvs, new._verts_uvs, new._maps_ids = maps, faces, verts, ids
        return new

    @property
    def multi_map(self) -> bool:
        """Whether faces of one mesh read different maps."""
        return self._maps_ids is not None

    @property
    def device(self) -> torch.device:
        """Where the maps lie."""
        return self._maps[0].device if len(self._maps) else self._faces_uvs.lengths.device

    def __len__(self) -> int:
        """The number of meshes N."""
        return len(self._faces_uvs)

    def maps_list(self) -> list[Tensor]:
        """The maps. N of (H_i, W_i, C), or (M_i, H_i, W_i, C) with `maps_ids`"""
        return list(self._maps)

    def maps_padded(self) -> Tensor:
        """The maps in one tensor, those of a list enlarged to the largest height and width. (N, H, W, C)"""
        if isinstance(self._maps, Tensor):
            return self._maps
        if not self._maps:
            return torch.zeros(0, 0, 0, 3, device=self.device)
        size = [max(m.shape[d] for m in self._maps) for d in (-3, -2)]
        return torch.stack([resized(m, size) for m in self._maps])

    def maps_ids_list(self) -> list[Tensor] | None:
        """The map that each face reads. N of (F_i,), or None if there is one map a mesh"""
        return None if self._maps_ids is None else self._maps_ids.items()

    def maps_ids_padded(self) -> Tensor | None:
        """The map that each face reads. (N, F), or None if there is one map a mesh"""
        return None if self._maps_ids is None else self._maps_ids.padded()

    def faces_uvs_list(self) -> list[Tensor]:
        """Rows of `verts_uvs` at the corners of each face. N of (F_i, 3)"""
        return self._faces_uvs.items()

    def faces_uvs_padded(self) -> Tensor:
        """Rows of `verts_uvs` at the corners of each face, filled up with -1. (N, F, 3)"""
        return self._faces_uvs.padded()

    def verts_uvs_list(self) -> list[Tensor]:
        """Texture coordinates. N of (T_i, 2)"""
        return self._verts_uvs.items()

    def verts_uvs_padded(self) -> Tensor:
        """Texture coordinates, filled up with 0. (N, T, 2)"""
        return self._verts_uvs.padded()

    def _corners(self) -> Tensor:
        """Rows of the packed coordinates at the corners of every face. (sum F, 3)"""
        corners = self._faces_uvs.packed().clamp_min(0)  # -1 marks a face without coordinates: it reads row 0
        if len(self) < 2:
            return corners
        return corners + self._verts_uvs.lengths.first_idx[self._faces_uvs.lengths.item_idx, None]

    def _corner_uvs(self) -> Tensor:
        """Texture coordinates at the corners of every face. (sum F, 3, 2)"""
        return self._verts_uvs.packed().index_select(0, self._corners().reshape(-1)).view(-1, 3, 2)

    def _images(self) -> list[Tensor]:
        """Every map of every mesh. (H_i, W_i, C) each"""
        return [m for stack in self._maps for m in stack] if self.multi_map else self.maps_list()

    def _image_of_faces(self) -> Tensor:
        """The number of the image that each face reads. (sum F,)"""
        mesh = self._faces_uvs.lengths.item_idx
        if self._maps_ids is None:
            return mesh
        counts = Lengths([len(stack) for stack in self._maps], self.device)
        return counts.first_idx[mesh] + self._maps_ids.packed()

    def _sample_images(self, uvs: Tensor, faces: Tensor) -> Tensor:
        """Colours (M, C) at `uvs` (M, 2) on the given faces (M,)."""
        images = self._images()
        if len(images) == 1:
            return self._sample_image(images[0], uvs)
        if not images:
            return uvs.new_zeros(len(uvs), self.maps_padded().shape[-1])
        source = self._image_of_faces().index_select(0, faces)
        order = None
        if (source[1:] < source[:-1]).any():
            source, order = source.sort(stable=True)
            uvs = uvs.index_select(0, order)
        counts = torch.bincount(source, minlength=len(images)).tolist()
        parts = [self._sample_image(m, part) for m, part in zip(images, uvs.split(counts), strict=True)]
        colors = torch.cat(parts)
        return colors if order is None else torch.empty_like(colors).index_copy(0, order, colors)

    def _sample_image(self, image: Tensor, uvs: Tensor) -> Tensor:
        """Colours (M, C) of one map (H, W, C) at `uvs` (M, 2)."""
        if len(uvs) == 0:
            return image.new_zeros(0, image.shape[-1])
        grid = torch.stack([2 * uvs[:, 0] - 1, 1 - 2 * uvs[:, 1]], dim=1).to(image.dtype)
        sampled = F.grid_sample(
            image.permute(2, 0, 1)[None],
            grid[None, :, None],
            mode=self.sampling_mode,
            padding_mode=self.padding_mode,
            align_corners=self.align_corners,
        )
        return sampled[0, :, :, 0].T

    def sample_textures(self, fragments: Any, faces_packed: Tensor | None = None) -> Tensor:
        """The maps read at every point, 0 in empty slots. (N, H, W, K, C)"""
        hits = Hits(fragments)
        return hits.spread(self._sample_images(hits.interpolate(self._corner_uvs()), hits.faces))

    def faces_verts_textures_packed(self, faces_packed: Tensor | None = None) -> Tensor:
        """The maps read at the three corners of every face. (sum F, 3, C)"""
        uvs = self._corner_uvs()
        faces = torch.arange(len(uvs), device=uvs.device).repeat_interleave(3)
        colors = self._sample_images(uvs.view(-1, 2), faces)
        return colors.view(-1, 3, colors.shape[1])

    def centers_for_image(self, index: int) -> Tensor:
        """Where the coordinates of one mesh lie in its map: (T, 2) x, y in texels from the top left centre.

        Raises:
            NotImplementedError: the mesh has several maps.
        """
        if self.multi_map:
            raise NotImplementedError(
                "centers_for_image needs one map a mesh, these textures have several (maps_ids)"
            )
        height, width = self._maps[index].shape[:2]
        texels = self._sampling().texels(self.verts_uvs_list()[index], height, width)
        return torch.minimum(texels.clamp_min(0), texels.new_tensor([width - 1, height - 1]))

    def _sampling(self) -> Sampling:
        return Sampling(self.padding_mode, self.align_corners, self.sampling_mode)

    def check_shapes(self, batch_size: int, max_num_verts: int, max_num_faces: int) -> bool:
        """Whether there is one row of `faces_uvs` for each face of the largest mesh."""
        lengths = self._faces_uvs.lengths
        return (len(lengths), lengths.padded_size) == (batch_size, max_num_faces)

    def fit_to(self, verts: Lengths, faces: Lengths) -> "TexturesUV":
        """These textures, knowing which rows of `faces_uvs` are padding."""
        fitted = fit_rows(self._faces_uvs, faces, "faces_uvs")
        if fitted is self._faces_uvs:
            return self
        ids = None if self._maps_ids is None else fit_rows(self._maps_ids, faces, "maps_ids")
        return self._with(self._maps, fitted, self._verts_uvs, ids)

    def submeshes(self, vertex_ids_list: SubmeshIds, faces_ids_list: SubmeshIds) -> "TexturesUV":
        """The submeshes' faces with the whole maps and coordinates of their meshes."""
        owners = [i for i, chosen in enumerate(faces_ids_list) for _ in chosen]
        whole = self._select(owners)
        ids = None if self._maps_ids is None else picked(self._maps_ids, faces_ids_list)
        return self._with(whole._maps, picked(self._faces_uvs, faces_ids_list), whole._verts_uvs, ids)

    def join_batch(self, textures: list[Any]) -> "TexturesUV":
        """The textures of several batches in order.

        Raises:
            ValueError: textures of another class, or read in another way.
        """
        require_same_class(self, textures)
        if any(t._sampling() != self._sampling() or t.multi_map != self.multi_map for t in textures):
            raise ValueError(
                "all textures must have the same padding_mode, align_corners, sampling_mode and maps_ids"
            )
        every = [self, *textures]
        ids = concatenated([t._maps_ids for t in every]) if self.multi_map else None
        return self._with(
            [m for t in every for m in t.maps_list()],
            concatenated([t._faces_uvs for t in every]),
            concatenated([t._verts_uvs for t in every]),
            ids,
        )

    def join_scene(self) -> "TexturesUV":
        """The maps side by side in one image, and coordinates in it, for the one mesh that joins all.

        Sampling gives the same colours as before, also where coordinates lie outside of [0, 1].

        Raises:
            ValueError: coordinates lie further outside than 2, or channels differ.
            NotImplementedError: a mesh has several maps.
        """
        if self.multi_map:
            raise NotImplementedError("join_scene needs one map a mesh, these textures have several (maps_ids)")
        faces, verts = as_one_item(self._faces_uvs), as_one_item(self._verts_uvs)
        if len(self) == 0:
            return self._with(self.maps_padded().new_zeros(1, 1, 1, 3), faces, verts, None)
        corners = self._corners()
        used = verts.packed().index_select(0, corners.reshape(-1))
        used_by_mesh = used.split([3 * size for size in self._faces_uvs.lengths.sizes])
        packed = pack_maps(self.maps_list(), used_by_mesh, self._sampling())
        moved = torch.cat([packed.move(i, own) for i, own in enumerate(self.verts_uvs_list())])
        faces, verts = Ragged.from_list([corners], corners, pad_value=-1), Ragged.from_list([moved], moved)
        return self._with(packed.image[None], faces, verts, None)

    def _apply(self, fn: Callable[[Tensor], Tensor]) -> "TexturesUV":
        maps = fn(self._maps) if isinstance(self._maps, Tensor) else [fn(m) for m in self._maps]
        ids = None if self._maps_ids is None else self._maps_ids.apply(fn)
        return self._with(maps, self._faces_uvs.apply(fn), self._verts_uvs.apply(fn), ids)

    def _select(self, indices: list[int]) -> "TexturesUV":
        maps = self.maps_list()
        ids = None if self._maps_ids is None else self._maps_ids.select(indices)
        faces, verts = self._faces_uvs.select(indices), self._verts_uvs.select(indices)
        return self._with([maps[i] for i in indices], faces, verts, ids)
