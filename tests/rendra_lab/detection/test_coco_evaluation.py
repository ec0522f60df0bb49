"""COCO's average precision: the numbers of pycocotools on random pictures, and closed forms."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from rendra_lab.detection.coco_evaluation import CocoPrecision, coco_precision, matched, precisions
from rendra_lab.detection.mask_pasting import pasted_masks
from rendra_lab.detection.records import Detections, Instances

HEIGHT, WIDTH, CLASSES = 200, 220, 3


def random_boxes(count: int, generator: np.random.Generator) -> torch.Tensor:
    low = generator.uniform(0, 70, (count, 2))
    size = generator.uniform(8, 180, (count, 2))
    high = np.minimum(low + size, [WIDTH, HEIGHT])
    return torch.from_numpy(np.concatenate([low, high], 1).astype(np.float32))


def random_batch(seed: int, pictures: int = 4) -> tuple[Detections, Instances]:
    """Pictures of a few objects, most of them found about where they are, some twice, and much that is not there."""
    generator = np.random.default_rng(seed)
    count = int(generator.integers(pictures, 5 * pictures))
    true_boxes = random_boxes(count, generator)
    true_pictures = torch.from_numpy(np.sort(generator.integers(0, pictures, count)))
    true_labels = torch.from_numpy(generator.integers(0, CLASSES, count))
    masks = pasted_masks(
        torch.from_numpy(generator.random((count, 5, 5)) * 0.6 + 0.35).float(), true_boxes, HEIGHT, WIDTH
    )
    rows = torch.from_numpy(generator.integers(0, count, 2 * count))
    shaken = true_boxes[rows] + torch.from_numpy(generator.normal(0, 3, (2 * count, 4))).float()
    boxes = torch.cat([torch.cat([shaken[:, :2], torch.maximum(shaken[:, 2:], shaken[:, :2] + 2)], 1),
                       random_boxes(count, generator)])  # fmt: skip
    where = torch.cat([true_pictures[rows], torch.from_numpy(generator.integers(0, pictures, count))])
    labels = torch.cat([true_labels[rows], torch.from_numpy(generator.integers(0, CLASSES, count))])
    scores = torch.from_numpy(generator.random(3 * count)).float()
    squares = torch.from_numpy(generator.random((3 * count, 5, 5)) * 0.6 + 0.35).float()
    order = torch.argsort(where * 2.0 - scores.double())
    found = Detections(where[order], boxes[order], labels[order], scores[order], squares[order])
    return found, Instances(true_pictures, true_boxes, true_labels, masks)


def as_xywh(boxes: torch.Tensor) -> list[list[float]]:
    boxes = boxes.double()
    return torch.cat([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], 1).tolist()


def encoded(masks: torch.Tensor) -> list[Any]:
    return [coco_mask.encode(np.asfortranarray(mask.numpy().astype(np.uint8))) for mask in masks]


def reference(batches: Sequence[tuple[Detections, Instances]], kind: str, most: int) -> COCOeval:
    """What pycocotools makes of the same pictures."""
    annotations, results, first = [], [], 1
    images: set[int] = set()
    for found, true in batches:
        codes = encoded(true.masks)
        for i, box in enumerate(as_xywh(true.boxes)):
            annotations.append({
                "id": len(annotations) + 1, "image_id": first + int(true.picture[i]), "iscrowd": 0,
                "category_id": 1 + int(true.labels[i]), "bbox": box, "segmentation": codes[i],
                "area": float(true.masks[i].sum()),
            })  # fmt: skip
        codes = encoded(pasted_masks(found.masks, found.boxes, HEIGHT, WIDTH))
        for i, box in enumerate(as_xywh(found.boxes)):
            shape = {"bbox": box} if kind == "box" else {"segmentation": codes[i]}
            results.append({"image_id": first + int(found.picture[i]), "category_id": 1 + int(found.labels[i]),
                            "score": float(found.scores[i]), **shape})  # fmt: skip
        images |= {first + picture for picture in range(4)}
        first += 4
    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO()
        truth.dataset = {
            "info": {}, "annotations": annotations, "categories": [{"id": 1 + c} for c in range(CLASSES)],
            "images": [{"id": image, "height": HEIGHT, "width": WIDTH} for image in sorted(images)],
        }  # fmt: skip
        truth.createIndex()
        judge = COCOeval(truth, truth.loadRes(results), "bbox" if kind == "box" else "segm")
        judge.params.maxDets = [1, 1, most]
        judge.evaluate()
        judge.accumulate()
    return judge


def summary(judge: COCOeval, iou: float | None, area: str) -> float:
    precision = judge.eval["precision"][:, :, :, ["all", "small", "medium", "large"].index(area), -1]
    if iou is not None:
        precision = precision[np.isclose(judge.params.iouThrs, iou)]
    return 100 * precision[precision > -1].mean()


@pytest.mark.parametrize("kind", ["box", "mask"])
@pytest.mark.parametrize("most", [100, 2])
def test_the_numbers_of_pycocotools(kind: Any, most: int) -> None:
    batches = [random_batch(seed) for seed in range(6)]
    judge = reference(batches, kind, most)
    for iou, area in ((None, "all"), (0.5, "all"), (0.75, "all"), (None, "small"), (None, "medium"), (0.5, "large")):
        metric = CocoPrecision(kind, iou, area, most)
        for batch in batches:
            metric.update(*batch)
        assert float(metric.compute()) == pytest.approx(summary(judge, iou, area), abs=1e-4), (iou, area)
        assert 0 < float(metric.compute()) < 100


def test_what_is_found_exactly_is_100() -> None:
    _, true = random_batch(3)
    scores = torch.linspace(1, 0.5, len(true.labels))
    found = Detections(true.picture, true.boxes, true.labels, scores)
    metric = CocoPrecision("box")
    metric.update(found, true)
    assert float(metric.compute()) == pytest.approx(100)
    assert set(metric.per_class()) == set(true.labels.tolist())


def test_nothing_found_is_0_and_nothing_annotated_is_unknown() -> None:
    found, true = random_batch(4)
    nothing = Detections(*(value[:0] for value in (found.picture, found.boxes, found.labels, found.scores)))
    metric = coco_precision("box", 0.5)({"detections": nothing}, {"instances": true})
    assert float(metric.compute()) == 0
    empty = Instances(true.picture[:0], true.boxes[:0], true.labels[:0], true.masks[:0])
    metric = CocoPrecision("mask")
    assert metric.per_class() == {}
    metric.update(found, empty)
    assert torch.isnan(metric.compute())


def test_true_objects_that_do_not_count_are_given_last() -> None:
    ious = np.array([[0.9, 0.6], [0.9, 0.6], [0.9, 0.6]])
    hits, ignored = matched(ious, np.array([True, False]), np.array([0.5, 0.8]))
    assert hits.tolist() == [[True, True], [True, False], [False, False]]
    assert ignored.tolist() == [[False, True], [True, False], [False, False]]


def test_precision_at_recalls_beyond_reach_is_0() -> None:
    hits = np.array([[True], [False]])
    assert precisions(hits, np.zeros_like(hits), 4) == pytest.approx(26 / 101)  # recalls 0, 0.01 ... 0.25
    assert precisions(np.zeros((0, 2), bool), np.zeros((0, 2), bool), 4).tolist() == [0, 0]
