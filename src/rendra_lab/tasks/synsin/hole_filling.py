"""Holes of a picture filled with the colours about them: near a hole's edge sharp, further in ever smoother.

Push and pull along a pyramid: Gortler et al., "The Lumigraph", SIGGRAPH 1996, Sec. 3.4.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F


def filled(colors: Float[Tensor, "B C H W"], weight: Float[Tensor, "B 1 H W"]) -> Float[Tensor, "B C H W"]:
    """Colours where the weight is 1, what surrounds them where it is 0, mixed between; 0 where there is no colour.

    Args:
        colors: of pixels with any weight; the others may be anything finite.
        weight: in [0, 1].
    """
    pyramid = [(colors * weight, weight)]
    while max(pyramid[-1][1].shape[-2:]) > 1:
        known, share = (F.avg_pool2d(values, 2, ceil_mode=True) for values in pyramid[-1])
        full = (4 * share).clamp_max(1)  # a quarter that is known is enough
        pyramid.append((known * (full / share.clamp_min(1e-6)), full))
    around = torch.zeros_like(pyramid[-1][0])
    for known, share in reversed(pyramid):
        around = F.interpolate(around, known.shape[-2:], mode="bilinear", align_corners=False)
        around = known + (1 - share) * around
    return around
