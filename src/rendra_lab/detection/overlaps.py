"""Which found and which true objects show in the same picture, and how far they cover each other.

Letters: M found and N true objects of a batch; those of one picture are m and n.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rendra_lab.detection.boxes import iou
from rendra_lab.detection.mask_pasting import pasted_masks
from rendra_lab.detection.records import Detections, Instances
from rendra_lab.errors import UserError
from rendra_lab.latest_answers import remembered

CoverKind = Literal["box", "mask"]


class PictureOverlaps(NamedTuple):
    """One picture, with its found objects in the order of falling scores; on the CPU."""

    found: Int[Tensor, " m"]  # rows of the detections, the surest first
    true: Int[Tensor, " n"]  # rows of the instances
    ious: Float[Tensor, "m n"]  # float64, in [0, 1]
    found_areas: Float[Tensor, " m"]  # square pixels, float64


@remembered()
def overlaps_of(kind: CoverKind, detections: Detections, instances: Instances) -> list[PictureOverlaps]:
    """The intersections over union of boxes or masks in all pictures that show a found or a true object.

    Predicted masks are pasted into their picture and cut at a probability of 0.5.

    Raises:
        UserError: masks of a detector without them.
    """
    pictures = torch.cat([detections.picture, instances.picture]).unique().tolist()
    order = detections.scores.argsort(descending=True, stable=True)
    sorted_pictures = detections.picture.index_select(0, order)
    return [
        _overlaps(kind, detections, instances, order[sorted_pictures == picture], _rows(instances, picture))
        for picture in pictures
    ]


def mask_iou(first: Bool[Tensor, "m H W"], second: Bool[Tensor, "n H W"]) -> Float[Tensor, "m n"]:
    """Intersection over union of each of m masks with each of n, float64; 0 where both are empty."""
    one, other = (masks.flatten(1).float() for masks in (first, second))  # float32 counts to 2^24 exactly
    shared = (one @ other.T).double()
    union = one.sum(1).double()[:, None] + other.sum(1).double() - shared
    return shared / union.clamp_min(1)


def nearest_truths(
    detections: Detections, instances: Instances, least_iou: float = 0.3
) -> tuple[Int[Tensor, " M"], Float[Tensor, " M"]]:
    """The true object of its picture whose box each found one covers best, and by how much.

    Returns:
        Rows of the instances, -1 where no intersection over union is above `least_iou`, and the largest of those.
    """
    rows = torch.full((len(detections.scores),), -1, dtype=torch.int64)
    best = torch.zeros(len(rows), dtype=torch.float64)
    for found, true, ious, _ in overlaps_of("box", detections, instances):
        if len(found) and len(true):
            most, column = ious.max(dim=1)
            best[found] = most
            rows[found] = torch.where(most > least_iou, true[column], -1)
    return rows, best


def _overlaps(
    kind: CoverKind, detections: Detections, instances: Instances, found: Tensor, true: Tensor
) -> PictureOverlaps:
    boxes = detections.boxes.index_select(0, found)
    if kind == "box":
        boxes = boxes.double()
        ious = iou(boxes, instances.boxes.index_select(0, true).double())
        areas = (boxes[:, 2:] - boxes[:, :2]).clamp_min(0).prod(1)
    else:
        if detections.masks is None:
            raise UserError("these detections have no masks, which a score of masks needs: leave it out of metric")
        masks = instances.masks.index_select(0, true)
        pasted = pasted_masks(detections.masks.index_select(0, found), boxes, *masks.shape[1:])
        ious, areas = mask_iou(pasted, masks), pasted.sum((1, 2)).double()
    return PictureOverlaps(found.cpu(), true.cpu(), ious.cpu(), areas.cpu())


def _rows(instances: Instances, picture: int) -> Tensor:
    return (instances.picture == picture).nonzero()[:, 0]
