"""Where in a picture something may stand: region proposals from the levels of a feature pyramid.

Ren et al., "Faster R-CNN", NIPS 2015, arXiv:1506.01497, Sec. 3.1; over a pyramid: Lin et al., "Feature Pyramid
Networks", CVPR 2017, arXiv:1612.03144, Sec. 4.1. Numbers are Detectron2's where nothing else is said.
Letters: B pictures, A anchors a cell, K anchors of a picture on all levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab.detection.anchors import LevelAnchors
from rendra_lab.detection.boxes import BoxCoder, clipped, have_sides_of
from rendra_lab.detection.matching import Matcher, balanced_sample
from rendra_lab.detection.records import AnchorVerdicts, Instances
from rendra_lab.detection.regions import Maps, Proposals
from rendra_lab.detection.suppression import kept_boxes, surest_of_each
from rendra_lab.settings import Fraction, Positive

_LEAST_SIDE_PX = 1e-2  # of a proposal


@dataclass(frozen=True)
class AnchorAnswers:
    """What the network says of every anchor of every picture; levels one after the other."""

    logits: Float[Tensor, "B K"]
    deltas: Float[Tensor, "B K 4"]
    anchors: Float[Tensor, "K 4"]
    level_sizes: tuple[int, ...]  # anchors of each level: sum to K


class RegionProposals(nn.Module):
    """A 3x3 convolution on every level, and from each cell the logits and the boxes of its anchors.

    Args:
        width: channels of the levels.
        anchors: the boxes that it begins with.
        matcher: which of them hold an object.
        sampled: anchors of a picture that a step learns from, at most.
        positive_fraction: of them with an object, at most.
        most_before: proposals of a level before suppression, in training and in evaluation.
        most_after: proposals of a picture, likewise.
        overlap: of two proposals of one level above which the surer one stays.
    """

    def __init__(
        self,
        width: Positive = 256,
        anchors: LevelAnchors | None = None,
        matcher: Matcher | None = None,
        sampled: Positive = 256,
        positive_fraction: Fraction = 0.5,
        most_before: Sequence[Positive] = (2000, 1000),
        most_after: Sequence[Positive] = (1000, 1000),
        overlap: Fraction = 0.7,
    ) -> None:
        super().__init__()
        self.anchors = anchors or LevelAnchors()
        self.matcher = matcher or Matcher((0.3, 0.7), (0, -1, 1), keeps_best=True)
        self.coder = BoxCoder()
        self.sampled, self.positive_fraction = sampled, positive_fraction
        self.most_before, self.most_after = tuple(most_before), tuple(most_after)
        self.overlap = overlap
        self.conv = nn.Conv2d(width, width, 3, padding=1)
        self.logits = nn.Conv2d(width, self.anchors.per_cell, 1)
        self.deltas = nn.Conv2d(width, 4 * self.anchors.per_cell, 1)
        for layer in (self.conv, self.logits, self.deltas):
            nn.init.normal_(layer.weight, std=0.01)
            nn.init.zeros_(layer.get_parameter("bias"))

    def forward(self, maps: Maps) -> AnchorAnswers:
        """What the network says.

        Args:
            maps: a level (B, width, H, W) for each size of the anchors.
        """
        logits, deltas = [], []
        for level in maps:
            x = F.relu(self.conv(level))
            logits.append(self.logits(x).permute(0, 2, 3, 1).flatten(1))
            deltas.append(self.deltas(x).unflatten(1, (-1, 4)).permute(0, 3, 4, 1, 2).flatten(1, 3))
        sizes = tuple(each.shape[1] for each in logits)
        return AnchorAnswers(
            torch.cat(logits, 1), torch.cat(deltas, 1), torch.cat(self.anchors.of_levels(maps)), sizes
        )

    @torch.no_grad()
    def chosen(self, answers: AnchorAnswers, sizes: Int[Tensor, "B 2"]) -> Proposals:
        """The surest regions, cut at the edges of their pictures, of those that overlap much only one.

        Args:
            answers: for the pictures.
            sizes: their heights and widths.
        """
        mode = 0 if self.training else 1
        surest, level = self._surest(answers.logits, answers.level_sizes, self.most_before[mode])
        picture = torch.arange(len(sizes), device=sizes.device)[:, None].expand_as(surest)
        deltas = answers.deltas.gather(1, surest[..., None].expand(-1, -1, 4))
        boxes = clipped(self.coder.decode(deltas, answers.anchors[surest]).flatten(0, 1), sizes[picture.flatten()])
        is_some = have_sides_of(boxes, _LEAST_SIDE_PX)
        group = (picture * len(answers.level_sizes) + level).flatten()[is_some]
        scores, boxes = answers.logits.gather(1, surest).flatten()[is_some], boxes[is_some]
        picture = picture.flatten()[is_some]
        kept = kept_boxes(boxes, scores, group, self.overlap)
        kept = kept[surest_of_each(scores[kept], picture[kept], self.most_after[mode])]
        return Proposals(picture[kept], boxes[kept])

    def learned(self, answers: AnchorAnswers, instances: Instances) -> AnchorVerdicts:
        """What was said of anchors drawn at random, beside the truth."""
        drawn = [self._drawn(answers.anchors, instances, number) for number in range(len(answers.logits))]
        objects, goals, rest = (torch.cat(parts) for parts in zip(*drawn, strict=True))
        said = answers.logits.flatten()
        logits = torch.cat([said.index_select(0, objects), said.index_select(0, rest)])
        labels = torch.cat([torch.ones_like(logits[: len(objects)]), torch.zeros_like(logits[len(objects) :])])
        return AnchorVerdicts(logits, labels, answers.deltas.flatten(0, 1).index_select(0, objects), goals)

    @staticmethod
    def _surest(logits: Tensor, level_sizes: Sequence[int], most: int) -> tuple[Tensor, Tensor]:
        """Which anchors of each picture are looked at further (B, k), and the level of each (k,)."""
        found, first = [], 0
        for size in level_sizes:
            found.append(logits[:, first : first + size].topk(min(most, size), dim=1).indices + first)
            first += size
        counts = [each.shape[1] for each in found]
        level = torch.arange(len(counts), device=logits.device).repeat_interleave(
            torch.tensor(counts, device=logits.device)
        )
        return torch.cat(found, 1), level

    @torch.no_grad()
    def _drawn(self, anchors: Tensor, instances: Instances, picture: int) -> tuple[Tensor, Tensor, Tensor]:
        """Of one picture: anchors with an object, counted through all pictures, their deltas, and background."""
        boxes = instances.boxes[instances.picture == picture].to(anchors)
        matches = self.matcher(boxes, anchors)
        objects, rest = balanced_sample(matches.labels, self.sampled, self.positive_fraction)
        goals = self.coder.encode(boxes[matches.index[objects]], anchors[objects]) if len(boxes) else anchors[:0]
        return objects + picture * len(anchors), goals, rest + picture * len(anchors)
