"""Operators on meshes, point clouds and grids."""

from rendra.ops.interp_face_attrs import interpolate_face_attributes
from rendra.ops.subdivide_meshes import SubdivideMeshes

__all__ = ["SubdivideMeshes", "interpolate_face_attributes"]
