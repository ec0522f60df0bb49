"""Pictures to features, and features, moved into another view, back to pictures.

Wiles et al., "SynSin", CVPR 2020, arXiv:1912.08804, Sec. 3.1 and 3.3; sizes are those of its code.
Pictures are sRGB in [0, 1] outside, and in [-1, 1] within.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from rendra_lab.errors import UserError
from rendra_lab.networks.spectral_blocks import Resample, ResidualChain
from rendra_lab.settings import Amount, Count, Positive
from rendra_lab.tasks.synsin.hole_filling import filled

_LEAST_COVER = 1e-3  # of a pixel: where there is less, the colour is nobody's
_PAINTED = 0.5  # of the way to white or black, the furthest that the decoder moves colours of holes
_RETOUCHED = 0.02  # the same where points cover a pixel
_COVERED = 0.25  # what is covered by so much is no hole


class FeatureEncoder(nn.Module):
    """A picture to features of each of its pixels.

    Args:
        widths: channels behind each residual block.
        resample: of each block, see `ResidualChain`.
        fold: the blocks see squares of `fold` x `fold` pixels as one, with more channels.
        keep_color: the first four features are the picture itself and 1, beside what the blocks make of it.
        noise_seed, noise_std: see `NoiseBatchNorm`.

    `channels` is how many features a pixel has.
    """

    def __init__(
        self,
        widths: Sequence[int] = (32, 32, 32, 64, 64, 64, 64, 64),
        resample: Sequence[Resample] | None = None,
        fold: Positive = 1,
        keep_color: bool = False,
        noise_seed: Count = 0,
        noise_std: Amount = 1.0,
    ) -> None:
        super().__init__()
        if not widths or widths[-1] % fold**2:
            raise UserError(f"the last of the encoder's widths must be a multiple of fold^2 = {fold**2}: {widths}")
        self.keep_color = keep_color
        self.channels = widths[-1] // fold**2 + 4 * keep_color
        self.chain = ResidualChain(3 * fold**2, widths, resample, 2 * noise_seed, noise_std, fold)

    def forward(self, pictures: Tensor) -> Tensor:
        """Features (B, C, H, W) of pictures (B, 3, H, W)."""
        inner = 2 * pictures - 1
        features = self.chain(inner)
        return torch.cat([inner, torch.ones_like(inner[:, :1]), features], 1) if self.keep_color else features


class RefinementDecoder(nn.Module):
    """Features as they fell into a new view, holes and all, to the picture of that view: the last layer's tanh.

    Args:
        channels: C, of the features.
        widths: channels behind each residual block but the last, which gives the picture.
        resample: of each block, the last included, see `ResidualChain`.
        fold: the blocks see squares of `fold` x `fold` pixels as one, with more channels.
        keep_color: the first four features are colours and how much of a pixel they cover, as `FeatureEncoder`
            keeps them. Holes take the colours about them, and the tanh says how far towards white or black each
            channel of that moves: little where points fell, half the way at most in holes, and alike in neighbours.
        noise_seed, noise_std: see `NoiseBatchNorm`.
    """

    def __init__(
        self,
        channels: Positive = 64,
        widths: Sequence[int] = (64, 128, 256, 256, 128, 128, 128),
        resample: Sequence[Resample] | None = ("keep", "down", "down", "keep", "up", "up", "keep", "keep"),
        fold: Positive = 1,
        keep_color: bool = False,
        noise_seed: Count = 0,
        noise_std: Amount = 1.0,
    ) -> None:
        super().__init__()
        if keep_color and channels < 4:
            raise UserError(f"a decoder that keeps colours needs channels of at least 4, got {channels}")
        self.channels = channels
        self.keep_color = keep_color
        outer = [*widths, 3 if keep_color else 3 * fold**2]
        # odd: other noise than the encoder's of the same seed
        odd = 2 * noise_seed + 1
        self.chain = ResidualChain(channels * fold**2, outer, resample, odd, noise_std, fold, keep_color)

    def forward(self, features: Tensor) -> Tensor:
        """Pictures (B, 3, H, W) of features (B, C, H, W).

        Raises:
            ValueError: the features are not C, or their sides no multiples of what the blocks halve.
        """
        if features.ndim != 4 or features.shape[1] != self.channels:
            raise ValueError(f"a decoder of {self.channels} features got {tuple(features.shape)}")
        if not self.keep_color:
            return 0.5 * torch.tanh(self.chain(features)) + 0.5
        weights = features[:, 3:4]
        cover = weights.clamp(0, 1)
        given = filled((features[:, :3] / weights.clamp_min(_LEAST_COVER)).clamp(-1, 1), cover)
        answer = torch.tanh(self.chain(torch.cat([given, features[:, 3:]], 1)))
        reach = _PAINTED + (_RETOUCHED - _PAINTED) * (cover / _COVERED).clamp_max(1)
        change = reach * answer
        return 0.5 * (given * (1 - change.abs()) + change) + 0.5
