"""Operators on meshes, point clouds and grids."""

from rendra.ops.ball_query import ball_query
from rendra.ops.interp_face_attrs import interpolate_face_attributes
from rendra.ops.knn import knn_gather, knn_points
from rendra.ops.mesh_face_areas_normals import mesh_face_areas_normals
from rendra.ops.sample_points_from_meshes import sample_points_from_meshes
from rendra.ops.subdivide_meshes import SubdivideMeshes

__all__ = [
    "SubdivideMeshes",
    "ball_query",
    "interpolate_face_attributes",
    "knn_gather",
    "knn_points",
    "mesh_face_areas_normals",
    "sample_points_from_meshes",
]
