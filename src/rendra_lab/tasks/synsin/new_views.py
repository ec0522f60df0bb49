"""Views of a place of which there is one picture: what `scripts/synthesize.py` makes.

A motion is given as in the demonstrations of SynSin's code, in axes x right, y up, z backwards: angles `phi` about x
and `theta` about y, radians, one rotation vector; then what is added to the coordinates of points, in the units of
the depth that the run learned. tz = 0.1 brings everything nearer by 0.1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from rendra.transforms import axis_angle_to_matrix
from rendra_lab import visualization
from rendra_lab.base_task import BaseTask
from rendra_lab.data.picture_files import read_upright
from rendra_lab.errors import UserError
from rendra_lab.tasks.synsin.records import PairBatch, ViewPrediction
from rendra_lab.tasks.synsin.report import log_depth_image
from rendra_lab.visualization import Picture

_MOST_FRAMES = 600
_SECONDS_A_FRAME = 1.0  # as the book shows them


@dataclass(frozen=True)
class Motion:
    """How points move, from one frame to the next."""

    theta: float = 0.0
    phi: float = 0.0
    tx: float = 0.0
    ty: float = 0.0
    tz: float = 0.0

    def __post_init__(self) -> None:
        bad = [name for name, value in vars(self).items() if not math.isfinite(value)]
        if bad:
            raise UserError(f"{bad[0]} must be a finite number, got {getattr(self, bad[0])}")

    def matrix(self) -> Tensor:
        """(4, 4), columns, in OpenCV's axes: x right, y down, z forwards."""
        moved = torch.eye(4)
        moved[:3, :3] = axis_angle_to_matrix(torch.tensor([self.phi, -self.theta, 0.0]))
        moved[:3, 3] = torch.tensor([self.tx, -self.ty, -self.tz])
        return moved


@dataclass(frozen=True)
class NewViews:
    """What was made of one picture.

    Attributes:
        input: (3, S, S), the square in the middle of the picture.
        depth: (S, S) of it.
        fed_back: (N, 3, S, S), each made of the one before.
        from_first: (N, 3, S, S), each made of the input.
    """

    input: Tensor
    depth: Tensor
    fed_back: Tensor
    from_first: Tensor


def read_square(path: str | Path, side: int) -> Tensor:
    """The square in the middle of a picture, upright, at side x side pixels: (3, side, side) in [0, 1].

    Raises:
        UserError: no picture.
    """
    image = Image.fromarray(read_upright(Path(path), "image"))
    least = min(image.size)
    left, top = ((size - least) / 2 for size in image.size)
    box = (left, top, left + least, top + least)
    small = image.resize((side, side), Image.Resampling.LANCZOS, box=box)
    return torch.from_numpy(np.array(small)).movedim(-1, 0) / 255


def pinhole(side: int, fov_deg: float) -> Tensor:
    """Intrinsics (3, 3) of a square picture that shows so many degrees from left to right, pixels."""
    if not 1 <= fov_deg <= 170:
        raise UserError(f"fov_deg must be between 1 and 170 degrees, got {fov_deg}")
    focal = side / 2 / math.tan(math.radians(fov_deg) / 2)
    return torch.tensor([[focal, 0.0, side / 2], [0.0, focal, side / 2], [0.0, 0.0, 1.0]])


def new_views(
    task: BaseTask[PairBatch, ViewPrediction], picture: Tensor, intrinsics: Tensor, motion: Motion, frames: int = 1
) -> NewViews:
    """A camera that makes the same motion in each of some frames.

    Args:
        task: trained.
        picture: (3, S, S), sRGB in [0, 1].
        intrinsics: (3, 3) of it, pixels.
        motion: of each frame.
        frames: N.

    Raises:
        UserError: less than one frame, or more than 600.
    """
    if not 1 <= frames <= _MOST_FRAMES:
        raise UserError(f"frames must be from 1 to {_MOST_FRAMES}, got {frames}")
    step = whole = motion.matrix()
    first = task.observe(_pair(picture, intrinsics, step))
    fed_back, from_first = [first.rgb[0]], [first.rgb[0]]
    for _ in range(frames - 1):
        whole = step @ whole
        fed_back.append(task.observe(_pair(fed_back[-1], intrinsics, step)).rgb[0])
        from_first.append(task.observe(_pair(picture, intrinsics, whole)).rgb[0])
    return NewViews(picture, first.depth[0, 0], torch.stack(fed_back), torch.stack(from_first))


def save_views(views: NewViews, folder: Path, endings: Sequence[str] = ("gif",)) -> list[Path]:
    """Writes input, view and depth side by side and apart, and where there are several frames both sequences.

    Args:
        views: to write.
        folder: of view.png, depth.png, views.png, fed_back.gif and from_first.gif, and their frames.
        endings: of the animations, gif or mp4.
    """
    first, view = _picture(views.input), _picture(views.from_first[0])
    depth = visualization.to_picture(log_depth_image(views.depth))
    row = visualization.captioned_row({"input": first, "new view": view, "depth": depth}, max(192, len(first)))
    save = visualization.save_picture
    written = [save(folder / "views.png", row), save(folder / "view.png", view), save(folder / "depth.png", depth)]
    for name in ("fed_back", "from_first") if len(views.fed_back) > 1 else ():
        frames = [first, *(_picture(frame) for frame in getattr(views, name))]
        written += [save(folder / name / f"{number:03d}.png", frame) for number, frame in enumerate(frames)]
        for ending in endings:
            path = folder / f"{name}.{ending}"
            written.append(visualization.save_animation(path, frames, 1 / _SECONDS_A_FRAME, _SECONDS_A_FRAME))
    return written


def _pair(picture: Tensor, intrinsics: Tensor, motion: Tensor) -> PairBatch:
    """A picture, and a camera whose picture nobody knows."""
    rgb, lens = picture[None], intrinsics[None]
    return PairBatch(rgb, torch.zeros_like(rgb), lens, lens, motion[None])


def _picture(rgb: Tensor) -> Picture:
    return visualization.to_picture(rgb.movedim(0, -1))
