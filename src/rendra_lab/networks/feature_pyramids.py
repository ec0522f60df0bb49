"""Networks that are never trained here, and what their layers see in a picture, from fine to coarse.

Pictures are (B, 3, H, W), sRGB in [0, 1]. Building one leaves torch's random stream as it was, so that a resumed run,
which builds it at another time, draws the same numbers.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab.networks.efficientnet_lite import EfficientNetLite0
from rendra_lab.networks.foreign_weights import ForeignWeights
from rendra_lab.random_state import untouched

_VGG19_FILE = "torchvision's vgg19-dcbb9e9d.pth, or the like as .safetensors"
# torchvision's vgg19.features up to relu5_1: where its convolutions stand, their widths, and what pools come before
_VGG19_CONVS = (0, 2, 5, 7, 10, 12, 14, 16, 19, 21, 23, 25, 28)
_VGG19_WIDTHS = (64, 64, 128, 128, 256, 256, 256, 256, 512, 512, 512, 512, 512)
_VGG19_POOLED = (5, 10, 19, 28)
_VGG19_LEVELS = (0, 5, 10, 19, 28)  # relu1_1, relu2_1, relu3_1, relu4_1, relu5_1
_RANDOM_WIDTHS = (16, 32, 64, 64, 64)
_RANDOM_SEED = 19


class FeaturePyramid(Protocol):
    """A network seen from the side."""

    name: str  # what scores and messages call it
    height: int  # how many levels there are

    def levels(self, pictures: Tensor, count: int) -> list[Tensor]:
        """The first `count` levels, (B, C, H / s, W / s) each; s doubles from level to level."""

    def to(self, device: torch.device, /) -> FeaturePyramid:
        """The same, moved."""


class Lite0Pyramid(nn.Module):
    """EfficientNet-Lite0 of ImageNet, strides 2, 4, 8, 16, 32.

    Raises:
        UserError: the extra [features] is not installed.
    """

    name = "lite0"
    height = 5

    def __init__(self) -> None:
        super().__init__()
        with untouched():
            self.network = EfficientNetLite0.pretrained()

    def levels(self, pictures: Tensor, count: int) -> list[Tensor]:
        """See `FeaturePyramid`."""
        return self.network.levels(pictures, count)


class RandomPyramid(nn.Module):
    """3x3 convolutions with fixed random weights, each the same ones in every run; strides 1, 2, 4, 8, 16.

    It has seen no picture: it compares edges and colours at several scales, and knows nothing of things.
    """

    name = "random"
    height = len(_RANDOM_WIDTHS)

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(_RANDOM_SEED)
        width = 3
        for level, wider in enumerate(_RANDOM_WIDTHS):
            weight = torch.randn(wider, width, 3, 3, generator=generator) * (2 / (9 * width)) ** 0.5
            self.register_buffer(f"weight{level}", weight)
            width = wider

    def levels(self, pictures: Tensor, count: int) -> list[Tensor]:
        """See `FeaturePyramid`."""
        x, found = 2 * pictures - 1, []
        for level in range(count):
            x = F.relu(F.conv2d(_halved(x) if level else x, self.get_buffer(f"weight{level}"), padding=1))
            found.append(x)
        return found


class VGG19Pyramid(nn.Module):
    """VGG19 behind relu1_1, 2_1, 3_1, 4_1 and 5_1, strides 1, 2, 4, 8, 16; pictures enter in [-1, 1], as in SynSin.

    Args:
        path: of the weights, by torchvision's names `features.<n>.weight` and `features.<n>.bias`; what else the
            file holds is not looked at.

    Raises:
        UserError: there is no such file, or it holds something else.
    """

    name = "vgg19"
    height = len(_VGG19_LEVELS)

    def __init__(self, path: Path) -> None:
        super().__init__()
        weights = ForeignWeights(path, "VGG19", _VGG19_FILE)
        width = 3
        for number, wider in zip(_VGG19_CONVS, _VGG19_WIDTHS, strict=True):
            for kind, shape in (("weight", (wider, width, 3, 3)), ("bias", (wider,))):
                self.register_buffer(f"{kind}{number}", weights.taken(f"features.{number}.{kind}", shape))
            width = wider

    def levels(self, pictures: Tensor, count: int) -> list[Tensor]:
        """See `FeaturePyramid`."""
        x = 2 * pictures - 1
        found: list[Tensor] = []
        for number in _VGG19_CONVS:
            if len(found) == count:
                break
            if number in _VGG19_POOLED:
                x = _halved(x, F.max_pool2d)
            weight, bias = self.get_buffer(f"weight{number}"), self.get_buffer(f"bias{number}")
            x = F.relu(F.conv2d(x, weight, bias, padding=1))
            if number in _VGG19_LEVELS:
                found.append(x)
        return found


def _halved(x: Tensor, pool: object = F.avg_pool2d) -> Tensor:
    """Half the resolution; a side of one pixel stays."""
    return pool(x, [min(2, side) for side in x.shape[-2:]])  # type: ignore[operator]
