"""Blending: published formulas, limits, anchors and derivatives, on fragments made by hand."""

from dataclasses import dataclass

import pytest
import torch
from assertions import assert_close, assert_finite
from torch import Tensor

from rendra.renderer.blending import (
    BlendParams,
    hard_rgb_blend,
    sigmoid_alpha_blend,
    softmax_depth_blend,
    softmax_rgb_blend,
)

RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


@dataclass
class Layers:
    pix_to_face: Tensor
    zbuf: Tensor
    dists: Tensor


def random_layers(n: int = 2, h: int = 3, w: int = 4, k: int = 5, fill: float = 0.5) -> tuple[Layers, Tensor]:
    """Layers near the scale of sigma = gamma = 1, about half of the slots filled, some pixels empty."""
    filled = (torch.rand(n, h, w, k) < fill) & (torch.rand(n, h, w, 1) < 0.8)
    faces = torch.where(filled, torch.randint(0, 9, filled.shape), -1)
    dists = torch.randn(n, h, w, k, dtype=torch.float64).masked_fill(~filled, -1.0)
    zbuf = (1 + 9 * torch.rand(n, h, w, k, dtype=torch.float64)).masked_fill(~filled, -1.0)
    return Layers(faces, zbuf, dists), torch.rand(n, h, w, k, 3, dtype=torch.float64)


def one_pixel(faces: list[int], zbuf: list[float], dists: list[float]) -> Layers:
    shape = (1, 1, 1, len(faces))
    return Layers(
        torch.tensor(faces).view(shape),
        torch.tensor(zbuf, dtype=torch.float64).view(shape),
        torch.tensor(dists, dtype=torch.float64).view(shape),
    )


def colors_of(*colors: tuple[float, ...]) -> Tensor:
    return torch.tensor(colors, dtype=torch.float64)[None, None, None]


def literal_softmax(
    colors: Tensor, layers: Layers, params: BlendParams, znear: float | Tensor, zfar: float | Tensor
) -> Tensor:
    """The formula of Soft Rasterizer, written as it stands in the paper's notation."""
    mask = (layers.pix_to_face >= 0).double()
    coverage = torch.sigmoid(-layers.dists / params.sigma) * mask
    near = (zfar - layers.zbuf) / (zfar - znear) * mask
    nearest = near.max(-1, keepdim=True).values.clamp(min=1e-10)
    weights = coverage * torch.exp((near - nearest) / params.gamma)
    delta = torch.exp((1e-10 - nearest) / params.gamma).clamp(min=1e-10)
    total = weights.sum(-1, keepdim=True) + delta
    background = torch.tensor(params.background_color, dtype=torch.float64)
    rgb = ((weights[..., None] * colors).sum(-2) + delta * background) / total
    return torch.cat((rgb, 1 - (1 - coverage).prod(-1, keepdim=True)), -1)


def test_anchor_of_softmax_blending() -> None:
    layers = one_pixel([0, 1], [2.0, 5.0], [-1e-4, 5e-5])
    pixel = softmax_rgb_blend(colors_of(RED, GREEN), layers, BlendParams(gamma=0.1), znear=1.0, zfar=100.0)
    assert_close(pixel[0, 0, 0, :3], [0.7239, 0.27614, 4.97e-5], atol=1e-5)
    assert_close(pixel[0, 0, 0, 3], 0.83259, atol=1e-5)


@pytest.mark.parametrize("sigma", [0.3, 2.0])
@pytest.mark.parametrize("gamma", [0.05, 1.0])
def test_softmax_is_the_published_formula(sigma: float, gamma: float) -> None:
    layers, colors = random_layers()
    params = BlendParams(sigma, gamma, (0.2, 0.5, 0.9))
    expected = literal_softmax(colors, layers, params, 0.5, 20.0)
    assert_close(softmax_rgb_blend(colors, layers, params, 0.5, 20.0), expected, atol=1e-12)


def test_planes_may_differ_between_images() -> None:
    layers, colors = random_layers(n=3)
    znear, zfar = torch.tensor([0.5, 1.0, 0.1]), torch.tensor([20.0, 30.0, 11.0])
    params = BlendParams(1.0, 0.5)
    expected = literal_softmax(colors, layers, params, znear.view(3, 1, 1, 1), zfar.view(3, 1, 1, 1))
    assert_close(softmax_rgb_blend(colors, layers, params, znear, zfar), expected, atol=1e-6)
    shared = literal_softmax(colors, layers, params, znear[0], zfar[0])
    assert_close(softmax_rgb_blend(colors, layers, params, znear[:1], zfar[:1]), shared, atol=1e-6)


def test_hard_blending_is_the_limit_of_softmax() -> None:
    layers, colors = random_layers(fill=1.1)
    order = layers.zbuf.argsort(-1)
    layers.zbuf = layers.zbuf.gather(-1, order)
    layers.dists = -layers.dists.abs() - 0.1  # inside, far from any edge
    params = BlendParams(sigma=1e-4, gamma=1e-6, background_color=BLUE)
    soft, hard = softmax_rgb_blend(colors, layers, params), hard_rgb_blend(colors, layers, params)
    assert_close(soft, hard, atol=1e-6)


def test_silhouette_ignores_order_and_empty_slots() -> None:
    layers, colors = random_layers()
    params = BlendParams(sigma=1.0)
    alpha = sigmoid_alpha_blend(colors, layers, params)[..., 3]
    mask = layers.pix_to_face >= 0
    expected = 1 - (1 - torch.sigmoid(-layers.dists) * mask).prod(-1)
    assert_close(alpha, expected, atol=1e-12)
    turned = Layers(layers.pix_to_face.flip(-1), layers.zbuf.flip(-1), layers.dists.flip(-1))
    assert_close(sigmoid_alpha_blend(colors, turned, params)[..., 3], alpha, atol=1e-12)
    assert_close(sigmoid_alpha_blend(colors, layers, params)[..., :3], colors[..., 0, :])


def test_on_an_edge_coverage_is_one_half() -> None:
    layers = one_pixel([3, -1], [2.0, -1.0], [0.0, -1.0])
    assert_close(sigmoid_alpha_blend(colors_of(RED, GREEN), layers, BlendParams())[..., 3], [[[0.5]]])


@pytest.mark.parametrize("blend", [hard_rgb_blend, softmax_rgb_blend])
def test_pixels_without_a_face_show_the_background(blend) -> None:
    layers, colors = random_layers(fill=-1.0)
    image = blend(colors, layers, BlendParams(background_color=torch.tensor([0.1, 0.2, 0.3])))
    assert_close(image, torch.tensor([0.1, 0.2, 0.3, 0.0]).expand(2, 3, 4, 4), atol=1e-6)


def test_hard_blending_takes_the_first_layer() -> None:
    layers = one_pixel([3, 2], [2.0, 3.0], [-1.0, -1.0])
    assert_close(hard_rgb_blend(colors_of(RED, GREEN), layers, BlendParams()), [[[[1.0, 0.0, 0.0, 1.0]]]])


def test_gradients_by_finite_differences() -> None:
    layers, colors = random_layers(n=1, h=2, w=3, k=3)
    inputs = tuple(t.requires_grad_() for t in (colors, layers.zbuf, layers.dists))

    def soft(c: Tensor, z: Tensor, d: Tensor) -> Tensor:
        return softmax_rgb_blend(c, Layers(layers.pix_to_face, z, d), BlendParams(0.7, 0.3), 0.5, 12.0)

    def depth(_: Tensor, z: Tensor, d: Tensor) -> Tensor:
        return softmax_depth_blend(Layers(layers.pix_to_face, z, d), BlendParams(0.7, 0.3), 0.5, 12.0)

    def alpha(c: Tensor, z: Tensor, d: Tensor) -> Tensor:
        return sigmoid_alpha_blend(c, Layers(layers.pix_to_face, z, d), BlendParams(0.7))

    for blend in (soft, depth, alpha):
        assert torch.autograd.gradcheck(blend, inputs)


def test_gradients_stay_finite_where_coverage_saturates() -> None:
    layers = one_pixel([0, 1, -1], [2.0, 3.0, -1.0], [-0.5, 0.5, -1.0])
    layers.dists.requires_grad_()
    layers.zbuf.requires_grad_()
    softmax_rgb_blend(colors_of(RED, GREEN, BLUE), layers, BlendParams()).sum().backward()
    assert_finite(layers.dists.grad)
    assert_finite(layers.zbuf.grad)


def test_a_trainable_background_gets_its_share() -> None:
    layers, colors = random_layers(n=1, fill=-1.0)
    background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64, requires_grad=True)
    softmax_rgb_blend(colors, layers, BlendParams(1.0, 1.0, background)).sum().backward()
    assert_close(background.grad, [12.0, 12.0, 12.0])


def test_blended_depth_lies_between_face_and_far_plane() -> None:
    layers = one_pixel([0, -1], [2.0, -1.0], [-10.0, -1.0])
    assert_close(softmax_depth_blend(layers, BlendParams(), 1.0, 50.0), [[[[2.0]]]])
    empty = one_pixel([-1], [-1.0], [-1.0])
    assert_close(softmax_depth_blend(empty, BlendParams(), 1.0, torch.tensor([50.0])), [[[[50.0]]]])


def test_any_number_of_channels_and_a_background_that_fits() -> None:
    layers, colors = random_layers()
    features = torch.cat((colors, colors), -1)
    params = BlendParams(background_color=(0.0,) * 6)
    assert softmax_rgb_blend(features, layers, params).shape == (2, 3, 4, 7)
    assert hard_rgb_blend(features, layers, params).shape == (2, 3, 4, 7)
    with pytest.raises(ValueError, match="background_color must hold 6 numbers"):
        softmax_rgb_blend(features, layers, BlendParams())


def test_empty_batch() -> None:
    layers, colors = random_layers(n=0)
    assert softmax_rgb_blend(colors, layers, BlendParams()).shape == (0, 3, 4, 4)
    assert sigmoid_alpha_blend(colors, layers, BlendParams()).shape == (0, 3, 4, 4)
