"""A rasterizer and a compositor put together."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rendra.common.datatypes import Device
from rendra.renderer.points.rasterize_points import Radius, packed_radius
from rendra.renderer.points.rasterizer import PointFragments
from rendra.structures.pointclouds import Pointclouds


class PointsRenderer(nn.Module):
    """Point clouds to images: rasterize, weigh each point by 1 - d^2 / r^2, then composite."""

    def __init__(self, rasterizer: nn.Module, compositor: nn.Module) -> None:
        """Keep a rasterizer (clouds -> fragments) and a compositor (indices, weights, features -> images)."""
        super().__init__()
        self.rasterizer = rasterizer
        self.compositor = compositor

    def to(self, device: Device) -> "PointsRenderer":  # type: ignore[override]
        """Move the parts."""
        self.rasterizer = self.rasterizer.to(device)
        self.compositor = self.compositor.to(device)
        return self

    def forward(self, point_clouds: Pointclouds, **kwargs: Any) -> Tensor:
        """Render clouds in world coordinates.

        Args:
            point_clouds: batch of N with features of C channels.
            **kwargs: passed to both parts: cameras, R, T, raster_settings, background_color.

        Returns:
            (N, H, W, C), differentiable in points, features, and radii where they are tensors.

        Raises:
            ValueError: the clouds have no features.
        """
        features = point_clouds.features_packed()
        if features is None:
            raise ValueError("PointsRenderer draws features, and these point clouds have none: give features")
        settings = kwargs.get("raster_settings", self.rasterizer.raster_settings)
        fragments = self.rasterizer(point_clouds, **kwargs)
        weights = _weights(fragments, settings.radius, point_clouds)
        images = self.compositor(
            fragments.idx.long().permute(0, 3, 1, 2), weights.permute(0, 3, 1, 2), features.permute(1, 0), **kwargs
        )
        return images.permute(0, 2, 3, 1)


def _weights(fragments: PointFragments, radius: Radius, point_clouds: Pointclouds) -> Tensor:
    """1 - d^2 / r^2 (N, H, W, K): 1 at a point, 0 at the rim of its disc; 0 in empty slots."""
    is_empty = fragments.idx < 0
    squared: Tensor | float
    if isinstance(radius, (int, float)):
        squared = radius * radius
    else:
        # empty slots take a radius of 1 from behind the last point: so there is one where there are no points
        radii = F.pad(packed_radius(radius, point_clouds), (0, 1), value=1.0)
        place = torch.where(is_empty, len(radii) - 1, fragments.idx)
        squared = radii.index_select(0, place.flatten()).view(place.shape).square()
    return torch.where(is_empty, 0.0, 1 - fragments.dists / squared)
