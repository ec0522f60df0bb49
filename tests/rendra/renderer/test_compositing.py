"""The public compositing functions: their formulas in the public layout, and errors."""

import pytest
import torch
from assertions import assert_close

from rendra.renderer.compositing import alpha_composite, norm_weighted_sum, weighted_sum


def layers(images: int = 2, slots: int = 5, height: int = 3, width: int = 4, points: int = 7) -> tuple:
    idx = torch.randint(-1, points, (images, slots, height, width))
    return idx, torch.rand(idx.shape), torch.randn(3, points)


def weights_of(idx: torch.Tensor, alphas: torch.Tensor, name: str) -> torch.Tensor:
    alphas = alphas * (idx >= 0)
    if name == "alpha_composite":
        clear = torch.cat((torch.ones_like(alphas[:, :1]), (1 - alphas).cumprod(1)[:, :-1]), dim=1)
        return alphas * clear
    return alphas if name == "weighted_sum" else alphas / alphas.sum(1, keepdim=True).clamp(min=1e-4)


@pytest.mark.parametrize("composite", [alpha_composite, norm_weighted_sum, weighted_sum])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_images_are_weighted_sums(composite, dtype) -> None:
    idx, alphas, features = layers()
    alphas, features = alphas.to(dtype), features.to(dtype)
    found = features[:, idx.clamp(min=0)]  # (C, N, K, H, W)
    expected = (found * weights_of(idx, alphas, composite.__name__)).sum(2).transpose(0, 1)
    image = composite(idx, alphas, features)
    assert image.shape == (2, 3, 3, 4)
    assert_close(image, expected)
    assert torch.equal(image, composite(idx.int(), alphas, features))


def test_published_layout_and_order() -> None:
    """Two slots over one pixel: 0.5 of the near point, and 0.8 of half of the far one."""
    idx = torch.tensor([1, 0]).view(1, 2, 1, 1)
    alphas = torch.tensor([0.5, 0.8]).view(1, 2, 1, 1)
    features = torch.tensor([[10.0, 1.0]])
    assert_close(alpha_composite(idx, alphas, features), [[[[0.5 + 4.0]]]])
    assert_close(weighted_sum(idx, alphas, features), [[[[0.5 + 8.0]]]])
    assert_close(norm_weighted_sum(idx, alphas, features), [[[[8.5 / 1.3]]]])


def test_gradients_reach_opacities_and_features() -> None:
    idx, alphas, features = layers()
    for composite in (alpha_composite, norm_weighted_sum, weighted_sum):
        leaves = [tensor.double().requires_grad_() for tensor in (alphas, features)]
        assert torch.autograd.gradcheck(lambda a, f, c=composite: c(idx, a, f), leaves)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pointsidx": torch.zeros(1, 2, 3, 4)}, r"pointsidx must be integers of shape \(N, K, H, W\)"),
        (
            {"pointsidx": torch.zeros(1, 3, 4, dtype=torch.int64)},
            r"pointsidx must be integers of shape \(N, K, H, W\)",
        ),
        ({"alphas": torch.zeros(1, 2, 4, 3)}, r"alphas must have the shape of pointsidx, \(1, 2, 3, 4\)"),
        ({"pt_clds": torch.zeros(3, 5, dtype=torch.uint8)}, r"pt_clds must be torch.float32 of shape \(C, P\)"),
        ({"pt_clds": torch.zeros(5)}, r"pt_clds must be torch.float32 of shape \(C, P\)"),
        ({"pointsidx": torch.full((1, 2, 3, 4), 5)}, "idx names point 5, but features are those of 5 points"),
    ],
)
def test_bad_input_is_named(change, message) -> None:
    arguments = {
        "pointsidx": torch.zeros(1, 2, 3, 4, dtype=torch.int64), "alphas": torch.zeros(1, 2, 3, 4),
        "pt_clds": torch.zeros(3, 5),
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        alpha_composite(**{**arguments, **change})
