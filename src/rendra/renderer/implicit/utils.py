"""Bundles of rays, and the points along them.

Letters: N cameras, S samples along a ray; (...) is the shape in which the rays are arranged, as (H, W) of an image.
"""

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor


class RayBundle(NamedTuple):
    """Rays of a batch of cameras, and where on each to take samples.

    A sample lies at origin + length * direction. Directions need not have length 1: those of the ray samplers go
    one unit of view depth, so that lengths are depths.
    """

    origins: Tensor  # (N, ..., 3) world
    directions: Tensor  # (N, ..., 3) world
    lengths: Tensor  # (N, ..., S) in units of the directions
    xys: Tensor  # (N, ..., 2) where the ray meets the image, usually NDC


@dataclass
class HeterogeneousRayBundle:
    """Rays of which every camera has its own number: those of one camera stand together, cameras ascending.

    The first four fields are as of `RayBundle`, with the number of all rays in place of N.
    """

    origins: Tensor  # (R, ..., 3)
    directions: Tensor  # (R, ..., 3)
    lengths: Tensor  # (R, ..., S)
    xys: Tensor  # (R, ..., 2)
    camera_ids: Tensor | None = None  # (M,) which cameras have rays
    camera_counts: Tensor | None = None  # (M,) how many rays each of these has; they sum to R


def ray_bundle_to_ray_points(ray_bundle: RayBundle | HeterogeneousRayBundle) -> Tensor:
    """The sample points (N, ..., S, 3) of a bundle, in world coordinates."""
    return ray_bundle_variables_to_ray_points(ray_bundle.origins, ray_bundle.directions, ray_bundle.lengths)


def ray_bundle_variables_to_ray_points(rays_origins: Tensor, rays_directions: Tensor, rays_lengths: Tensor) -> Tensor:
    """The points origin + length * direction.

    Args:
        rays_origins: (..., 3).
        rays_directions: (..., 3).
        rays_lengths: (..., S).

    Returns:
        (..., S, 3), differentiable with respect to all.
    """
    return rays_origins[..., None, :] + rays_lengths[..., None] * rays_directions[..., None, :]
