"""Masks as COCO's files have them: polygons, and lengths of runs.

Lin et al., "Microsoft COCO", ECCV 2014, and the format of its API. Pixels: the middle of the first one at (0.5, 0.5).
A pixel is in a polygon if its middle is, by the even-odd rule; several polygons are one mask together. Runs go down
column after column and tell background and object in turn, background first. As text each length is one number, from
the fourth on its difference to the one before the last, in digits of five bits from the lowest to the highest, each a
character from '0' on; 32 more stands for "goes on", and the highest bit of the last digit for the sign.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from rendra_lab.errors import UserError

Size = tuple[int, int]
"""Height and width, pixels."""
Polygon = npt.NDArray[np.float64]
"""Corners (K, 2): x and y, pixels."""
Runs = npt.NDArray[np.int64]
"""Lengths, background first, of a whole picture."""

_FARTHEST = 1e6
_MOST_CORNERS = 100_000
_MOST_CROSSINGS = 1 << 22  # at once
_MOST_DIGITS = 12  # of a length
_EXPECTED = "polygons, lists of x and y in turn, or runs: counts and size"


def read_segmentation(value: Any, size: Size, where: str) -> list[Polygon] | Runs:
    """What stands in a file for a mask, checked.

    Args:
        value: a list of polygons, or an object of `counts` (a list or text) and `size`.
        size: of the picture.
        where: whose it is, for complaints.

    Raises:
        UserError: neither, numbers that cannot be, or runs of another size than the picture's.
    """
    if isinstance(value, dict):
        return _runs(value, size, where)
    if not isinstance(value, list) or not value:
        raise UserError(f"{where}: 'segmentation' is {_shown(value)}; expected {_EXPECTED}")
    return [_polygon(part, where) for part in value]


def mask_of(segmentation: list[Polygon] | Runs, size: Size, shown: Size) -> npt.NDArray[np.bool_]:
    """The mask (H, W): polygons at the size that is shown, runs at the picture's own."""
    if isinstance(segmentation, np.ndarray):
        values = np.arange(len(segmentation)) % 2 == 1
        return np.repeat(values, segmentation).reshape(size[::-1]).T
    factors = np.array([shown[1] / size[1], shown[0] / size[0]])
    mask = np.zeros(shown, bool)
    for polygon in segmentation:
        mask |= filled(polygon * factors, shown)
    return mask


def filled(polygon: Polygon, size: Size) -> npt.NDArray[np.bool_]:
    """Pixels (H, W) whose middles lie in a polygon, by the even-odd rule."""
    height, width = size
    x0, y0 = polygon.T
    x1, y1 = np.roll(polygon, -1, axis=0).T
    first = np.ceil(np.minimum(y0, y1) - 0.5).clip(0, height).astype(np.int64)
    count = np.ceil(np.maximum(y0, y1) - 0.5).clip(0, height).astype(np.int64) - first
    turns = np.zeros(height * (width + 1), np.int64)
    share = max(1, _MOST_CROSSINGS // height)
    for at in range(0, len(polygon), share):
        edges = slice(at, at + share)
        edge = np.repeat(np.arange(len(polygon))[edges], count[edges])
        row = np.arange(len(edge)) - np.repeat(np.cumsum(count[edges]) - count[edges], count[edges]) + first[edge]
        x = x0[edge] + (row + 0.5 - y0[edge]) * (x1[edge] - x0[edge]) / (y1[edge] - y0[edge])
        column = np.ceil(x - 0.5).clip(0, width).astype(np.int64)
        turns += np.bincount(row * (width + 1) + column, minlength=len(turns))
    return (turns.reshape(height, width + 1).cumsum(1)[:, :width] % 2).astype(bool)


def lengths_of(text: str, where: str) -> list[int]:
    """The lengths of runs that are written as text.

    Raises:
        UserError: characters that are no digits, or a number without an end; `where` says whose it is.
    """
    lengths: list[int] = []
    value = digits = 0
    for character in text:
        code = ord(character) - 48
        if not 0 <= code < 64 or digits >= _MOST_DIGITS:
            raise UserError(f"{where}: 'counts' holds {character!r} where no digit of a run can be")
        value |= (code & 31) << (5 * digits)
        digits += 1
        if code & 32:
            continue
        if code & 16:
            value -= 1 << (5 * digits)
        lengths.append(value + (lengths[-2] if len(lengths) > 2 else 0))
        value = digits = 0
    if digits:
        raise UserError(f"{where}: 'counts' ends in the middle of a number")
    return lengths


def _runs(tree: dict[str, Any], size: Size, where: str) -> Runs:
    counts: Any = tree.get("counts")
    if tree.get("size") != list(size):
        raise UserError(f"{where}: the mask's 'size' is {_shown(tree.get('size'))}; expected that of its picture, "
                        f"[{size[0]}, {size[1]}]")  # fmt: skip
    if isinstance(counts, str):
        counts = lengths_of(counts, where)
    if not isinstance(counts, list) or not all(type(each) is int and 0 <= each <= 1 << 40 for each in counts):
        raise UserError(f"{where}: the mask's 'counts' are {_shown(counts)}; expected lengths of runs of pixels")
    if sum(counts) != size[0] * size[1]:
        raise UserError(
            f"{where}: the runs of the mask have {sum(counts):,} pixels; its picture has {size[0] * size[1]:,}"
        )
    return np.array(counts, np.int64)


def _polygon(value: Any, where: str) -> Polygon:
    try:
        numbers = np.array(value, np.float64) if isinstance(value, list) else np.zeros(0)
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    if numbers.ndim != 1 or not 6 <= len(numbers) <= 2 * _MOST_CORNERS or len(numbers) % 2:
        raise UserError(f"{where}: a polygon is {_shown(value)}; expected x and y in turn, three corners at least")
    if not (np.abs(numbers) < _FARTHEST).all():
        raise UserError(f"{where}: a polygon has a corner at {numbers[~(np.abs(numbers) < _FARTHEST)][0]:g}")
    return numbers.reshape(-1, 2)


def _shown(value: Sequence[Any] | Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
