"""Operators on meshes, point clouds and grids."""

from rendra.ops.subdivide_meshes import SubdivideMeshes

__all__ = ["SubdivideMeshes"]
