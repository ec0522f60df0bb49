"""Areas and overlaps of boxes that can be counted by hand; coding and decoding undo each other."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rendra_lab.detection.boxes import BoxCoder, areas, clipped, have_sides_of, iou, overlap_areas

SQUARE = torch.tensor([[0.0, 0, 10, 10]])


def random_boxes(count: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    low, size = torch.rand(2, count, 2, generator=generator, dtype=torch.float64)
    return torch.cat([100 * low, 100 * low + 1 + 50 * size], dim=1)


@pytest.mark.parametrize(
    ("other", "share"),
    [
        ([0.0, 0, 10, 10], 1.0),
        ([5.0, 0, 15, 10], 50 / 150),
        ([2.0, 2, 4, 7], 10 / 100),
        ([10.0, 0, 20, 10], 0.0),  # they share an edge alone
        ([12.0, 12, 20, 20], 0.0),  # apart along both axes: two negative sides are no area
        ([4.0, 4, 4, 9], 0.0),
        ([9.0, 9, 1, 1], 0.0),
    ],
)
def test_overlaps_that_can_be_counted(other: list[float], share: float) -> None:
    assert iou(SQUARE, torch.tensor([other])).item() == pytest.approx(share)


def test_boxes_without_area_do_not_divide_by_it() -> None:
    point = torch.tensor([[3.0, 3, 3, 3]], requires_grad=True)
    share = iou(point, point)
    share.sum().backward()
    assert share.item() == 0
    assert bool(point.grad.isfinite().all())


def test_overlap_is_that_of_pictures_of_the_boxes() -> None:
    boxes = random_boxes(6).round()
    pixels = torch.arange(160) + 0.5
    inside = (pixels > boxes[:, :1]) & (pixels < boxes[:, 2:3]), (pixels > boxes[:, 1:2]) & (pixels < boxes[:, 3:])
    pictures = (inside[1][:, :, None] & inside[0][:, None, :]).reshape(6, -1).double()
    torch.testing.assert_close(overlap_areas(boxes, boxes), pictures @ pictures.T)
    torch.testing.assert_close(areas(boxes), pictures.sum(1))


def test_overlap_is_symmetric_and_blind_to_shifts_and_scales() -> None:
    first, second = random_boxes(5), random_boxes(7, seed=1)
    table = iou(first, second)
    assert table.shape == (5, 7)
    torch.testing.assert_close(iou(second, first), table.T)
    torch.testing.assert_close(iou(3 * first - 40, 3 * second - 40), table)


def test_no_boxes_have_no_overlaps() -> None:
    assert iou(SQUARE, torch.zeros(0, 4)).shape == (1, 0)
    assert iou(torch.zeros(0, 4), torch.zeros(0, 4)).shape == (0, 0)


def test_boxes_are_cut_at_the_edges_of_their_own_picture() -> None:
    boxes = torch.tensor([[-5.0, 2, 90, 70], [-5.0, 2, 90, 70], [100.0, 100, 120, 120]])
    cut = clipped(boxes, torch.tensor([[48, 64], [100, 80], [48, 64]]))
    assert cut.tolist() == [[0, 2, 64, 48], [0, 2, 80, 70], [64, 48, 64, 48]]
    assert torch.equal(clipped(boxes[:1], torch.tensor([[48, 64]])), cut[:1])


def test_thin_and_endless_boxes_are_told_from_others() -> None:
    boxes = torch.tensor([[0.0, 0, 5, 5], [0, 0, 5, 1], [0, 0, math.nan, 5], [0, 0, math.inf, 5], [5, 5, 0, 0]])
    assert have_sides_of(boxes, 1.0).tolist() == [True, False, False, False, False]


def test_a_code_is_what_its_equation_says() -> None:
    region = torch.tensor([[10.0, 20, 30, 60]])  # middle 20, 40; sides 20, 40
    box = torch.tensor([[15.0, 20, 25, 100]])  # middle 20, 60; sides 10, 80
    deltas = BoxCoder((10.0, 10.0, 5.0, 5.0)).encode(box, region)
    torch.testing.assert_close(deltas, torch.tensor([[0, 10 * 20 / 40, 5 * math.log(0.5), 5 * math.log(2.0)]]))


@pytest.mark.parametrize("weights", [(1.0, 1.0, 1.0, 1.0), (10.0, 10.0, 5.0, 5.0)])
def test_coding_there_and_back_is_nothing(weights: tuple[float, float, float, float]) -> None:
    coder, boxes, regions = BoxCoder(weights), random_boxes(20), random_boxes(20, seed=1)
    torch.testing.assert_close(coder.decode(coder.encode(boxes, regions), regions), boxes)
    assert torch.equal(coder.encode(regions, regions), torch.zeros(20, 4, dtype=torch.float64))


def test_decoding_broadcasts_over_classes() -> None:
    coder, regions = BoxCoder(), random_boxes(4)
    deltas = torch.randn(4, 3, 4, dtype=torch.float64)
    together = coder.decode(deltas, regions[:, None])
    torch.testing.assert_close(together[:, 1], coder.decode(deltas[:, 1], regions))


def test_wild_deltas_and_flat_boxes_stay_finite() -> None:
    coder = BoxCoder()
    decoded = coder.decode(torch.tensor([[0.0, 0, 500, -500]]), SQUARE)
    assert decoded[0, 2] - decoded[0, 0] == pytest.approx(10 * 1000 / 16)
    flat = torch.tensor([[3.0, 3, 3, 8]])
    assert bool(coder.encode(flat, SQUARE).isfinite().all())
    assert bool(coder.encode(SQUARE, flat).isfinite().all())


def test_gradients_of_decoded_boxes() -> None:
    deltas = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda values: BoxCoder().decode(values, random_boxes(3)), deltas)
