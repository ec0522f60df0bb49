"""What the faces of a mesh imply for its edges: checked by counting, and against dense matrices."""

from itertools import combinations

import torch
from assertions import assert_close

from rendra.structures import Meshes
from rendra.utils import ico_sphere, torus

FAN = torch.tensor([[0, 1, 2], [1, 0, 3], [0, 1, 4], [5, 1, 0]])  # four faces at the edge 01


def _meshes() -> Meshes:
    shapes = [ico_sphere(0), torus(0.3, 1.0, 3, 5)]
    verts = [shapes[0].verts_packed(), torch.rand(6, 3), torch.rand(2, 3), shapes[1].verts_packed()]
    return Meshes(
        verts, [shapes[0].faces_packed(), FAN, torch.zeros(0, 3, dtype=torch.int64), shapes[1].faces_packed()]
    )


def test_every_two_faces_at_an_edge_are_a_pair() -> None:
    meshes = _meshes()
    faces = [set(face) for face in meshes.faces_packed().tolist()]
    expected = [(i, j) for i, j in combinations(range(len(faces)), 2) if len(faces[i] & faces[j]) == 2]
    pairs = meshes.topology.face_pairs
    assert sorted(tuple(sorted(pair)) for pair in pairs.tolist()) == expected
    counts = torch.bincount(meshes.topology.face_pairs_to_mesh, minlength=4)
    assert counts.tolist() == [30, 6, 0, 45]  # a closed mesh has as many as edges


def test_no_pairs() -> None:
    assert Meshes([torch.rand(3, 3)], [torch.tensor([[0, 1, 2]])]).topology.face_pairs.shape == (0, 2)
    assert Meshes([], []).topology.face_pairs.shape == (0, 2)
    assert Meshes([torch.rand(3, 3)], [torch.zeros(0, 3)]).topology.face_pairs_to_mesh.shape == (0,)


def test_matrices_do_what_they_say() -> None:
    meshes = _meshes()
    topology, verts = meshes.topology, meshes.verts_packed()
    v0, v1 = verts[meshes.edges_packed()].unbind(1)
    assert_close(topology.edge_differences(torch.float32) @ verts, v1 - v0)
    assert_close(topology.edge_sums(torch.float32) @ verts, v1 + v0)
    assert_close(topology.laplacian_matrix(torch.float32) @ verts, meshes.laplacian_packed() @ verts)
    corners = torch.rand(3 * len(meshes.faces_packed()), 1)
    at_verts = torch.zeros(len(verts), 1).index_add(0, meshes.faces_packed().view(-1), corners)
    assert_close(topology.corners_to_verts(torch.float32) @ corners, at_verts)
    at_edges = torch.zeros(len(v0), 1).index_add(0, meshes.faces_packed_to_edges_packed().view(-1), corners)
    assert_close(topology.corners_to_edges(torch.float32) @ corners, at_edges)


def test_normals_are_turned_where_the_windings_disagree() -> None:
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])  # flat
    for faces in ([[0, 1, 2], [2, 1, 3]], [[0, 1, 2], [1, 2, 3]], [[2, 1, 0], [3, 1, 2]]):
        mesh = Meshes([verts], [torch.tensor(faces)])
        difference = mesh.topology.normal_differences(torch.float32) @ mesh.faces_normals_packed()
        assert_close(difference, torch.zeros(1, 3))


def test_moved_meshes_share_what_was_computed() -> None:
    sphere = ico_sphere(1)
    moved = sphere.offset_verts(torch.rand(42, 3)).scale_verts(2.0)
    assert moved.update_padded(moved.verts_padded()).topology is sphere.topology
    assert sphere.topology.edge_sums(torch.float32) is moved.topology.edge_sums(torch.float32)
    assert sphere.topology.edge_sums(torch.float64) is not moved.topology.edge_sums(torch.float32)


def test_made_in_inference_mode_it_serves_training() -> None:
    sphere = ico_sphere(1)
    with torch.inference_mode():
        sphere.topology.normal_differences(torch.float32).transposed  # noqa: B018
        sphere.topology.laplacian_matrix(torch.float32).transposed  # noqa: B018
    offsets = torch.zeros(42, 3, requires_grad=True)
    moved = sphere.offset_verts(offsets)
    laplacian = sphere.topology.laplacian_matrix(torch.float32) @ moved.verts_packed()
    normals = sphere.topology.normal_differences(torch.float32) @ moved.faces_normals_packed()
    (laplacian.square().sum() + normals.square().sum()).backward()
    assert offsets.grad.abs().sum() > 0
