"""What a generator and its adversary want of the adversary's logits (B, 1) of "this picture is real"; scalars each.

Goodfellow et al., "Generative Adversarial Nets", NeurIPS 2014 (logistic and non-saturating objectives); Mescheder,
Geiger and Nowozin, "Which Training Methods for GANs do actually Converge?", ICML 2018 (R1).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F


def non_saturating(fake: Float[Tensor, "B 1"]) -> Float[Tensor, ""]:
    """The generator's: minus the mean logarithm of the chance that its pictures are real; log 2 at logits of 0."""
    return F.softplus(-fake).mean()


def logistic(fake: Float[Tensor, "B 1"], real: Float[Tensor, "B 1"]) -> Float[Tensor, ""]:
    """The adversary's: both cross entropies added; 2 log 2 where it cannot tell them apart."""
    return F.softplus(fake).mean() + F.softplus(-real).mean()


def r1(real: Float[Tensor, "B 1"], pictures: Float[Tensor, "B 3 S S"]) -> Float[Tensor, ""]:
    """The mean over pictures of the squared length of the logit's gradient in the picture, without Mescheder's half.

    Differentiable once more. GIRAFFE weighs it 10.

    Args:
        real: logits of real pictures.
        pictures: these pictures, from which the logits were made with gradients.
    """
    (slopes,) = torch.autograd.grad(real.sum(), pictures, create_graph=True)
    return slopes.square().flatten(1).sum(1).mean()
