"""The losses that keep a deforming mesh well shaped: closed forms, invariances, anchors, finite differences."""

import math
from collections.abc import Callable

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401
from torch import Tensor

from rendra.loss.mesh_edge_loss import mesh_edge_loss
from rendra.loss.mesh_laplacian_smoothing import mesh_laplacian_smoothing
from rendra.loss.mesh_normal_consistency import mesh_normal_consistency
from rendra.ops.laplacian_matrices import cot_laplacian
from rendra.structures import Meshes
from rendra.transforms import random_rotation
from rendra.utils import ico_sphere, torus

NO_FACES = torch.zeros(0, 3, dtype=torch.int64)


def uniform(meshes: Meshes) -> Tensor:
    return mesh_laplacian_smoothing(meshes)


def cot(meshes: Meshes) -> Tensor:
    return mesh_laplacian_smoothing(meshes, method="cot")


def cotcurv(meshes: Meshes) -> Tensor:
    return mesh_laplacian_smoothing(meshes, "cotcurv")


def to_length(meshes: Meshes) -> Tensor:
    return mesh_edge_loss(meshes, target_length=0.7)


LOSSES = [mesh_edge_loss, to_length, mesh_normal_consistency, uniform, cot, cotcurv]
Loss = Callable[[Meshes], Tensor]


def _bumpy(dtype: torch.dtype = torch.float64, level: int = 1) -> Meshes:
    sphere = ico_sphere(level)
    verts = sphere.verts_packed().to(dtype)
    return Meshes([verts + 0.1 * torch.randn_like(verts)], [sphere.faces_packed()])


def _grid(size: int = 5, bend: float = 0.0) -> Meshes:
    """A square of size^2 vertices one apart; folded along the diagonal x = y by `bend`."""
    x, y = torch.meshgrid(torch.arange(float(size)), torch.arange(float(size)), indexing="ij")
    corner = (torch.arange(size - 1)[:, None] * size + torch.arange(size - 1)).reshape(-1, 1)
    faces = torch.cat([corner + torch.tensor([0, size, size + 1]), corner + torch.tensor([0, size + 1, 1])])
    z = bend * (x - y).clamp_min(0)
    return Meshes([torch.stack([x, y, z], -1).view(-1, 3).double()], [faces])


@pytest.mark.parametrize(
    ("loss", "expected"),
    [
        (mesh_edge_loss, 1.1056),
        (uniform, 0.5528),
        (cot, 0.5528),
        (cotcurv, 0.3333),
        (mesh_normal_consistency, 0.2546),
    ],
)
def test_the_icosahedron(loss: Loss, expected: float) -> None:
    """Numbers obtained by running PyTorch3D 0.7.9."""
    assert_close(loss(ico_sphere(0)), expected, atol=5e-5, rtol=0)


def test_edge_lengths_of_a_tetrahedron() -> None:
    verts = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    mesh = Meshes([verts], [torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])])
    assert_close(mesh_edge_loss(mesh), 8.0)
    assert_close(mesh_edge_loss(mesh, 8**0.5), 0.0)
    assert_close(mesh_edge_loss(mesh, 1.0), (8**0.5 - 1) ** 2)


@pytest.mark.parametrize("angle", [0.0, 0.01, 1.0, math.pi / 2, 3.0, math.pi])
@pytest.mark.parametrize("faces", [[[0, 1, 2], [1, 0, 3]], [[0, 1, 2], [0, 1, 3]]])
def test_a_hinge_costs_one_minus_the_cosine(angle: float, faces: list) -> None:
    wing = [0.3, -math.cos(angle), math.sin(angle)]
    mesh = Meshes([torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.2, 1, 0], wing])], [torch.tensor(faces)])
    assert_close(mesh_normal_consistency(mesh), 1 - math.cos(angle), atol=1e-7)


def test_three_sheets_at_an_edge_make_three_pairs() -> None:
    verts = [[0.0, 0, 0], [0, 0, 1]] + [[math.cos(a), math.sin(a), 0] for a in (0, 2 * math.pi / 3, 4 * math.pi / 3)]
    mesh = Meshes([torch.tensor(verts)], [torch.tensor([[0, 1, 2], [0, 1, 3], [1, 0, 4]])])
    assert_close(mesh_normal_consistency(mesh), 1 - math.cos(math.pi / 3))  # every two are 60 degrees from flat


def test_a_plane_costs_at_its_boundary_only() -> None:
    plane, boundary = _grid(), torch.ones(5, 5, dtype=torch.bool)
    boundary[1:-1, 1:-1] = False
    assert_close(mesh_normal_consistency(plane), 0.0, atol=1e-12)
    laplacian = plane.laplacian_packed() @ plane.verts_packed()
    assert_close(uniform(plane), laplacian[boundary.view(-1)].norm(dim=1).sum() / 25)
    weights, inverse_areas = cot_laplacian(plane.verts_packed(), plane.faces_packed())
    pulls = weights @ plane.verts_packed() - weights.to_dense().sum(1, keepdim=True) * plane.verts_packed()
    at_boundary = (0.25 * pulls * inverse_areas)[boundary.view(-1)]
    assert_close(cotcurv(plane), at_boundary.norm(dim=1).sum() / 25)


@pytest.mark.parametrize("radius", [0.5, 2.0])
def test_cotcurv_is_a_third_of_the_mean_curvature(radius: float) -> None:
    sphere = ico_sphere(4).scale_verts(radius)
    assert_close(cotcurv(sphere), 1 / (3 * radius), rtol=2e-3)


@pytest.mark.parametrize("loss", LOSSES)
def test_rigid_motion_changes_nothing(loss: Loss) -> None:
    mesh = _bumpy()
    moved = mesh.verts_packed() @ random_rotation(dtype=torch.float64) + torch.tensor([1.0, -2, 3])
    assert_close(loss(mesh.update_padded(moved[None])), loss(mesh), rtol=1e-9)


@pytest.mark.parametrize(("loss", "power"), [(mesh_edge_loss, 2), (uniform, 1), (cot, 1), (cotcurv, -1),
                                             (mesh_normal_consistency, 0)])  # fmt: skip
@pytest.mark.parametrize("scale", [1e-2, 1e3])
def test_scale_counts_with_its_power(loss: Loss, power: int, scale: float) -> None:
    mesh = _bumpy()
    assert_close(loss(mesh.scale_verts(scale)), loss(mesh) * scale**power, rtol=1e-9, atol=0)


def test_normals_of_a_tiny_mesh_count_as_those_of_a_large_one() -> None:
    sphere = ico_sphere(3)
    assert_close(mesh_normal_consistency(sphere.scale_verts(1e-5)), mesh_normal_consistency(sphere), rtol=1e-4)


@pytest.mark.parametrize("loss", LOSSES)
def test_order_and_winding_of_faces_do_not_matter(loss: Loss) -> None:
    mesh = _bumpy()
    faces = mesh.faces_packed()[torch.randperm(80)]
    faces[::3] = faces[::3].flip(1)
    assert_close(loss(Meshes(mesh.verts_list(), [faces])), loss(mesh), rtol=1e-9)


@pytest.mark.parametrize("loss", LOSSES)
def test_a_batch_costs_the_mean_of_its_meshes(loss: Loss) -> None:
    shapes = [_bumpy(), _grid(4, 0.5), _bumpy(level=0)]
    alone = torch.stack([loss(mesh) for mesh in shapes])
    verts, faces = [m.verts_packed() for m in shapes], [m.faces_packed() for m in shapes]
    assert_close(loss(Meshes(verts, faces)), alone.mean(), rtol=1e-9)
    with_empty = Meshes([*verts, torch.zeros(0, 3).double()], [*faces, NO_FACES])
    assert_close(loss(with_empty), alone.sum() / 4, rtol=1e-9)


@pytest.mark.parametrize("loss", [mesh_edge_loss, to_length, mesh_normal_consistency, uniform])
def test_gradients_by_finite_differences(loss: Loss) -> None:
    mesh = _bumpy(level=0)
    verts = mesh.verts_packed().requires_grad_()
    assert torch.autograd.gradcheck(lambda v: loss(mesh.update_padded(v[None])), verts)
    assert torch.autograd.gradgradcheck(lambda v: loss(mesh.update_padded(v[None])), verts)


@pytest.mark.parametrize("method", ["cot", "cotcurv"])
def test_gradients_hold_the_weights_fixed(method: str) -> None:
    mesh = _bumpy(level=0)
    verts = mesh.verts_packed().requires_grad_()
    weights, inverse_areas = (t.to_dense() for t in cot_laplacian(verts.detach(), mesh.faces_packed()))
    total = weights.sum(1, keepdim=True)
    factor = 0.25 * inverse_areas if method == "cotcurv" else 1 / total
    plain = ((weights @ verts - total * verts) * factor).norm(dim=1).mean()
    ours = mesh_laplacian_smoothing(mesh.update_padded(verts[None]), method)
    assert_close(ours, plain, rtol=1e-9)
    assert_close(torch.autograd.grad(ours, verts)[0], torch.autograd.grad(plain, verts)[0], atol=1e-12, rtol=1e-9)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_faces_have_finite_gradients(loss: Loss, dtype: torch.dtype) -> None:
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 0, 0], [0, 1, 0], [7, 7, 7]], dtype=dtype)
    faces = [[0, 1, 2], [0, 1, 3], [0, 1, 4], [3, 3, 4], [1, 4, 2], [1, 1, 1]]  # a line, coinciding corners, a point
    verts.requires_grad_()
    value = loss(Meshes([verts], [torch.tensor(faces)]))
    value.backward()
    assert_finite(value)
    assert_finite(verts.grad)


def test_a_face_without_area_is_orthogonal_to_all() -> None:
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0]], requires_grad=True)
    value = mesh_normal_consistency(Meshes([verts], [torch.tensor([[0, 1, 2], [1, 0, 3]])]))
    assert_close(value, 1.0)
    value.backward()
    assert_close(verts.grad, torch.zeros(4, 3))


def test_a_vertex_without_neighbours_counts_its_own_length() -> None:
    verts = torch.cat([ico_sphere(0).verts_packed(), torch.tensor([[3.0, 0, 4]])])
    mesh = Meshes([verts], [ico_sphere(0).faces_packed()])
    for method in ("uniform", "cot"):
        assert_close(mesh_laplacian_smoothing(mesh, method), (12 * 0.552786 + 5) / 13)
    assert_close(cotcurv(mesh), 4 / 13)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("meshes", [Meshes([], []), Meshes([torch.rand(3, 3)], [NO_FACES])])
def test_nothing_costs_nothing(loss: Loss, meshes: Meshes) -> None:
    value = loss(meshes)
    assert value.shape == (1,)
    assert value == 0
    value.backward()


def test_a_mesh_without_pairs_of_faces_is_consistent() -> None:
    verts = torch.rand(3, 3, requires_grad=True)
    value = mesh_normal_consistency(Meshes([verts], [torch.tensor([[0, 1, 2]])]))
    value.backward()
    assert value == 0
    assert_close(verts.grad, torch.zeros(3, 3))


def test_unknown_methods_are_named() -> None:
    with pytest.raises(ValueError, match=r"Method should be one of \{uniform, cot, cotcurv\}, got 'cots'"):
        mesh_laplacian_smoothing(ico_sphere(0), "cots")


@pytest.mark.parametrize("loss", LOSSES)
def test_threads_do_not_show(loss: Loss) -> None:
    sphere, before = ico_sphere(4), torch.get_num_threads()
    offsets = 0.01 * torch.randn(2562, 3)
    results = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            leaf = offsets.clone().requires_grad_()
            value = loss(sphere.offset_verts(leaf))
            value.backward()
            results.append((value.detach(), leaf.grad))
    finally:
        torch.set_num_threads(before)
    for value, gradient in results[1:]:
        assert_close(value, results[0][0], rtol=1e-6)
        assert torch.equal(gradient, results[0][1])


@pytest.mark.parametrize("loss", LOSSES)
def test_the_device_is_kept(far, loss: Loss) -> None:  # noqa: F811
    values = []
    for device in (far, "cpu"):
        offsets = torch.zeros(132, 3, device=device, requires_grad=True)
        batch = ico_sphere(0, device).extend(11).scale_verts(1.0)
        value = loss(batch.offset_verts(offsets))
        value.backward()
        values.append((value, offsets.grad))
    assert isinstance(values[0][0], Far)
    assert_close(values[0][0].detach().cpu(), values[1][0].detach())
    assert_close(values[0][1].cpu(), values[1][1])


def test_descent_smooths_a_rough_torus() -> None:
    ring = torus(0.3, 1.0, 8, 16)
    offsets = (0.03 * torch.randn_like(ring.verts_packed())).requires_grad_()
    before = mesh_normal_consistency(ring.offset_verts(offsets)).item()
    optimizer = torch.optim.SGD([offsets], lr=0.1)
    for _ in range(30):
        optimizer.zero_grad()
        mesh_normal_consistency(ring.offset_verts(offsets)).backward()
        optimizer.step()
    assert mesh_normal_consistency(ring.offset_verts(offsets)).item() < 0.8 * before
    assert mesh_normal_consistency(ring).item() < 0.8 * before
