"""From the features of a few rays to a picture: Niemeyer and Geiger, "GIRAFFE", CVPR 2021, Sec. 3.4, Fig. 4."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.networks.initialization import he_init
from rendra_lab.settings import Positive

_SLOPE = 0.2  # of leaky ReLUs


class NeuralRenderer(nn.Module):
    """Doubles the resolution with a convolution at a time; at each, colours are added that grow smoothly.

    Its options are the rows of the paper's ablation (Table 4).

    Args:
        features: channels of the feature image.
        feature_side: V, its pixels.
        picture_side: S, a power of two times V.
        least_width: each convolution halves the channels, down to this.
        rgb_skips: colours are summed over all resolutions; false takes those of the last alone.
        sigmoid: at the end; false clamps nothing.
        feature_upsampling, rgb_upsampling: `nearest` or `bilinear`, that followed by a small blur for the colours.
        torch_init: weights begin as PyTorch's do, as published.

    Raises:
        UserError: sizes that are not a power of two apart.
    """

    def __init__(
        self,
        features: Positive = 128,
        feature_side: Positive = 16,
        picture_side: Positive = 64,
        least_width: Positive = 32,
        rgb_skips: bool = True,
        sigmoid: bool = True,
        feature_upsampling: Literal["nearest", "bilinear"] = "nearest",
        rgb_upsampling: Literal["nearest", "bilinear"] = "bilinear",
        torch_init: bool = False,
    ) -> None:
        super().__init__()
        doublings = (max(picture_side // feature_side, 1)).bit_length() - 1
        if feature_side << doublings != picture_side:
            raise UserError(
                f"a picture's side must be 1, 2, 4, 8 .. times that of its features, got picture_side={picture_side} "
                f"and feature_side={feature_side}"
            )
        widths = [features, *(max(features >> number, least_width) for number in range(1, doublings + 1))]
        self.features, self.feature_side, self.picture_side = features, feature_side, picture_side
        self.sigmoid = sigmoid
        self.feature_upsampling, self.rgb_upsampling = feature_upsampling, rgb_upsampling
        convs = [nn.Conv2d(before, after, 3, padding=1) for before, after in pairwise(widths)]
        self.blocks = nn.ModuleList(convs)
        self.to_rgb = nn.ModuleList(
            nn.Conv2d(width, 3, 3, padding=1) if rgb_skips or number == doublings else nn.Identity()
            for number, width in enumerate(widths)
        )
        self.rgb_skips = rgb_skips
        if not torch_init:
            for conv in convs:
                he_init(conv, _SLOPE)

    def forward(self, features: Tensor) -> Tensor:
        """Pictures (B, 3, S, S), in [0, 1] with the sigmoid, of features (B, C, V, V)."""
        x, rgb = features, self.to_rgb[0](features) if self.rgb_skips or not self.blocks else None
        for conv, to_rgb in zip(self.blocks, list(self.to_rgb)[1:], strict=True):
            assert isinstance(conv, nn.Conv2d)
            x = F.leaky_relu(self._doubled(conv, x), _SLOPE)
            if rgb is not None:
                rgb = self._larger(rgb) + to_rgb(x)
        rgb = self.to_rgb[-1](x) if rgb is None else rgb
        return rgb.sigmoid() if self.sigmoid else rgb

    def _doubled(self, conv: nn.Conv2d, x: Tensor) -> Tensor:
        if self.feature_upsampling == "nearest":
            return doubled_and_convolved(x, conv.weight, conv.bias)
        return conv(F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False))

    def _larger(self, rgb: Tensor) -> Tensor:
        if self.rgb_upsampling == "nearest":
            return F.interpolate(rgb, scale_factor=2, mode="nearest")
        return blurred(F.interpolate(rgb, scale_factor=2, mode="bilinear", align_corners=False))


def doubled_and_convolved(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """Pixels repeated along both axes, then a 3x3 convolution with zeros around: (B, D, 2H, 2W).

    Of the nine pixels that such a convolution reads at most four differ, so that one with a stride of 1/2 and 4x4
    weights, sums of the given ones, does the same with 16 products for every 36.

    Args:
        x: (B, C, H, W).
        weight: (D, C, 3, 3).
        bias: (D,), or None.
    """
    sums = F.pad(weight, (1, 1, 1, 1))
    sums = sums[:, :, 1:] + sums[:, :, :-1]
    sums = sums[..., 1:] + sums[..., :-1]
    return F.conv_transpose2d(x, sums.flip(2, 3).transpose(0, 1), bias, stride=2, padding=1)


def blurred(pictures: Tensor) -> Tensor:
    """Each pixel averaged with its neighbours, weights 1 2 1 along both axes; pictures are mirrored at their sides.

    Args:
        pictures: (B, C, H, W), two pixels or more along each side.
    """
    rows = F.pad(pictures, (1, 1, 1, 1), mode="reflect")
    rows = 0.25 * (rows[:, :, :-2] + rows[:, :, 2:]) + 0.5 * rows[:, :, 1:-1]
    return 0.25 * (rows[..., :-2] + rows[..., 2:]) + 0.5 * rows[..., 1:-1]
