"""The box head: which regions become detections, and what it learns from."""

from typing import Any

import pytest
import torch
from assertions import assert_close
from painted_photos import painted_photos

from rendra_lab.detection.box_head import BoxHead
from rendra_lab.detection.regions import ObjectRegions, Proposals, SampledRegions
from rendra_lab.detection.roi_align import RoiAlign

_SIZES = torch.tensor([[64, 96], [64, 96]])


def head_of(
    monkeypatch: pytest.MonkeyPatch, logits: list[list[float]], deltas: Any = None, **settings: Any
) -> BoxHead:
    """A box head that answers two classes and background, whatever it sees."""
    head = BoxHead(RoiAlign(2), 2, 3, 4, **settings)
    said = torch.tensor(logits), torch.zeros(len(logits), 2, 4) if deltas is None else torch.as_tensor(deltas)
    monkeypatch.setattr(head, "forward", lambda maps, regions: said)
    return head


def test_the_published_size() -> None:
    head = BoxHead(RoiAlign(7), 90)
    assert sum(each.numel() for each in head.parameters()) == 12544 * 1024 + 1024 + 1024**2 + 1024 + 1025 * (91 + 360)


def test_regions_become_detections_of_their_likely_classes(monkeypatch: pytest.MonkeyPatch) -> None:
    head = head_of(monkeypatch, [[9.0, 0, 0], [0, 0, 9], [0, 6, 0], [4, 4, -9]])
    boxes = torch.tensor([[1.0, 2, 30, 40], [5, 5, 20, 20], [40, 10, 80, 50], [10, 10, 50, 60]])
    found = head.detections([], Proposals(torch.tensor([0, 0, 0, 1]), boxes), _SIZES)
    assert found.picture.tolist() == [0, 0, 1, 1]
    assert found.labels.tolist() == [0, 1, 0, 1]
    assert_close(found.boxes, boxes[[0, 2, 3, 3]])
    assert_close(found.scores[2:], [0.5, 0.5], atol=1e-4)


def test_boxes_are_moved_by_the_deltas_of_the_class_and_cut_at_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    deltas = torch.zeros(1, 2, 4)
    deltas[0, 1] = torch.tensor([5.0, 0, 0, 0])  # half a box to the right
    head = head_of(monkeypatch, [[4.0, 4, 0]], deltas)
    found = head.detections(
        [], Proposals(torch.zeros(1, dtype=torch.int64), torch.tensor([[60.0, 0, 90, 50]])), _SIZES
    )
    assert_close(found.boxes[found.labels == 0], [[60.0, 0, 90, 50]])
    assert_close(found.boxes[found.labels == 1], [[75.0, 0, 96, 50]])


def test_suppression_stays_within_pictures_and_classes(monkeypatch: pytest.MonkeyPatch) -> None:
    head = head_of(monkeypatch, [[5.0, -9, 0], [6, -9, 0], [-9, 5, 0], [5, -9, 0]])
    boxes = torch.tensor([[10.0, 10, 50, 50]]).repeat(4, 1)
    found = head.detections([], Proposals(torch.tensor([0, 0, 0, 1]), boxes), _SIZES)
    assert list(zip(found.picture.tolist(), found.labels.tolist(), strict=True)) == [(0, 0), (0, 1), (1, 0)]
    assert float(found.scores[0]) == pytest.approx(1 / (1 + 2.718281828**-6), abs=1e-5)


@pytest.mark.parametrize(("least_score", "most", "count"), [(0.05, 100, 8), (0.05, 3, 3), (0.999, 100, 0)])
def test_scores_and_numbers_are_bounded(
    monkeypatch: pytest.MonkeyPatch, least_score: float, most: int, count: int
) -> None:
    head = head_of(monkeypatch, [[5.0, -9, 0]] * 8, least_score=least_score, most=most)
    low = 10.0 * torch.arange(8)[:, None]
    boxes = torch.cat([low, torch.zeros(8, 1), low + 9, torch.full((8, 1), 20.0)], dim=1)
    found = head.detections([], Proposals(torch.zeros(8, dtype=torch.int64), boxes), _SIZES)
    assert len(found.scores) == count
    assert found.scores.tolist() == sorted(found.scores.tolist(), reverse=True)


def test_no_proposals_give_no_detections() -> None:
    head = BoxHead(RoiAlign(2), 2, 3, 4)
    maps = [torch.rand(2, 3, 16 // 2**level, 24 // 2**level) for level in range(4)]
    found = head.detections(maps, Proposals(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 4)), _SIZES)
    assert found.boxes.shape == (0, 4)
    assert found.labels.dtype == torch.int64


def test_verdicts_stand_beside_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    boxes = painted_photos([[(4, 4, 30, 40, 1), (50, 10, 90, 60, 0)]]).instances.boxes
    deltas = torch.arange(24.0).reshape(3, 2, 4)
    head = head_of(monkeypatch, [[0.0, 1, 0], [1, 0, 0], [0, 0, 1]], deltas)
    zeros = torch.zeros(2, dtype=torch.int64)
    regions = torch.tensor([[52.0, 8, 88, 62], [4.0, 4, 30, 40]])
    found = ObjectRegions(zeros, regions, torch.tensor([0, 1]), torch.tensor([1, 0]))
    verdicts = head.learned([], SampledRegions(found, Proposals(zeros[:1], torch.tensor([[0.0, 0, 9, 9]]))), boxes)
    assert verdicts.labels.tolist() == [0, 1, 2]
    assert_close(verdicts.deltas, torch.stack([deltas[0, 0], deltas[1, 1]]))
    assert_close(head.coder.decode(verdicts.target_deltas, regions), boxes[[1, 0]], atol=1e-4)
    assert_close(verdicts.target_deltas[1], torch.zeros(4))
