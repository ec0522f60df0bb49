"""Distances of clouds to meshes: sums over a batch, edges, gradients to the vertices, devices."""

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import far

from rendra.loss import point_mesh_edge_distance, point_mesh_face_distance
from rendra.loss.point_mesh_distance import (
    edge_point_distance,
    face_point_distance,
    point_edge_distance,
    point_face_distance,
)
from rendra.structures import Meshes, Pointclouds
from rendra.utils import ico_sphere

__all__ = ["far"]
ZERO = torch.zeros(1, dtype=torch.int64)


def clouds_and_meshes(dtype=torch.float32):
    sphere, tetrahedron = ico_sphere(1), torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    verts = [sphere.verts_packed().to(dtype), torch.randn(4, 3, dtype=dtype)]
    points = [torch.randn(n, 3, dtype=dtype) for n in (30, 11)]
    return Meshes(verts, [sphere.faces_packed(), tetrahedron]), Pointclouds(points)


def segment_distance(points, segments):
    """Squared distances (P, E), by the textbook's formula."""
    a, b = segments[:, 0], segments[:, 1]
    t = ((points[:, None] - a) * (b - a)).sum(-1) / (b - a).square().sum(-1)
    return (points[:, None] - a - t.clamp(0, 1)[..., None] * (b - a)).square().sum(-1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_edges_follow_the_textbook(dtype):
    points, segments = torch.randn(50, 3, dtype=dtype), torch.randn(40, 2, 3, dtype=dtype)
    table = segment_distance(points, segments)
    assert_close(point_edge_distance(points, ZERO, segments, ZERO, 50), table.amin(1), rtol=1e-4, atol=1e-6)
    assert_close(edge_point_distance(points, ZERO, segments, ZERO, 40), table.amin(0), rtol=1e-4, atol=1e-6)


def test_gradients_of_edges_are_finite_differences():
    points = torch.randn(6, 3, dtype=torch.float64, requires_grad=True)
    segments = torch.randn(5, 2, 3, dtype=torch.float64, requires_grad=True)
    for distance in (point_edge_distance, edge_point_distance):
        assert torch.autograd.gradcheck(lambda p, s, f=distance: f(p, ZERO, s, ZERO, 6), (points, segments))


def test_the_default_area_is_half_a_percent():
    """A triangle of area 0.0045 and one of 0.0055, a point above the middle of each."""
    for area, is_edges in ((0.0045, True), (0.0055, False)):
        side = (2 * area) ** 0.5
        tris = torch.tensor([[[0.0, 0.0, 0.0], [side, 0.0, 0.0], [0.0, side, 0.0]]])
        point = torch.tensor([[side / 4, side / 4, 1.0]])
        expected = torch.tensor([1 + (side**2 / 16 if is_edges else 0)])
        assert_close(point_face_distance(point, ZERO, tris, ZERO, 1), expected, rtol=1e-6)
        assert_close(face_point_distance(point, ZERO, tris, ZERO, 1), expected, rtol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_batch_is_the_mean_of_its_pairs(dtype):
    meshes, clouds = clouds_and_meshes(dtype)
    for loss in (point_mesh_face_distance, point_mesh_edge_distance):
        pairs = [loss(meshes[i], clouds[i]) for i in range(2)]
        assert_close(loss(meshes, clouds), sum(pairs) / 2, rtol=1e-5)


def test_each_way_is_a_mean():
    meshes, clouds = clouds_and_meshes()
    mesh, cloud = meshes[0], clouds[0]
    points, tris = cloud.points_packed(), mesh.verts_packed()[mesh.faces_packed()]
    there = point_face_distance(points, ZERO, tris, ZERO, len(points)).mean()
    back = face_point_distance(points, ZERO, tris, ZERO, len(tris)).mean()
    assert_close(point_mesh_face_distance(mesh, cloud), there + back, rtol=1e-6)
    edges = mesh.verts_packed()[mesh.edges_packed()]
    table = segment_distance(points, edges)
    assert_close(point_mesh_edge_distance(mesh, cloud), table.amin(0).mean() + table.amin(1).mean(), rtol=1e-5)


def test_points_of_the_surface_are_at_distance_zero():
    sphere = ico_sphere(2)
    verts, faces = sphere.verts_packed(), sphere.faces_packed()
    edge_middles = verts[sphere.edges_packed()].mean(1)
    zero = point_mesh_edge_distance(sphere, Pointclouds([edge_middles]))
    assert zero.item() < 1e-13
    zero = point_mesh_face_distance(sphere, Pointclouds([verts[faces].mean(1)]), min_triangle_area=0.0)
    assert zero.item() < 1e-13


@pytest.mark.parametrize("loss", [point_mesh_face_distance, point_mesh_edge_distance])
def test_gradients_reach_vertices_and_points(loss):
    meshes, clouds = clouds_and_meshes(torch.float64)
    verts, points = meshes.verts_list()[1].clone(), clouds.points_list()[1].clone()
    faces = meshes.faces_list()[1]
    leaves = verts.requires_grad_(), points.requires_grad_()
    assert torch.autograd.gradcheck(lambda v, p: loss(Meshes([v], [faces]), Pointclouds([p])), leaves)


@pytest.mark.parametrize("loss", [point_mesh_face_distance, point_mesh_edge_distance])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_empty_clouds_and_meshes_add_nothing(loss, dtype):
    meshes, clouds = clouds_and_meshes(dtype)
    none, no_face = torch.zeros(0, 3, dtype=dtype), torch.zeros(0, 3, dtype=torch.int64)
    verts, points = meshes.verts_list()[0].requires_grad_(), clouds.points_list()[0].requires_grad_()
    mixed = Meshes([verts, none, verts], [meshes.faces_list()[0], no_face, meshes.faces_list()[0]])
    value = loss(mixed, Pointclouds([points, points, none]))
    assert_close(value, loss(mixed[0], Pointclouds([points])) / 3, rtol=1e-5)
    value.backward()
    assert_finite(verts.grad)
    assert_finite(points.grad)


@pytest.mark.parametrize("loss", [point_mesh_face_distance, point_mesh_edge_distance])
def test_batches_must_pair_up(loss):
    meshes, clouds = clouds_and_meshes()
    with pytest.raises(ValueError, match="equal sized batches, got 2 meshes and 1 clouds"):
        loss(meshes, clouds[0])


def test_segments_have_two_ends():
    with pytest.raises(ValueError, match=r"segms must have shape \(E, 2, 3\), got \(4, 3, 3\)"):
        point_edge_distance(torch.zeros(2, 3), ZERO, torch.zeros(4, 3, 3), ZERO, 2)


@pytest.mark.parametrize("loss", [point_mesh_face_distance, point_mesh_edge_distance])
def test_another_device_gets_the_same(loss, far):
    meshes, clouds = clouds_and_meshes()
    there = loss(meshes.to(far), clouds.to(far))
    assert_close(there.held, loss(meshes, clouds), rtol=1e-5)
