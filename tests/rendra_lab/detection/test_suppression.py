"""Suppression: against the rule written down as a loop, in groups, on both of its paths and any number of threads."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rendra_lab.detection.boxes import iou
from rendra_lab.detection.suppression import kept_boxes, surest_of_each


def crowd(count: int, groups: int = 1, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor, Tensor]:
    low, size = torch.rand(2, count, 2, dtype=dtype)
    boxes = torch.cat([100 * low, 100 * low + 10 + 40 * size], dim=1)
    return boxes, torch.rand(count, dtype=dtype), torch.randint(groups, (count,))


def by_hand(boxes: Tensor, scores: Tensor, groups: Tensor, threshold: float) -> list[int]:
    """The rule itself."""
    table, kept = iou(boxes, boxes), list[int]()
    for index in scores.sort(descending=True, stable=True).indices.tolist():
        if all(groups[other] != groups[index] or table[other, index] <= threshold for other in kept):
            kept.append(index)
    return kept


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])  # compiled loops, tables
@pytest.mark.parametrize(("count", "groups"), [(1, 1), (7, 1), (200, 1), (200, 6), (150, 150)])
@pytest.mark.parametrize("threshold", [0.05, 0.5, 0.8])
def test_it_is_greedy(count: int, groups: int, threshold: float, dtype: torch.dtype) -> None:
    boxes, scores, group = crowd(count, groups, dtype)
    assert kept_boxes(boxes, scores, group, threshold).tolist() == by_hand(boxes, scores, group, threshold)


def test_both_paths_keep_the_same_boxes(monkeypatch: pytest.MonkeyPatch) -> None:
    from rendra_lab.detection import suppression

    boxes, scores, groups = crowd(700, 5)
    compiled = kept_boxes(boxes, scores, groups, 0.3)
    monkeypatch.setattr(suppression, "_is_kept_on_cpu", suppression._is_kept_in_rounds)
    monkeypatch.setattr(suppression, "_MOST_PAIRS", 1)  # group by group
    assert torch.equal(kept_boxes(boxes, scores, groups, 0.3), compiled)


def test_a_chain_is_settled_link_by_link() -> None:
    """Each box overlaps its neighbours alone: every second one stays, and rounds must run to the end of it."""
    left = torch.arange(41, dtype=torch.float64) * 6
    boxes = torch.stack([left, torch.zeros(41), left + 10, torch.full((41,), 10)], dim=1).double()
    kept = kept_boxes(boxes, -left, torch.zeros(41, dtype=torch.int64), 0.2)
    assert kept.tolist() == list(range(0, 41, 2))


def test_groups_leave_each_other_alone() -> None:
    boxes = torch.tensor([[0.0, 0, 10, 10]]).repeat(4, 1)
    scores = torch.tensor([0.1, 0.4, 0.3, 0.2])
    assert kept_boxes(boxes, scores, torch.tensor([7, -2, 7, 5]), 0.5).tolist() == [1, 2, 3]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ties_go_to_the_first_given(dtype: torch.dtype) -> None:
    boxes = torch.tensor([[0.0, 0, 10, 10], [0, 0, 10, 9], [50, 0, 60, 10]], dtype=dtype)
    kept = kept_boxes(boxes, torch.ones(3, dtype=dtype), torch.zeros(3, dtype=torch.int64), 0.5)
    assert kept.tolist() == [0, 2]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_overlap_of_the_threshold_is_no_more_than_it(dtype: torch.dtype) -> None:
    boxes = torch.tensor([[0.0, 0, 10, 10], [0, 0, 10, 5]], dtype=dtype)
    scores, group = torch.tensor([2.0, 1.0], dtype=dtype), torch.zeros(2, dtype=torch.int64)
    assert len(kept_boxes(boxes, scores, group, 0.5)) == 2
    assert len(kept_boxes(boxes, scores, group, 0.49)) == 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nothing_is_kept_of_nothing(dtype: torch.dtype) -> None:
    empty = torch.zeros(0, dtype=dtype)
    kept = kept_boxes(torch.zeros(0, 4, dtype=dtype), empty, torch.zeros(0, dtype=torch.int64), 0.5)
    assert (kept.shape, kept.dtype) == ((0,), torch.int64)
    assert surest_of_each(empty, torch.zeros(0, dtype=torch.int64), 3).shape == (0,)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_boxes_without_area_or_with_lost_corners_harm_nobody(dtype: torch.dtype) -> None:
    boxes = torch.tensor([[5.0, 5, 5, 5], [5, 5, 5, 5], [float("nan")] * 4, [0, 0, 10, 10]], dtype=dtype)
    scores = torch.tensor([4.0, 3, 2, 1], dtype=dtype)
    assert kept_boxes(boxes, scores, torch.zeros(4, dtype=torch.int64), 0.5).tolist() == [0, 1, 2, 3]


def test_threads_change_nothing() -> None:
    boxes, scores, groups = crowd(600, 9)
    threads = torch.get_num_threads()
    try:
        answers = [
            (torch.set_num_threads(number), kept_boxes(boxes, scores, groups, 0.4))[1].tolist()
            for number in (1, 2, 3)
        ]
    finally:
        torch.set_num_threads(threads)
    assert answers[0] == answers[1] == answers[2]


def test_the_surest_of_each_group_in_order() -> None:
    scores = torch.tensor([0.3, 0.9, 0.5, 0.5, 0.1, 0.7])
    groups = torch.tensor([4, 1, 4, 4, 1, 4])
    assert surest_of_each(scores, groups, 2).tolist() == [1, 4, 5, 2]
    assert surest_of_each(scores, groups, 100).tolist() == [1, 4, 5, 2, 3, 0]
    assert surest_of_each(scores, groups, 0).tolist() == []


def test_bad_input_is_refused() -> None:
    boxes, scores, groups = crowd(4)
    with pytest.raises(ValueError, match=r"got \(4, 4\), \(3,\), \(4,\)"):
        kept_boxes(boxes, scores[:3], groups, 0.5)
    with pytest.raises(ValueError, match=r"in \[0, 1\], got 50"):
        kept_boxes(boxes, scores, groups, 50.0)
