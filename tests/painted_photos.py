"""Small pictures of coloured rectangles on noise, with everything that is known about them; and a small detector."""

import torch

from rendra_lab.detection.anchors import LevelAnchors
from rendra_lab.detection.box_head import BoxHead
from rendra_lab.detection.mask_head import MaskHead
from rendra_lab.detection.proposals import RegionProposals
from rendra_lab.detection.records import Instances, PhotoBatch
from rendra_lab.detection.regions import RegionSampler
from rendra_lab.detection.roi_align import RoiAlign
from rendra_lab.detection.two_stage_detector import TwoStageDetector
from rendra_lab.networks.feature_pyramid import FeaturePyramid
from rendra_lab.networks.residual_backbone import ResidualBackbone

CLASSES = 3
_COLORS = torch.eye(3)


def painted_photos(
    boxes: list[list[tuple[int, int, int, int, int]]], height: int = 64, width: int = 96
) -> PhotoBatch:
    """Pictures of rectangles x0, y0, x1, y1 of a class, which is their colour."""
    rgb = 0.3 * torch.rand(len(boxes), 3, height, width)
    rows = [(number, *box) for number, picture in enumerate(boxes) for box in picture]
    masks = torch.zeros(len(rows), height, width, dtype=torch.bool)
    for mask, (number, x0, y0, x1, y1, label) in zip(masks, rows, strict=True):
        rgb[number, :, y0:y1, x0:x1] = _COLORS[label][:, None, None]
        mask[y0:y1, x0:x1] = True
    table = torch.tensor(rows, dtype=torch.int64).reshape(-1, 6)
    instances = Instances(table[:, 0], table[:, 1:5].float(), table[:, 5], masks)
    sizes = torch.tensor([[height, width]] * len(boxes))
    lenses = torch.tensor([[80.0, 0, width / 2], [0, 80.0, height / 2], [0, 0, 1]]).repeat(len(boxes), 1, 1)
    return PhotoBatch(rgb, sizes, lenses, instances, [f"painted {number}" for number in range(len(boxes))])


def small_detector(width: int = 16) -> TwoStageDetector:
    """Every part, in a second's worth of work."""
    backbone = ResidualBackbone((1, 1, 1, 1), (8, 8, 16, 16), "basic")
    proposals = RegionProposals(
        width, LevelAnchors((8.0, 16.0, 32.0, 48.0, 64.0)), sampled=64, most_before=(60, 40), most_after=(40, 30)
    )
    return TwoStageDetector(
        backbone,
        FeaturePyramid(backbone.channels, width, "group"),
        proposals,
        RegionSampler(count=32),
        BoxHead(RoiAlign(5, canonical_px=48.0), CLASSES, width, 32, most=10),
        {"masks": MaskHead(RoiAlign(6, canonical_px=48.0), CLASSES, width, 16, 1, "group")},
    )
