"""Blending by splats: every coloured surface point is spread over its 3 x 3 pixels.

Cole et al., "Differentiable surface rendering via non-differentiable sampling", ICCV 2021, arXiv:2108.04886.
The rasteriser samples the surface at pixel centres; the samples are then drawn again as small Gaussians at their
projected positions. In value these are the pixel centres, so the image is only slightly blurred; in gradient they
move with the surface, so the image has derivatives at occlusion boundaries.

For a pixel p and a neighbour q, the layer of q that lies nearest in depth to the first surface of p continues that
surface; layers of q before it occlude p, layers after it are hidden. Splats are summed in these three groups, which
are then composited front over surface over back over background. Where the paper keeps the total weight of a splat
below one by a constant, the sums here are divided by the weight that the surface group received: a plane of one
colour keeps its colour, at the border of the image too.

Notation: N images, H x W pixels, K layers.
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rendra.common.datatypes import Device
from rendra.renderer.blending import BlendParams, background_color

_OFFSETS = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]  # from the splat to the pixel it lands on
_RGBA_AND_WEIGHT = 5


class SplatterBlender(nn.Module):
    """Splats of K layers of coloured points, composited into one image."""

    pixel_centres: Tensor  # (H, W, 2) as (x, y)

    def __init__(self, input_shape: tuple[int, int, int, int], device: Device) -> None:
        """Fix the (N, H, W, K) of the input, and its device."""
        super().__init__()
        self.input_shape = tuple(input_shape)
        height, width = self.input_shape[1:3]
        rows = torch.arange(height, device=device) + 0.5
        columns = torch.arange(width, device=device) + 0.5
        centres = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)
        self.register_buffer("pixel_centres", centres, persistent=False)

    def forward(
        self,
        colors: Tensor,
        pixel_coords_cameras: Tensor,
        cameras: Any,
        background_mask: Tensor,
        blend_params: BlendParams,
    ) -> Tensor:
        """Splat and composite.

        Args:
            colors: (N, H, W, K, 3), RGB of the surface points.
            pixel_coords_cameras: (N, H, W, K, 3), the points themselves, in world coordinates.
            cameras: that took the image, one for all or one for each.
            background_mask: (N, H, W, K) bool, True where a slot is empty.
            blend_params: sigma is the standard deviation of a splat in pixels; the background is used too.

        Returns:
            (N, H, W, 4).

        Raises:
            ValueError: colours of another shape than announced.
        """
        if colors.shape[:-1] != self.input_shape:
            raise ValueError(f"colors must be {(*self.input_shape, 3)}; got {tuple(colors.shape)}")
        if colors.numel() == 0:
            return colors.new_zeros(*self.input_shape[:3], 4)
        shift, depth = self._projected(pixel_coords_cameras, cameras, background_mask)
        filled = (~background_mask)[..., None].to(colors.dtype)
        rgba = torch.cat((colors * filled, filled), dim=-1)
        layers = _accumulate(rgba, shift, depth, blend_params.sigma)
        return _composite(layers, background_color(blend_params, colors))

    def _projected(self, points: Tensor, cameras: Any, background_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (N, H, W, K, 2) in pixels from each pixel's centre to its points, and view depth (N, H, W, K).

        Empty slots lie at the centre, behind everything.
        """
        height, width = self.input_shape[1:3]
        flat = points.flatten(1, 3)
        screen = cameras.transform_points_screen(flat, image_size=(height, width), with_xyflip=True)
        view = cameras.get_world_to_view_transform().transform_points(flat)
        shift = screen[..., :2].view(*points.shape[:-1], 2) - self.pixel_centres[:, :, None]
        shift = shift.masked_fill(background_mask[..., None], 0.0)
        depth = view[..., 2].view(points.shape[:-1]).detach()  # occlusion is decided, not differentiated
        nearest, farthest = depth.aminmax()
        return shift, torch.where(background_mask, 2 * farthest - nearest + 1, depth)


def _accumulate(rgba: Tensor, shift: Tensor, depth: Tensor, sigma: float) -> Tensor:
    """Sums (N, H, W, 3, 5) of splatted RGBA and weight in front of, on and behind the surface of each pixel."""
    total = torch.stack([_weight(shift, offset, sigma) for offset in _OFFSETS]).sum(0)
    shares = torch.cat((rgba, torch.ones_like(rgba[..., :1])), dim=-1) / total[..., None]
    shares, shift, far = _pad(shares), _pad(shift), _pad(depth[..., None])[..., 0]
    layers = shares.new_zeros(*depth.shape[:3], 3, _RGBA_AND_WEIGHT)
    index = torch.arange(depth.shape[3], device=depth.device)
    for offset in _OFFSETS:
        splat_depth = _neighbor(far, offset)
        same = (splat_depth - depth[..., :1]).abs().argmin(-1, keepdim=True)
        hidden = (index > same) & (_neighbor(shares, offset)[..., 3] > 0)  # empty slots hide nothing, however many
        groups = torch.stack((index < same, index == same, hidden), dim=-2)  # (N, H, W, 3, K)
        weight = _weight(_neighbor(shift, offset), offset, sigma)
        layers = layers + (groups * weight[..., None, :]) @ _neighbor(shares, offset)
    return layers


def _weight(shift: Tensor, offset: tuple[int, int], sigma: float) -> Tensor:
    """Gaussian of a splat, `shift` off its pixel's centre, at the pixel `offset` away. (N, H, W, K)"""
    dx, dy = shift[..., 0] - offset[1], shift[..., 1] - offset[0]
    return (-(dx.square() + dy.square()) / (2 * sigma**2)).exp()


def _pad(values: Tensor) -> Tensor:
    """One pixel of zeros around (N, H, W, K, C)."""
    return F.pad(values, (0, 0, 0, 0, 1, 1, 1, 1))


def _neighbor(padded: Tensor, offset: tuple[int, int]) -> Tensor:
    """For every pixel p the values at p - offset, of a batch that `_pad` has padded."""
    height, width = padded.shape[1] - 2, padded.shape[2] - 2
    top, left = 1 - offset[0], 1 - offset[1]
    return padded[:, top : top + height, left : left + width]


def _composite(layers: Tensor, background: Tensor) -> Tensor:
    """Front over surface over back over the background: (N, H, W, 4)."""
    weight = layers[..., 4:]
    rgba = layers[..., :4] / torch.maximum(weight, weight[..., 1:2, :])
    image = torch.cat((background, background.new_zeros(1)))
    for group in (2, 1, 0):
        premultiplied = rgba[..., group, :]
        image = premultiplied + (1 - premultiplied[..., 3:]) * image
    return image
