"""Masks between the squares in which heads predict them and the pictures in which they lie.

Letters: M or R masks, S cells along each side of a square, N true masks of H x W pixels.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_MOST_VALUES = 2**25  # of probabilities that exist at one time


def pasted_probabilities(
    squares: Float[Tensor, "M S S"], boxes: Float[Tensor, "M 4"], height: int, width: int
) -> Float[Tensor, "M H W"]:
    """Squares stretched over their boxes, bilinear between the middles of cells and towards 0 beyond their edges.

    What the middle of each pixel sees. Separable: two products of matrices.
    """
    side = squares.shape[-1]
    across = _tents(boxes[:, 0], boxes[:, 2], width, side)
    down = _tents(boxes[:, 1], boxes[:, 3], height, side)
    return down @ squares @ across.transpose(1, 2)


def pasted_masks(
    squares: Float[Tensor, "M S S"], boxes: Float[Tensor, "M 4"], height: int, width: int, threshold: float = 0.5
) -> Bool[Tensor, "M H W"]:
    """Where in the picture the probability is `threshold` or more. In bounded memory, some masks at a time."""
    count = max(1, _MOST_VALUES // max(1, height * width))
    parts = [
        pasted_probabilities(part, where, height, width) >= threshold
        for part, where in zip(squares.split(count), boxes.split(count), strict=True)
    ]
    return torch.cat(parts)


def cropped_masks(
    masks: Bool[Tensor, "N H W"], index: Int[Tensor, " R"], boxes: Float[Tensor, "R 4"], side: int
) -> Bool[Tensor, "R S S"]:
    """What is in S x S cells of boxes: true where half of a cell's area or more is. Nothing lies outside a picture.

    Exact: means over cells are differences of the summed-area table, which is bilinear within pixels.

    Args:
        masks: true ones.
        index: which of them each box is cut from.
        boxes: in pixels.
        side: S.
    """
    if not len(boxes):
        return torch.zeros((0, side, side), dtype=torch.bool, device=masks.device)
    sums = torch.nn.functional.pad(masks.to(torch.float64), (1, 0, 1, 0)).cumsum(1).cumsum(2)
    ticks = torch.arange(side + 1, device=boxes.device, dtype=torch.float64) / side
    low, high = boxes.detach().to(torch.float64).split(2, dim=1)
    corners = low[:, :, None] + (high - low)[:, :, None] * ticks  # (R, 2, S + 1)
    whole = _interpolated(sums, index, corners[:, 1], corners[:, 0])
    inside = whole.diff(dim=1).diff(dim=2)
    area = (high - low).prod(1)[:, None, None] / side**2
    return (inside >= area / 2) & (area > 0)


def _tents(low: Tensor, high: Tensor, extent: int, side: int) -> Tensor:
    """Weights (M, extent, side) of the cells of [low, high] at the middles of pixels."""
    middles = torch.arange(extent, device=low.device).to(low) + 0.5
    cells = torch.arange(side, device=low.device).to(low) + 0.5
    size = (high - low).clamp_min(torch.finfo(low.dtype).tiny)
    at = (middles - low[:, None]) / size[:, None] * side  # (M, extent)
    return (1 - (at[:, :, None] - cells).abs()).clamp_min(0)


def _interpolated(sums: Tensor, index: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """Tables (N, H + 1, W + 1) at crossings of lines y (R, P) and x (R, P) of table `index`: (R, P, P)."""
    _, rows, columns = sums.shape
    y, x = y.clamp(0, rows - 1), x.clamp(0, columns - 1)
    top, left = y.floor().long().clamp(0, max(0, rows - 2)), x.floor().long().clamp(0, max(0, columns - 2))
    down, across = (y - top)[:, :, None], (x - left)[:, None, :]
    flat = sums.reshape(-1)
    corner = index[:, None, None] * (rows * columns) + top[:, :, None] * columns + left[:, None, :]
    upper = flat[corner] * (1 - across) + flat[corner + 1] * across
    lower = flat[corner + columns] * (1 - across) + flat[corner + columns + 1] * across
    return upper * (1 - down) + lower * down
