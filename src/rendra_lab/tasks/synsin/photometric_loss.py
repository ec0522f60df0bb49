"""Depth that explains a second picture: what a pixel shows is where its depth says, in the other view.

SynSin learns depth through splats alone, whose gradients reach as far as a disc: tens of thousands of steps. Seen
from pixels, as in Zhou et al., "Unsupervised Learning of Depth and Ego-Motion from Video", CVPR 2017, and Godard et
al., "Digging Into Self-Supervised Monocular Depth Estimation", ICCV 2019 (Eqs. 2 and 3), and from coarse pictures to
fine ones, whose gradients reach across objects, a thousand will do. It needs pairs alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.settings import Amount, Fraction, Positive, check_numbers
from rendra_lab.synthesis.posed_views import to_other_view

_C1, _C2 = 0.01**2, 0.03**2  # of SSIM, for pictures in [0, 1]


class PhotometricLoss:
    """The input, put together from the target by the input's depth, against the input; a scalar.

    On each level of a pyramid of halved pictures: alpha / 2 (1 - SSIM) + (1 - alpha) |difference|, SSIM over 3 x 3
    pixels, the mean over those that the target's camera has in view; levels averaged. Besides, `smoothness` times the
    change of 1 / depth over its mean, where the picture does not change.

    Args:
        levels: of the pyramid, 0 the picture itself.
        alpha: share of SSIM.
        smoothness: weight of smooth depth.
    """

    def __init__(self, levels: Sequence[int] = (1, 2, 3), alpha: Fraction = 0.85, smoothness: Amount = 0.02) -> None:
        check_numbers("loss.photometric.fn", Fraction, alpha=alpha)
        check_numbers("loss.photometric.fn", Amount, smoothness=smoothness)
        if not levels or min(levels) < 0:
            raise UserError(f"loss.photometric.fn.levels: numbers from 0 on, at least one; got {list(levels)}")
        self.levels = tuple(levels)
        self.alpha = alpha
        self.smoothness = smoothness

    def __call__(
        self,
        depth: Float[Tensor, "B 1 H W"],
        target: Float[Tensor, "B 3 H W"],
        input: Float[Tensor, "B 3 H W"],
        intrinsics: Float[Tensor, "B 3 3"],
        target_intrinsics: Float[Tensor, "B 3 3"],
        input_to_target: Float[Tensor, "B 4 4"],
    ) -> Float[Tensor, ""]:
        """The loss of z of the inputs, see `PairBatch`; differentiable in it."""
        nearness = 1 / depth
        errors = []
        for level in self.levels:
            scale = 2**level
            here, there, coarse = (F.avg_pool2d(values, scale) for values in (input, target, nearness))
            pixels, z = to_other_view(
                1 / coarse, _scaled(intrinsics, scale), input_to_target, _scaled(target_intrinsics, scale)
            )
            size = pixels.new_tensor([here.shape[-1], here.shape[-2]])
            inside = ((pixels >= 0) & (pixels <= size)).all(-1) & (z > 0)
            grid = torch.where(inside[..., None], 2 * pixels / size - 1, 0.0)
            made = F.grid_sample(there, grid, padding_mode="border", align_corners=False)
            errors.append(_mean_where(self._difference(made, here), inside[:, None]))
        return torch.stack(errors).mean() + self.smoothness * _roughness(nearness, input)

    def _difference(self, made: Tensor, true: Tensor) -> Tensor:
        """(B, 1, H, W)"""
        unlike = (0.5 - 0.5 * _local_ssim(made, true)).clamp(0, 1)
        return (self.alpha * unlike + (1 - self.alpha) * (made - true).abs()).mean(1, keepdim=True)


def _scaled(intrinsics: Tensor, scale: Positive) -> Tensor:
    """Of pictures that are that many times smaller; edges of pictures stay edges."""
    return torch.cat([intrinsics[:, :2] / scale, intrinsics[:, 2:]], dim=1)


def _local_ssim(first: Tensor, second: Tensor) -> Tensor:
    """Of each pixel's 3 x 3 neighbours: (B, 3, H, W)."""
    values = torch.stack([first, second, first * first, second * second, first * second])
    padded = F.pad(values.flatten(0, 1), (1, 1, 1, 1), mode="reflect")
    mean1, mean2, square1, square2, product = F.avg_pool2d(padded, 3, 1).view_as(values)
    spread1, spread2, joint = square1 - mean1 * mean1, square2 - mean2 * mean2, product - mean1 * mean2
    return ((2 * mean1 * mean2 + _C1) * (2 * joint + _C2)) / (
        (mean1 * mean1 + mean2 * mean2 + _C1) * (spread1 + spread2 + _C2)
    )


def _mean_where(values: Tensor, mask: Tensor) -> Tensor:
    """Zero where nothing is."""
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp_min(1)


def _roughness(nearness: Tensor, picture: Tensor) -> Tensor:
    relative = nearness / nearness.mean((2, 3), keepdim=True)
    changes = []
    for axis in (-2, -1):
        edge = picture.diff(dim=axis).abs().mean(1, keepdim=True)
        changes.append((relative.diff(dim=axis).abs() * torch.exp(-10 * edge)).mean())
    return torch.stack(changes).sum()
