"""The detector whole: finite from the first step, also without objects; heads plug in; it learns what it is shown."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401
from painted_photos import painted_photos, small_detector
from torch import Tensor, nn

from rendra_lab.detection import detector_losses as losses
from rendra_lab.detection.boxes import iou
from rendra_lab.detection.mask_pasting import pasted_masks
from rendra_lab.detection.records import Detections, DetectorPrediction, PhotoBatch
from rendra_lab.detection.regions import Maps, ObjectRegions
from rendra_lab.detection.two_stage_detector import TwoStageDetector
from rendra_lab.errors import UserError
from rendra_lab.networks.feature_pyramid import FeaturePyramid

_TWO = [(4, 4, 30, 40, 1), (50, 10, 90, 60, 2)]


def terms(prediction: DetectorPrediction) -> dict[str, Tensor]:
    return {
        "anchor_objectness": losses.anchor_objectness(prediction.anchors),
        "anchor_boxes": losses.anchor_boxes(prediction.anchors),
        "region_classes": losses.region_classes(prediction.boxes),
        "region_boxes": losses.region_boxes(prediction.boxes),
        "masks": losses.cells(prediction.masks),
    }


@pytest.mark.parametrize("boxes", [[_TWO, []], [[], []], [[(0, 0, 96, 64, 0)], [(95, 63, 96, 64, 1)]]])
def test_the_first_step_is_finite_and_reaches_every_weight(boxes: list[Any]) -> None:
    detector = small_detector()
    prediction = detector(painted_photos(boxes))
    assert prediction.detections is None
    values = terms(prediction)
    sum(values.values()).backward()
    assert all(bool(value.isfinite()) for value in values.values())
    for parameter in detector.parameters():
        assert_finite(parameter.grad)


def test_evaluation_gives_detections_alone_and_no_gradients_are_needed() -> None:
    detector = small_detector().eval()
    batch = painted_photos([_TWO, [], _TWO])
    with torch.no_grad():
        prediction = detector(batch)
    assert prediction.anchors is None
    found = prediction.detections
    assert found.masks.shape == (len(found.scores), 12, 12)
    assert found.picture.tolist() == sorted(found.picture.tolist())
    assert bool(((found.scores > 0) & (found.scores <= 1)).all())


def test_who_finds_nothing_says_so() -> None:
    detector = small_detector().eval()
    detector.box.least_score = 1.0
    found = detector(painted_photos([_TWO])).detections
    assert len(found.scores) == 0
    assert found.masks.shape == (0, 12, 12)


def test_pictures_do_not_depend_on_those_beside_them() -> None:
    detector = small_detector().eval()
    nn.init.normal_(detector.box.logits.weight)
    batch = painted_photos([_TWO, [(8, 8, 60, 60, 0)]])
    with torch.no_grad():
        both = detector(batch).detections
        alone = detector(replace(batch, rgb=batch.rgb[1:], sizes=batch.sizes[1:])).detections
    second = both.picture == 1
    assert int(second.sum()) == len(alone.scores) > 0
    assert_close(both.boxes[second], alone.boxes, atol=1e-3)
    assert_close(both.masks[second], alone.masks, atol=1e-3)


def test_detections_keep_off_what_a_picture_was_filled_up_with() -> None:
    detector = small_detector().eval()
    batch = painted_photos([_TWO])
    with torch.no_grad():
        found = detector(replace(batch, sizes=torch.tensor([[40, 50]]))).detections
    assert len(found.boxes)
    assert float(found.boxes[:, [0, 2]].max()) <= 50
    assert float(found.boxes[:, [1, 3]].max()) <= 40


class AreaHead(nn.Module):
    """Tells areas of boxes as depths, and remembers what it was given."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(()))
        self.seen: list[Any] = []

    def learn(self, maps: Maps, regions: ObjectRegions, batch: PhotoBatch) -> Mapping[str, Any]:
        self.seen.append((maps, regions, batch))
        return {"depths": self.scale * regions.boxes.sum(1)}

    def describe(self, maps: Maps, found: Detections) -> Detections:
        assert found.masks is not None
        return replace(found, depth_extents=self.scale * found.boxes[:, 2])


def test_a_head_more_is_told_what_it_needs() -> None:
    detector = small_detector()
    head = AreaHead()
    parts = (detector.backbone, detector.pyramid, detector.proposals, detector.sampler, detector.box)
    detector = TwoStageDetector(*parts, {**detector.heads, "area": head, "absent": None})
    batch = painted_photos([_TWO, [], [(8, 8, 60, 60, 0)]])
    prediction = detector(batch)
    maps, regions, given = head.seen[0]
    assert given is batch
    assert [each.shape[-2:] for each in maps] == [(16, 24), (8, 12), (4, 6), (2, 3)]
    assert len(regions.boxes) >= 3
    assert torch.equal(batch.instances.labels[regions.objects], regions.labels)
    assert torch.equal(batch.instances.picture[regions.objects], regions.picture)
    overlap = iou(regions.boxes, batch.instances.boxes)[torch.arange(len(regions.boxes)), regions.objects]
    assert float(overlap.min()) >= 0.5
    assert not regions.boxes.requires_grad
    assert_close(prediction.depths, regions.boxes.sum(1))
    assert any(name.startswith("heads.area") for name, _ in detector.named_parameters())
    found = detector.eval()(batch).detections
    assert_close(found.depth_extents, found.boxes[:, 2])


def test_classes_that_the_network_does_not_have_are_refused() -> None:
    batch = painted_photos([_TWO])
    batch = replace(batch, instances=replace(batch.instances, labels=torch.tensor([1, 3])))
    with pytest.raises(UserError, match=r"painted 0 show an object of class 3.*knows 3: network\.classes"):
        small_detector()(batch)


def test_a_pyramid_of_other_channels_is_refused() -> None:
    detector = small_detector()
    with pytest.raises(
        UserError, match=r"maps of \(8, 8, 16, 16\) channels, the feature pyramid takes \(8, 8, 8, 8\)"
    ):
        TwoStageDetector(
            detector.backbone, FeaturePyramid((8, 8, 8, 8), 16), detector.proposals, detector.sampler, detector.box
        )


def test_the_same_seed_gives_the_same_step() -> None:
    totals = []
    for _ in range(2):
        torch.manual_seed(3)
        detector, batch = small_detector(), painted_photos([_TWO, _TWO])
        totals.append(sum(terms(detector(batch)).values()))
    assert torch.equal(*totals)


def test_it_learns_what_it_is_shown() -> None:
    batch = painted_photos([_TWO, [(10, 8, 60, 56, 0)]])
    detector = small_detector()
    optimizer = torch.optim.Adam(detector.parameters(), lr=3e-3)
    for _ in range(90):
        optimizer.zero_grad()
        sum(terms(detector(batch)).values()).backward()
        optimizer.step()
    with torch.no_grad():
        found = detector.eval()(batch).detections
    truth = batch.instances
    for picture in (0, 1):
        mine, own = found.picture == picture, truth.picture == picture
        count = int(own.sum())
        overlaps = iou(found.boxes[mine][:count], truth.boxes[own])
        best = overlaps.argmax(0)
        assert float(overlaps.amax(0).min()) > 0.6
        assert torch.equal(found.labels[mine][:count][best], truth.labels[own])
        masks = pasted_masks(found.masks[mine][:count], found.boxes[mine][:count], 64, 96)[best]
        shared, either = (masks & truth.masks[own]).sum((1, 2)), (masks | truth.masks[own]).sum((1, 2))
        assert float((shared / either).min()) > 0.6


def test_a_step_and_a_detection_there(far: Any) -> None:  # noqa: F811
    detector = small_detector().to(far)
    batch = painted_photos([_TWO, []]).to(far)
    prediction = detector(batch)
    assert all(isinstance(value, Far) for value in terms(prediction).values())
    found = detector.eval()(batch).detections
    assert isinstance(found.masks, Far)
