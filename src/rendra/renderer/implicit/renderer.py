"""Renderers of what has no surface: rays are cast, something is asked about points along them, a marcher sums up."""

from collections.abc import Callable
from typing import Any

from torch import Tensor, nn

from rendra.renderer.camera_base import CamerasBase
from rendra.renderer.implicit.utils import HeterogeneousRayBundle, RayBundle

__all__ = ["ImplicitRenderer"]


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
        densities, features = volumetric_function(ray_bundle=ray_bundle, cameras=cameras, **kwargs)
        images = self.raymarcher(rays_densities=densities, rays_features=features, ray_bundle=ray_bundle, **kwargs)
        return images, ray_bundle


def _check_callable(name: str, given: Any) -> None:
    if not callable(given):
        raise ValueError(f"{name} has to be callable, got {type(given).__name__}")
