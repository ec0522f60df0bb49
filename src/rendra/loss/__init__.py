"""Losses on meshes and point clouds."""

from rendra.loss.chamfer import chamfer_distance
from rendra.loss.mesh_edge_loss import mesh_edge_loss
from rendra.loss.mesh_laplacian_smoothing import mesh_laplacian_smoothing
from rendra.loss.mesh_normal_consistency import mesh_normal_consistency
from rendra.loss.point_mesh_distance import point_mesh_edge_distance, point_mesh_face_distance

__all__ = [
    "chamfer_distance",
    "mesh_edge_loss",
    "mesh_laplacian_smoothing",
    "mesh_normal_consistency",
    "point_mesh_edge_distance",
    "point_mesh_face_distance",
]
