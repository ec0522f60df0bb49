"""Anchors: the boxes at every cell of every level of a feature pyramid from which region proposals start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class LevelAnchors:
    """Boxes of some shapes about the middle of each cell.

    Ren et al., "Faster R-CNN", NIPS 2015, section 3.1.1; one size a level as in Lin et al., "Feature Pyramid
    Networks", CVPR 2017, section 4.1.
    """

    sizes_px: tuple[float, ...] = (32.0, 64.0, 128.0, 256.0, 512.0)  # of each level: sides of a square of that area
    strides: tuple[int, ...] = (4, 8, 16, 32, 64)  # pixels between the cells of each level
    ratios: tuple[float, ...] = (0.5, 1.0, 2.0)  # height over width
    offset: float = (
        0.5  # of a box's middle from the corner of its cell, in cells (Detectron2's 0 lies off the middle)
    )

    def __post_init__(self) -> None:
        if len(self.sizes_px) != len(self.strides):
            raise ValueError(
                f"anchors need one size for each level, got sizes_px={self.sizes_px} for strides={self.strides}"
            )
        if not all(value > 0 for value in (*self.sizes_px, *self.strides, *self.ratios)) or not self.ratios:
            raise ValueError(
                "anchors need sizes, strides and ratios above 0, got "
                f"sizes_px={self.sizes_px}, strides={self.strides}, ratios={self.ratios}"
            )

    @property
    def per_cell(self) -> int:
        """How many boxes each cell has."""
        return len(self.ratios)

    def of_levels(self, features: Sequence[Float[Tensor, "B _ _ _"]]) -> tuple[Float[Tensor, "_ 4"], ...]:
        """Anchors (H W A, 4) in pixels of each level: cells row by row, at each the A ratios in order.

        Args:
            features: maps (B, C, H, W) of the levels, finest first, of whatever channels.

        Raises:
            ValueError: not one map for each level.
        """
        if len(features) != len(self.strides):
            raise ValueError(f"anchors of {len(self.strides)} levels got {len(features)} feature maps")
        return tuple(
            self._of_level(feature, size, stride)
            for feature, size, stride in zip(features, self.sizes_px, self.strides, strict=True)
        )

    def _of_level(self, feature: Tensor, size: float, stride: int) -> Tensor:
        dtype = torch.promote_types(feature.dtype, torch.float32)  # half precision has no pixels beyond 2048
        ticks = (torch.arange(n, device=feature.device, dtype=dtype) for n in feature.shape[-2:])
        y, x = ((tick + self.offset) * stride for tick in ticks)
        middles = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 1, 2)  # (H W, 1, 2)
        ratios = torch.tensor(self.ratios, device=feature.device, dtype=dtype)
        halves = size / 2 * torch.stack([ratios.rsqrt(), ratios.sqrt()], dim=-1)  # (A, 2)
        return torch.cat([middles - halves, middles + halves], dim=-1).reshape(-1, 4)
