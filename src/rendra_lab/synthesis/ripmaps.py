"""Textures that stay sharp across a surface seen at a grazing angle: shrunk along each axis on its own.

Letters: T textures, H x W texels, C channels, S samples.
"""

from __future__ import annotations

import torch
from torch import Tensor


class Ripmaps:
    """Repeating textures at all sizes, of which a sample takes the one whose texels are as large as its footprint.

    Args:
        textures: (T, H, W, C), H and W powers of two; row 0 lies at v = 0.

    Raises:
        ValueError: sides that are no powers of two.
    """

    def __init__(self, textures: Tensor) -> None:
        _, height, width, channels = textures.shape
        if height & (height - 1) or width & (width - 1) or height * width == 0:
            raise ValueError(f"sides of ripmaps must be powers of two, got {height} x {width}")
        self.size = textures.new_tensor([width, height])
        pieces, first, starts = [], 0, []
        tall = textures
        while True:
            wide = tall
            while True:
                starts.append(first)
                pieces.append(wide.reshape(-1, channels))
                first += len(pieces[-1])
                if wide.shape[2] == 1:
                    break
                wide = (wide[:, :, 0::2] + wide[:, :, 1::2]) / 2
            if tall.shape[1] == 1:
                break
            tall = (tall[:, 0::2] + tall[:, 1::2]) / 2
        self.texels = torch.cat(pieces)
        self.levels = torch.tensor([width.bit_length() - 1, height.bit_length() - 1], device=textures.device)
        self.starts = torch.tensor(starts, device=textures.device)  # of (level of v, level of u)

    def sample(self, which: Tensor, uv: Tensor, footprint: Tensor) -> Tensor:
        """Colours (S, C), linear between the texels.

        Args:
            which: (S,) int64, the texture of each sample.
            uv: (S, 2), 1 is a whole texture; it repeats.
            footprint: (S, 2), how far u and v reach over a sample.
        """
        level = (footprint * self.size).clamp_min(1e-6).log2().round().long().clamp_min(0).minimum(self.levels)
        sides = (self.size.long() >> level).contiguous()
        width, height = sides.unbind(1)
        start = self.starts[level[:, 1] * (self.levels[0] + 1) + level[:, 0]] + which * width * height
        place = uv.remainder(1.0) * sides - 0.5
        corner = place.floor()
        right, down = (place - corner).unbind(1)
        near = corner.long().remainder(sides)
        far = (near + 1).remainder(sides)
        above, below = start + near[:, 1] * width, start + far[:, 1] * width
        rows = [
            torch.lerp(self._at(row + near[:, 0]), self._at(row + far[:, 0]), right[:, None])
            for row in (above, below)
        ]
        return torch.lerp(rows[0], rows[1], down[:, None])

    def _at(self, index: Tensor) -> Tensor:
        return self.texels.index_select(0, index)
