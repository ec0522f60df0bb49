"""RoIAlign: against its definition sample by sample, maps that are linear, and levels by the published rule."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rendra_lab.detection.roi_align import RoiAlign, levels_of


def boxes_over(count: int, width: float, height: float) -> Tensor:
    """Some of them partly or wholly outside."""
    middle = (torch.rand(count, 2, dtype=torch.float64) * 1.6 - 0.3) * torch.tensor([width, height])
    half = torch.rand(count, 2, dtype=torch.float64) * torch.tensor([width, height]) / 2
    return torch.cat([middle - half, middle + half], dim=1)


def by_hand(feature: Tensor, box: list[float], stride: int, side: int, samples: int) -> Tensor:
    """The definition, for one map (C, H, W) and one box."""
    x0, y0, x1, y1 = (edge / stride - 0.5 for edge in box)
    count_x, count_y = samples or math.ceil((x1 - x0) / side), samples or math.ceil((y1 - y0) / side)
    out = feature.new_zeros(feature.shape[0], side, side)
    for i in range(side):
        for j in range(side):
            for a in range(count_y):
                for b in range(count_x):
                    y = y0 + (i + (a + 0.5) / count_y) * (y1 - y0) / side
                    x = x0 + (j + (b + 0.5) / count_x) * (x1 - x0) / side
                    out[:, i, j] += bilinear(feature, y, x) / (count_x * count_y)
    return out


def bilinear(feature: Tensor, y: float, x: float) -> Tensor:
    _, height, width = feature.shape
    if not (-1 <= y <= height and -1 <= x <= width):
        return feature.new_zeros(feature.shape[0])
    y, x = min(max(y, 0), height - 1), min(max(x, 0), width - 1)
    top, left = int(y), int(x)
    down, right = min(top + 1, height - 1), min(left + 1, width - 1)
    upper = feature[:, top, left] * (1 - x + left) + feature[:, top, right] * (x - left)
    lower = feature[:, down, left] * (1 - x + left) + feature[:, down, right] * (x - left)
    return upper * (1 - y + top) + lower * (y - top)


@pytest.mark.parametrize("samples", [0, 1, 2, 3])
def test_it_is_its_definition(samples: int) -> None:
    features = torch.randn(2, 3, 6, 9, dtype=torch.float64)
    boxes, picture = boxes_over(12, 36, 24), torch.arange(12) % 2
    cut = RoiAlign(3, (4,), samples)([features], boxes, picture)
    wanted = [by_hand(features[p], box, 4, 3, samples) for box, p in zip(boxes.tolist(), picture, strict=True)]
    torch.testing.assert_close(cut, torch.stack(wanted))


@pytest.mark.parametrize("samples", [0, 2])
def test_a_linear_map_is_read_at_the_middles_of_cells(samples: int) -> None:
    y, x = torch.meshgrid(torch.arange(16.0) + 0.5, torch.arange(20.0) + 0.5, indexing="ij")
    box = torch.tensor([[13.0, 9.0, 61.0, 45.0]])
    cut = RoiAlign(4, (4,), samples)([torch.stack([x, y])[None] * 4], box, torch.zeros(1, dtype=torch.int64))
    torch.testing.assert_close(cut[0, 0, 0], 13 + 48 * (torch.arange(4) + 0.5) / 4)
    torch.testing.assert_close(cut[0, 1, :, 0], 9 + 36 * (torch.arange(4) + 0.5) / 4)


@pytest.mark.parametrize("samples", [0, 1])
def test_the_box_of_the_whole_map_is_the_map(samples: int) -> None:
    feature = torch.randn(1, 4, 7, 7)
    cut = RoiAlign(7, (8,), samples)([feature], torch.tensor([[0.0, 0, 56, 56]]), torch.zeros(1, dtype=torch.int64))
    torch.testing.assert_close(cut, feature)


def test_levels_by_the_side_of_boxes() -> None:
    sides = torch.tensor([0.0, 10, 111.9, 112, 223.9, 224, 447.9, 448, 5000])
    boxes = torch.stack([torch.zeros(9), torch.zeros(9), sides, sides], dim=1)
    assert levels_of(boxes, (4, 8, 16, 32)).tolist() == [0, 0, 0, 1, 1, 2, 2, 3, 3]
    assert levels_of(boxes, (8, 16)).tolist() == [0, 0, 0, 0, 0, 1, 1, 1, 1]
    assert levels_of(boxes / 4, (4, 8, 16, 32), 56.0).tolist() == levels_of(boxes, (4, 8, 16, 32)).tolist()
    wide = torch.tensor([[0.0, 0, 448, 112], [3.0, 3, 1, 1]])  # its area counts; inside out: none
    assert levels_of(wide, (4, 8, 16, 32)).tolist() == [2, 0]


@pytest.mark.parametrize("samples", [0, 2])
def test_every_region_reads_its_own_level_and_picture(samples: int) -> None:
    features = [
        torch.arange(3.0)[:, None, None, None] * 10 + level + torch.zeros(3, 2, 16 >> level, 12 >> level)
        for level in range(3)
    ]
    sides, picture = torch.tensor([20.0, 30, 45, 12, 28]), torch.tensor([2, 0, 1, 1, 2])
    boxes = torch.stack([torch.zeros(5), torch.zeros(5), sides, sides], dim=1)
    cut = RoiAlign(2, (4, 8, 16), samples, canonical_px=40.0)(features, boxes, picture)
    level = levels_of(boxes, (4, 8, 16), 40.0)
    assert level.tolist() == [1, 1, 2, 0, 1]
    torch.testing.assert_close(cut, (picture * 10.0 + level)[:, None, None, None].expand(5, 2, 2, 2))


@pytest.mark.parametrize("samples", [0, 2])
def test_gradients(samples: int) -> None:
    maps = [torch.randn(2, 2, 5, 6, dtype=torch.float64), torch.randn(2, 2, 3, 3, dtype=torch.float64)]
    boxes, picture = boxes_over(5, 24, 20), torch.arange(5) % 2
    align = RoiAlign(2, (4, 8), samples, canonical_px=24.0)
    wanted = [feature.requires_grad_() for feature in maps]
    assert torch.autograd.gradcheck(lambda *features: align(features, boxes, picture), wanted)


@pytest.mark.parametrize("samples", [0, 2])
def test_no_regions(samples: int) -> None:
    feature = torch.randn(2, 3, 4, 4, requires_grad=True)
    cut = RoiAlign(7, (4,), samples)([feature], torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64))
    cut.sum().backward()
    assert cut.shape == (0, 3, 7, 7)
    assert torch.equal(feature.grad, torch.zeros_like(feature))


@pytest.mark.parametrize("samples", [0, 2])
def test_lost_boxes_read_nothing_and_fail_nowhere(samples: int) -> None:
    feature = torch.ones(1, 1, 4, 4)
    boxes = torch.tensor([[float("nan")] * 4, [0.0, 0, float("inf"), 8], [900.0, 900, 950, 950], [8.0, 8, 8, 8]])
    cut = RoiAlign(2, (4,), samples)([feature], boxes, torch.zeros(4, dtype=torch.int64))
    assert cut.flatten(1).amax(1).tolist() == [0, 0, 0, 1]
    assert bool(cut.isfinite().all())


@pytest.mark.parametrize("samples", [0, 2])
def test_threads_change_no_bit(samples: int) -> None:
    feature, boxes = torch.randn(2, 24, 16, 20), boxes_over(70, 80, 64).float()
    picture, weights = torch.arange(70) % 2, torch.randn(70, 24, 7, 7)
    threads, results = torch.get_num_threads(), []
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            leaf = feature.clone().requires_grad_()
            cut = RoiAlign(7, (4,), samples)([leaf], boxes, picture)
            (cut * weights).sum().backward()
            results.append((cut.detach(), leaf.grad))
    finally:
        torch.set_num_threads(threads)
    for cut, slope in results[1:]:
        assert torch.equal(cut, results[0][0])
        assert torch.equal(slope, results[0][1])


def test_bad_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="side=0"):
        RoiAlign(0)
    with pytest.raises(ValueError, match="got 1 feature maps"):
        RoiAlign(7)([torch.zeros(1, 1, 2, 2)], torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64))
