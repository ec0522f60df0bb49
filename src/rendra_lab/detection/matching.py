"""Which true box each region belongs to, and which regions are drawn to learn from.

Letters: N true boxes and M regions (anchors or proposals) of one picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rendra_lab.detection.boxes import iou
from rendra_lab.records import TensorRecord


@dataclass(frozen=True)
class Matches(TensorRecord):
    """What each of M regions is taken to be."""

    index: Int[Tensor, " M"]  # of the true box that it overlaps most; 0 where there is none
    labels: Int[Tensor, " M"]  # 1 object, 0 background, -1 neither: nothing to learn from
    overlaps: Float[Tensor, " M"]  # intersection over union with that box


@dataclass(frozen=True)
class Matcher:
    """What a region is follows from the overlap with its true box: thresholds cut [0, 1] into intervals with labels.

    With `keeps_best`, the regions that overlap a true box most are objects too, however little that is, so that no
    box is left without one (Ren et al., "Faster R-CNN", section 3.1.2). Which true box such a region is compared with
    stays the one that it overlaps most. In a picture without boxes all regions have the first label.
    """

    thresholds: tuple[float, ...] = (0.5,)  # intersection over union, rising; each belongs to the interval above it
    labels: tuple[int, ...] = (0, 1)  # of the intervals: 1 object, 0 background, -1 neither
    keeps_best: bool = False

    def __post_init__(self) -> None:
        if sorted(set(self.thresholds)) != list(self.thresholds) or len(self.labels) != len(self.thresholds) + 1:
            raise ValueError(
                "a matcher needs thresholds that rise and one label more than thresholds, got "
                f"thresholds={self.thresholds}, labels={self.labels}"
            )
        if not set(self.labels) <= {-1, 0, 1}:
            raise ValueError(f"labels of a matcher are 1, 0 and -1, got {self.labels}")

    def __call__(self, boxes: Float[Tensor, "N 4"], regions: Float[Tensor, "M 4"]) -> Matches:
        """Matches of regions with the true boxes of one picture."""
        table = iou(boxes, regions)
        if len(boxes):
            overlaps, index = table.max(dim=0)
        else:
            overlaps, index = regions.new_zeros(len(regions)), regions.new_zeros(len(regions), dtype=torch.int64)
        interval = torch.bucketize(overlaps, overlaps.new_tensor(self.thresholds), right=True)
        labels = index.new_tensor(self.labels)[interval]
        if self.keeps_best and table.numel():
            best = table.amax(dim=1, keepdim=True)
            labels = labels.masked_fill(((table == best) & (best > 0)).any(dim=0), 1)
        return Matches(index, labels, overlaps)


def balanced_sample(
    labels: Int[Tensor, " M"], count: int, positive_fraction: float
) -> tuple[Int[Tensor, " P"], Int[Tensor, " Q"]]:
    """Draw regions to learn from, at random and without repetition.

    Args:
        labels: 1 or more object, 0 background, negative: neither, never drawn.
        count: of regions at most; fewer where there are not as many.
        positive_fraction: of them objects, at most. What is missing of these is made up by background.

    Returns:
        Indices of the objects and of the background that were drawn, each in ascending order.
    """
    positive, negative = (labels > 0).nonzero()[:, 0], (labels == 0).nonzero()[:, 0]
    num_positive = min(len(positive), int(count * positive_fraction))
    num_negative = min(len(negative), count - num_positive)
    return _drawn(positive, num_positive), _drawn(negative, num_negative)


def _drawn(values: Tensor, count: int) -> Tensor:
    order = torch.randperm(len(values), device=values.device)[:count]
    return values[order.sort().values]
