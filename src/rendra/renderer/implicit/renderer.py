"""Renderers of what has no surface: rays are cast, something is asked about points along them, a marcher sums up."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rendra.renderer.camera_base import CamerasBase
from rendra.renderer.implicit.utils import (
    HeterogeneousRayBundle,
    RayBundle,
    ray_bundle_variables_to_ray_points,
)
from rendra.renderer.implicit.volume_march import march_in_one_pass
from rendra.structures.volumes import Volumes

__all__ = ["ImplicitRenderer", "VolumeRenderer", "VolumeSampler"]

_SAMPLE_MODES = ("bilinear", "nearest")
_PADDING_MODES = ("zeros", "border", "reflection")


class ImplicitRenderer(nn.Module):
    """A ray sampler and a ray marcher put together: renders any function of space.

    Both are callables with keyword arguments, and get all that `forward` is given beside its cameras:
        ray_bundle = raysampler(cameras=, volumetric_function=, **kwargs)
        images = raymarcher(rays_densities=, rays_features=, ray_bundle=, **kwargs)
    """

    def __init__(self, raysampler: Callable[..., Any], raymarcher: Callable[..., Tensor]) -> None:
        """Keep the parts.

        Raises:
            ValueError: if one of them cannot be called.
        """
        super().__init__()
        _check_callable("raysampler", raysampler)
        _check_callable("raymarcher", raymarcher)
        self.raysampler = raysampler
        self.raymarcher = raymarcher

    def forward(
        self, cameras: CamerasBase, volumetric_function: Callable[..., tuple[Tensor, Tensor]], **kwargs: Any
    ) -> tuple[Tensor, RayBundle | HeterogeneousRayBundle]:
        """Render a function of space.

        Args:
            cameras: N of them.
            volumetric_function: called with `ray_bundle=`, `cameras=` and `kwargs`; returns densities (N, ..., S, 1)
                and features (N, ..., S, C) at the samples of the bundle. What a density means is for the marcher
                to say.
            **kwargs: passed to the sampler, the function and the marcher.

        Returns:
            What the marcher gives, as (N, ..., C + 1) colours and opacity, and the bundle of rays.

        Raises:
            ValueError: if `volumetric_function` cannot be called.
        """
        _check_callable("volumetric_function", volumetric_function)
        ray_bundle = self.raysampler(cameras=cameras, volumetric_function=volumetric_function, **kwargs)
        images = self._sum_up(cameras, volumetric_function, ray_bundle, kwargs)
        return images, ray_bundle

    def _sum_up(
        self,
        cameras: CamerasBase,
        volumetric_function: Callable[..., tuple[Tensor, Tensor | None]],
        ray_bundle: RayBundle | HeterogeneousRayBundle,
        kwargs: dict[str, Any],
    ) -> Tensor:
        """Ask about the points of the rays, and march."""
        if type(volumetric_function) is VolumeSampler:
            images = volumetric_function._march(ray_bundle, self.raymarcher, kwargs)
            if images is not None:
                return images
        densities, features = volumetric_function(ray_bundle=ray_bundle, cameras=cameras, **kwargs)
        return self.raymarcher(rays_densities=densities, rays_features=features, ray_bundle=ray_bundle, **kwargs)


class VolumeRenderer(nn.Module):
    """Volumes to images: sample them along the cameras' rays, then march.

    The usual parts work in one pass that keeps no samples, see `volume_march`: float32 on a CPU, opacities in [0, 1],
    bilinear, even steps along rays that need no gradient, `EmissionAbsorptionRaymarcher` of thickness 1 or
    `AbsorptionOnlyRaymarcher`. With others every sample of every ray is made and kept for the backward pass: on a
    CPU one to two microseconds each.
    """

    def __init__(
        self, raysampler: Callable[..., Any], raymarcher: Callable[..., Tensor], sample_mode: str = "bilinear"
    ) -> None:
        """Keep a ray sampler, a ray marcher (see `ImplicitRenderer`) and how to read between voxels.

        Args:
            raysampler: cameras to a ray bundle.
            raymarcher: densities and features along rays to images.
            sample_mode: see `VolumeSampler`.

        Raises:
            ValueError: a part that cannot be called, or an unknown `sample_mode`.
        """
        super().__init__()
        _check_choice("sample_mode", sample_mode, _SAMPLE_MODES)
        self.renderer = ImplicitRenderer(raysampler, raymarcher)
        self._sample_mode = sample_mode

    def forward(
        self, cameras: CamerasBase, volumes: Volumes, **kwargs: Any
    ) -> tuple[Tensor, RayBundle | HeterogeneousRayBundle]:
        """Render volume i as camera i sees it.

        Args:
            cameras: N of them.
            volumes: N of them, with features.
            **kwargs: passed to ray sampler, volume sampler and ray marcher.

        Returns:
            Images and ray bundle, as `ImplicitRenderer` gives them.

        Raises:
            ValueError: the batches differ in size.
        """
        sampler = VolumeSampler(volumes, sample_mode=self._sample_mode)
        return self.renderer(cameras=cameras, volumetric_function=sampler, **kwargs)


class VolumeSampler(nn.Module):
    """Volumes as a function of space: what ray i of a bundle meets in volume i."""

    def __init__(self, volumes: Volumes, sample_mode: str = "bilinear", padding_mode: str = "zeros") -> None:
        """Keep N volumes.

        Args:
            volumes: of any sizes.
            sample_mode: "bilinear", the weighted mean of the 8 voxels around a point, or "nearest".
            padding_mode: what lies outside: "zeros", "border" or "reflection", as in
                `torch.nn.functional.grid_sample`.

        Raises:
            ValueError: another mode, or something else than volumes.
        """
        super().__init__()
        if not isinstance(volumes, Volumes):
            raise ValueError(f"'volumes' have to be an instance of Volumes, got {type(volumes)}")
        _check_choice("sample_mode", sample_mode, _SAMPLE_MODES)
        _check_choice("padding_mode", padding_mode, _PADDING_MODES)
        self._volumes = volumes
        self._sample_mode = sample_mode
        self._padding_mode = padding_mode

    def forward(self, ray_bundle: RayBundle | HeterogeneousRayBundle, **kwargs: Any) -> tuple[Tensor, Tensor | None]:
        """Densities and features at the points of the rays.

        Args:
            ray_bundle: origins (N, ..., 3) and directions (N, ..., 3) in the world, lengths (N, ..., S).
            **kwargs: ignored.

        Returns:
            Densities (N, ..., S, Cd), and features (N, ..., S, C) or None where the volumes have none.

        Raises:
            ValueError: not as many batches of rays as volumes.
        """
        if len(ray_bundle.origins) != len(self._volumes):
            raise ValueError(
                "Input volumes have to have the batch size of the rays: "
                f"got {len(self._volumes)} volumes and {len(ray_bundle.origins)} batches of rays"
            )
        points = self._local_points(ray_bundle)
        features = self._volumes.features()
        return (
            self._read(self._volumes.densities(), self._volumes.densities_list(), points),
            None if features is None else self._read(features, self._volumes.features_list() or [], points),
        )

    def _march(
        self,
        ray_bundle: RayBundle | HeterogeneousRayBundle,
        raymarcher: Callable[..., Tensor],
        kwargs: dict[str, Any],
    ) -> Tensor | None:
        """What the marcher would make of the samples, without making them; None where that is not known."""
        if (self._sample_mode, self._padding_mode) != ("bilinear", "zeros"):
            return None
        return march_in_one_pass(self._volumes, ray_bundle, raymarcher, kwargs)

    def _local_points(self, ray_bundle: RayBundle | HeterogeneousRayBundle) -> Tensor:
        """Points of the rays in local coordinates; as the map is affine, rays are all it takes. (N, ..., S, 3)"""
        origins, directions = ray_bundle.origins, ray_bundle.directions
        to_local = self._volumes.get_world_to_local_coords_transform().get_matrix()[:, :3, :3].to(directions.dtype)
        rows = directions.reshape(len(directions), math.prod(directions.shape[1:-1]), 3)
        return ray_bundle_variables_to_ray_points(
            self._volumes.world_to_local_coords(origins), (rows @ to_local).view_as(directions), ray_bundle.lengths
        )

    def _read(self, padded: Tensor, own: list[Tensor], points: Tensor) -> Tensor:
        """Values of grids at local points. (N, ..., S, C)"""
        count = math.prod(points.shape[1:-1])
        places = points.reshape(len(points), 1, 1, count, 3).to(padded.dtype)
        if all(grid.shape == padded.shape[1:] for grid in own):
            values = self._sampled(padded, places)
        else:  # local coordinates are those of each volume without its padding
            values = torch.cat([self._sampled(grid[None], at[None]) for grid, at in zip(own, places, strict=True)])
        return values.reshape(*values.shape[:2], *points.shape[1:-1]).movedim(1, -1)

    def _sampled(self, grids: Tensor, places: Tensor) -> Tensor:
        """(N, C, 1, 1, points of each)"""
        if grids.numel() == 0 or places.numel() == 0:  # grid_sample refuses these
            return grids.new_zeros(*grids.shape[:2], 1, 1, places.shape[3])
        return F.grid_sample(
            grids,
            places,
            mode=self._sample_mode,
            padding_mode=self._padding_mode,
            align_corners=self._volumes.get_align_corners(),
        )


def _check_callable(name: str, given: Any) -> None:
    if not callable(given):
        raise ValueError(f"{name} has to be callable, got {type(given).__name__}")


def _check_choice(name: str, given: str, choices: tuple[str, ...]) -> None:
    if given not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}; got {given!r}")
