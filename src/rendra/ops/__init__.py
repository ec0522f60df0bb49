"""Operators on meshes, point clouds and grids."""

from rendra.ops.ball_query import ball_query
from rendra.ops.cameras_alignment import corresponding_cameras_alignment
from rendra.ops.cubify import cubify
from rendra.ops.graph_conv import GraphConv
from rendra.ops.interp_face_attrs import interpolate_face_attributes
from rendra.ops.iou_box3d import box3d_overlap
from rendra.ops.knn import knn_gather, knn_points
from rendra.ops.laplacian_matrices import cot_laplacian, laplacian, norm_laplacian
from rendra.ops.marching_cubes import marching_cubes
from rendra.ops.mesh_face_areas_normals import mesh_face_areas_normals
from rendra.ops.mesh_filtering import taubin_smoothing
from rendra.ops.packed_to_padded import packed_to_padded, padded_to_packed
from rendra.ops.perspective_n_points import efficient_pnp
from rendra.ops.points_alignment import corresponding_points_alignment, iterative_closest_point
from rendra.ops.points_normals import estimate_pointcloud_local_coord_frames, estimate_pointcloud_normals
from rendra.ops.points_to_volumes import add_pointclouds_to_volumes, add_points_features_to_volume_densities_features
from rendra.ops.sample_farthest_points import sample_farthest_points
from rendra.ops.sample_pdf import sample_pdf
from rendra.ops.sample_points_from_meshes import sample_points_from_meshes
from rendra.ops.self_intersections import self_intersections
from rendra.ops.subdivide_meshes import SubdivideMeshes
from rendra.ops.surface_distance import SurfacePoints, distance_to_surface
from rendra.ops.utils import (
    convert_pointclouds_to_tensor,
    eyes,
    get_point_covariances,
    is_pointclouds,
    wmean,
)
from rendra.ops.vert_align import vert_align

__all__ = [
    "GraphConv",
    "SubdivideMeshes",
    "SurfacePoints",
    "add_pointclouds_to_volumes",
    "add_points_features_to_volume_densities_features",
    "ball_query",
    "box3d_overlap",
    "convert_pointclouds_to_tensor",
    "corresponding_cameras_alignment",
    "corresponding_points_alignment",
    "cot_laplacian",
    "cubify",
    "distance_to_surface",
    "efficient_pnp",
    "estimate_pointcloud_local_coord_frames",
    "estimate_pointcloud_normals",
    "eyes",
    "get_point_covariances",
    "interpolate_face_attributes",
    "is_pointclouds",
    "iterative_closest_point",
    "knn_gather",
    "knn_points",
    "laplacian",
    "marching_cubes",
    "mesh_face_areas_normals",
    "norm_laplacian",
    "packed_to_padded",
    "padded_to_packed",
    "sample_farthest_points",
    "sample_pdf",
    "sample_points_from_meshes",
    "self_intersections",
    "taubin_smoothing",
    "vert_align",
    "wmean",
]
