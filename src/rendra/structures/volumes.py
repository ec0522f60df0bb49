"""
Batches of voxel grids of different sizes, and where their voxels lie in the world.

Letters: N volumes, C channels, D H W voxels along z, y and x: depth, height and width of the largest of them.
List: one tensor (C, D_i, H_i, W_i) a volume. Padded: (N, C, D, H, W), filled up with 0 at the end of each axis.

Coordinates are xyz, axes of tensors zyx: x runs along W, y along H, z along D. Local coordinates run from -1 to 1
over each volume's own voxels, as in `torch.nn.functional.grid_sample`; beyond 1 lies the padding. In the world

    x_world = x_local * (size - 1) / 2 * voxel_size - volume_translation
"""

import copy as copying
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from rendra.common.datatypes import Device, make_device
from rendra.structures.ragged import batch_indices, lasting
from rendra.structures.utils import padded_to_list
from rendra.structures.volume_input import (
    GridSize,
    check_voxel_size,
    features_from,
    grid_sizes_from,
    grids_from,
    xyz_from,
)
from rendra.transforms.transform3d import Scale, Transform3d


class Volumes:
    """
    N voxel grids of densities with, optionally, C features for each voxel, placed in the world.

    Tensors given in padded form are kept, not copied: they may be views that repeat one volume N times.

    Attributes:
        device: where all tensors lie.
        locator: the `VolumeLocator` that knows sizes and places.
    """

    def __init__(
        self,
        densities: Sequence[Tensor] | Tensor,
        features: Sequence[Tensor] | Tensor | None = None,
        voxel_size: float | Sequence[float] | Tensor = 1.0,
        volume_translation: float | Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        align_corners: bool = True,
    ) -> None:
        """
        Take densities, and what belongs to them, as lists or padded.

        Args:
            densities: N tensors (Cd, D_i, H_i, W_i), or one (N, Cd, D, H, W); what they mean is the renderer's.
            features: N tensors (C, D_i, H_i, W_i), or one (N, C, D, H, W).
            voxel_size: edge length of a voxel in world units: a number, three numbers (x, y, z), or a tensor
                (1,), (3,), (N, 1) or (N, 3), which may require grad.
            volume_translation: the centre of a volume lies at minus this, in world units; forms as of `voxel_size`.
            align_corners: local -1 and 1 are the centres of the outermost voxels; if False, their outer faces,
                which then come to lie where those centres would be: voxels shrink by (size - 1) / size.

        Raises:
            ValueError: forms, shapes, devices or numbers do not fit together, or a voxel size of 0.
        """
        padded, sizes = grids_from(densities, "densities")
        depth, height, width = padded.shape[2:]
        locator = VolumeLocator(
            len(padded),
            sizes if sizes else (depth, height, width),
            padded.device,
            voxel_size=voxel_size,
            volume_translation=volume_translation,
            align_corners=align_corners,
            dtype=torch.promote_types(padded.dtype, torch.float32),
        )
        self._set(padded, features_from(features, padded, sizes), locator)

    def _set(self, densities: Tensor, features: Tensor | None, locator: "VolumeLocator") -> None:
        self._densities = densities
        self._features = features
        self.locator = locator

    def _replaced(self, densities: Tensor, features: Tensor | None, locator: "VolumeLocator") -> "Volumes":
        """Volumes of this class from parts that are known to fit."""
        new = self.__class__.__new__(self.__class__)
        new._set(densities, features, locator)
        return new

    def _each(self, fn: Callable[[Tensor], Tensor], locator: "VolumeLocator") -> "Volumes":
        """The volumes after `fn` of densities and features alike."""
        return self._replaced(fn(self._densities), None if self._features is None else fn(self._features), locator)

    @property
    def device(self) -> torch.device:
        """Where all tensors lie."""
        return self._densities.device

    def __len__(self) -> int:
        """The number of volumes N."""
        return len(self._densities)

    def __getitem__(self, index: int | slice | list[int] | tuple[int, ...] | Tensor) -> "Volumes":
        """
        Pick volumes by an int, a slice, a list or tuple of ints, or a 1-D tensor of integers or booleans.

        They keep the padding that they have here. A picked range shares its memory.

        Raises:
            IndexError: another kind of index, or one out of range.
        """
        picked = batch_indices(list(index) if isinstance(index, tuple) else index, len(self))
        return self._each(lambda grids: _picked(grids, picked), self.locator[picked])

    # -- densities and features

    def densities(self) -> Tensor:
        """Densities, filled up with 0. (N, Cd, D, H, W)"""
        return self._densities

    def densities_list(self) -> list[Tensor]:
        """Densities of each volume: views. N of (Cd, D_i, H_i, W_i)"""
        return self._unpadded(self._densities)

    def features(self) -> Tensor | None:
        """Features filled up with 0, (N, C, D, H, W), or None."""
        return self._features

    def features_list(self) -> list[Tensor] | None:
        """Features of each volume: views, N of (C, D_i, H_i, W_i), or None."""
        return None if self._features is None else self._unpadded(self._features)

    def _unpadded(self, grids: Tensor) -> list[Tensor]:
        return padded_to_list(grids, [(grids.shape[1], *size) for size in self.locator.sizes])

    def update_padded(self, new_densities: Tensor, new_features: Tensor | None = None) -> "Volumes":
        """
        Volumes of the same sizes in the same places, with other values.

        Args:
            new_densities: (N, Cd, D, H, W) with the present N, D, H and W.
            new_features: (N, C, D, H, W), or None for volumes without features.

        Raises:
            ValueError: another shape or device.
        """
        for name, grids in (("densities", new_densities), ("features", new_features)):
            if grids is not None:
                self._check_update(f"new_{name}", grids)
        return self._replaced(new_densities, new_features, self.locator)

    def _check_update(self, name: str, grids: Tensor) -> None:
        depth, height, width = self._densities.shape[2:]
        if grids.ndim != 5 or (len(grids), *grids.shape[2:]) != (len(self), depth, height, width):
            raise ValueError(
                f"{name} must have shape ({len(self)}, C, {depth}, {height}, {width}), got {tuple(grids.shape)}"
            )
        if grids.device != self.device:
            raise ValueError(f"{name} must be on the volumes' device, {self.device}; got {grids.device}")

    # -- copies

    def clone(self) -> "Volumes":
        """A copy with memory of its own, still part of the autograd graph."""
        return self._each(torch.clone, self.locator.clone())

    def to(self, device: Device, copy: bool = False) -> "Volumes":
        """The volumes on `device`: themselves if they are there already and `copy` is False."""
        target = make_device(device)
        if target == self.device:
            return self.clone() if copy else self
        return self._each(lambda grids: grids.to(target), self.locator.to(target))

    def cpu(self) -> "Volumes":
        """The volumes on the CPU."""
        return self.to("cpu")

    def cuda(self) -> "Volumes":
        """The volumes on the current CUDA device."""
        return self.to("cuda")

    # -- places: what the locator knows

    def get_align_corners(self) -> bool:
        """Whether local -1 and 1 are the centres of the outermost voxels, and not their outer faces."""
        return self.locator.get_align_corners()

    def get_grid_sizes(self) -> Tensor:
        """Depth, height and width of each volume in voxels, without padding. (N, 3)"""
        return self.locator.get_grid_sizes()

    def get_local_to_world_coords_transform(self) -> Transform3d:
        """The transforms of local coordinates to the world. N"""
        return self.locator.get_local_to_world_coords_transform()

    def get_world_to_local_coords_transform(self) -> Transform3d:
        """The transforms of the world to local coordinates. N"""
        return self.locator.get_world_to_local_coords_transform()

    def local_to_world_coords(self, points_3d_local: Tensor) -> Tensor:
        """Points (N, ..., 3) from local coordinates to the world; see `VolumeLocator.local_to_world_coords`."""
        return self.locator.local_to_world_coords(points_3d_local)

    def world_to_local_coords(self, points_3d_world: Tensor) -> Tensor:
        """Points (N, ..., 3) from the world to local coordinates; see `VolumeLocator.local_to_world_coords`."""
        return self.locator.world_to_local_coords(points_3d_world)

    def get_coord_grid(self, world_coordinates: bool = True) -> Tensor:
        """The centres of all voxels; see `VolumeLocator.get_coord_grid`. (N, D, H, W, 3)"""
        return self.locator.get_coord_grid(world_coordinates)


class VolumeLocator:
    """
    Sizes and places of N voxel grids, without what is in them.

    Attributes:
        device: where all tensors lie.
        sizes: the own (depth, height, width) of each grid, in voxels.
        resolution: the common (depth, height, width) that grids are padded to.
    """

    def __init__(
        self,
        batch_size: int,
        grid_sizes: Sequence[int] | Sequence[Sequence[int]] | Sequence[Tensor] | Tensor,
        device: Device,
        voxel_size: float | Sequence[float] | Tensor = 1.0,
        volume_translation: float | Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        align_corners: bool = True,
        *,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        """
        Place N grids in the world.

        Args:
            batch_size: N.
            grid_sizes: (depth, height, width) of all grids, or N of them, or a tensor (N, 3).
            device: where to keep the transforms.
            voxel_size: as of `Volumes`.
            volume_translation: as of `Volumes`.
            align_corners: as of `Volumes`.
            dtype: of the transforms.

        Raises:
            ValueError: sizes or numbers of another form, or a voxel size of 0.
        """
        check_voxel_size(voxel_size)
        self.device = make_device(device)
        self._align_corners = align_corners
        self.sizes, self.resolution = grid_sizes_from(grid_sizes, batch_size)
        with lasting():
            self._grid_sizes = torch.tensor(self.sizes, dtype=torch.int64, device=self.device).reshape(-1, 3)
        edges = xyz_from(voxel_size, "voxel_size", batch_size, self.device, dtype)
        offsets = xyz_from(volume_translation, "volume_translation", batch_size, self.device, dtype)
        # an axis of one voxel has no extent between centres; one step keeps the transform invertible
        steps = (self._grid_sizes.flip(1) - 1).clamp(min=1).to(dtype)
        self._scale = steps * edges / 2  # (N, 3)
        self._shift = -offsets.expand(batch_size, 3)

    def __len__(self) -> int:
        """The number of grids N."""
        return len(self.sizes)

    def __getitem__(self, index: int | slice | list[int] | tuple[int, ...] | Tensor) -> "VolumeLocator":
        """
        Pick grids, which keep their padding, by an index as of `Volumes`.

        Raises:
            IndexError: another kind of index, or one out of range.
        """
        picked = batch_indices(list(index) if isinstance(index, tuple) else index, len(self))
        return self._each([self.sizes[i] for i in picked], lambda rows: _picked(rows, picked))

    def _each(self, sizes: list[GridSize], fn: Callable[[Tensor], Tensor]) -> "VolumeLocator":
        """Grids of these sizes after `fn` of all tensors."""
        new = copying.copy(self)
        new.sizes = sizes
        new._grid_sizes, new._scale, new._shift = fn(self._grid_sizes), fn(self._scale), fn(self._shift)
        new.device = new._grid_sizes.device
        return new

    def clone(self) -> "VolumeLocator":
        """A copy with memory of its own, still part of the autograd graph."""
        return self._each(list(self.sizes), torch.clone)

    def to(self, device: Device) -> "VolumeLocator":
        """The same places on `device`."""
        target = make_device(device)
        return self._each(self.sizes, lambda rows: rows.to(target))

    def get_align_corners(self) -> bool:
        """Whether local -1 and 1 are the centres of the outermost voxels, and not their outer faces."""
        return self._align_corners

    def get_grid_sizes(self) -> Tensor:
        """Depth, height and width of each grid in voxels, without padding. (N, 3)"""
        return self._grid_sizes

    def get_local_to_world_coords_transform(self) -> Transform3d:
        """The transforms of local coordinates to the world. N"""
        return Scale(self._scale).translate(self._shift)

    def get_world_to_local_coords_transform(self) -> Transform3d:
        """The transforms of the world to local coordinates. N"""
        return self.get_local_to_world_coords_transform().inverse()

    def local_to_world_coords(self, points_3d_local: Tensor) -> Tensor:
        """
        Points from the local coordinates of their volume to the world.

        Args:
            points_3d_local: (N, ..., 3).

        Returns:
            As many, of the same type.

        Raises:
            ValueError: another shape.
        """
        return self._transformed(self.get_local_to_world_coords_transform(), points_3d_local)

    def world_to_local_coords(self, points_3d_world: Tensor) -> Tensor:
        """The inverse of `local_to_world_coords`."""
        return self._transformed(self.get_world_to_local_coords_transform(), points_3d_world)

    def _transformed(self, transform: Transform3d, points: Tensor) -> Tensor:
        if points.ndim < 2 or len(points) != len(self) or points.shape[-1] != 3:
            raise ValueError(f"points must have shape ({len(self)}, ..., 3), got {tuple(points.shape)}")
        rows = points.reshape(len(points), math.prod(points.shape[1:-1]), 3)
        return transform.transform_points(rows).reshape(points.shape)

    def get_coord_grid(self, world_coordinates: bool = True) -> Tensor:
        """
        The centres of all voxels, those of the padding too.

        Args:
            world_coordinates: in the world; else local.

        Returns:
            (N, D, H, W, 3), xyz.
        """
        axes = [self._local_centers(axis) for axis in range(3)]
        shape = (len(self), *self.resolution)
        z, y, x = (
            centers.reshape(-1, *[1] * axis, self.resolution[axis], *[1] * (2 - axis)).expand(shape)
            for axis, centers in enumerate(axes)
        )
        grid = torch.stack([x, y, z], dim=-1)
        return self.local_to_world_coords(grid) if world_coordinates else grid

    def _local_centers(self, axis: int) -> Tensor:
        """Local coordinates of the centres of voxels along z (0), y (1) or x (2). (N, its resolution)"""
        size = self._grid_sizes[:, axis, None].to(self._scale.dtype)
        voxel = torch.arange(self.resolution[axis], dtype=size.dtype, device=self.device)
        return (2 * voxel - (size - 1)) / local_extent(size, self._align_corners)


def local_extent(size: Tensor, align_corners: bool) -> Tensor:
    """How many voxels local coordinates from -1 to 1 span along an axis of `size` voxels."""
    return (size - 1 if align_corners else size).clamp(min=1)


def _picked(rows: Tensor, picked: list[int]) -> Tensor:
    """Some rows of a tensor, repetition allowed; a view where they follow each other."""
    if picked and picked == list(range(picked[0], picked[0] + len(picked))):
        return rows[picked[0] : picked[-1] + 1]
    return rows.index_select(0, torch.tensor(picked, dtype=torch.int64, device=rows.device))
