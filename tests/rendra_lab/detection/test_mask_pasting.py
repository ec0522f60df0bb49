"""Masks from squares into pictures and back, against sampling by torch and against counted pixels."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.detection import mask_pasting
from rendra_lab.detection.mask_pasting import cropped_masks, pasted_masks, pasted_probabilities

BOXES = torch.tensor(
    [[3.2, 5.1, 20.7, 17.4], [-4.0, -3.0, 9.5, 12.0], [25.0, 10.0, 50.0, 40.0], [8.0, 8.0, 9.0, 9.0]]
)


def sampled(squares: Tensor, boxes: Tensor, height: int, width: int) -> Tensor:
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    low, high = boxes[:, None, None, :2], boxes[:, None, None, 2:]
    grid = 2 * (torch.stack([x, y], dim=-1).to(boxes) - low) / (high - low) - 1
    return F.grid_sample(squares[:, None], grid, align_corners=False)[:, 0]


@pytest.mark.parametrize("side", [1, 5, 28])
def test_pasting_is_bilinear_sampling(side: int) -> None:
    squares, boxes = torch.rand(4, side, side, dtype=torch.float64), BOXES.double()
    torch.testing.assert_close(
        pasted_probabilities(squares, boxes, 24, 32), sampled(squares, boxes, 24, 32), atol=1e-12, rtol=0
    )


def test_a_full_square_fills_its_box_and_nothing_else() -> None:
    masks = pasted_masks(torch.ones(2, 14, 14), torch.tensor([[4.0, 2, 12, 9], [-5.0, 20, 40, 60]]), 24, 32)
    wanted = torch.zeros(2, 24, 32, dtype=torch.bool)
    wanted[0, 2:9, 4:12] = True
    wanted[1, 20:] = True
    assert torch.equal(masks, wanted)


def test_masks_in_parts_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    squares = torch.rand(4, 7, 7)
    whole = pasted_masks(squares, BOXES, 24, 32, threshold=0.3)
    monkeypatch.setattr(mask_pasting, "_MOST_VALUES", 1)
    assert torch.equal(pasted_masks(squares, BOXES, 24, 32, threshold=0.3), whole)


def test_pasting_boxes_that_are_nowhere() -> None:
    boxes = torch.tensor([[5.0, 5, 5, 9], [100.0, 100, 120, 120], [9.0, 9, 2, 2]])
    probabilities = pasted_probabilities(torch.ones(3, 4, 4), boxes, 12, 12)
    assert bool(probabilities.isfinite().all())
    assert not bool(pasted_masks(torch.ones(3, 4, 4), boxes, 12, 12).any())
    assert pasted_masks(torch.zeros(0, 4, 4), torch.zeros(0, 4), 12, 12).shape == (0, 12, 12)


def test_pasting_has_gradients() -> None:
    squares = torch.rand(4, 3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda values: pasted_probabilities(values, BOXES.double(), 6, 8), squares)


def test_a_crop_along_pixels_is_those_pixels() -> None:
    masks = torch.rand(3, 20, 24) > 0.5
    index = torch.tensor([2, 0])
    cut = cropped_masks(masks, index, torch.tensor([[4.0, 3, 11, 10], [0.0, 0, 7, 7]]), 7)
    assert torch.equal(cut, torch.stack([masks[2, 3:10, 4:11], masks[0, :7, :7]]))
    finer = cropped_masks(masks, index[:1], torch.tensor([[4.0, 3, 11, 10]]), 14)
    assert torch.equal(finer[0], masks[2, 3:10, 4:11].repeat_interleave(2, 0).repeat_interleave(2, 1))


def test_cells_hold_what_fills_half_of_them() -> None:
    mask = torch.zeros(1, 8, 8, dtype=torch.bool)
    mask[0, :4, :4] = True  # the whole of the first cell of 2 x 2
    mask[0, :4, 4:6] = True  # half of the second
    mask[0, 4:, :3] = True  # three quarters of the third
    mask[0, 4:7, 4:6] = True  # three eighths of the fourth
    cut = cropped_masks(mask, torch.tensor([0]), torch.tensor([[0.0, 0, 8, 8]]), 2)
    assert cut[0].tolist() == [[True, True], [True, False]]


def test_crops_are_means_over_cells_that_cut_pixels() -> None:
    """Against the mask drawn 20 times larger, where the cells end between pixels."""
    mask = torch.rand(1, 9, 11) > 0.4
    box = torch.tensor([[1.35, 0.8, 9.75, 8.6]])  # cells of 1.4 x 1.3 pixels
    large = mask[0].repeat_interleave(20, 0).repeat_interleave(20, 1).double()
    means = large[16:172, 27:195].reshape(6, 26, 6, 28).mean((1, 3))
    assert bool(((means - 0.5).abs() > 1e-6).all())
    assert torch.equal(cropped_masks(mask, torch.tensor([0]), box, 6)[0], means > 0.5)


def test_nothing_is_outside_a_picture_or_in_a_flat_box() -> None:
    masks = torch.ones(1, 6, 6, dtype=torch.bool)
    boxes = torch.tensor([[-4.0, 0, 4, 8], [2.0, 2, 2, 5], [50.0, 50, 60, 60], [float("nan")] * 4])
    cut = cropped_masks(masks, torch.zeros(4, dtype=torch.int64), boxes, 4)
    wanted = torch.zeros(4, 4, dtype=torch.bool)
    wanted[:3, 2:] = True
    assert torch.equal(cut[0], wanted)
    assert not bool(cut[1:].any())


def test_no_crops() -> None:
    none = torch.zeros(0, dtype=torch.int64)
    assert cropped_masks(torch.zeros(0, 6, 6, dtype=torch.bool), none, torch.zeros(0, 4), 5).shape == (0, 5, 5)


def test_a_small_box_in_a_large_picture_is_exact() -> None:
    mask = torch.ones(1, 1200, 1600, dtype=torch.bool)
    mask[0, 1190:, 1592:] = False
    cut = cropped_masks(mask, torch.tensor([0]), torch.tensor([[1590.0, 1188, 1594, 1192]]), 28)
    wanted = torch.ones(28, 28, dtype=torch.bool)
    wanted[14:, 14:] = False
    assert torch.equal(cut[0], wanted)


def test_pasting_and_cropping_undo_each_other() -> None:
    y, x = torch.meshgrid(torch.arange(28.0), torch.arange(28.0), indexing="ij")
    disk = ((y - 13.5) ** 2 + (x - 13.5) ** 2 < 120)[None]
    box = torch.tensor([[10.3, 4.6, 66.8, 71.2]])
    mask = pasted_masks(disk.float(), box, 80, 90)
    again = cropped_masks(mask, torch.tensor([0]), box, 28)
    assert int((again != disk).sum()) <= 4  # cells of the edge that pixels cut in half
