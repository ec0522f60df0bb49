"""What is seen of samples along a ray, each of which hides those behind it.

Max, "Optical models for direct volume rendering", 1995; Niemeyer and Geiger, "GIRAFFE", CVPR 2021, Eq. 7 to 9.
Letters: R rays, K samples of each, the first the nearest. Thickness is density times length: it has no unit.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

_WALL = 100.0  # thickness of what nothing passes: exp(-100) is 0 in float32
_THINNEST = 1e-20  # density below which there is nothing


def clear(thickness: Float[Tensor, "R K"]) -> Float[Tensor, "R K"]:
    """How much of each sample's light passes those before it: exp(-sum of their thickness)."""
    return torch.exp(-F.pad(thickness.cumsum(1)[:, :-1], (1, 0)))


def seen(thickness: Float[Tensor, "R K"]) -> Float[Tensor, "R K"]:
    """Weights of samples, 1 - exp(-thickness) dimmed by those before; the sum over a ray is at most 1."""
    return clear(thickness) * -torch.expm1(-thickness)


def walled(thickness: Float[Tensor, "R K"]) -> Float[Tensor, "R K"]:
    """The same samples, but nothing passes the last."""
    return torch.cat([thickness[:, :-1], torch.full_like(thickness[:, -1:], _WALL)], 1)


def per_density(weights: Float[Tensor, "R K"], density: Float[Tensor, "R K"]) -> Float[Tensor, "R K"]:
    """What a thing weighs at samples for each unit of its density: things share a sample as their densities are.

    Eq. 7: features are averaged with densities as weights. 0 where there is nothing.
    """
    return weights / density.clamp_min(_THINNEST)
