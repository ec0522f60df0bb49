"""Annotated pictures from files: at which size they are shown, and their pixels, masks and boxes at that size.

Letters: H x W pixels. Boxes and pixels: as of `rendra_lab.detection.records`. Pixels are taken as they stand in the
file, since that is what annotators' tools did.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from rendra_lab.data.photographs import decode, demand_size, image_size
from rendra_lab.errors import UserError
from rendra_lab.settings import Positive, check_numbers

Size = tuple[int, int]
"""Height and width, pixels."""


@dataclass(frozen=True)
class Sizing:
    """Which size pictures are brought to: Detectron2's rule.

    Attributes:
        shortest_px: what the shorter side becomes; None leaves pictures as they are.
        longest_px: what the longer side may become; then both shrink further.
    """

    shortest_px: int | None = None
    longest_px: int | None = None

    def __post_init__(self) -> None:
        check_numbers("data", Positive | None, shortest_px=self.shortest_px, longest_px=self.longest_px)

    def of(self, size: Size) -> Size:
        """The size that a picture of one size is shown at."""
        factor = 1.0 if self.shortest_px is None else self.shortest_px / min(size)
        if self.longest_px is not None:
            factor = min(factor, self.longest_px / max(size))
        height, width = (max(1, round(side * factor)) for side in size)
        return height, width


def read_colors(
    path: Path, where: str, expected: Size, shown: Size, background: str | None = "white"
) -> Float[Tensor, "3 H W"]:
    """Colours, sRGB in [0, 1]; each pixel is a mean of all that it covers.

    Args:
        path: of the picture.
        where: who names it, for complaints.
        expected: size of the file.
        shown: H and W of the result.
        background: a colour's name, behind what is transparent; None drops alpha.

    Raises:
        UserError: no picture that can be read, or one of another size.
    """
    demand_size(path, where, image_size(path, where), expected)
    picture = decode(path, where)
    if background is not None and ("A" in picture.getbands() or "transparency" in picture.info):
        picture = picture.convert("RGBA")
        picture = Image.alpha_composite(Image.new("RGBA", picture.size, background), picture)
    pixels = np.array(_resized(picture.convert("RGB"), shown))
    return torch.from_numpy(pixels).permute(2, 0, 1).contiguous().float() / 255


def read_mask(path: Path, where: str, expected: Size, shown: Size) -> Bool[Tensor, "H W"]:
    """Where a picture is bright: over half of the pixel, at half of full brightness.

    Args:
        path: of the mask.
        where: who names it, for complaints.
        expected: size of the file.
        shown: H and W of the result.

    Raises:
        UserError: no picture that can be read, one of another size, or one that is dark all over.
    """
    demand_size(path, where, image_size(path, where), expected)
    bright = decode(path, where).convert("L").point(lambda level: 255 * (level >= 128))
    if not bright.getbbox():
        raise UserError(
            f"{where}: the mask {path} is dark all over; expected it to be bright where the object is seen"
        )
    return resized_mask(np.asarray(bright) > 0, shown)


def resized_mask(mask: npt.NDArray[np.bool_], shown: Size) -> Bool[Tensor, "H W"]:
    """A mask at another size: pixels of which half is covered, or else the one in the middle of what is covered."""
    if mask.shape == shown:
        return torch.from_numpy(mask.copy())
    small = np.asarray(_resized(Image.fromarray(mask.astype(np.uint8) * 255), shown)) >= 128
    if mask.any() and not small.any():
        rows, columns = np.nonzero(mask)
        factors = shown[0] / mask.shape[0], shown[1] / mask.shape[1]
        small[int((rows.mean() + 0.5) * factors[0]), int((columns.mean() + 0.5) * factors[1])] = True
    return torch.from_numpy(small)


def within_picture(box: tuple[float, ...], size: Size, where: str) -> tuple[float, float, float, float]:
    """What of a box x0, y0, x1, y1 lies in a picture.

    Raises:
        UserError: a box turned inside out, or nothing of it; `where` says whose it is.
    """
    x0, y0, x1, y1 = box
    height, width = size
    cut = (max(x0, 0.0), max(y0, 0.0), min(x1, float(width)), min(y1, float(height)))
    if not (cut[0] < cut[2] and cut[1] < cut[3]):
        shown = ", ".join(f"{edge:g}" for edge in box)
        raise UserError(
            f"{where}: the box [{shown}] holds nothing of a picture {width} px wide and {height} high; "
            "expected x0 < x1 and y0 < y1 within it"
        )
    return cut


def boxes_at(boxes: list[tuple[float, float, float, float]], size: Size, shown: Size) -> Float[Tensor, "N 4"]:
    """Boxes of a picture of one size as they are when it is shown at another."""
    across, down = shown[1] / size[1], shown[0] / size[0]
    return (torch.tensor(boxes, dtype=torch.float64).reshape(-1, 4) * torch.tensor([across, down] * 2)).float()


def _resized(picture: Image.Image, shown: Size) -> Image.Image:
    if (picture.height, picture.width) == shown:
        return picture
    return picture.resize(shown[::-1], Image.Resampling.BILINEAR)
