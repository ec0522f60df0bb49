"""The mask head: a mask of the class of each region, true masks beside it."""

import pytest
import torch
from assertions import assert_close, assert_finite
from painted_photos import painted_photos

from rendra_lab.detection.mask_head import MaskHead
from rendra_lab.detection.records import Detections
from rendra_lab.detection.regions import ObjectRegions
from rendra_lab.detection.roi_align import RoiAlign

_MAPS = [(16, 24), (8, 12), (4, 6), (2, 3)]


def head_and_maps(norm: str = "none") -> tuple[MaskHead, list[torch.Tensor]]:
    head = MaskHead(RoiAlign(4, canonical_px=64.0), 3, 8, 8, 2, norm)
    return head, [torch.rand(2, 8, *size) for size in _MAPS]


def test_the_published_size() -> None:
    head = MaskHead(RoiAlign(14), 80)
    assert head.side == 28
    convs, wider, last = 4 * (256 * 256 * 9 + 256), 256 * 256 * 4 + 256, 80 * 257
    assert sum(each.numel() for each in head.parameters()) == convs + wider + last


@pytest.mark.parametrize("norm", ["none", "group"])
def test_masks_are_those_of_the_class(norm: str) -> None:
    head, maps = head_and_maps(norm)
    boxes = torch.tensor([[4.0, 4, 30, 40], [20, 8, 60, 60], [4, 4, 30, 40]])
    picture, labels = torch.tensor([0, 1, 0]), torch.tensor([2, 0, 1])
    masks = head(maps, boxes, picture, labels)
    assert masks.shape == (3, 8, 8)
    every = head.logits(torch.relu(head.wider(head.convs(head.pool(maps, boxes, picture)))))
    assert_close(masks, every[torch.arange(3), labels])


def test_truth_is_cut_from_the_mask_of_the_own_object() -> None:
    head, maps = head_and_maps()
    batch = painted_photos([[(0, 0, 20, 20, 1)], [(40, 8, 72, 40, 0), (4, 4, 20, 60, 2)]])
    boxes = torch.tensor([[0.0, 0, 40, 40], [40, 8, 72, 40], [12, 4, 28, 60]])
    picture = torch.tensor([0, 1, 1])
    verdicts = head.learn(
        maps, ObjectRegions(picture, boxes, torch.tensor([1, 0, 2]), torch.tensor([0, 1, 2])), batch
    )
    truth = verdicts["masks"].targets
    quarter = torch.zeros(8, 8)
    quarter[:4, :4] = 1
    left = torch.zeros(8, 8)
    left[:, :4] = 1
    assert_close(truth, torch.stack([quarter, torch.ones(8, 8), left]))
    assert verdicts["masks"].logits.shape == (3, 8, 8)


@pytest.mark.parametrize("norm", ["none", "group"])
def test_no_regions_give_no_masks_and_gradients_of_zeros(norm: str) -> None:
    head, maps = head_and_maps(norm)
    none = torch.zeros(0, dtype=torch.int64)
    verdicts = head.learn(maps, ObjectRegions(none, torch.zeros(0, 4), none, none), painted_photos([[], []]))["masks"]
    assert verdicts.logits.shape == verdicts.targets.shape == (0, 8, 8)
    verdicts.logits.sum().backward()
    for parameter in head.parameters():
        assert_finite(parameter.grad)
    found = head.describe(maps, Detections(none, torch.zeros(0, 4), none, torch.zeros(0)))
    assert found.masks.shape == (0, 8, 8)


def test_detections_get_probabilities_and_keep_what_they_are() -> None:
    head, maps = head_and_maps()
    found = Detections(
        torch.tensor([0, 1]), torch.tensor([[4.0, 4, 30, 40], [3.0, 3, 3.5, 3.5]]), torch.tensor([2, 0]),
        torch.tensor([0.9, 0.1]),
    )  # fmt: skip
    seen = head.describe(maps, found)
    assert seen.boxes is found.boxes
    assert bool(((seen.masks > 0) & (seen.masks < 1)).all())
    assert_close(seen.masks.logit(), head(maps, found.boxes, found.picture, found.labels), atol=1e-4)
