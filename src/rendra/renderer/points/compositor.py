"""Modules that blend the points behind each pixel, before a background."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from rendra.renderer.compositing import alpha_composite, norm_weighted_sum

Color = Sequence[float] | Tensor


class AlphaCompositor(nn.Module):
    """Front-to-back compositing by opacity; see `alpha_composite`."""

    def __init__(self, background_color: Color | None = None) -> None:
        """Keep the background.

        Args:
            background_color: (C,) features of pixels without a point; for images of four channels also three colours,
                to which an alpha of 1 is added. None leaves such pixels 0.
        """
        super().__init__()
        self.background_color = background_color

    def forward(self, fragments: Tensor, alphas: Tensor, ptclds: Tensor, **kwargs: Any) -> Tensor:
        """Blend.

        Args:
            fragments: (N, K, H, W) integers, packed index of each point, nearest first, negative where empty.
            alphas: (N, K, H, W) opacities.
            ptclds: (C, P) features of the packed points.
            **kwargs: `background_color` to replace that of this compositor.

        Returns:
            (N, C, H, W).

        Raises:
            ValueError: shapes that do not fit, or a background of another number of channels.
        """
        images = alpha_composite(fragments, alphas, ptclds)
        return _with_background(images, fragments, kwargs.get("background_color", self.background_color))


class NormWeightedCompositor(nn.Module):
    """Weighted mean of the points behind a pixel; see `norm_weighted_sum`."""

    def __init__(self, background_color: Color | None = None) -> None:
        """Keep the background; as of `AlphaCompositor`."""
        super().__init__()
        self.background_color = background_color

    def forward(self, fragments: Tensor, alphas: Tensor, ptclds: Tensor, **kwargs: Any) -> Tensor:
        """Blend; arguments, result and errors as of `AlphaCompositor`."""
        images = norm_weighted_sum(fragments, alphas, ptclds)
        return _with_background(images, fragments, kwargs.get("background_color", self.background_color))


def _with_background(images: Tensor, fragments: Tensor, background_color: Color | None) -> Tensor:
    """The background where a pixel's nearest slot is empty."""
    if background_color is None:
        return images
    color = _channels_of(background_color, images)
    is_empty = fragments[:, :1] < 0
    return torch.where(is_empty, color[:, None, None], images)


def _channels_of(background_color: Color, images: Tensor) -> Tensor:
    """The background (C,) beside images (N, C, H, W).

    Raises:
        ValueError: it has another number of channels.
    """
    color = torch.as_tensor(background_color).to(images)
    if color.ndim == 0:
        color = color.expand(images.shape[1])
    if color.ndim > 1:
        raise ValueError(f"Wrong shape of background_color: expected one number a channel, got {tuple(color.shape)}")
    if images.shape[1] == 4 and len(color) == 3:
        color = torch.cat((color, color.new_ones(1)))
    if len(color) != images.shape[1]:
        raise ValueError(f"background_color has {len(color)} channels, the images have {images.shape[1]}")
    return color
