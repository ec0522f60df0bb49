"""What SynSin is given and what it answers.

Letters: B pairs of pictures, H x W pixels, C features.
Pictures are sRGB in [0, 1]. Pixels: x right, y down, the middle of the first pixel at 0.5.
Cameras look along +z, x right, y down (OpenCV's axes); depth is z, not the distance. Metres, where anybody knows.
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from rendra_lab.records import TensorRecord


@dataclass(frozen=True)
class PairTruth(TensorRecord):
    """What only a generated world knows: for scores and for upper bounds, never for training."""

    depth: Float[Tensor, "B 1 H W"]  # of the input; inf where there is nothing but sky
    target_depth: Float[Tensor, "B 1 H W"]
    visible: Bool[Tensor, "B 1 H W"]  # pixels of the target whose surface the input sees too


@dataclass(frozen=True)
class PairBatch(TensorRecord):
    """Pairs of pictures of one place: from the first the second is to be made."""

    input: Float[Tensor, "B 3 H W"]
    target: Float[Tensor, "B 3 H W"]
    intrinsics: Float[Tensor, "B 3 3"]  # of the input, pixels
    target_intrinsics: Float[Tensor, "B 3 3"]
    input_to_target: Float[Tensor, "B 4 4"]  # columns: a point (x, y, z, 1) in the input's axes to the target's
    truth: PairTruth | None = None


@dataclass(frozen=True)
class ViewPrediction(TensorRecord):
    """The new view, and what it was made of."""

    rgb: Float[Tensor, "B 3 H W"]
    depth: Float[Tensor, "B 1 H W"]  # of the input
    features: Float[Tensor, "B C H W"]  # of the input, splatted into the target's camera
    opacity: Float[Tensor, "B 1 H W"]  # of the splats: 0 where no point fell


@dataclass(frozen=True)
class Verdict(TensorRecord):
    """What a discriminator of several scales says of pictures: its layers' outputs, the last of each the scores."""

    scales: tuple[tuple[Tensor, ...], ...]
