"""Residual blocks whose convolutions have spectral norm 1 and whose batch norms are shaken by noise.

Brock et al., "Large Scale GAN Training" (BigGAN), ICLR 2019, the block, with noise in place of the class; Miyato et
al., "Spectral Normalization for Generative Adversarial Networks", ICLR 2018; the order is SynSin's.
Shapes: features are (B, C, H, W).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.parametrizations import spectral_norm

from rendra_lab.errors import UserError
from rendra_lab.settings import Amount, Count

NOISE_SIZE = 20
Resample = Literal["keep", "down", "up"]


def spectral_conv(
    channels_in: int, channels_out: int, size: int, stride: int = 1, padding: int | None = None, bias: bool = True
) -> nn.Conv2d:
    """A convolution whose weight, as a matrix (C_out, C_in size^2), is divided by its largest singular value.

    The value comes from one step of power iteration a training pass, and from none in evaluation. Without `padding`
    an odd size keeps the resolution.
    """
    padding = size // 2 if padding is None else padding
    return cast(nn.Conv2d, spectral_norm(nn.Conv2d(channels_in, channels_out, size, stride, padding, bias=bias)))


class NoiseBatchNorm(nn.Module):
    """(1 + gain) * BN(x) + shift, gain and shift of each channel linear in noise, BN without numbers of its own.

    In training each sample has its own noise, standard normal, drawn from torch's global stream; in evaluation all
    have the same, so that a picture does not depend on those beside it, nor on what was computed before.

    Args:
        channels: C.
        still: (N,) the noise of evaluation, not in checkpoints.
        std: of the noise; 0 leaves a batch norm alone.
    """

    still: Tensor

    def __init__(self, channels: int, still: Tensor, std: float = 1.0) -> None:
        super().__init__()
        self.std = std
        self.norm = nn.BatchNorm2d(channels, eps=1e-5, momentum=0.1, affine=False)
        self.gain = spectral_norm(nn.Linear(len(still), channels, bias=False))
        self.shift = spectral_norm(nn.Linear(len(still), channels, bias=False))
        self.register_buffer("still", still.clone(), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Features (B, C, H, W) of the same shape."""
        if self.training:
            noise = torch.randn(len(x), len(self.still), dtype=x.dtype, device=x.device)
        else:
            noise = self.still[None]
        gain, shift = 1 + self.gain(self.std * noise), self.shift(self.std * noise)
        return torch.addcmul(shift[..., None, None], self.norm(x), gain[..., None, None])


class ResidualBlock(nn.Module):
    """Norm, ReLU, 3x3, norm, ReLU, 3x3 beside a shortcut, which is a 1x1 where widths or resolution change.

    Args:
        channels_in, channels_out: of the features.
        still: (2, N) noise of evaluation of the two norms.
        resample: of both branches, last: keep, down (mean of 3x3, half the pixels), up (bilinear, twice the pixels).
        noise_std: see `NoiseBatchNorm`.
    """

    def __init__(
        self,
        channels_in: int,
        channels_out: int,
        still: Tensor,
        resample: Resample = "keep",
        noise_std: float = 1.0,
    ) -> None:
        super().__init__()
        self.branch = nn.Sequential(
            NoiseBatchNorm(channels_in, still[0], noise_std),
            nn.ReLU(),
            spectral_conv(channels_in, channels_out, 3),
            NoiseBatchNorm(channels_out, still[1], noise_std),
            nn.ReLU(),
            spectral_conv(channels_out, channels_out, 3),
        )
        changes = channels_in != channels_out or resample != "keep"
        self.shortcut = spectral_conv(channels_in, channels_out, 1) if changes else nn.Identity()
        self.resample = _resampler(resample)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C_in, H, W) to (B, C_out, H, W), (B, C_out, H / 2, W / 2) or (B, C_out, 2 H, 2 W)."""
        # resampling is linear: the sum of the resampled branches, at half the work
        return self.resample(self.branch(x) + self.shortcut(x))


class ResidualChain(nn.Module):
    """Residual blocks one after the other, with as many halvings of the resolution as doublings.

    Args:
        channels: of the input.
        widths: channels behind each block.
        resample: of each block; none changes the resolution where it is left out.
        noise_seed: of the noise of evaluation.
        noise_std: see `NoiseBatchNorm`.
        fold: squares of so many pixels on a side are folded into channels first: the blocks work at a fraction of
            the resolution. `channels` then counts those of folded pixels.
        smooth: that resolution is left by bilinear interpolation, with as many channels as the last width; else by
            unfolding, with the last width that of folded pixels. Unfolded, neighbours have weights of their own, and
            what no loss holds together shows as a pattern of `fold` pixels.

    Raises:
        UserError: `resample` is not one a block, or goes below no resolution that it comes back from.
    """

    def __init__(
        self,
        channels: int,
        widths: Sequence[int],
        resample: Sequence[Resample] | None = None,
        noise_seed: Count = 0,
        noise_std: Amount = 1.0,
        fold: int = 1,
        smooth: bool = False,
    ) -> None:
        super().__init__()
        steps = list(resample) if resample else ["keep"] * len(widths)
        self.fold = fold
        self.smooth = smooth
        self.multiple = fold * _deepest(steps, len(widths))
        generator = torch.Generator().manual_seed(noise_seed)
        still = torch.randn(len(widths), 2, NOISE_SIZE, generator=generator)
        pairs = pairwise([channels, *widths])
        self.blocks = nn.Sequential(
            *(
                ResidualBlock(first, last, noise, cast(Resample, step), noise_std)
                for (first, last), noise, step in zip(pairs, still, steps, strict=True)
            )
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels / fold^2, H, W) to (B, widths[-1] / fold^2, H, W); if smooth, to (B, widths[-1], H, W).

        Raises:
            ValueError: H or W is no multiple of `multiple`.
        """
        if x.shape[-2] % self.multiple or x.shape[-1] % self.multiple:
            raise ValueError(
                f"this network takes pictures whose sides are multiples of {self.multiple} pixels, got "
                f"{x.shape[-2]} x {x.shape[-1]}"
            )
        if self.fold == 1:
            return self.blocks(x)
        inner = self.blocks(F.pixel_unshuffle(x, self.fold))
        if self.smooth:
            return F.interpolate(inner, scale_factor=self.fold, mode="bilinear", align_corners=False)
        return F.pixel_shuffle(inner, self.fold)


def _resampler(resample: Resample) -> nn.Module:
    if resample == "down":
        return nn.AvgPool2d(3, stride=2, padding=1)
    if resample == "up":
        return nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False)
    return nn.Identity()


def _deepest(steps: Sequence[str], blocks: int) -> int:
    """By how much the resolution shrinks on the way."""
    level = deepest = 0
    for step in steps:
        level += {"keep": 0, "down": 1, "up": -1}.get(step, 99)
        deepest = max(deepest, level)
    if len(steps) != blocks or level or blocks == 0:
        raise UserError(
            "resample must name keep, down or up for each width, with as many ups as downs; got "
            f"{list(steps)} for {blocks} widths"
        )
    return 2**deepest
