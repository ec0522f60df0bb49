"""The fused silhouette against its reference, against fragments, and against closed forms."""

import pytest
import torch
from assertions import assert_close, assert_finite
from scenes import BLUR, packed, soup, with_monsters

from rendra.kernels.rasterize_meshes import rasterize_meshes
from rendra.kernels.soft_silhouette import numba_cpu, soft_silhouette

SIGMA = 1e-4


def silhouette(faces, counts=None, size=(24, 24), blur=BLUR, sigma=SIGMA, cull=False, neighbor=None):
    return soft_silhouette(faces, *packed(*(counts or (len(faces),))), neighbor, size, blur, sigma, cull)


@pytest.mark.parametrize("size", [(24, 24), (17, 31), (31, 17), (1, 1), (9, 40)])
@pytest.mark.parametrize(("blur", "sigma"), [(BLUR, SIGMA), (0.05, 1e-2), (0.0, 1e-3)])
@pytest.mark.parametrize("cull", [True, False])
def test_value_and_gradient_agree_with_the_reference_in_float64(size, blur, sigma, cull):
    faces = with_monsters(soup(50))
    single, double = faces.clone().requires_grad_(), faces.double().requires_grad_()
    fast, slow = (silhouette(v, size=size, blur=blur, sigma=sigma, cull=cull) for v in (single, double))
    off = (fast - slow).abs() > 2e-5
    assert off.sum() <= 1  # a counted allowance: a pixel on the blur radius
    weight = torch.randn_like(fast) * ~off
    (fast * weight).sum().backward()
    (slow * weight.double()).sum().backward()
    assert_finite(single.grad)
    assert (single.grad - double.grad).norm() <= 1e-4 * double.grad.norm() + 1e-6


def test_agrees_with_the_blend_of_all_fragments():
    faces = soup(40, seed=1)
    _, _, _, dists = pix = rasterize_meshes(faces, *packed(25, 15), None, (30, 20), BLUR, 40, True, True, False)
    coverage = torch.where(pix[0] >= 0, torch.sigmoid(-dists / SIGMA), 0.0)
    assert_close(silhouette(faces, counts=(25, 15), size=(30, 20)), 1 - (1 - coverage).prod(-1), atol=2e-6)


def test_more_faces_a_pixel_than_any_limit():
    """500 equal faces far from the pixel: 1 - (1 - p)^500."""
    face = torch.tensor([[[-0.5, -0.5, 2.0], [0.5, -0.5, 2.0], [0.0, -0.9, 2.0]]])
    alpha = silhouette(face.repeat(500, 1, 1), size=(2, 2), blur=1.0, sigma=0.25)
    one = silhouette(face, size=(2, 2), blur=1.0, sigma=0.25).double()
    assert_close(alpha, (1 - (1 - one) ** 500).float(), atol=1e-4)
    assert 0.4 < one[0, 1, 0] < 0.7


def test_half_a_plane_is_a_sigmoid_of_the_squared_distance():
    """A huge face with one edge at x = 0: alpha = sigmoid(+-x^2 / sigma)."""
    face = torch.tensor([[[0.0, -50.0, 1.0], [50.0, 0.0, 1.0], [0.0, 50.0, 1.0]]])
    alpha = silhouette(face, size=(16, 16), blur=4.0, sigma=0.1)[0]
    x = torch.arange(15, -16, -2) / 16
    assert_close(alpha[8], torch.sigmoid(x.sign() * x**2 / 0.1), atol=1e-5)


def test_empty_images_are_transparent():
    assert (silhouette(torch.zeros(0, 3, 3), counts=(0, 0)) == 0).all()
    assert silhouette(soup(5), counts=(5, 0))[1].max() == 0


def test_halves_of_a_clipped_face_count_once():
    square = torch.tensor([[-0.6, -0.6, 2.0], [0.6, -0.6, 2.0], [0.6, 0.6, 2.0], [-0.6, 0.6, 2.0]])
    halves = torch.stack([square[[0, 1, 2]], square[[0, 2, 3]]])
    neighbor = torch.tensor([1, 0])
    single, double = halves.clone().requires_grad_(), halves.double().requires_grad_()
    fast, slow = (
        silhouette(single, neighbor=neighbor, size=(47, 48)),
        silhouette(double, neighbor=neighbor, size=(47, 48)),
    )
    assert_close(fast, slow.float(), atol=1e-5)
    assert (fast < silhouette(halves, size=(47, 48)) - 1e-3).any()
    fast.square().sum().backward()
    slow.square().sum().backward()
    assert (single.grad - double.grad).norm() <= 1e-4 * double.grad.norm()


def test_every_element_is_written():
    survival = torch.full((2, 11, 13), float("nan"))
    first, num = packed(10, 20)
    none = torch.full((30,), -1)
    numba_cpu.forward(
        soup(30).numpy(), first.numpy(), num.numpy(), none.numpy(), BLUR, SIGMA, False, survival.numpy()
    )
    assert_finite(survival)


def test_results_do_not_depend_on_threads():
    threads, results = torch.get_num_threads(), []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        leaf = soup(80, seed=4).requires_grad_()
        alpha = silhouette(leaf, size=(50, 40))
        alpha.square().sum().backward()
        results.append((alpha.detach(), leaf.grad))
    torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_reference_gradients_are_finite_differences():
    faces = soup(6, seed=6, reach=0.6).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda v: silhouette(v, size=(6, 7), blur=0.05, sigma=0.02), (faces,), atol=1e-4)


def test_the_operator_is_well_registered():
    first, num = packed(8)
    arguments = (soup(8).requires_grad_(), first, num, None, 6, 5, 0.01, 1e-3, False)
    torch.library.opcheck(torch.ops.rendra.soft_silhouette.default, arguments)


def test_bad_sigma_is_named():
    with pytest.raises(ValueError, match="sigma must be positive"):
        silhouette(soup(3), sigma=0.0)


@pytest.mark.gpu
def test_cuda_takes_the_reference():
    faces = soup(40)
    first, num = packed(40)
    leaf = faces.cuda().requires_grad_()
    cuda = soft_silhouette(leaf, first.cuda(), num.cuda(), None, (32, 24), BLUR, SIGMA, False)
    assert_close(cuda.detach().cpu(), silhouette(faces, size=(32, 24)), atol=1e-4)
    cuda.sum().backward()
    assert_finite(leaf.grad)
