"""The depth of every pixel of a picture, by a U-Net that ends in a sigmoid.

Ronneberger et al., "U-Net", MICCAI 2015; widths and order are SynSin's.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from rendra_lab.errors import UserError
from rendra_lab.networks.spectral_blocks import spectral_conv
from rendra_lab.settings import Positive, Size

_WIDEST = 8  # times the width of the first level


class DepthUNet(nn.Module):
    """Pictures to depth, which a sigmoid s of the last layer holds between two limits.

    Linear: depth = min_z + s (max_z - min_z). Inverse: 1 / depth = 1 / max_z + s (1 / min_z - 1 / max_z), so that
    near things are resolved better than far ones. SynSin's inverse form, 1 / (10 s + 0.01), ignores its limits: it
    is this one with min_z = 1 / 10.01 and max_z = 100.

    Each level halves the resolution with a 4x4 convolution; on the way back each doubles it (bilinear), convolves
    (3x3) and takes along what the way down knew at that resolution. Convolutions are spectral-normalised.

    Args:
        levels: halvings; sides of pictures are multiples of 2^levels.
        base: channels of the first level; they double three times.
        min_z, max_z: limits of the depth, in the scene's units.
        inverse: the sigmoid is linear in 1 / depth.
        start_z: the depth that an untrained network sees everywhere, up to noise; null: where s = 1/2.

    Raises:
        UserError: not 0 < min_z < max_z, or `start_z` not between them.
    """

    def __init__(
        self,
        levels: Positive = 8,
        base: Positive = 32,
        min_z: Size = 1.0,
        max_z: Size = 50.0,
        inverse: bool = False,
        start_z: Size | None = None,
    ) -> None:
        super().__init__()
        if not 0 < min_z < max_z or not (start_z is None or min_z < start_z < max_z):
            raise UserError(
                f"depth needs 0 < min_z < max_z, and start_z between them: got {min_z}, {max_z} and {start_z}"
            )
        self.multiple = 2**levels
        self.ends = (1 / max_z, 1 / min_z) if inverse else (min_z, max_z)  # at s = 0 and s = 1
        self.inverse = inverse
        widths = [base * min(2**level, _WIDEST) for level in range(levels)]
        self.down = nn.ModuleList(_Down(widths, level) for level in range(levels))
        self.up = nn.ModuleList(_Up(widths, level) for level in reversed(range(levels)))
        if start_z is not None:
            nn.init.constant_(self.up[-1].get_parameter("conv.bias"), self._logit(start_z))

    def forward(self, pictures: Tensor) -> Tensor:
        """Depth (B, 1, H, W) of pictures (B, 3, H, W), sRGB in [0, 1].

        Raises:
            ValueError: H or W is no multiple of 2^levels.
        """
        self._check_size(pictures)
        x, skips = 2 * pictures - 1, []
        for down in self.down:
            x = down(x)
            skips.append(x)
        x = self.up[0](skips.pop())
        for up in self.up[1:]:
            x = up(torch.cat([x, skips.pop()], 1))
        first, last = self.ends
        value = first + torch.sigmoid(x) * (last - first)
        return 1 / value if self.inverse else value

    def _check_size(self, pictures: Tensor) -> None:
        height, width = pictures.shape[-2:]
        if height % self.multiple == 0 and width % self.multiple == 0:
            return
        common = math.gcd(height, width)
        fits = (common & -common).bit_length() - 1  # halvings that both sides allow
        advice = f"levels={fits} would fit" if fits else "both sides must be even"
        raise ValueError(
            f"a depth network of {len(self.down)} levels takes pictures whose sides are multiples of {self.multiple} "
            f"pixels, got {height} x {width}: {advice}"
        )

    def _logit(self, depth: float) -> float:
        """Of which the sigmoid gives the depth."""
        first, last = self.ends
        share = ((1 / depth if self.inverse else depth) - first) / (last - first)
        return math.log(share / (1 - share))


class _Down(nn.Module):
    """LeakyReLU (not on the picture), 4x4 with stride 2, batch norm (not on the first and the last level)."""

    def __init__(self, widths: list[int], level: int) -> None:
        super().__init__()
        self.act = nn.LeakyReLU(0.2) if level else nn.Identity()
        self.conv = spectral_conv(widths[level - 1] if level else 3, widths[level], 4, stride=2, padding=1)
        self.norm = nn.BatchNorm2d(widths[level]) if 0 < level < len(widths) - 1 else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(self.conv(self.act(x)))


class _Up(nn.Module):
    """ReLU, twice the resolution, 3x3, batch norm (not behind the depth itself)."""

    def __init__(self, widths: list[int], level: int) -> None:
        super().__init__()
        innermost = level == len(widths) - 1
        out = widths[level - 1] if level else 1
        self.act = nn.Sequential(nn.ReLU(), nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False))
        self.conv = spectral_conv(widths[level] * (1 if innermost else 2), out, 3)
        self.norm = nn.BatchNorm2d(out) if level else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(self.conv(self.act(x)))
