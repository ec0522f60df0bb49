"""The losses of a two-stage detector. Each takes the verdicts of one of its parts and returns a scalar.

Sums over what was drawn, divided by how much that was, as in Detectron2; 0 where nothing was drawn, never NaN.
"""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional as F

from rendra_lab.detection.records import AnchorVerdicts, BoxVerdicts, CellVerdicts
from rendra_lab.settings import Amount


def anchor_objectness(verdicts: AnchorVerdicts) -> Tensor:
    """Binary cross-entropy of the logits of anchors, their mean (Ren et al., "Faster R-CNN", 2015, Eq. 1)."""
    total = F.binary_cross_entropy_with_logits(verdicts.logits, verdicts.labels, reduction="sum")
    return total / max(len(verdicts.logits), 1)


def anchor_boxes(verdicts: AnchorVerdicts, beta: Amount = 1 / 9) -> Tensor:
    """Smooth L1 of the deltas of anchors with an object, summed; divided by the number of all that were drawn.

    Args:
        verdicts: what was said, and what it should have been.
        beta: errors below it are squared.
    """
    total = F.smooth_l1_loss(verdicts.deltas, verdicts.target_deltas, reduction="sum", beta=beta)
    return total / max(len(verdicts.logits), 1)


def region_classes(verdicts: BoxVerdicts) -> Tensor:
    """Cross-entropy of the classes of regions, background among them, their mean (Girshick, 2015, Eq. 1)."""
    return F.cross_entropy(verdicts.logits, verdicts.labels, reduction="sum") / max(len(verdicts.labels), 1)


def region_boxes(verdicts: BoxVerdicts, beta: Amount = 1.0) -> Tensor:
    """Smooth L1 of the deltas of regions with an object, summed; divided by the number of all that were drawn.

    Args:
        verdicts: what was said, and what it should have been.
        beta: errors below it are squared.
    """
    total = F.smooth_l1_loss(verdicts.deltas, verdicts.target_deltas, reduction="sum", beta=beta)
    return total / max(len(verdicts.labels), 1)


def cells(verdicts: CellVerdicts) -> Tensor:
    """Binary cross-entropy of the cells of masks or voxels, their mean over cells and regions with an object."""
    total = F.binary_cross_entropy_with_logits(verdicts.logits, verdicts.targets, reduction="sum")
    return total / max(verdicts.logits.numel(), 1)
