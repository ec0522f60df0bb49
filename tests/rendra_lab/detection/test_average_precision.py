"""Average precision by Pix3D's rules: closed forms, each rule by a picture that breaks it, and meshes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from far_device import Far, far  # noqa: F401

from rendra.structures import Meshes, join_meshes_as_batch
from rendra.utils import ico_sphere
from rendra_lab.detection.average_precision import AveragePrecision, MeshAgreement, average_precision, photo_precision
from rendra_lab.detection.coco_evaluation import CocoPrecision
from rendra_lab.detection.object_frames import depth_extents
from rendra_lab.detection.overlaps import nearest_truths
from rendra_lab.detection.records import Detections, Instances
from rendra_lab.errors import UserError
from rendra_lab.frustums import Frustums
from rendra_lab.shape_records import Shapes

SIDE = 40


def truths(boxes: list[list[float]], labels: list[int], pictures: list[int] | None = None) -> Instances:
    corners = torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4)
    ticks = torch.arange(SIDE) + 0.5
    x, y = ticks[None, None, :], ticks[None, :, None]
    x0, y0, x1, y1 = corners[:, :, None, None].unbind(1)
    masks = (x > x0) & (x < x1) & (y > y0) & (y < y1)
    where = torch.tensor(pictures or [0] * len(boxes), dtype=torch.int64)
    return Instances(where, corners, torch.tensor(labels, dtype=torch.int64), masks)


def guesses(
    boxes: list[list[float]], labels: list[int], scores: list[float], pictures: list[int] | None = None, **more: Any
) -> Detections:
    where = torch.tensor(pictures or [0] * len(boxes), dtype=torch.int64)
    corners = torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4)
    return Detections(where, corners, torch.tensor(labels, dtype=torch.int64), torch.tensor(scores), **more)


def score_of(found: Detections, true: Instances, kind: Any = "box", **more: Any) -> float:
    metric = AveragePrecision(kind, **more)
    metric.update(found, true)
    return float(metric.compute())


BOX, NEAR, HALF, FAR = [0.0, 0, 10, 10], [0.0, 0, 10, 11], [0.0, 0, 10, 4.5], [20.0, 20, 30, 30]


def test_the_area_under_an_interpolated_curve() -> None:
    scores, hits = torch.tensor([0.9, 0.1, 0.5, 0.3, 0.7]), torch.tensor([True, True, True, False, False])
    # right, wrong, right, wrong, right: precisions 1, 2/3, 3/5 at the recalls 1/4, 2/4, 3/4 of 4
    assert average_precision(scores, hits, 4) == pytest.approx((1 + 2 / 3 + 3 / 5) / 4)
    late = torch.tensor([False, True, True])
    # precision 1/2 at the first, interpolated by the 2/3 that come after it
    assert average_precision(torch.tensor([0.9, 0.8, 0.7]), late, 2) == pytest.approx(2 / 3)


def test_all_found_is_100_and_nothing_found_0() -> None:
    true = truths([BOX, FAR], [0, 1])
    assert score_of(guesses([NEAR, FAR], [0, 1], [0.9, 0.2]), true) == pytest.approx(100)
    assert score_of(guesses([], [], []), true) == 0


def test_without_annotation_there_is_nothing_to_say() -> None:
    assert torch.isnan(torch.tensor(score_of(guesses([BOX], [0], [0.9]), truths([], []))))
    assert AveragePrecision("box").per_class() == {}


def test_what_is_of_something_else_does_not_count() -> None:
    true = truths([BOX], [0])
    assert score_of(guesses([FAR, NEAR], [0, 0], [0.9, 0.5]), true) == pytest.approx(100)


def test_what_covers_too_little_or_has_another_class_is_wrong() -> None:
    true = truths([BOX], [0])
    assert score_of(guesses([HALF, NEAR], [0, 0], [0.9, 0.5]), true) == pytest.approx(50)
    elsewhere = truths([BOX, FAR], [0, 1])
    assert score_of(guesses([NEAR, NEAR, FAR], [1, 0, 1], [0.9, 0.5, 0.3]), elsewhere) == pytest.approx(75)


def test_an_object_is_found_once() -> None:
    true = truths([BOX, FAR], [0, 0])
    assert score_of(guesses([NEAR, BOX, FAR], [0, 0, 0], [0.9, 0.8, 0.7]), true) == pytest.approx((1 + 2 / 3) * 50)


def test_pictures_keep_their_objects_and_batches_add_up() -> None:
    metric = AveragePrecision("box")
    true = truths([BOX, BOX], [0, 0], [0, 1])
    metric.update(guesses([NEAR, NEAR], [0, 0], [0.9, 0.8], [1, 1]), true)
    assert float(metric.compute()) == pytest.approx(50)
    metric.update(guesses([NEAR], [0], [0.95], [0]), truths([BOX], [0], [0]))
    assert float(metric.compute()) == pytest.approx(100 * 2 / 3)
    metric.update(guesses([FAR], [3], [0.7]), truths([FAR], [3]))
    assert metric.per_class() == pytest.approx({0: 100 * 2 / 3, 3: 100.0})
    assert float(metric.compute()) == pytest.approx((100 * 2 / 3 + 100) / 2)


def test_masks_are_judged_by_masks() -> None:
    true = truths([BOX], [0])
    square = torch.ones(1, 8, 8)
    half = square.clone()
    half[:, :, 4:] = 0
    assert score_of(guesses([BOX], [0], [0.9], masks=square), true, "mask") == pytest.approx(100)
    assert score_of(guesses([BOX], [0], [0.9], masks=half), true, "mask") == 0
    with pytest.raises(UserError, match="no masks"):
        score_of(guesses([BOX], [0], [0.9]), true, "mask")


LENS = torch.tensor([[[50.0, 0, 20], [0, 50, 20], [0, 0, 1]]])
FRUSTUM = Frustums(torch.tensor([[10.0, 10, 30, 30]]), torch.tensor([[1.6, 2.4]]), LENS)


def shaped(instances: Instances, meshes: Meshes) -> Instances:
    count = len(meshes)
    shapes = Shapes(
        torch.zeros(count, 1, 3),
        torch.zeros(count, 1, 3),
        torch.zeros(count, 2, 2, 2, dtype=torch.bool),
        torch.eye(4).repeat(count, 1, 1),
        tuple(meshes.verts_list()),
        tuple(meshes.faces_list()),
    )
    return replace(instances, shapes=shapes)


def ball_scene() -> tuple[Detections, Instances]:
    """A ball that fills a frustum, found as it is, twice, the surer one much too flat."""
    ball = ico_sphere(3)
    there = FRUSTUM.to_camera(ball.verts_packed()[None])[0]
    box = FRUSTUM.boxes[0].tolist()
    true = shaped(truths([box], [2]), Meshes([there], [ball.faces_packed()]))
    flat = ball.update_padded(ball.verts_padded() * torch.tensor([1.0, 1.0, 0.05]))
    extents = depth_extents(FRUSTUM).expand(2)
    found = guesses([box, box], [2, 2], [0.9, 0.8], depth_extents=extents, meshes=join_meshes_as_batch([flat, ball]))
    return found, true


def test_meshes_are_judged_where_the_truth_is_deep() -> None:
    found, true = ball_scene()
    agreement = MeshAgreement(found, true, LENS)
    assert agreement(0, 0) < 0.4
    assert agreement(1, 0) > 0.95
    expected = FRUSTUM.to_camera(ico_sphere(3).verts_packed()[None])[0]
    torch.testing.assert_close(agreement.placed(1, 0).verts_packed(), expected, atol=1e-4, rtol=1e-4)
    metric = AveragePrecision("mesh")
    metric.update(found, true, LENS)
    assert float(metric.compute()) == pytest.approx(50)


def test_balls_stand_in_for_meshes_that_are_not_there() -> None:
    found, true = ball_scene()
    none = Meshes([torch.zeros(0, 3)] * 2, [torch.zeros(0, 3, dtype=torch.int64)] * 2)
    for meshes in (None, none):
        assert MeshAgreement(replace(found, meshes=meshes), true, LENS)(0, 0) > 0.9


def test_ap_of_meshes_says_what_it_lacks() -> None:
    found, true = ball_scene()
    with pytest.raises(UserError, match="no depth extents; the annotated objects have no shapes; nobody gave"):
        AveragePrecision("mesh").update(replace(found, depth_extents=None), replace(true, shapes=None))


def test_terms_read_the_batch() -> None:
    found, true = ball_scene()
    metric = photo_precision("mesh", samples=500)({"detections": found}, {"instances": true, "intrinsics": LENS})
    assert 0 <= float(metric.compute()) <= 100


def test_the_nearest_truth_of_each_found_object() -> None:
    true = truths([FAR, BOX, BOX], [0, 0, 0], [0, 0, 1])
    rows, overlaps = nearest_truths(
        guesses([NEAR, [35.0, 35, 39, 39], BOX], [0] * 3, [0.1, 0.9, 0.5], [0, 0, 1]), true
    )
    assert rows.tolist() == [1, -1, 2]
    assert overlaps.tolist() == pytest.approx([100 / 110, 0, 1])


def test_detections_of_any_device_are_judged(far: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    generator = torch.Generator()  # the device that stands in has none of its own
    monkeypatch.setattr(torch, "Generator", lambda device: generator)
    found, true = ball_scene()
    square = torch.ones(2, 8, 8)
    found, true = replace(found, masks=square).to(far), true.to(far)
    for kind in ("box", "mask", "mesh"):
        metric = AveragePrecision(kind, samples=60)
        metric.update(found, true, LENS.to(far))
        assert isinstance(metric.scores[0], Far)
        assert isinstance(metric.hits[0], Far)
        assert 0 <= float(metric.compute()) <= 100
    coco = CocoPrecision("mask")
    coco.update(found, true)
    assert isinstance(coco.ignored[0], Far)
    assert float(coco.compute()) == pytest.approx(100)
