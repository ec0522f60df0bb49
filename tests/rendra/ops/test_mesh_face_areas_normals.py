import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.ops.mesh_face_areas_normals import mesh_face_areas_normals
from rendra.transforms import random_rotation
from rendra.utils import ico_sphere, torus


def test_a_right_triangle() -> None:
    verts = torch.tensor([[0.0, 0, 0], [3, 0, 0], [0, 4, 0]])
    areas, normals = mesh_face_areas_normals(verts, torch.tensor([[0, 1, 2], [0, 2, 1]]))
    assert_close(areas, [6.0, 6.0])
    assert_close(normals, [[0.0, 0, 1], [0, 0, -1]])


def test_the_same_as_of_meshes() -> None:
    mesh = torus(0.3, 1.0, 5, 7)
    areas, normals = mesh_face_areas_normals(mesh.verts_packed(), mesh.faces_packed())
    assert_close(areas, mesh.faces_areas_packed())
    assert_close(normals, mesh.faces_normals_packed())


def test_a_closed_surface_has_no_mean_normal_and_turns_with_its_frame() -> None:
    sphere, rotation = ico_sphere(2), random_rotation()
    areas, normals = mesh_face_areas_normals(sphere.verts_packed(), sphere.faces_packed())
    assert_close(areas @ normals, torch.zeros(3))
    turned = mesh_face_areas_normals(2 * sphere.verts_packed() @ rotation, sphere.faces_packed())
    assert_close(turned[0], 4 * areas)
    assert_close(turned[1], normals @ rotation)


def test_gradients_also_of_degenerate_faces() -> None:
    verts = torch.rand(5, 3, dtype=torch.float64, requires_grad=True)
    faces = torch.tensor([[0, 1, 2], [2, 3, 4]])
    assert torch.autograd.gradcheck(lambda v: mesh_face_areas_normals(v, faces), verts)
    areas, normals = mesh_face_areas_normals(verts, torch.tensor([[0, 0, 1], [2, 2, 2]]))
    (areas.sum() + normals.sum()).backward()
    assert_close(areas, torch.zeros(2))
    assert_close(normals, torch.zeros(2, 3))
    assert_finite(verts.grad)


def test_no_faces_and_wrong_shapes() -> None:
    areas, normals = mesh_face_areas_normals(torch.rand(3, 3), torch.zeros(0, 3, dtype=torch.int64))
    assert areas.shape == (0,)
    assert normals.shape == (0, 3)
    with pytest.raises(ValueError, match=r"verts must have shape \(V, 3\), got \(1, 3, 3\)"):
        mesh_face_areas_normals(torch.rand(1, 3, 3), torch.zeros(1, 3, dtype=torch.int64))
    with pytest.raises(ValueError, match=r"faces must have shape \(F, 3\), got \(1, 4\)"):
        mesh_face_areas_normals(torch.rand(3, 3), torch.zeros(1, 4, dtype=torch.int64))


def test_the_device_is_kept(far) -> None:  # noqa: F811
    sphere = ico_sphere(0, far)
    assert all(isinstance(t, Far) for t in mesh_face_areas_normals(sphere.verts_packed(), sphere.faces_packed()))
