"""Average precision of boxes, masks and meshes, by the rules under which Pix3D's numbers are published.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 4.2; the curve is that of Everingham et
al., "The Pascal Visual Object Classes Challenge", IJCV 2010, as it is since 2010: every point of it counts.

Photographs show more than is annotated. So a found object whose box covers no annotated one with an intersection
over union above 0.3 is left out altogether. Any other is right if it has the class of an object that is not found
yet, and agrees with it by more than 0.5: in intersection over union of boxes or of masks, or, of meshes, in the F1 at
0.3 of a true box whose longest side is 10. Its depth cannot be told from a picture: the true centre gives it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from rendra.structures import Meshes
from rendra.utils import ico_sphere
from rendra_lab.detection.object_frames import depth_ranges, frustums_of, meshes_in_camera
from rendra_lab.detection.overlaps import PictureOverlaps, overlaps_of
from rendra_lab.detection.records import Detections, Instances
from rendra_lab.errors import UserError
from rendra_lab.mesh_scores import PROTOCOLS, score_surfaces
from rendra_lab.settings import Fraction, Positive
from rendra_lab.terms import MetricTerm

Kind = Literal["box", "mask", "mesh"]

_SEEN_IOU = 0.3  # of boxes: what covers no annotated object so far is of something else
_F1_COLUMN = PROTOCOLS["scaled"].thresholds.index(0.3)

Agreement = Callable[[int, int], float]  # of a row of the detections with one of the instances, in [0, 1]


def average_precision(scores: Float[Tensor, " M"], hits: Bool[Tensor, " M"], num_truths: int) -> float:
    """The area under the precision over recall, of found objects in the order of falling scores.

    Precision is interpolated: at each recall it is the largest that is reached at this recall or a higher one.

    Args:
        scores: of what was found.
        hits: whether it is right.
        num_truths: how many there are to find; at least 1.

    Returns:
        The area, in [0, 1].
    """
    right = hits[scores.argsort(descending=True, stable=True)].double()
    precision = right.cumsum(0) / torch.arange(1, len(right) + 1, device=right.device)
    envelope = precision.flip(0).cummax(0).values.flip(0)
    return float((envelope * right).sum() / num_truths)


class AveragePrecision(Metric):
    """The mean over classes of the average precision, in percent; NaN where nothing is annotated.

    Classes without an annotated object do not count. Pictures are judged one by one, and objects of a picture in the
    order of falling scores.

    Args:
        kind: by what found objects are judged: box, mask or mesh.
        agreement: above which they are right.
        samples: points on each mesh.
    """

    full_state_update = False
    scores: list[Tensor]
    labels: list[Tensor]
    hits: list[Tensor]
    truths: list[Tensor]

    def __init__(self, kind: Kind, agreement: Fraction = 0.5, samples: Positive = 10_000) -> None:
        super().__init__()
        self.kind = kind
        self.agreement = agreement
        self.samples = samples
        for name in ("scores", "labels", "hits", "truths"):
            self.add_state(name, [], dist_reduce_fx="cat")

    @torch.no_grad()
    def update(self, detections: Detections, instances: Instances, intrinsics: Tensor | None = None) -> None:
        """Adds the pictures of a batch.

        Args:
            detections: what was found.
            instances: what is annotated.
            intrinsics: (B, 3, 3), pixels; only meshes need them.

        Raises:
            UserError: masks, meshes or true shapes that the kind needs are missing.
        """
        agreed = list(self._agreements(detections, instances, intrinsics))
        rows = [
            row for picture, agreement in agreed for row in self._judged(picture, agreement, detections, instances)
        ]
        counted = torch.tensor([row for row, _ in rows], dtype=torch.int64, device=detections.scores.device)
        self.scores.append(detections.scores.detach().index_select(0, counted).double())
        self.labels.append(detections.labels.index_select(0, counted))
        self.hits.append(torch.tensor([hit for _, hit in rows], dtype=torch.bool, device=counted.device))
        self.truths.append(instances.labels)

    def compute(self) -> Tensor:
        """The mean over classes, percent."""
        return torch.tensor(list(self._by_class().values()) or [torch.nan]).mean()

    def per_class(self) -> dict[int, float]:
        """The average precision of each annotated class, percent, over all processes."""
        with self.sync_context():
            return self._by_class()

    def _by_class(self) -> dict[int, float]:
        if not self.truths:
            return {}
        scores, labels, hits, truths = map(dim_zero_cat, (self.scores, self.labels, self.hits, self.truths))
        return {
            label: 100 * average_precision(scores[labels == label], hits[labels == label], count)
            for label, count in zip(*(values.tolist() for values in truths.unique(return_counts=True)), strict=True)
        }

    def _agreements(
        self, detections: Detections, instances: Instances, intrinsics: Tensor | None
    ) -> Iterator[tuple[PictureOverlaps, Agreement]]:
        """The pictures with the overlaps of their boxes, and what says how far objects agree."""
        if not len(instances.labels):
            return
        boxes = overlaps_of("box", detections, instances)
        if self.kind == "mesh":
            meshes = MeshAgreement(detections, instances, intrinsics, self.samples)
            yield from ((picture, meshes) for picture in boxes)
            return
        judged = boxes if self.kind == "box" else overlaps_of("mask", detections, instances)
        yield from ((picture, _LookedUp(values)) for picture, values in zip(boxes, judged, strict=True))

    def _judged(
        self, boxes: PictureOverlaps, agreement: Agreement, detections: Detections, instances: Instances
    ) -> Iterator[tuple[int, bool]]:
        """The rows of the detections of a picture that count, and whether each is right."""
        labels, true_labels = detections.labels.tolist(), instances.labels.tolist()
        claimed: set[int] = set()
        for found, row in zip(boxes.found.tolist(), boxes.ious.tolist(), strict=True):
            near = [true for true, overlap in zip(boxes.true.tolist(), row, strict=True) if overlap > _SEEN_IOU]
            if not near:
                continue
            same = [true for true in near if true_labels[true] == labels[found]]
            if same and not claimed.issuperset(same):  # else it is wrong, however well it agrees
                best = max(same, key=lambda true: agreement(found, true))
                if best not in claimed and agreement(found, best) > self.agreement:
                    claimed.add(best)
                    yield found, True
                    continue
            yield found, False


class _LookedUp:
    """Agreement by a table."""

    def __init__(self, picture: PictureOverlaps) -> None:
        rows = zip(picture.found.tolist(), picture.ious.tolist(), strict=True)
        true = picture.true.tolist()
        self.table = {(found, t): value for found, row in rows for t, value in zip(true, row, strict=True)}

    def __call__(self, found: int, true: int) -> float:
        return self.table[found, true]


class MeshAgreement:
    """F1 at 0.3 of found meshes with true ones, each scaled until the true box's longest side is 10; in [0, 1].

    A found mesh is placed at the true object's depth. One without faces is replaced by a ball that fills its box, and
    so are all of a detector that says how deep objects are but gives no meshes.

    Args:
        detections: with depth extents.
        instances: with shapes.
        intrinsics: (B, 3, 3) of the pictures, pixels.
        samples: points on each mesh.

    Raises:
        UserError: depth extents, shapes or intrinsics are missing.
    """

    def __init__(
        self, detections: Detections, instances: Instances, intrinsics: Tensor | None, samples: int = 10_000
    ) -> None:
        missing = {
            "the detections have no depth extents": detections.depth_extents is None,
            "the annotated objects have no shapes": instances.shapes is None,
            "nobody gave the intrinsics: metric.NAME.context={intrinsics: intrinsics}": intrinsics is None,
        }
        if reasons := [reason for reason, holds in missing.items() if holds]:
            raise UserError(f"AP of meshes cannot be told: {'; '.join(reasons)}")
        assert instances.shapes is not None
        assert intrinsics is not None
        self.detections = detections
        self.verts, self.faces = instances.shapes.verts, instances.shapes.faces
        self.lenses = intrinsics
        self.samples = samples
        self.center_depths = depth_ranges(self.verts).mean(1)
        self._known: dict[tuple[int, int], float] = {}

    def __call__(self, found: int, true: int) -> float:
        """Of a row of the detections with a row of the instances."""
        if (found, true) not in self._known:
            truth = Meshes([self.verts[true]], [self.faces[true]])
            scores = score_surfaces(self.placed(found, true), truth, samples=self.samples)
            self._known[found, true] = float(scores.f1[0, _F1_COLUMN]) / 100
        return self._known[found, true]

    def placed(self, found: int, true: int) -> Meshes:
        """The found mesh in the axes of its camera, as deep as the true object."""
        row, extents = slice(found, found + 1), self.detections.depth_extents
        assert extents is not None
        lens = self.lenses.index_select(0, self.detections.picture[row])
        depth = self.center_depths[true : true + 1].to(extents)
        return meshes_in_camera(self._mesh(found), frustums_of(extents[row], self.detections.boxes[row], lens, depth))

    def _mesh(self, found: int) -> Meshes:
        meshes, device = self.detections.meshes, self.detections.boxes.device
        if meshes is None:
            return ico_sphere(4, device)
        return meshes[found] if int(meshes.num_faces_per_mesh()[found]) else ico_sphere(3, device)


def photo_precision(kind: Kind, agreement: Fraction = 0.5, samples: Positive = 10_000) -> MetricTerm:
    """`AveragePrecision` as a metric of a task that predicts `detections` of a `PhotoBatch`."""
    context = {"intrinsics": "intrinsics"} if kind == "mesh" else None
    metric = AveragePrecision(kind, agreement, samples)
    return MetricTerm(metric, prediction="detections", target="instances", context=context)
