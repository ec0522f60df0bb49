"""Residual networks that see a picture at four resolutions: what detectors and VoxMesh stand on.

He et al., "Deep Residual Learning for Image Recognition", CVPR 2016, arXiv:1512.03385; a bottleneck has its stride on
its 3x3 convolution. Layout and names are torchvision's, so that a file of its weights is read by name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.networks.foreign_weights import ForeignWeights
from rendra_lab.networks.normalization import Norm, norm_of
from rendra_lab.settings import Count, Positive

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's pictures
_FILE = "torchvision's resnet50-11ad3fa6.pth, or the like as .safetensors, of the widths and depths of the network"
_BOTTLENECK = 4  # channels of a block's result, over those inside
_STAGES = 4


class ResidualBackbone(nn.Module):
    """A residual network without its classifier.

    Args:
        depths: blocks of each of the four stages.
        widths: channels inside the blocks of each stage; the first also those of the stem.
        block: two 3x3 convolutions (basic), or 1x1, 3x3, 1x1 with four times the channels behind it (bottleneck).
        norm: behind each convolution. null: frozen for weights from a file, else group, which needs no large batch.
        weights: file of weights by torchvision's names; null: random, each block starting as the identity.
        frozen_stages: how many parts, the stem first, keep the weights of the file; without a file all learn.

    Raises:
        UserError: numbers that cannot be, or a file that does not fit.
    """

    strides = (4, 8, 16, 32)  # pixels between the cells of each map

    def __init__(
        self,
        depths: Sequence[Positive] = (3, 4, 6, 3),
        widths: Sequence[Positive] = (64, 128, 256, 512),
        block: Literal["basic", "bottleneck"] = "bottleneck",
        norm: Norm | None = None,
        weights: Path | None = None,
        frozen_stages: Count = 0,
    ) -> None:
        super().__init__()
        if len(depths) != _STAGES or len(widths) != _STAGES or frozen_stages > _STAGES + 1:
            raise UserError(
                "a residual backbone has four depths, four widths, and five parts to freeze, the stem first: got "
                f"depths={list(depths)}, widths={list(widths)}, frozen_stages={frozen_stages}"
            )
        kind: Norm = norm or ("frozen" if weights else "group")
        make = _Bottleneck if block == "bottleneck" else _Basic
        self.channels = tuple(width * make.expansion for width in widths)  # of each map
        self.conv1 = nn.Conv2d(3, widths[0], 7, stride=2, padding=3, bias=False)
        self.bn1 = norm_of(kind, widths[0])
        before = widths[0]
        for number, (depth, width) in enumerate(zip(depths, widths, strict=True)):
            stride = 1 if number == 0 else 2
            self.add_module(f"layer{number + 1}", _stage(make, before, width, depth, stride, kind))
            before = width * make.expansion
        self._start(kind)
        if weights is not None:
            self._read(Path(weights))
            self._freeze(frozen_stages)
        self.register_buffer("mean", torch.tensor(_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(_STD)[:, None, None], persistent=False)

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What each stage sees.

        Args:
            pictures: (B, 3, H, W), sRGB in [0, 1], of any size.

        Returns:
            Four tensors (B, channels[i], ceil(H / s), ceil(W / s)) at strides s = 4, 8, 16, 32.
        """
        x = (pictures - self.get_buffer("mean")) / self.get_buffer("std")
        x = F.max_pool2d(F.relu(self.bn1(self.conv1(x))), 3, stride=2, padding=1)
        found = []
        for stage in self._stages():
            x = stage(x)
            found.append(x)
        return (found[0], found[1], found[2], found[3])

    def _stages(self) -> list[nn.Module]:
        return [self.get_submodule(f"layer{number + 1}") for number in range(_STAGES)]

    def _start(self, norm: Norm) -> None:
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
            elif isinstance(module, (_Basic, _Bottleneck)) and norm in ("batch", "group"):
                nn.init.zeros_(module.last_norm().get_parameter("weight"))  # Goyal et al., 2017, Sec. 5.1

    def _read(self, path: Path) -> None:
        file = ForeignWeights(path, "this residual network", _FILE)
        counts = "num_batches_tracked"
        names = {name: value for name, value in self.state_dict().items() if not name.endswith(counts)}
        found = {name: file.taken(name, tuple(value.shape)) for name, value in names.items()}
        self.load_state_dict(found, strict=False)

    def _freeze(self, parts: int) -> None:
        stem: list[nn.Module] = [self.conv1, self.bn1]
        frozen = [*(stem if parts else []), *self._stages()[: max(parts - 1, 0)]]
        for part in frozen:
            part.requires_grad_(False)


class _Basic(nn.Module):
    """Two 3x3 convolutions beside a shortcut."""

    expansion = 1

    def __init__(self, before: int, width: int, stride: int, norm: Norm) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(before, width, 3, stride=stride, padding=1, bias=False)
        self.bn1 = norm_of(norm, width)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn2 = norm_of(norm, width)
        self.downsample = _shortcut(before, width, stride, norm)

    def last_norm(self) -> nn.Module:
        return self.bn2

    def forward(self, x: Tensor) -> Tensor:
        inner = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(inner)) + (x if self.downsample is None else self.downsample(x)))


class _Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolutions beside a shortcut."""

    expansion = _BOTTLENECK

    def __init__(self, before: int, width: int, stride: int, norm: Norm) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(before, width, 1, bias=False)
        self.bn1 = norm_of(norm, width)
        self.conv2 = nn.Conv2d(width, width, 3, stride=stride, padding=1, bias=False)
        self.bn2 = norm_of(norm, width)
        self.conv3 = nn.Conv2d(width, width * _BOTTLENECK, 1, bias=False)
        self.bn3 = norm_of(norm, width * _BOTTLENECK)
        self.downsample = _shortcut(before, width * _BOTTLENECK, stride, norm)

    def last_norm(self) -> nn.Module:
        return self.bn3

    def forward(self, x: Tensor) -> Tensor:
        inner = F.relu(self.bn1(self.conv1(x)))
        inner = F.relu(self.bn2(self.conv2(inner)))
        return F.relu(self.bn3(self.conv3(inner)) + (x if self.downsample is None else self.downsample(x)))


def _shortcut(before: int, after: int, stride: int, norm: Norm) -> nn.Sequential | None:
    if stride == 1 and before == after:
        return None
    return nn.Sequential(nn.Conv2d(before, after, 1, stride=stride, bias=False), norm_of(norm, after))


def _stage(
    make: Callable[[int, int, int, Norm], nn.Module], before: int, width: int, depth: int, stride: int, norm: Norm
) -> nn.Sequential:
    expansion: int = getattr(make, "expansion", 1)
    first = make(before, width, stride, norm)
    return nn.Sequential(first, *(make(width * expansion, width, 1, norm) for _ in range(depth - 1)))
