"""Feature pyramids: maps of a backbone, brought to one width, each told what the coarser ones see.

Lin et al., "Feature Pyramid Networks for Object Detection", CVPR 2017, arXiv:1612.03144.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab.networks.normalization import Norm, norm_of
from rendra_lab.settings import Positive


class FeaturePyramid(nn.Module):
    """1x1 convolutions, sums from coarse to fine, 3x3 convolutions, and a coarsest level more.

    Args:
        channels: of the backbone's maps, finest first.
        width: of every level.
        norm: behind each convolution.
    """

    def __init__(self, channels: Sequence[Positive], width: Positive = 256, norm: Norm = "none") -> None:
        super().__init__()
        self.channels, self.width = tuple(channels), width
        self.lateral = nn.ModuleList(_convolution(before, width, 1, norm) for before in channels)
        self.output = nn.ModuleList(_convolution(width, width, 3, norm) for _ in channels)

    def forward(self, maps: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """The levels, finest first.

        Args:
            maps: (B, channels[i], H_i, W_i), each ceil(half) of the one before.

        Returns:
            A level (B, width, H_i, W_i) for each map, and one of every other cell of the last.
        """
        sums: list[Tensor] = []
        for lateral, seen in zip(reversed(self.lateral), reversed(maps), strict=True):
            x = lateral(seen)
            sums.append(x + F.interpolate(sums[-1], size=x.shape[-2:], mode="nearest") if sums else x)
        levels = [output(x) for output, x in zip(self.output, reversed(sums), strict=True)]
        return (*levels, levels[-1][..., ::2, ::2])


def _convolution(before: int, width: int, size: int, norm: Norm) -> nn.Sequential:
    conv = nn.Conv2d(before, width, size, padding=size // 2, bias=norm == "none")
    nn.init.kaiming_uniform_(conv.weight, a=1)  # without a ReLU behind it
    if conv.bias is not None:
        nn.init.zeros_(conv.bias)
    return nn.Sequential(conv, norm_of(norm, width))
