"""Rays through space, what marchers make of the samples along them, and renderers of fields and volumes."""

from rendra.renderer.implicit.renderer import ImplicitRenderer, VolumeRenderer, VolumeSampler
from rendra.renderer.implicit.utils import (
    HeterogeneousRayBundle,
    RayBundle,
    ray_bundle_to_ray_points,
    ray_bundle_variables_to_ray_points,
)

__all__ = [
    "HeterogeneousRayBundle",
    "ImplicitRenderer",
    "RayBundle",
    "VolumeRenderer",
    "VolumeSampler",
    "ray_bundle_to_ray_points",
    "ray_bundle_variables_to_ray_points",
]
