"""Frames of films that others took: pictures that are yet to be read, and their cameras.

Letters: N frames, H x W pixels. Cameras are OpenCV's (x right, y down, z forwards), columns: x_camera = M x_world.
Pixels: the middle of the first one at (0.5, 0.5), so that a picture that is resized takes its intrinsics along by
plain factors: f' = s f, c' = s c, each axis with its own s.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.data.photographs import SUFFIXES, decode, image_size
from rendra_lab.data.posed_images import NUM_DISTORTION, distorted
from rendra_lab.errors import UserError
from rendra_lab.tasks.synsin.records import PairBatch

FITS = ("squeeze", "crop")
_LARGEST = 1e9  # number of a camera
_Numbers = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """A picture that is yet to be read, and its camera.

    Attributes:
        path: of the picture.
        where: the file and the place in it that name the frame, for complaints.
        intrinsics: (4,) fx fy cx cy.
        world_to_camera: (4, 4).
        in_parts: whether the intrinsics are parts of the picture's width and height instead of pixels.
        distortion: (8,) of the lens, see `posed_images.NUM_DISTORTION`; None where there is none.
        fisheye: whether that is an equidistant lens.
    """

    path: Path
    where: str
    intrinsics: _Numbers
    world_to_camera: _Numbers
    in_parts: bool = False
    distortion: _Numbers | None = None
    fisheye: bool = False


@dataclass(frozen=True)
class Film:
    """Frames of one place in their order; attributes as of `Frame`, each with N in front."""

    paths: Sequence[Path]
    places: Sequence[str]
    intrinsics: _Numbers  # (N, 4)
    world_to_camera: _Numbers  # (N, 4, 4)
    in_parts: bool = False
    distortion: _Numbers | None = None  # (N, 8)
    fisheye: npt.NDArray[np.bool_] | None = None  # (N,)

    def __len__(self) -> int:
        return len(self.paths)

    def frame(self, index: int) -> Frame:
        """One of them."""
        return Frame(
            self.paths[index],
            self.places[index],
            self.intrinsics[index],
            self.world_to_camera[index],
            self.in_parts,
            None if self.distortion is None or not self.distortion[index].any() else self.distortion[index],
            self.fisheye is not None and bool(self.fisheye[index]),
        )

    def turns_deg(self, index: int, others: npt.NDArray[np.int64]) -> _Numbers:
        """By how much the cameras of `others` (M,) are turned against that of one frame: (M,) degrees."""
        R = self.world_to_camera[:, :3, :3]
        traces = np.einsum("mij,ij->m", R[others], R[index])
        return np.degrees(np.arccos(((traces - 1) / 2).clip(-1, 1)))

    def moves(self, index: int, others: npt.NDArray[np.int64]) -> _Numbers:
        """How far from one frame's camera those of `others` (M,) stood: (M,) units of the poses."""
        positions = self._positions(np.append(others, index))
        return np.linalg.norm(positions[:-1] - positions[-1], axis=1)

    def _positions(self, indices: npt.NDArray[np.int64]) -> _Numbers:
        matrices = self.world_to_camera[indices]
        return -np.einsum("mji,mj->mi", matrices[:, :3, :3], matrices[:, :3, 3])


class PictureReader:
    """Reads frames at one size, and keeps those that it read last.

    Each pixel is a weighted mean of all that it covers (a triangle, twice as wide as a pixel), so that nothing is
    aliased. Transparent pictures lie over white. Lenses with distortion are straightened, their intrinsics kept.

    Args:
        size: (H, W).
        fit: `squeeze` takes the whole picture, whatever its shape; `crop` the largest part of that shape in its
            middle.
        kept: how many pictures stay in memory; copies of the reader begin with none.
        scale: metres of a unit of the poses.

    Raises:
        UserError: an unknown `fit`.
    """

    def __init__(self, size: tuple[int, int], fit: str = "squeeze", kept: int = 0, scale: float = 1.0) -> None:
        if fit not in FITS:
            raise UserError(f"data.fit must be one of {', '.join(FITS)}, got {fit!r}")
        self.size = size
        self.fit = fit
        self.kept = kept
        self.scale = scale
        self._shelf: OrderedDict[Path, tuple[Tensor, Tensor]] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_shelf": OrderedDict()}

    def pair(self, first: Frame, second: Frame) -> PairBatch:
        """A batch of one, from the first frame to the second.

        Raises:
            UserError: a picture that is not there or cannot be read, a camera that cannot be.
        """
        (rgb, intrinsics), (target, target_intrinsics) = self._read(first), self._read(second)
        motion = second.world_to_camera @ np.linalg.inv(first.world_to_camera)
        motion[:3, 3] *= self.scale
        return PairBatch(
            input=rgb[None].float() / 255,
            target=target[None].float() / 255,
            intrinsics=intrinsics[None],
            target_intrinsics=target_intrinsics[None],
            input_to_target=torch.from_numpy(motion).float()[None],
        )

    def _read(self, frame: Frame) -> tuple[Tensor, Tensor]:
        """Pixels (3, H, W) uint8 and intrinsics (3, 3)."""
        found = self._shelf.pop(frame.path, None) or self._develop(frame)
        if self.kept > 0:
            self._shelf[frame.path] = found
            if len(self._shelf) > self.kept:
                self._shelf.popitem(last=False)
        return found

    def _develop(self, frame: Frame) -> tuple[Tensor, Tensor]:
        picture = _opaque(frame)
        left, top, right, bottom = self._part(picture.width, picture.height)
        height, width = self.size
        across, down = width / (right - left), height / (bottom - top)
        fx, fy, cx, cy = _in_pixels(frame, picture.width, picture.height)
        pinhole = np.array([fx * across, fy * down, (cx - left) * across, (cy - top) * down])
        detail = 1 if frame.distortion is None and not frame.fisheye else 2
        small = picture.resize(
            (detail * width, detail * height), Image.Resampling.BILINEAR, box=(left, top, right, bottom)
        )
        pixels = torch.from_numpy(np.array(small)).permute(2, 0, 1)
        if detail > 1:
            pixels = _straightened(pixels, detail * pinhole, frame, detail)
        intrinsics = torch.eye(3)
        intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]] = torch.from_numpy(pinhole).float()
        return pixels.contiguous(), intrinsics

    def _part(self, width: int, height: int) -> tuple[float, float, float, float]:
        """Left, top, right and bottom of what is taken of a picture."""
        if self.fit == "squeeze":
            return 0.0, 0.0, float(width), float(height)
        shrink = min(width / self.size[1], height / self.size[0])
        half_width, half_height = shrink * self.size[1] / 2, shrink * self.size[0] / 2
        return width / 2 - half_width, height / 2 - half_height, width / 2 + half_width, height / 2 + half_height


def pictures_by_name(folder: Path) -> dict[str, Path]:
    """The pictures of a folder by their names without suffix; none where there is no folder."""
    if not folder.is_dir():
        return {}
    names = (os.path.splitext(name) for name in os.listdir(folder))
    return {stem: folder / f"{stem}{suffix}" for stem, suffix in names if suffix.lower() in SUFFIXES}


def _opaque(frame: Frame) -> Image.Image:
    """The picture in RGB, laid over white where it has alpha."""
    image_size(frame.path, frame.where)
    picture = decode(frame.path, frame.where)
    if "A" in picture.getbands() or "transparency" in picture.info:
        picture = picture.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", picture.size, "white"), picture).convert("RGB")
    return picture.convert("RGB")


def _in_pixels(frame: Frame, width: int, height: int) -> _Numbers:
    """Intrinsics (4,) in pixels of the file.

    Raises:
        UserError: numbers that no camera has.
    """
    found = frame.intrinsics * [width, height, width, height] if frame.in_parts else frame.intrinsics
    if not np.isfinite(found).all() or (found[:2] <= 0).any() or (np.abs(found) > _LARGEST).any():
        shown = " ".join(f"{number:.6g}" for number in frame.intrinsics)
        raise UserError(f"{frame.where}: fx fy cx cy are {shown}; expected finite numbers, fx and fy above zero")
    return found


def _straightened(pixels: Tensor, pinhole: _Numbers, frame: Frame, detail: int) -> Tensor:
    """What a pinhole of the same intrinsics would have shown, `detail` times smaller.

    Beyond the border of the picture, its border goes on.

    Args:
        pixels: (3, H, W) uint8, as the lens showed them.
        pinhole: (4,) in these pixels.
        frame: whose lens it is.
        detail: pixels along each side of one of the result.
    """
    height, width = pixels.shape[1:]
    focal, centre = torch.from_numpy(pinhole).split(2)
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    slope = (torch.stack([columns, rows], dim=-1).reshape(-1, 2) + 0.5 - centre) / focal
    lens = torch.zeros(NUM_DISTORTION) if frame.distortion is None else torch.from_numpy(frame.distortion)
    bent = distorted(slope, lens.to(slope).expand(len(slope), -1), torch.full((len(slope),), frame.fisheye))
    place = 2 * (bent * focal + centre) / torch.tensor([width, height]) - 1
    grid = place.reshape(1, height, width, 2).float()
    straight = F.grid_sample(pixels[None].float(), grid, padding_mode="border", align_corners=False)
    return F.avg_pool2d(straight, detail)[0].round().to(torch.uint8)
