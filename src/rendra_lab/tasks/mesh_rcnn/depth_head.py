"""How deep an object reaches, told from the features behind its box.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 4.2: what the box head is to the sides of
a box, this head is to its depth.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rendra_lab.settings import Positive

_MOST_LOG = math.log(1000 / 16)  # of an extent: as of the sides of boxes


class DepthHead(nn.Module):
    """Fully connected layers to the logarithm of the depth extent, one for each class.

    The paper's: 13.905 M weights with 256 channels, 7 x 7 cells, two layers of 1024 and nine classes.

    Args:
        in_channels: of the features.
        classes: C.
        side: cells along each side of a region.
        width: of the layers between.
        layers: how many of them.
    """

    def __init__(
        self,
        in_channels: Positive,
        classes: Positive,
        side: Positive = 7,
        width: Positive = 1024,
        layers: Positive = 2,
    ) -> None:
        super().__init__()
        widths = [in_channels * side**2] + [width] * layers
        stack: list[nn.Module] = [nn.Flatten()]
        for before, after in pairwise(widths):
            stack += [nn.Linear(before, after), nn.ReLU()]
            nn.init.kaiming_uniform_(stack[-2].weight, a=1)  # type: ignore[arg-type]
            nn.init.zeros_(stack[-2].bias)  # type: ignore[arg-type]
        self.layers = nn.Sequential(*stack)
        self.last = nn.Linear(width, classes)
        nn.init.normal_(self.last.weight, std=0.001)
        nn.init.zeros_(self.last.bias)

    def forward(self, regions: Float[Tensor, "R D S S"], labels: Int[Tensor, " R"]) -> Float[Tensor, " R"]:
        """Logarithms of the depth extents (`rendra_lab.detection.object_frames`) of regions, of their classes."""
        return self.last(self.layers(regions)).gather(1, labels[:, None])[:, 0]


def extents_of(logarithms: Float[Tensor, " R"]) -> Float[Tensor, " R"]:
    """Depth extents, at most 62.5 heights of a box."""
    return torch.exp(logarithms.clamp_max(_MOST_LOG))
