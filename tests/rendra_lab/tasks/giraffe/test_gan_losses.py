"""What generator and adversary want: closed forms, gradients, and gradients of gradients."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from rendra_lab.tasks.giraffe.gan_losses import logistic, non_saturating, r1


def test_where_nobody_can_tell() -> None:
    nothing = torch.zeros(3, 1, dtype=torch.float64)
    assert math.isclose(float(non_saturating(nothing)), math.log(2))
    assert math.isclose(float(logistic(nothing, nothing)), 2 * math.log(2))


def test_they_are_binary_cross_entropies() -> None:
    torch.manual_seed(0)
    fake, real = torch.randn(2, 5, 1, dtype=torch.float64).unbind()
    of = nn.functional.binary_cross_entropy_with_logits
    torch.testing.assert_close(non_saturating(fake), of(fake, torch.ones_like(fake)))
    torch.testing.assert_close(
        logistic(fake, real), of(real, torch.ones_like(real)) + of(fake, torch.zeros_like(fake))
    )


def test_large_logits_stay_finite() -> None:
    for size in (1e4, -1e4):
        logits = torch.full((2, 1), size, requires_grad=True)
        (gradient,) = torch.autograd.grad(non_saturating(logits) + logistic(logits, -logits), logits)
        assert gradient.isfinite().all()


def test_r1_of_a_linear_adversary_is_the_squared_length_of_its_weights() -> None:
    weight = torch.randn(3 * 16, dtype=torch.float64, requires_grad=True)
    pictures = torch.rand(5, 3, 4, 4, dtype=torch.float64, requires_grad=True)
    value = r1((pictures.flatten(1) @ weight)[:, None], pictures)
    torch.testing.assert_close(value, weight.square().sum())
    (gradient,) = torch.autograd.grad(value, weight)
    torch.testing.assert_close(gradient, 2 * weight)


def test_r1_is_differentiable_once_more() -> None:
    torch.manual_seed(1)
    network = nn.Sequential(nn.Conv2d(3, 2, 4, 2, 1), nn.Softplus(), nn.Flatten(), nn.Linear(8, 1)).double()
    pictures = torch.rand(2, 3, 4, 4, dtype=torch.float64, requires_grad=True)
    weight = network[0].weight

    def penalty(weight: Tensor) -> Tensor:
        return r1(torch.func.functional_call(network, {"0.weight": weight}, (pictures,)), pictures)

    assert torch.autograd.gradcheck(penalty, (weight,))
