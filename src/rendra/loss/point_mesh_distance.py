"""Squared distances between the points of clouds and the faces or edges of meshes, both ways.

Notation: N pairs of a cloud and a mesh; P points, F faces (triangles), E edges (segments), all packed: those of one
pair after those of the one before. What has nothing to compare itself with (a point whose mesh has no face) has
distance zero.
"""

import torch
from torch import Tensor

from rendra.kernels.point_face_distance import nearest_face, nearest_point
from rendra.structures.meshes import Meshes
from rendra.structures.pointclouds import Pointclouds

_DEFAULT_MIN_TRIANGLE_AREA = 5e-3


def point_face_distance(
    points: Tensor,
    points_first_idx: Tensor,
    tris: Tensor,
    tris_first_idx: Tensor,
    max_points: int,
    min_triangle_area: float = _DEFAULT_MIN_TRIANGLE_AREA,
) -> Tensor:
    """Squared distance of every point to the nearest face of its own mesh.

    Args:
        points: (P, 3).
        points_first_idx: (N,) index of the first point of each cloud.
        tris: (F, 3, 3) corners of the faces.
        tris_first_idx: (N,) index of the first face of each mesh.
        max_points: most points of a cloud; of no consequence here.
        min_triangle_area: a face of less area counts as its three edges alone.

    Returns:
        (P,), differentiable in points and faces; the choice of the nearest face is not.

    Raises:
        ValueError: a shape, type, device, index or area that cannot be.
    """
    return nearest_face(points, points_first_idx, tris, tris_first_idx, min_triangle_area)[0]


def face_point_distance(
    points: Tensor,
    points_first_idx: Tensor,
    tris: Tensor,
    tris_first_idx: Tensor,
    max_tris: int,
    min_triangle_area: float = _DEFAULT_MIN_TRIANGLE_AREA,
) -> Tensor:
    """Squared distance of every face to the nearest point of its own cloud: (F,); see `point_face_distance`."""
    return nearest_point(points, points_first_idx, tris, tris_first_idx, min_triangle_area)[0]


def point_edge_distance(
    points: Tensor, points_first_idx: Tensor, segms: Tensor, segms_first_idx: Tensor, max_points: int
) -> Tensor:
    """Squared distance of every point to the nearest edge of its own mesh.

    Args:
        points: (P, 3).
        points_first_idx: (N,) index of the first point of each cloud.
        segms: (E, 2, 3) ends of the edges.
        segms_first_idx: (N,) index of the first edge of each mesh.
        max_points: most points of a cloud; of no consequence here.

    Returns:
        (P,), differentiable in points and edges; the choice of the nearest edge is not.

    Raises:
        ValueError: a shape, type, device or index that cannot be.
    """
    return nearest_face(points, points_first_idx, _flat_triangles(segms), segms_first_idx)[0]


def edge_point_distance(
    points: Tensor, points_first_idx: Tensor, segms: Tensor, segms_first_idx: Tensor, max_segms: int
) -> Tensor:
    """Squared distance of every edge to the nearest point of its own cloud: (E,); see `point_edge_distance`."""
    return nearest_point(points, points_first_idx, _flat_triangles(segms), segms_first_idx)[0]


def point_mesh_edge_distance(meshes: Meshes, pcls: Pointclouds) -> Tensor:
    """How far clouds are from the edges of meshes: the mean over points of the squared distance to the nearest edge,
    plus the mean over edges of that to the nearest point.

    Args:
        meshes: N meshes.
        pcls: N clouds.

    Returns:
        The mean over the batch, a scalar; differentiable in vertices and points.

    Raises:
        ValueError: not as many meshes as clouds.
    """
    _check_pair(meshes, pcls)
    edges, first = _corners(meshes, meshes.edges_packed()), meshes.mesh_to_edges_packed_first_idx()
    clouds = pcls.points_packed(), pcls.cloud_to_packed_first_idx()
    to_edges = point_edge_distance(*clouds, edges, first, 0)
    to_points = edge_point_distance(*clouds, edges, first, 0)
    per_mesh = meshes.num_edges_per_mesh()
    return _mean(to_edges, pcls.num_points_per_cloud()) + _mean(to_points, per_mesh)


def point_mesh_face_distance(
    meshes: Meshes, pcls: Pointclouds, min_triangle_area: float = _DEFAULT_MIN_TRIANGLE_AREA
) -> Tensor:
    """How far clouds are from the faces of meshes: the mean over points of the squared distance to the nearest face,
    plus the mean over faces of that to the nearest point.

    Args:
        meshes: N meshes.
        pcls: N clouds.
        min_triangle_area: a face of less area counts as its three edges alone.

    Returns:
        The mean over the batch, a scalar; differentiable in vertices and points.

    Raises:
        ValueError: not as many meshes as clouds, or a negative area.
    """
    _check_pair(meshes, pcls)
    tris, first = _corners(meshes, meshes.faces_packed()), meshes.mesh_to_faces_packed_first_idx()
    clouds = pcls.points_packed(), pcls.cloud_to_packed_first_idx()
    to_faces = point_face_distance(*clouds, tris, first, 0, min_triangle_area)
    to_points = face_point_distance(*clouds, tris, first, 0, min_triangle_area)
    per_mesh = meshes.num_faces_per_mesh()
    return _mean(to_faces, pcls.num_points_per_cloud()) + _mean(to_points, per_mesh)


def _check_pair(meshes: Meshes, pcls: Pointclouds) -> None:
    if len(meshes) != len(pcls):
        raise ValueError(
            f"meshes and pointclouds must be equal sized batches, got {len(meshes)} meshes and {len(pcls)} clouds"
        )


def _corners(meshes: Meshes, elements: Tensor) -> Tensor:
    """Coordinates (M, k, 3) of the vertices of faces or edges (M, k)."""
    return meshes.verts_packed().index_select(0, elements.reshape(-1)).view(*elements.shape, 3)


def _flat_triangles(segms: Tensor) -> Tensor:
    """Edges as triangles (E, 3, 3) of no area, whose second side is a point: they have the same distances."""
    if segms.ndim != 3 or segms.shape[1:] != (2, 3):
        raise ValueError(f"segms must have shape (E, 2, 3), got {tuple(segms.shape)}")
    return torch.cat([segms, segms[:, 1:]], dim=1)


def _mean(squared: Tensor, counts: Tensor) -> Tensor:
    """Mean over the batch of the mean of each member's values."""
    if len(counts) == 1:
        return squared.sum() / max(len(squared), 1)
    weights = (1 / counts).to(squared.dtype).repeat_interleave(counts, output_size=len(squared))
    return (squared * weights).sum() / max(len(counts), 1)
