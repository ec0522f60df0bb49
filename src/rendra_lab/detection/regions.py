"""Regions of pictures in which something may stand, and which of them a step learns from.

Letters: B pictures, N annotated objects, P proposed regions, F regions with an object and Q of background.
Boxes: as of `rendra_lab.detection.records`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rendra_lab.detection.matching import Matcher, balanced_sample
from rendra_lab.detection.records import Instances
from rendra_lab.records import TensorRecord
from rendra_lab.settings import Fraction, Positive

Maps = Sequence[Float[Tensor, "B D _ _"]]  # levels of a feature pyramid, finest first


@dataclass(frozen=True)
class Proposals(TensorRecord):
    """Boxes worth a look, those of the first picture first."""

    picture: Int[Tensor, " P"]
    boxes: Float[Tensor, "P 4"]


@dataclass(frozen=True)
class ObjectRegions(TensorRecord):
    """Proposed regions, true boxes among them, that overlap an annotated object enough to be taken for it."""

    picture: Int[Tensor, " F"]
    boxes: Float[Tensor, "F 4"]
    labels: Int[Tensor, " F"]  # class of the object
    objects: Int[Tensor, " F"]  # which row of the batch's `Instances` it is


@dataclass(frozen=True)
class SampledRegions(TensorRecord):
    """What the heads of a detector learn from in one step."""

    objects: ObjectRegions
    background: Proposals

    @property
    def all(self) -> Proposals:
        """Both, those with an object first."""
        return Proposals(
            torch.cat([self.objects.picture, self.background.picture]),
            torch.cat([self.objects.boxes, self.background.boxes]),
        )


class RegionSampler:
    """Draws regions of each picture, at random; the true boxes themselves are proposals too.

    Args:
        matcher: says what holds an object and what is background; null: overlaps of 0.5 or more do, all others are.
        count: of regions of a picture, at most.
        positive_fraction: of them with an object, at most.
    """

    def __init__(
        self, matcher: Matcher | None = None, count: Positive = 512, positive_fraction: Fraction = 0.25
    ) -> None:
        self.matcher = matcher or Matcher()
        self.count = count
        self.positive_fraction = positive_fraction

    @torch.no_grad()
    def __call__(self, proposals: Proposals, instances: Instances, pictures: int) -> SampledRegions:
        """Regions of all pictures, in their order.

        Args:
            proposals: of the pictures.
            instances: what stands in them.
            pictures: B.
        """
        picture = torch.cat([instances.picture, proposals.picture])
        boxes = torch.cat([instances.boxes.to(proposals.boxes), proposals.boxes])
        drawn = [
            self._drawn(boxes, (picture == number).nonzero()[:, 0], (instances.picture == number).nonzero()[:, 0])
            for number in range(pictures)
        ]
        rows, objects, rest = (torch.cat(parts) for parts in zip(*drawn, strict=True))
        labels = instances.labels.index_select(0, objects)
        return SampledRegions(
            ObjectRegions(picture[rows], boxes[rows], labels, objects), Proposals(picture[rest], boxes[rest])
        )

    def _drawn(self, boxes: Tensor, rows: Tensor, objects: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Of one picture: the rows of `boxes` with an object, which object, and the rows of background."""
        matches = self.matcher(boxes[objects], boxes[rows])  # annotated objects are the first rows of `boxes`
        found, background = balanced_sample(matches.labels, self.count, self.positive_fraction)
        index = objects[matches.index[found]] if len(objects) else found
        return rows[found], index, rows[background]
