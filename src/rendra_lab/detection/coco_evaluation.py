"""Average precision of boxes and masks as COCO defines it; the same numbers as pycocotools gives.

Lin et al., "Microsoft COCO: Common Objects in Context", ECCV 2014, arXiv:1405.0312, and the page "detection-eval" of
cocodataset.org: the mean over classes, and over intersections over union of 0.5, 0.55 ... 0.95, of the precision at
101 recalls.
Numbers are in percent. Letters: m found and n true objects of one class in one picture, T thresholds.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from rendra_lab.detection.overlaps import CoverKind, PictureOverlaps, overlaps_of
from rendra_lab.detection.records import Detections, Instances
from rendra_lab.settings import Fraction, Positive
from rendra_lab.terms import MetricTerm

Area = Literal["all", "small", "medium", "large"]
Array = np.ndarray[Any, Any]

_THRESHOLDS = np.linspace(0.5, 0.95, 10)
_RECALLS = np.linspace(0.0, 1.0, 101)
_AREAS: dict[Area, tuple[float, float]] = {  # square pixels, both ends inside
    "all": (0.0, 1e10),
    "small": (0.0, 32.0**2),
    "medium": (32.0**2, 96.0**2),
    "large": (96.0**2, 1e10),
}


class CocoPrecision(Metric):
    """COCO's average precision, percent; NaN where nothing is annotated.

    What is annotated but has another size does not count, nor what is found on it, nor what is found on nothing and
    has another size. The size of an annotated object is the area of its mask, for boxes too.

    Args:
        kind: box or mask.
        iou: one threshold, such as 0.5 for AP50; None takes the mean over ten of them.
        area: objects of which size count: all, small (up to 32 x 32 pixels), medium or large (from 96 x 96 on).
        most: found objects that count of each class and picture, the surest ones.
    """

    full_state_update = False
    scores: list[Tensor]
    labels: list[Tensor]
    hits: list[Tensor]
    ignored: list[Tensor]
    truths: list[Tensor]

    def __init__(
        self, kind: CoverKind, iou: Fraction | None = None, area: Area = "all", most: Positive = 100
    ) -> None:
        super().__init__()
        self.kind = kind
        self.thresholds = _THRESHOLDS if iou is None else np.array([iou])
        self.area = _AREAS[area]
        self.most = most
        for name in ("scores", "labels", "hits", "ignored", "truths"):
            self.add_state(name, [], dist_reduce_fx="cat")

    @torch.no_grad()
    def update(self, detections: Detections, instances: Instances) -> None:
        """Adds the pictures of a batch; UserError for masks of a detector without them."""
        labels, true_labels = detections.labels.cpu().numpy(), instances.labels.cpu().numpy()
        sizes = instances.masks.sum((1, 2)).cpu().numpy().astype(np.float64)
        is_other = (sizes < self.area[0]) | (sizes > self.area[1])
        rows, hits, ignored = (
            [np.zeros(0, np.int64)],
            *([np.zeros((0, len(self.thresholds)), bool)] for _ in range(2)),
        )
        for picture in overlaps_of(self.kind, detections, instances):
            for found, true, ious, areas in _by_class(picture, labels, true_labels, self.most):
                right, skipped = matched(ious, is_other[true], self.thresholds)
                outside = (areas < self.area[0]) | (areas > self.area[1])
                rows.append(found)
                hits.append(right)
                ignored.append(skipped | (~right & outside[:, None]))
        self._append(detections, np.concatenate(rows), np.concatenate(hits), np.concatenate(ignored))
        self.truths.append(instances.labels[torch.from_numpy(~is_other).to(instances.labels.device)])

    def compute(self) -> Tensor:
        """The mean over classes and thresholds, percent."""
        return torch.tensor(list(self._by_class().values()) or [torch.nan]).mean()

    def per_class(self) -> dict[int, float]:
        """The average precision of each class with objects of this size, percent, over all processes."""
        with self.sync_context():
            return self._by_class()

    def _append(self, detections: Detections, rows: Array, hits: Array, ignored: Array) -> None:
        device = detections.scores.device
        index = torch.from_numpy(rows).to(device)
        self.scores.append(detections.scores.detach().index_select(0, index))
        self.labels.append(detections.labels.index_select(0, index))
        self.hits.append(torch.from_numpy(hits).to(device))
        self.ignored.append(torch.from_numpy(ignored).to(device))

    def _by_class(self) -> dict[int, float]:
        if not self.truths:
            return {}
        states = (self.scores, self.labels, self.hits, self.ignored, self.truths)
        scores, labels, hits, ignored, truths = (dim_zero_cat(state).cpu().numpy() for state in states)
        answer = {}
        for label, count in zip(*(values.tolist() for values in np.unique(truths, return_counts=True)), strict=True):
            chosen = np.flatnonzero(labels == label)
            chosen = chosen[np.argsort(-scores[chosen], kind="stable")]
            answer[label] = 100 * float(precisions(hits[chosen], ignored[chosen], count).mean())
        return answer


def matched(ious: Array, is_ignored: Array, thresholds: Array) -> tuple[Array, Array]:
    """Gives each found object, the surest first, the true one left that it covers best, by every threshold.

    True objects that do not count are given only to those that fit no other; of equal ones the last is taken.

    Args:
        ious: (m, n), the surest first.
        is_ignored: (n,), true objects that do not count.
        thresholds: (T,), which an intersection over union must reach.

    Returns:
        Whether a true object was given, (m, T), and whether it was one that does not count, (m, T).
    """
    m, n = ious.shape
    hits, ignored = np.zeros((m, len(thresholds)), bool), np.zeros((m, len(thresholds)), bool)
    if n == 0:
        return hits, ignored
    is_free = np.ones((len(thresholds), n), bool)
    least = np.minimum(thresholds, 1 - 1e-10)[:, None]
    for i in range(m):
        fits = is_free & (ious[i] >= least)
        counts = fits & ~is_ignored
        fits = np.where(counts.any(1, keepdims=True), counts, fits)
        best = n - 1 - np.where(fits, ious[i], -1.0)[:, ::-1].argmax(1)
        hits[i] = fits.any(1)
        ignored[i] = hits[i] & is_ignored[best]
        is_free[hits[i], best[hits[i]]] = False
    return hits, ignored


def precisions(hits: Array, ignored: Array, num_truths: int) -> Array:
    """Mean interpolated precision at 101 recalls, in [0, 1], by every threshold: (T,).

    Args:
        hits: (M, T), by falling scores.
        ignored: (M, T), found objects that do not count.
        num_truths: at least 1.
    """
    right, wrong = (hits & ~ignored).cumsum(0), (~hits & ~ignored).cumsum(0)
    answer = np.zeros(hits.shape[1])
    if not len(hits):
        return answer
    precision = right / (right + wrong + np.spacing(1))
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    for t in range(hits.shape[1]):
        at = np.searchsorted(right[:, t] / num_truths, _RECALLS)
        answer[t] = np.append(envelope[:, t], 0.0)[at].mean()
    return answer


def coco_precision(
    kind: CoverKind, iou: Fraction | None = None, area: Area = "all", most: Positive = 100
) -> MetricTerm:
    """`CocoPrecision` as a metric of a task that predicts `detections` of a `PhotoBatch`."""
    return MetricTerm(CocoPrecision(kind, iou, area, most), prediction="detections", target="instances")


def _by_class(
    picture: PictureOverlaps, labels: Array, true_labels: Array, most: int
) -> Iterator[tuple[Array, Array, Array, Array]]:
    """Found rows, true rows, overlaps and found areas of each class of which something was found in a picture."""
    found, true, ious, areas = (values.numpy() for values in picture)
    for label in np.unique(labels[found]):
        chosen = np.flatnonzero(labels[found] == label)[:most]
        wanted = np.flatnonzero(true_labels[true] == label)
        yield found[chosen], true[wanted], ious[np.ix_(chosen, wanted)], areas[chosen]
