"""Features of a picture's pixels, lifted to points by their depth and splatted into another view.

Wiles et al., "SynSin", CVPR 2020, arXiv:1912.08804, Sec. 3.2. Unlike in the published code, a pixel is lifted through
its middle, where the splatter draws it too: without a motion nothing moves.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rendra.kernels.splat_features import splat_features
from rendra_lab.settings import Amount, Positive, Size, check_numbers
from rendra_lab.synthesis.posed_views import to_other_view

Accumulation = Literal["alphacomposite", "wsum", "wsumnorm", "naive"]

_BEHIND_ALL = 1e30  # depth of what is infinitely far, in the order of what hides what


class LiftedPoints(NamedTuple):
    """The pixels of pictures as points, as another camera sees them."""

    pixels: Float[Tensor, "B P 2"]  # x right, y down, of the other picture
    depth: Float[Tensor, "B P"]  # z in the other camera's axes; 0 for what has no place


def lift(
    depth: Float[Tensor, "B 1 H W"],
    intrinsics: Float[Tensor, "B 3 3"],
    target_intrinsics: Float[Tensor, "B 3 3"],
    input_to_target: Float[Tensor, "B 4 4"],
) -> LiftedPoints:
    """Where the target's camera sees the pixels of the input, row by row.

    Differentiable in the depth. Of what is infinitely far, only the direction turns, and everything hides it; a depth
    that is negative, zero or no number has no place.
    """
    known = depth > 0
    pixels, z = to_other_view(torch.where(known, depth, 1.0), intrinsics, input_to_target, target_intrinsics)
    z = torch.where(depth[:, 0].isinf() & (z > 0), _BEHIND_ALL, z)
    return LiftedPoints(pixels.flatten(1, 2), torch.where(known[:, 0], z, 0.0).flatten(1))


class PointSplatter(nn.Module):
    """Draws the pixels of one view as soft discs into another; see `rendra.kernels.splat_features`.

    Args:
        accumulation: `alphacomposite`, `wsum`, `wsumnorm`, or `naive`, where the nearest point wins alone.
        radius_px: of a disc, pixels of the target.
        points_per_pixel: most points that a pixel is made of, the nearest ones.
        tau: exponent of the weights: larger ones make discs more pointed.
        near: depth up to which points are left out, units of the poses.
    """

    def __init__(
        self,
        accumulation: Accumulation = "alphacomposite",
        radius_px: Size = 4.0,
        points_per_pixel: Positive = 128,
        tau: Size = 1.0,
        near: Amount = 0.01,
    ) -> None:
        super().__init__()
        check_numbers("renderer", Positive, points_per_pixel=points_per_pixel)
        check_numbers("renderer", Size, radius_px=radius_px, tau=tau)
        check_numbers("renderer", Amount, near=near)
        self.accumulation = accumulation
        self.radius_px = radius_px
        self.points_per_pixel = points_per_pixel
        self.tau = tau
        self.near = near

    def forward(
        self,
        features: Float[Tensor, "B C H W"],
        depth: Float[Tensor, "B 1 H W"],
        intrinsics: Float[Tensor, "B 3 3"],
        target_intrinsics: Float[Tensor, "B 3 3"],
        input_to_target: Float[Tensor, "B 4 4"],
    ) -> tuple[Float[Tensor, "B C H W"], Float[Tensor, "B 1 H W"]]:
        """Features and opacity of the target's view, of the size of the input's.

        Gradients reach the features, and the depth through where its points fall; not through what hides what.

        Args:
            features: of the input's pixels.
            depth: z of the input; inf for sky, zero or no number for what has no place.
            intrinsics: of the input, pixels.
            target_intrinsics: of the target, pixels.
            input_to_target: columns: a point (x, y, z, 1) in the input's axes to the target's.
        """
        points = lift(depth, intrinsics, target_intrinsics, input_to_target)
        height, width = features.shape[-2:]
        image, opacity = splat_features(
            points.pixels,
            points.depth,
            features.flatten(2).mT,
            (height, width),
            self.radius_px,
            self.points_per_pixel,
            self.accumulation,
            self.tau,
            self.near,
        )
        return image, opacity

    def extra_repr(self) -> str:
        """What the settings are."""
        return f"{self.accumulation}, radius_px={self.radius_px}, points_per_pixel={self.points_per_pixel}"
