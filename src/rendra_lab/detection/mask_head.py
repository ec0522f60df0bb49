"""Which part of its box an object covers.

He et al., "Mask R-CNN", ICCV 2017, arXiv:1703.06870, Fig. 4 right.
Letters: R regions, S cells along each side of a region, C classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab.detection.mask_pasting import cropped_masks
from rendra_lab.detection.records import CellVerdicts, Detections, PhotoBatch
from rendra_lab.detection.regions import Maps, ObjectRegions
from rendra_lab.detection.roi_align import RoiAlign
from rendra_lab.networks.normalization import Norm, norm_of
from rendra_lab.settings import Positive


class MaskHead(nn.Module):
    """3x3 convolutions, twice the resolution, and a mask for each class: a `RegionHead`.

    Args:
        pool: cuts the regions, S / 2 cells on a side.
        classes: C.
        channels: of the features.
        width: of the convolutions.
        convs: how many of them.
        norm: behind each.
    """

    def __init__(
        self,
        pool: RoiAlign,
        classes: Positive,
        channels: Positive = 256,
        width: Positive = 256,
        convs: Positive = 4,
        norm: Norm = "none",
    ) -> None:
        super().__init__()
        self.pool = pool
        widths = [channels] + [width] * convs
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [nn.Conv2d(before, after, 3, padding=1, bias=norm == "none"), norm_of(norm, after), nn.ReLU()]
        self.convs = nn.Sequential(*layers)
        self.wider = nn.ConvTranspose2d(width, width, 2, stride=2)
        self.logits = nn.Conv2d(width, classes, 1)
        for layer in self.modules():
            if isinstance(layer, (nn.Conv2d, nn.ConvTranspose2d)):
                nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
                if layer.bias is not None:
                    nn.init.zeros_(layer.bias)
        nn.init.normal_(self.logits.weight, std=0.001)

    @property
    def side(self) -> int:
        """S: cells along each side of a mask."""
        return 2 * self.pool.side

    def forward(
        self, maps: Maps, boxes: Float[Tensor, "R 4"], picture: Int[Tensor, " R"], labels: Int[Tensor, " R"]
    ) -> Float[Tensor, "R S S"]:
        """Logits over boxes in their pictures, of the class of each."""
        if not len(boxes):  # group norm takes no empty batch; the gradients of all weights are zeros
            return self._nothing(maps)
        x = F.relu(self.wider(self.convs(self.pool(maps, boxes, picture))))
        # index_select: plain indexing adds up its gradient in parallel, in whatever order the threads come
        weight = self.logits.weight.flatten(1).index_select(0, labels)
        bias = self.logits.get_parameter("bias").index_select(0, labels)
        return torch.baddbmm(bias[:, None, None], weight[:, None], x.flatten(2)).view(-1, self.side, self.side)

    def learn(self, maps: Maps, regions: ObjectRegions, batch: PhotoBatch) -> Mapping[str, CellVerdicts]:
        """See `RegionHead`: the field `masks`."""
        logits = self(maps, regions.boxes, regions.picture, regions.labels)
        goals = cropped_masks(batch.instances.masks, regions.objects, regions.boxes, self.side)
        return {"masks": CellVerdicts(logits, goals.to(logits))}

    def describe(self, maps: Maps, found: Detections) -> Detections:
        """See `RegionHead`: the field `masks`."""
        return replace(found, masks=self(maps, found.boxes, found.picture, found.labels).sigmoid())

    def _nothing(self, maps: Maps) -> Tensor:
        total = torch.stack([parameter.sum() for parameter in self.parameters()]).sum() + maps[0].sum()
        return (0 * total).expand(0, self.side, self.side)
