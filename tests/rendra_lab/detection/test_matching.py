"""Matching by thresholds, boxes that keep their best region, and drawing in balance."""

from __future__ import annotations

import pytest
import torch

from rendra_lab.detection.matching import Matcher, balanced_sample

TRUE = torch.tensor([[0.0, 0, 10, 10], [20.0, 0, 30, 10]])
# overlap with the boxes: all of the first; 0.6 of it; 0.25 of it; 0.1 of the second; nothing
REGIONS = torch.tensor([[0.0, 0, 10, 10], [0, 0, 10, 6], [0, 0, 5, 5], [20, 0, 30, 1], [50, 50, 60, 60]])


def test_labels_follow_the_thresholds() -> None:
    matches = Matcher((0.3, 0.7), (0, -1, 1))(TRUE, REGIONS)
    assert matches.labels.tolist() == [1, -1, 0, 0, 0]
    assert matches.index.tolist()[:4] == [0, 0, 0, 1]
    torch.testing.assert_close(matches.overlaps, torch.tensor([1.0, 0.6, 0.25, 0.1, 0.0]))


def test_a_threshold_belongs_to_the_interval_above_it() -> None:
    half = torch.tensor([[0.0, 0, 10, 5]])  # overlap 0.5 exactly
    assert Matcher()(TRUE, half).labels.tolist() == [1]


def test_mesh_rcnn_learns_nothing_from_what_hardly_overlaps() -> None:
    matches = Matcher((0.2, 0.5, 0.7), (-1, 0, -1, 1))(TRUE, REGIONS)
    assert matches.labels.tolist() == [1, -1, 0, -1, -1]


def test_every_box_keeps_its_best_region_however_poor() -> None:
    matches = Matcher((0.3, 0.7), (0, -1, 1), keeps_best=True)(TRUE, REGIONS)
    assert matches.labels.tolist() == [1, -1, 0, 1, 0]


def test_all_regions_that_tie_for_best_are_kept() -> None:
    matches = Matcher((0.3, 0.7), (0, -1, 1), keeps_best=True)(TRUE, REGIONS[[3, 4, 3]])
    assert matches.labels.tolist() == [1, 0, 1]


def test_a_box_that_nothing_touches_makes_no_region_an_object() -> None:
    matches = Matcher((0.3, 0.7), (0, -1, 1), keeps_best=True)(TRUE[1:], REGIONS[:3])
    assert matches.labels.tolist() == [0, 0, 0]


def test_without_boxes_or_regions() -> None:
    matcher = Matcher((0.3, 0.7), (0, -1, 1), keeps_best=True)
    alone = matcher(torch.zeros(0, 4), REGIONS)
    assert alone.labels.tolist() == alone.index.tolist() == alone.overlaps.tolist() == [0] * 5
    assert len(matcher(TRUE, torch.zeros(0, 4)).labels) == 0
    assert len(matcher(torch.zeros(0, 4), torch.zeros(0, 4)).labels) == 0


def test_bad_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="thresholds that rise"):
        Matcher((0.7, 0.3), (0, -1, 1))
    with pytest.raises(ValueError, match="one label more"):
        Matcher((0.5,), (0, -1, 1))
    with pytest.raises(ValueError, match="1, 0 and -1"):
        Matcher((0.5,), (0, 2))


LABELS = torch.tensor([1] * 10 + [0] * 30 + [-1] * 20)


@pytest.mark.parametrize(
    ("count", "fraction", "objects", "background"),
    [(16, 0.25, 4, 12), (16, 1.0, 10, 6), (100, 0.5, 10, 30), (0, 0.5, 0, 0), (10, 0.0, 0, 10)],
)
def test_draws_have_the_size_and_the_balance_asked_for(
    count: int, fraction: float, objects: int, background: int
) -> None:
    positive, negative = balanced_sample(LABELS, count, fraction)
    assert (len(positive), len(negative)) == (objects, background)
    assert bool((LABELS[positive] == 1).all())
    assert bool((LABELS[negative] == 0).all())
    assert len(positive.unique()) == objects
    assert len(negative.unique()) == background


def test_what_one_side_lacks_of_objects_is_background() -> None:
    positive, negative = balanced_sample(LABELS[8:], 16, 0.5)
    assert (len(positive), len(negative)) == (2, 14)


def test_every_region_is_drawn_in_time_and_as_often_as_others() -> None:
    draws = torch.cat([balanced_sample(LABELS, 10, 0.5)[0] for _ in range(400)]).bincount(minlength=10)
    assert draws.sum() == 2000
    assert bool(((draws - 200).abs() < 60).all())  # six standard deviations


def test_draws_repeat_with_their_seed() -> None:
    first, again = (torch.manual_seed(3) and balanced_sample(LABELS, 8, 0.5) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
