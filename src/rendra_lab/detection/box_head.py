"""What a region holds and where exactly it ends: the second stage of a detector.

Girshick, "Fast R-CNN", ICCV 2015, arXiv:1504.08083; two fully connected layers as in Lin et al., "Feature Pyramid
Networks", CVPR 2017, Sec. 4.2. Numbers are Detectron2's where nothing else is said.
Letters: B pictures, R regions, M detections, C classes.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab.detection.boxes import BoxCoder, clipped, have_sides_of
from rendra_lab.detection.records import BoxVerdicts, Detections
from rendra_lab.detection.regions import Maps, Proposals, SampledRegions
from rendra_lab.detection.roi_align import RoiAlign
from rendra_lab.detection.suppression import kept_boxes, surest_of_each
from rendra_lab.settings import Fraction, Positive

_LEAST_SIDE_PX = 1e-2  # of a detection


class BoxHead(nn.Module):
    """Two fully connected layers to the class of a region, and to a box for each class.

    Args:
        pool: cuts the regions.
        classes: C.
        channels: of the features.
        width: of the layers.
        least_score: probability of a class that is a detection.
        overlap: of two detections of one class above which the surer one stays.
        most: detections of a picture.
    """

    def __init__(
        self,
        pool: RoiAlign,
        classes: Positive,
        channels: Positive = 256,
        width: Positive = 1024,
        least_score: Fraction = 0.05,
        overlap: Fraction = 0.5,
        most: Positive = 100,
    ) -> None:
        super().__init__()
        self.pool = pool
        self.classes = classes
        self.least_score, self.overlap, self.most = least_score, overlap, most
        self.coder = BoxCoder((10.0, 10.0, 5.0, 5.0))
        self.first = nn.Linear(channels * pool.side**2, width)
        self.second = nn.Linear(width, width)
        self.logits = nn.Linear(width, classes + 1)
        self.deltas = nn.Linear(width, 4 * classes)
        for layer in (self.first, self.second):
            nn.init.kaiming_uniform_(layer.weight, a=1)
        nn.init.normal_(self.logits.weight, std=0.01)
        nn.init.normal_(self.deltas.weight, std=0.001)
        for layer in (self.first, self.second, self.logits, self.deltas):
            nn.init.zeros_(layer.bias)

    def forward(self, maps: Maps, regions: Proposals) -> tuple[Float[Tensor, "R C1"], Float[Tensor, "R C 4"]]:
        """Logits of the C classes and, last, the background; deltas of the box of each class."""
        x = self.pool(maps, regions.boxes, regions.picture).flatten(1)
        x = F.relu(self.second(F.relu(self.first(x))))
        return self.logits(x), self.deltas(x).unflatten(1, (self.classes, 4))

    def learned(self, maps: Maps, regions: SampledRegions, boxes: Float[Tensor, "N 4"]) -> BoxVerdicts:
        """What the head says of regions, beside the truth.

        Args:
            maps: features of the pictures.
            regions: to learn from.
            boxes: of the annotated objects.
        """
        logits, deltas = self(maps, regions.all)
        found = regions.objects
        background = found.labels.new_full((len(regions.background.boxes),), self.classes)
        own = deltas[: len(found.labels)].gather(1, found.labels[:, None, None].expand(-1, 1, 4))[:, 0]
        goals = self.coder.encode(boxes.to(found.boxes).index_select(0, found.objects), found.boxes)
        return BoxVerdicts(logits, torch.cat([found.labels, background]), own, goals)

    def detections(self, maps: Maps, proposals: Proposals, sizes: Int[Tensor, "B 2"]) -> Detections:
        """What stands in pictures, the surest first in each.

        Args:
            maps: features of the pictures.
            proposals: regions to look at.
            sizes: heights and widths of the pictures.
        """
        logits, deltas = self(maps, proposals)
        scores = logits.softmax(1)[:, : self.classes]
        region, label = (scores > self.least_score).nonzero().unbind(1)
        picture = proposals.picture[region]
        boxes = self.coder.decode(deltas[region, label], proposals.boxes[region])
        boxes, scores = clipped(boxes, sizes[picture]), scores[region, label]
        is_some = have_sides_of(boxes, _LEAST_SIDE_PX).nonzero()[:, 0]
        picture, boxes, label, scores = (each[is_some] for each in (picture, boxes, label, scores))
        kept = kept_boxes(boxes, scores, picture * self.classes + label, self.overlap)
        kept = kept[surest_of_each(scores[kept], picture[kept], self.most)]
        return Detections(picture[kept], boxes[kept], label[kept], scores[kept])
