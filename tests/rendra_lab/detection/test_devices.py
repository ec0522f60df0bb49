"""Boxes, anchors, matches, suppression, RoIAlign and masks stay on the device of what they are given."""

from __future__ import annotations

from typing import Any

import torch
from far_device import Far, far  # noqa: F401

from rendra_lab.detection.anchors import LevelAnchors
from rendra_lab.detection.boxes import BoxCoder, clipped
from rendra_lab.detection.mask_pasting import cropped_masks, pasted_masks
from rendra_lab.detection.matching import Matcher, balanced_sample
from rendra_lab.detection.roi_align import RoiAlign
from rendra_lab.detection.suppression import kept_boxes, surest_of_each


def test_regions_of_a_picture_there(far: Any) -> None:  # noqa: F811
    features = [torch.randn(2, 3, 8, 8).to(far), torch.randn(2, 3, 4, 4).to(far)]
    anchors = torch.cat(LevelAnchors((8.0, 16.0), (4, 8)).of_levels(features))
    boxes = clipped(anchors, torch.tensor([[32, 32]]).to(far))
    true = torch.tensor([[3.0, 3, 15, 18], [20.0, 12, 30, 30]]).to(far)
    matches = Matcher((0.3, 0.7), (0, -1, 1), keeps_best=True)(true, boxes)
    positive, negative = balanced_sample(matches.labels, 20, 0.5)
    BoxCoder().decode(BoxCoder().encode(true[matches.index[positive]], boxes[positive]), boxes[positive])
    kept = kept_boxes(boxes, matches.overlaps, matches.labels, 0.5)
    surest = surest_of_each(matches.overlaps, matches.labels, 5)
    picture = torch.zeros(len(kept), dtype=torch.int64).to(far)
    for samples in (0, 2):
        cut = RoiAlign(3, (4, 8), samples, canonical_px=16.0)(features, boxes[kept], picture)
        assert isinstance(cut, Far)
    masks = pasted_masks(torch.rand(2, 5, 5).to(far), true, 32, 32)
    assert isinstance(cropped_masks(masks, torch.tensor([1, 0]).to(far), true, 5), Far)
    assert all(isinstance(values, Far) for values in (negative, kept, surest))
