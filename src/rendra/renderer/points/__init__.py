"""Rendering of point clouds."""

from rendra.renderer.points.compositor import AlphaCompositor, NormWeightedCompositor
from rendra.renderer.points.rasterize_points import rasterize_points
from rendra.renderer.points.rasterizer import PointFragments, PointsRasterizationSettings, PointsRasterizer
from rendra.renderer.points.renderer import PointsRenderer

__all__ = [
    "AlphaCompositor",
    "NormWeightedCompositor",
    "PointFragments",
    "PointsRasterizationSettings",
    "PointsRasterizer",
    "PointsRenderer",
    "rasterize_points",
]
