"""Detection in two stages: regions are proposed, then looked at. Mask R-CNN, and what Mesh R-CNN adds heads to.

He et al., "Mask R-CNN", ICCV 2017, arXiv:1703.06870; Ren et al., "Faster R-CNN", NIPS 2015, arXiv:1506.01497.

A head more is a module with the two methods of `RegionHead`, handed to the detector by any name: in training it
learns from the regions that hold an object, in evaluation it says more about what was found.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, cast

from torch import Tensor, nn

from rendra_lab.detection.box_head import BoxHead
from rendra_lab.detection.proposals import RegionProposals
from rendra_lab.detection.records import Detections, DetectorPrediction, PhotoBatch
from rendra_lab.detection.regions import Maps, ObjectRegions, RegionSampler
from rendra_lab.errors import UserError
from rendra_lab.networks.feature_pyramid import FeaturePyramid


class RegionHead(Protocol):
    """A head that looks at regions of pictures; also an `nn.Module`."""

    def learn(self, maps: Maps, regions: ObjectRegions, batch: PhotoBatch) -> Mapping[str, Any]:
        """What the head says of regions with objects, beside the truth.

        Args:
            maps: levels (B, D, H, W) of the feature pyramid at strides 4, 8, 16 and 32, of which a `RoiAlign` cuts
                regions.
            regions: drawn for this step, in the order of their pictures; perhaps none. Their boxes are proposals, or
                the true boxes themselves; `objects` says which row of `batch.instances` lies in each.
            batch: the pictures and the truth.

        Returns:
            Fields of `DetectorPrediction` by name. Without any region too they are finite, and attached to the head's
            weights.
        """

    def describe(self, maps: Maps, found: Detections) -> Detections:
        """The same detections, perhaps none, with what the head says about them; none may be left out."""


class TwoStageDetector(nn.Module):
    """Backbone, feature pyramid, region proposals, box head, and any heads besides.

    Args:
        backbone: pictures (B, 3, H, W), sRGB in [0, 1], to four maps at strides 4, 8, 16, 32: `ResidualBackbone`.
        pyramid: the maps to levels of one width, and one level more, at stride 64, for proposals alone.
        proposals: where something may stand.
        sampler: draws the regions that heads learn from.
        box: says what stands in a region, and where exactly.
        heads: `RegionHead`s by name; in evaluation each is handed the detections that the one before it gave.

    Raises:
        UserError: a pyramid of other channels than the backbone's.
    """

    def __init__(
        self,
        backbone: nn.Module,
        pyramid: FeaturePyramid,
        proposals: RegionProposals,
        sampler: RegionSampler,
        box: BoxHead,
        heads: Mapping[str, nn.Module] | None = None,
    ) -> None:
        super().__init__()
        made = tuple(getattr(backbone, "channels", pyramid.channels))
        if made != pyramid.channels:
            raise UserError(
                f"the backbone makes maps of {made} channels, the feature pyramid takes {pyramid.channels}"
            )
        self.backbone = backbone
        self.pyramid = pyramid
        self.proposals = proposals
        self.sampler = sampler
        self.box = box
        self.heads = nn.ModuleDict({name: head for name, head in (heads or {}).items() if head is not None})

    def forward(self, batch: PhotoBatch) -> DetectorPrediction:
        """In training mode verdicts for the losses, in evaluation mode detections."""
        levels = self.levels(batch.rgb)
        if self.training:
            return self.learn(levels, batch)
        return DetectorPrediction(detections=self.detect(levels, batch.sizes))

    def levels(self, pictures: Tensor) -> tuple[Tensor, ...]:
        """Five levels (B, D, ceil(H / s), ceil(W / s)) at strides s = 4, 8, 16, 32, 64."""
        return self.pyramid(self.backbone(pictures))

    def learn(self, levels: tuple[Tensor, ...], batch: PhotoBatch) -> DetectorPrediction:
        """What all parts say, beside the truth.

        Raises:
            UserError: an annotated object of a class that the box head does not have.
        """
        self._check_labels(batch)
        answers = self.proposals(levels)
        proposed = self.proposals.chosen(answers, batch.sizes)
        regions = self.sampler(proposed, batch.instances, len(batch.rgb))
        maps = levels[:-1]
        said: dict[str, Any] = {}
        for head in self._heads():
            said.update(head.learn(maps, regions.objects, batch))
        return DetectorPrediction(
            anchors=self.proposals.learned(answers, batch.instances),
            boxes=self.box.learned(maps, regions, batch.instances.boxes),
            **said,
        )

    def detect(self, levels: tuple[Tensor, ...], sizes: Tensor) -> Detections:
        """What stands in pictures of sizes (B, 2), height and width, without what they were filled up with."""
        proposed = self.proposals.chosen(self.proposals(levels), sizes)
        maps = levels[:-1]
        found = self.box.detections(maps, proposed, sizes)
        for head in self._heads():
            found = head.describe(maps, found)
        return found

    def _check_labels(self, batch: PhotoBatch) -> None:
        labels = batch.instances.labels
        if len(labels) and int(labels.max()) >= self.box.classes:
            raise UserError(
                f"the pictures {', '.join(batch.picture_ids)} show an object of class {int(labels.max())}, counted "
                f"from 0, and the network knows {self.box.classes}: network.classes must be as many as the data have"
            )

    def _heads(self) -> list[RegionHead]:
        return [cast(RegionHead, head) for head in self.heads.values()]
