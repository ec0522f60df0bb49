"""What stands behind a convolution: batch norm, its frozen form, group norm or nothing."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

Norm = Literal["batch", "frozen", "group", "none"]

_MOST_GROUPS, _FEWEST_CHANNELS = 32, 8  # of a group norm; the second in a group


class FrozenBatchNorm(nn.Module):
    """A batch norm whose statistics, gain and shift never change: for weights from elsewhere and small batches.

    Its buffers have the names of `nn.BatchNorm2d`. A new one is the identity, up to epsilon.
    """

    weight: Tensor
    bias: Tensor
    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        for name, value in (("weight", 1.0), ("bias", 0.0), ("running_mean", 0.0), ("running_var", 1.0)):
            self.register_buffer(name, torch.full((channels,), value))

    def forward(self, x: Tensor) -> Tensor:
        """Features (B, C, H, W) of the same shape."""
        return F.batch_norm(x, self.running_mean, self.running_var, self.weight, self.bias, eps=1e-5)


def norm_of(kind: Norm, channels: int) -> nn.Module:
    """The layer; group norm has groups of 8 channels or more, 32 of them at most (Wu and He, ECCV 2018)."""
    if kind == "batch":
        return nn.BatchNorm2d(channels)
    if kind == "frozen":
        return FrozenBatchNorm(channels)
    if kind == "group":
        most = max(1, min(_MOST_GROUPS, channels // _FEWEST_CHANNELS))
        return nn.GroupNorm(next(groups for groups in range(most, 0, -1) if channels % groups == 0), channels)
    return nn.Identity()
