"""Many square pictures that repeat, each at all resolutions, looked up at once.

Letters: M pictures of S x S texels, N places.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F


class TexturePyramid:
    """Pictures and their halved, quartered ... versions: what lies far away is looked up in a small one.

    Args:
        pictures: (M, S, S, 3); S a power of two.

    Raises:
        ValueError: pictures of another shape.
    """

    def __init__(self, pictures: Float[Tensor, "M S S 3"]) -> None:
        side = pictures.shape[1]
        if side < 2 or side & (side - 1) or pictures.shape[2:] != (side, 3):
            raise ValueError(f"pictures are (M, S, S, 3) with S a power of two, got {tuple(pictures.shape)}")
        levels, current = [], pictures.movedim(-1, 1)
        while current.shape[-1] >= 1:
            levels.append(current.movedim(1, -1).reshape(-1, 3))
            if current.shape[-1] == 1:
                break
            current = F.avg_pool2d(current, 2)
        sizes = torch.tensor([len(level) for level in levels])
        self.side = side
        self.texels = torch.cat(levels)
        self.starts = (sizes.cumsum(0) - sizes).to(pictures.device)

    def look_up(
        self, which: Int[Tensor, " N"], places: Float[Tensor, "N 2"], extent: Float[Tensor, " N"]
    ) -> Float[Tensor, "N 3"]:
        """The mean of a picture about a place, linear between texels and between resolutions.

        Args:
            which: the picture, from 0 to M - 1.
            places: columns from the left and rows from the bottom, in sides of the picture; it repeats.
            extent: side of the square of which the mean is wanted, in sides of the picture.
        """
        last = len(self.starts) - 1
        level = (extent * self.side).clamp_min(1e-6).log2().clamp(0, last - 1e-3)
        fine = level.long()
        share = (level - fine)[:, None]
        return torch.lerp(self._level(which, places, fine), self._level(which, places, fine + 1), share)

    def _level(self, which: Tensor, places: Tensor, level: Tensor) -> Tensor:
        """Looked up in the picture of side S / 2^level."""
        side = self.side >> level
        x = places[:, 0] * side - 0.5
        y = -places[:, 1] * side - 0.5
        left, top = x.floor(), y.floor()
        x, y = (x - left)[:, None], (y - top)[:, None]
        left, top = left.long(), top.long()
        mask = side - 1
        start = self.starts[level] + which * side * side
        rows = start + (top & mask) * side, start + ((top + 1) & mask) * side
        columns = left & mask, (left + 1) & mask
        upper, lower = (
            torch.lerp(
                self.texels.index_select(0, row + columns[0]), self.texels.index_select(0, row + columns[1]), x
            )
            for row in rows
        )
        return torch.lerp(upper, lower, y)
