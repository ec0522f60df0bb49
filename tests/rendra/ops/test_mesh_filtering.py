import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401

from rendra.loss.mesh_normal_consistency import mesh_normal_consistency
from rendra.ops.laplacian_matrices import norm_laplacian
from rendra.ops.mesh_filtering import taubin_smoothing
from rendra.renderer import TexturesVertex
from rendra.structures import Meshes
from rendra.utils import ico_sphere, torus


def _rough(level: int = 3) -> Meshes:
    sphere = ico_sphere(level)
    return sphere.offset_verts(0.03 * torch.randn_like(sphere.verts_packed()))


def test_noise_goes_and_the_size_stays() -> None:
    rough = _rough()
    smooth = taubin_smoothing(rough)
    assert mesh_normal_consistency(smooth) < 0.25 * mesh_normal_consistency(rough)
    radii = smooth.verts_packed().norm(dim=1)
    assert abs(radii.mean() - 1) < 0.01
    assert radii.std() < 0.6 * rough.verts_packed().norm(dim=1).std()
    shrunk = taubin_smoothing(rough, lambd=0.53, mu=0.53)
    assert shrunk.verts_packed().norm(dim=1).mean() < 0.95


def test_one_step_is_the_published_formula() -> None:
    rough = _rough(1)
    verts = rough.verts_packed().double()
    expected = verts
    for step in (0.4, -0.3):
        L = norm_laplacian(expected, rough.edges_packed()).to_dense()
        expected = (1 - step) * expected + step * (L @ expected) / L.sum(1, keepdim=True)
    moved = taubin_smoothing(Meshes([verts], rough.faces_list()), 0.4, -0.3, num_iter=1)
    assert_close(moved.verts_packed(), expected, atol=1e-12, rtol=1e-10)
    assert torch.equal(taubin_smoothing(rough, num_iter=0).verts_packed(), rough.verts_packed())


def test_a_batch_is_smoothed_mesh_by_mesh_and_keeps_the_rest() -> None:
    shapes = [_rough(1), torus(0.3, 1.0, 4, 7)]
    lonely = torch.tensor([[1.0, 2, 3]])
    verts = [shapes[0].verts_packed(), lonely, shapes[1].verts_packed()]
    faces = [shapes[0].faces_packed(), torch.zeros(0, 3), shapes[1].faces_packed()]
    batch = Meshes(verts, faces, TexturesVertex([v.abs() for v in verts]))
    smooth = taubin_smoothing(batch)
    assert_close(smooth.verts_list()[0], taubin_smoothing(shapes[0]).verts_packed())
    assert_close(smooth.verts_list()[1], lonely)
    assert_close(smooth.verts_list()[2], taubin_smoothing(shapes[1]).verts_packed())
    assert smooth.topology is batch.topology
    assert smooth.textures is not None
    assert len(taubin_smoothing(Meshes([], []))) == 0


def test_gradients() -> None:
    shape = ico_sphere(0)
    verts = (shape.verts_packed().double() + 0.1 * torch.randn(12, 3).double()).requires_grad_()
    smoothed = lambda v: taubin_smoothing(Meshes([v], shape.faces_list()), num_iter=2).verts_packed()  # noqa: E731
    assert torch.autograd.gradcheck(smoothed, verts)


def test_the_device_is_kept(far) -> None:  # noqa: F811
    assert isinstance(taubin_smoothing(ico_sphere(1, far).extend(2), num_iter=1).verts_packed(), Far)
