"""Rays through space, what marchers make of the samples along them, and renderers of fields and volumes."""

from rendra.renderer.implicit.harmonic_embedding import HarmonicEmbedding
from rendra.renderer.implicit.raymarching import (
    AbsorptionOnlyRaymarcher,
    EmissionAbsorptionRaymarcher,
    opacity_from_density,
)
from rendra.renderer.implicit.raysampling import (
    GridRaysampler,
    MonteCarloRaysampler,
    MultinomialRaysampler,
    NDCGridRaysampler,
    NDCMultinomialRaysampler,
)
from rendra.renderer.implicit.renderer import ImplicitRenderer, VolumeRenderer, VolumeSampler
from rendra.renderer.implicit.utils import (
    HeterogeneousRayBundle,
    RayBundle,
    ray_bundle_to_ray_points,
    ray_bundle_variables_to_ray_points,
)

__all__ = [
    "AbsorptionOnlyRaymarcher",
    "EmissionAbsorptionRaymarcher",
    "GridRaysampler",
    "HarmonicEmbedding",
    "HeterogeneousRayBundle",
    "ImplicitRenderer",
    "MonteCarloRaysampler",
    "MultinomialRaysampler",
    "NDCGridRaysampler",
    "NDCMultinomialRaysampler",
    "RayBundle",
    "VolumeRenderer",
    "VolumeSampler",
    "opacity_from_density",
    "ray_bundle_to_ray_points",
    "ray_bundle_variables_to_ray_points",
]
