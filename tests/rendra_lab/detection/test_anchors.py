"""Anchors: their number and order, their middles and areas."""

from __future__ import annotations

import pytest
import torch

from rendra_lab.detection.anchors import LevelAnchors
from rendra_lab.detection.boxes import areas


def maps(*shapes: tuple[int, int], dtype: torch.dtype = torch.float32) -> list[torch.Tensor]:
    return [torch.zeros(2, 3, height, width, dtype=dtype) for height, width in shapes]


def test_shapes_lie_about_the_middles_of_cells_row_by_row() -> None:
    anchors = LevelAnchors((8.0,), (4,), (0.25, 1.0, 4.0))
    (boxes,) = anchors.of_levels(maps((2, 3)))
    assert boxes.shape == (2 * 3 * anchors.per_cell, 4)
    assert boxes[:3].tolist() == [[-6, 0, 10, 4], [-2, -2, 6, 6], [0, -6, 4, 10]]  # about 2, 2
    middles = (boxes[:, :2] + boxes[:, 2:]) / 2
    assert middles[::3].tolist() == [[2, 2], [6, 2], [10, 2], [2, 6], [6, 6], [10, 6]]


def test_all_shapes_have_the_area_of_their_size_and_the_ratio_asked_for() -> None:
    ratios = (0.5, 1.0, 2.0)
    levels = LevelAnchors((32.0, 64.0), (4, 8), ratios).of_levels(maps((3, 5), (2, 2), dtype=torch.float64))
    for boxes, size in zip(levels, (32.0, 64.0), strict=True):
        sides = boxes[:, 2:] - boxes[:, :2]
        torch.testing.assert_close(areas(boxes), torch.full_like(areas(boxes), size**2))
        wanted = torch.tensor(ratios, dtype=torch.float64).repeat(len(boxes) // 3)
        torch.testing.assert_close(sides[:, 1] / sides[:, 0], wanted)


def test_offset_moves_all_boxes_by_a_share_of_a_cell() -> None:
    middle, corner = (LevelAnchors((8.0,), (4,), offset=offset).of_levels(maps((2, 2)))[0] for offset in (0.5, 0.0))
    torch.testing.assert_close(middle - corner, torch.full_like(middle, 2.0))


def test_the_same_stand_everywhere_when_a_map_grows() -> None:
    anchors = LevelAnchors((16.0,), (8,))
    small, large = (anchors.of_levels(maps(shape))[0] for shape in ((2, 4), (5, 4)))
    assert torch.equal(large[: len(small)], small)
    assert anchors.of_levels(maps((0, 4)))[0].shape == (0, 4)


def test_bad_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="one size for each level"):
        LevelAnchors((8.0, 16.0), (4,))
    with pytest.raises(ValueError, match="above 0"):
        LevelAnchors((8.0,), (4,), (0.0,))
    with pytest.raises(ValueError, match="1 levels got 2 feature maps"):
        LevelAnchors((8.0,), (4,)).of_levels(maps((2, 2), (1, 1)))


def test_maps_in_half_precision_have_anchors_in_pixels_all_the_same() -> None:
    (boxes,) = LevelAnchors((32.0,), (4,)).of_levels(maps((3, 700), dtype=torch.bfloat16))
    assert torch.equal(boxes, LevelAnchors((32.0,), (4,)).of_levels(maps((3, 700)))[0])
