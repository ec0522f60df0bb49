"""Boxes as numbers: areas, overlaps, clipping, and the four numbers by which one box is told from another.

Boxes: x0, y0, x1, y1 in pixels, as of `rendra_lab.detection.records`. A box that is inside out has no area.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_LEAST_SIDE_PX = 1e-3  # of a box that is coded: thinner ones have no logarithm that a network could learn


def areas(boxes: Float[Tensor, "*N 4"]) -> Float[Tensor, "*N"]:
    """Square pixels, at least 0."""
    sides = (boxes[..., 2:] - boxes[..., :2]).clamp_min(0)
    return sides[..., 0] * sides[..., 1]


def overlap_areas(first: Float[Tensor, "*N 4"], second: Float[Tensor, "*M 4"]) -> Float[Tensor, "*N M"]:
    """Square pixels that each of N boxes shares with each of M."""
    low = torch.maximum(first[..., :, None, :2], second[..., None, :, :2])
    high = torch.minimum(first[..., :, None, 2:], second[..., None, :, 2:])
    sides = (high - low).clamp_min(0)
    return sides[..., 0] * sides[..., 1]


def iou(first: Float[Tensor, "*N 4"], second: Float[Tensor, "*M 4"]) -> Float[Tensor, "*N M"]:
    """Intersection over union of each of N boxes with each of M, in [0, 1]; 0 where both have no area."""
    shared = overlap_areas(first, second)
    union = areas(first)[..., :, None] + areas(second)[..., None, :] - shared
    return torch.where(shared > 0, shared / union.where(shared > 0, 1), 0)


def clipped(boxes: Float[Tensor, "N 4"], sizes: Int[Tensor, "#N 2"]) -> Float[Tensor, "N 4"]:
    """Boxes cut at the edges of their pictures, whose heights and widths are `sizes`: one a box, or one for all."""
    limits = sizes.flip(-1).repeat(1, 2).to(boxes)
    return torch.minimum(boxes.clamp_min(0), limits)


def have_sides_of(boxes: Float[Tensor, "N 4"], least_px: float) -> Bool[Tensor, " N"]:
    """Which boxes are finite, and wider and higher than `least_px`."""
    return (boxes[:, 2:] - boxes[:, :2] > least_px).all(1) & boxes.isfinite().all(1)


@dataclass(frozen=True)
class BoxCoder:
    """Boxes relative to regions: shifts of the middle in sides of the region, and logarithms of the ratios of sides.

    Ren et al., "Faster R-CNN", NIPS 2015, arXiv:1506.01497, equation 2, times weights of the four numbers that bring
    them to about variance 1. Detectors use (1, 1, 1, 1) for anchors and (10, 10, 5, 5) for proposals.
    """

    weights: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)  # of x, y, width, height
    most_log_ratio: float = math.log(1000 / 16)  # decoded sides grow by no more: exp must not overflow

    def encode(self, boxes: Float[Tensor, "*N 4"], regions: Float[Tensor, "*N 4"]) -> Float[Tensor, "*N 4"]:
        """The four numbers (N, 4) that make boxes out of regions. Sides below 0.001 px count as that."""
        (goal, goal_sides), (middle, sides) = _middles_and_sides(boxes), _middles_and_sides(regions)
        goal_sides, sides = goal_sides.clamp_min(_LEAST_SIDE_PX), sides.clamp_min(_LEAST_SIDE_PX)
        deltas = torch.cat([(goal - middle) / sides, (goal_sides / sides).log()], dim=-1)
        return deltas * deltas.new_tensor(self.weights)

    def decode(self, deltas: Float[Tensor, "*N 4"], regions: Float[Tensor, "*N 4"]) -> Float[Tensor, "*N 4"]:
        """The inverse of `encode`; leading dimensions broadcast: (R, C, 4) deltas of (R, 1, 4) regions, say."""
        shifts, log_ratios = (deltas / deltas.new_tensor(self.weights)).split(2, dim=-1)
        middle, sides = _middles_and_sides(regions)
        center = middle + shifts * sides
        half = sides * log_ratios.clamp_max(self.most_log_ratio).exp() / 2
        return torch.cat([center - half, center + half], dim=-1)


def _middles_and_sides(boxes: Tensor) -> tuple[Tensor, Tensor]:
    low, high = boxes.split(2, dim=-1)
    return (low + high) / 2, high - low
