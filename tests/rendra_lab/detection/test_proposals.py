"""Region proposals: answers in the order of their anchors, regions in their pictures, verdicts beside the truth."""

import pytest
import torch
from assertions import assert_close
from painted_photos import painted_photos
from torch import nn

from rendra_lab.detection.anchors import LevelAnchors
from rendra_lab.detection.boxes import iou
from rendra_lab.detection.proposals import AnchorAnswers, RegionProposals

_ANCHORS = LevelAnchors((16.0, 32.0), (8, 16), (0.5, 1.0, 2.0))
_SIZES = torch.tensor([[64, 96], [48, 50]])


def answers_of(logits: torch.Tensor, deltas: torch.Tensor | None = None) -> AnchorAnswers:
    maps = [torch.zeros(1, 1, 8, 12), torch.zeros(1, 1, 4, 6)]
    anchors = torch.cat(_ANCHORS.of_levels(maps))
    deltas = torch.zeros(*logits.shape, 4) if deltas is None else deltas
    return AnchorAnswers(logits, deltas, anchors, (8 * 12 * 3, 4 * 6 * 3))


def test_every_answer_stands_where_its_anchor_does() -> None:
    network = RegionProposals(2, _ANCHORS)
    for layer in (network.conv, network.logits, network.deltas):
        nn.init.zeros_(layer.weight)
    with torch.no_grad():
        network.conv.weight[0, 0, 1, 1] = 1
        for anchor in range(3):
            network.logits.weight[anchor, 0] = anchor + 1
            network.deltas.weight[4 * anchor : 4 * anchor + 4, 0, 0, 0] = 10 * anchor + torch.arange(4.0)
    maps = [torch.rand(2, 2, 8, 12), torch.rand(2, 2, 4, 6)]
    answers = network(maps)
    cells = torch.cat([each[:, 0].flatten(1) for each in maps], 1).repeat_interleave(3, 1)
    number = torch.arange(cells.shape[1]) % 3
    assert answers.level_sizes == (288, 72)
    assert_close(answers.logits, cells * (number + 1))
    assert_close(answers.deltas, cells[..., None] * (10 * number[:, None] + torch.arange(4)))
    middles = (answers.anchors[:, :2] + answers.anchors[:, 2:]) / 2
    assert_close(middles[[0, 3, 36, 288]], [[4.0, 4], [12, 4], [4, 12], [8, 8]])


def test_the_surest_come_first_and_lie_in_their_pictures() -> None:
    network = RegionProposals(2, _ANCHORS).eval()
    proposals = network.chosen(answers_of(3 * torch.randn(2, 360), 0.3 * torch.randn(2, 360, 4)), _SIZES)
    assert proposals.picture.tolist() == sorted(proposals.picture.tolist())
    for picture, (height, width) in enumerate(_SIZES.tolist()):
        boxes = proposals.boxes[proposals.picture == picture]
        assert len(boxes) > 10
        assert float(boxes.min()) >= 0
        assert float(boxes[:, 2].max()) <= width
        assert float(boxes[:, 3].max()) <= height
        assert bool((boxes[:, 2:] > boxes[:, :2]).all())


def test_one_loud_anchor_is_the_first_region() -> None:
    network = RegionProposals(2, _ANCHORS).eval()
    logits = torch.zeros(2, 360)
    logits[0, 3 * (3 * 12 + 5) + 1] = 9.0
    logits[1, 288 + 3 * (1 * 6 + 1) + 1] = 9.0
    found = network.chosen(answers_of(logits), _SIZES)
    first = [found.boxes[found.picture == picture][0] for picture in (0, 1)]
    assert_close(first[0], [36.0, 20, 52, 36])
    assert_close(first[1], [8.0, 8, 40, 40])


def test_regions_of_one_level_overlap_no_more_than_they_may() -> None:
    network = RegionProposals(2, LevelAnchors((16.0,), (8,), (1.0,)), overlap=0.3).eval()
    anchors = torch.cat(network.anchors.of_levels([torch.zeros(1, 1, 8, 12)]))
    answers = AnchorAnswers(torch.randn(1, 96), 0.5 * torch.randn(1, 96, 4), anchors, (96,))
    boxes = network.chosen(answers, _SIZES[:1]).boxes
    assert 5 < len(boxes) < 96
    assert float(iou(boxes, boxes).fill_diagonal_(0).max()) <= 0.3


@pytest.mark.parametrize(("training", "most"), [(True, 7), (False, 4)])
def test_no_more_than_asked_for(training: bool, most: int) -> None:
    network = RegionProposals(2, _ANCHORS, most_before=(50, 40), most_after=(7, 4)).train(training)
    found = network.chosen(answers_of(torch.randn(2, 360)), _SIZES)
    assert torch.bincount(found.picture).tolist() == [most, most]


def test_answers_that_are_not_finite_give_no_region() -> None:
    network = RegionProposals(2, _ANCHORS).eval()
    deltas = torch.zeros(2, 360, 4)
    deltas[0] = torch.nan
    found = network.chosen(answers_of(torch.zeros(2, 360), deltas), _SIZES)
    assert set(found.picture.tolist()) == {1}


def test_verdicts_lead_from_anchors_to_the_true_boxes() -> None:
    network = RegionProposals(2, _ANCHORS, sampled=400)
    instances = painted_photos([[(4, 4, 30, 40, 1), (50, 10, 90, 60, 2)], [(10, 20, 44, 48, 0)]]).instances
    answers = answers_of(torch.arange(720.0).reshape(2, 360), torch.arange(2880.0).reshape(2, 360, 4))
    verdicts = network.learned(answers, instances)
    objects = int(verdicts.labels.sum())
    assert 3 <= objects == len(verdicts.deltas) == len(verdicts.target_deltas)
    assert bool((verdicts.labels[:objects] == 1).all())
    row = verdicts.logits[:objects].long()
    assert_close(verdicts.deltas, answers.deltas.flatten(0, 1)[row])
    boxes = network.coder.decode(verdicts.target_deltas, answers.anchors[row % 360])
    distance = (boxes[:, None] - instances.boxes).abs().amax(-1)
    distance[(row // 360)[:, None] != instances.picture] = 1e9
    assert float(distance.amin(1).max()) < 1e-3
    assert set(distance.argmin(1).tolist()) == {0, 1, 2}  # none is left without an anchor


def test_no_more_anchors_than_asked_for_and_none_with_an_object_where_there_is_none() -> None:
    network = RegionProposals(2, _ANCHORS, sampled=40, positive_fraction=0.5)
    verdicts = network.learned(answers_of(torch.zeros(2, 360)), painted_photos([[], []]).instances)
    assert verdicts.labels.tolist() == [0.0] * 80
    assert verdicts.deltas.shape == verdicts.target_deltas.shape == (0, 4)


def test_gradients_reach_what_was_drawn_alone() -> None:
    network = RegionProposals(2, _ANCHORS, sampled=10)
    logits, deltas = torch.zeros(2, 360, requires_grad=True), torch.zeros(2, 360, 4, requires_grad=True)
    instances = painted_photos([[(4, 4, 30, 40, 1)], []]).instances
    verdicts = network.learned(answers_of(logits, deltas), instances)
    (verdicts.logits.sum() + verdicts.deltas.sum()).backward()
    assert int((logits.grad != 0).sum()) == 20
    assert int((deltas.grad != 0).any(-1).sum()) == len(verdicts.deltas)
