"""Regions to learn from: true boxes among them, each with its own object, never more than asked for."""

import torch
from painted_photos import painted_photos

from rendra_lab.detection.boxes import iou
from rendra_lab.detection.matching import Matcher
from rendra_lab.detection.regions import Proposals, RegionSampler, SampledRegions

_BOXES = [[(4, 4, 30, 40, 1), (50, 10, 90, 60, 2)], [], [(10, 20, 60, 60, 0)]]


def proposals_of(count: int) -> Proposals:
    """So many of each of three pictures, half of them near true boxes of any picture."""
    near = painted_photos(_BOXES).instances.boxes.repeat(count, 1)[: 3 * count // 2]
    low = torch.rand(3 * count - len(near), 2) * torch.tensor([60.0, 40.0])
    rest = torch.cat([low, low + 5 + 30 * torch.rand(len(low), 2)], dim=1)
    boxes = torch.cat([near + 4 * torch.randn(near.shape), rest])
    return Proposals(torch.arange(3 * count) % 3, boxes[torch.randperm(3 * count)])


def drawn(sampler: RegionSampler, proposals: Proposals) -> SampledRegions:
    return sampler(proposals, painted_photos(_BOXES).instances, 3)


def test_without_proposals_the_true_boxes_are_the_regions() -> None:
    instances = painted_photos(_BOXES).instances
    found = drawn(RegionSampler(), Proposals(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 4)))
    assert torch.equal(found.objects.boxes, instances.boxes)
    assert torch.equal(found.objects.labels, instances.labels)
    assert torch.equal(found.objects.picture, instances.picture)
    assert found.objects.objects.tolist() == [0, 1, 2]
    assert found.background.boxes.shape == (0, 4)


def test_regions_hold_the_object_that_they_overlap_most_in_their_own_picture() -> None:
    instances = painted_photos(_BOXES).instances
    found = drawn(RegionSampler(), proposals_of(200)).objects
    assert len(found.boxes) > 5
    table = iou(found.boxes, instances.boxes)
    table[found.picture[:, None] != instances.picture] = -1
    assert torch.equal(table.argmax(1), found.objects)
    assert bool((table.amax(1) >= 0.5).all())
    assert torch.equal(found.labels, instances.labels[found.objects])


def test_background_overlaps_nothing_much_and_pictures_without_objects_have_nothing_else() -> None:
    instances = painted_photos(_BOXES).instances
    found = drawn(RegionSampler(count=1000), proposals_of(200)).background
    table = iou(found.boxes, instances.boxes) * (found.picture[:, None] == instances.picture)
    assert float(table.max()) < 0.5
    assert int((found.picture == 1).sum()) == 200


def test_no_more_than_asked_for_and_no_more_objects_than_their_share() -> None:
    found = drawn(RegionSampler(count=8, positive_fraction=0.25), proposals_of(300))
    everything = found.all
    assert [int((everything.picture == picture).sum()) for picture in range(3)] == [8, 8, 8]
    assert [int((found.objects.picture == picture).sum()) for picture in range(3)] == [2, 0, 2]
    assert torch.equal(everything.boxes[: len(found.objects.boxes)], found.objects.boxes)


def test_what_is_neither_is_never_drawn() -> None:
    sampler = RegionSampler(Matcher((0.2, 0.5), (-1, 0, 1)), count=10_000)  # as Pix3D's, where not all is annotated
    instances = painted_photos(_BOXES).instances
    found = drawn(sampler, proposals_of(200)).background
    table = iou(found.boxes, instances.boxes) * (found.picture[:, None] == instances.picture)
    assert float(table.amax(1).min()) >= 0.2
    assert not bool((found.picture == 1).any())


def test_pictures_without_any_object() -> None:
    found = RegionSampler(count=16)(proposals_of(40), painted_photos([[], [], []]).instances, 3)
    assert found.objects.boxes.shape == (0, 4)
    assert len(found.background.boxes) == 48
