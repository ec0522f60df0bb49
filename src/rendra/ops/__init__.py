"""Operators on meshes, point clouds and grids."""

from rendra.ops.ball_query import ball_query
from rendra.ops.graph_conv import GraphConv, gather_scatter
from rendra.ops.interp_face_attrs import interpolate_face_attributes
from rendra.ops.knn import knn_gather, knn_points
from rendra.ops.laplacian_matrices import cot_laplacian, laplacian, norm_laplacian
from rendra.ops.mesh_face_areas_normals import mesh_face_areas_normals
from rendra.ops.mesh_filtering import taubin_smoothing
from rendra.ops.sample_points_from_meshes import sample_points_from_meshes
from rendra.ops.subdivide_meshes import SubdivideMeshes
from rendra.ops.vert_align import vert_align

__all__ = [
    "GraphConv",
    "SubdivideMeshes",
    "ball_query",
    "cot_laplacian",
    "interpolate_face_attributes",
    "knn_gather",
    "knn_points",
    "laplacian",
    "mesh_face_areas_normals",
    "norm_laplacian",
    "sample_points_from_meshes",
    "taubin_smoothing",
    "vert_align",
]
