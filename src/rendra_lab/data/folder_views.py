"""Scenes that lie in folders, with what all of their formats share: options, division, box, complaints."""

from __future__ import annotations

import logging
import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rendra.io._source import neighbour
from rendra.io.errors import MeshFormatError
from rendra_lab.data.photographs import SUFFIXES, Photograph, read_photographs
from rendra_lab.data.posed_images import PosedImages
from rendra_lab.data.ray_views import RayWarp, Scene, SceneViews
from rendra_lab.data.scene_box import estimate_box, has_silhouettes
from rendra_lab.errors import UserError

log = logging.getLogger(__name__)

_FEWEST_POINTS = 10
_OUTLIERS = 0.005  # share of the points beyond each wall of the box
_MARGIN = 0.1  # of that box, in parts of its sides


@dataclass(frozen=True)
class Capture:
    """What a folder says, before any pixel is read."""

    train: Sequence[Photograph]
    val: Sequence[Photograph]
    test: Sequence[Photograph]
    points: Tensor | None = None  # (P, 3) of the scene's surfaces
    box: Tensor | None = None  # (2, 3) where the format leaves no choice
    depth_range: tuple[float, float] | None = None
    up: tuple[float, float, float] | None = None
    warp: RayWarp | None = None
    remark: str = ""  # what was made up
    is_interleaved: bool = False  # the format does not divide views: some in between are val and test


class FolderViews(SceneViews):
    """Views out of a folder; subclasses know its format.

    Args:
        path: the folder.
        shrink: pixels a side of the files that make one pixel.
        hold_out: every which photograph, by name, is kept from training where the format does not say.
        box: [[x,y,z],[x,y,z]], lowest and highest corner of the scene; null estimates it.
        depth_range: [near,far], distances along a ray to look between; null takes what the folder says.
        allow_outside: read files outside the folder if it names them.
        **rays: see SceneViews.

    Raises:
        UserError: options that cannot be.
    """

    def __init__(
        self,
        path: str | Path,
        shrink: int = 1,
        hold_out: int = 8,
        box: Sequence[Sequence[float]] | None = None,
        depth_range: Sequence[float] | None = None,
        allow_outside: bool = False,
        **rays: Any,
    ) -> None:
        super().__init__(**rays)
        if not isinstance(shrink, int) or shrink < 1:
            raise UserError(f"data.shrink is a whole number of pixels a side, 1 or more, got {shrink!r}")
        if not isinstance(hold_out, int) or hold_out < 2:
            raise UserError(f"data.hold_out must be 2 or more (8: every eighth photograph), got {hold_out!r}")
        self.path = Path(path)
        self.shrink = shrink
        self.hold_out = hold_out
        self.box = None if box is None else _given_box(box)
        self.depth_range = None if depth_range is None else _given_range(depth_range)
        self.allow_outside = allow_outside

    @abstractmethod
    def read(self) -> Capture:
        """The cameras and the names of the photographs."""

    def load(self) -> Scene:
        """The views; UserError names the file and what is wrong with it."""
        if not self.path.is_dir():
            raise UserError(f"data.path={self.path} is no folder")
        capture = self.read()
        if not capture.train:
            raise UserError(f"{self.path} has no photograph to train on")
        train = read_photographs(capture.train, self._factor)
        test = read_photographs(capture.test, self._factor)
        val = test if capture.val is capture.test else read_photographs(capture.val, self._factor)
        depth_range = self.depth_range or capture.depth_range
        scene = Scene(
            train=train,
            val=val,
            test=test,
            box=self._box(train, capture, depth_range),
            depth_range=depth_range,
            up=capture.up,
            warp=capture.warp,
        )
        log.info("%s", _summary(self.path, scene, capture))
        return scene

    @property
    def _factor(self) -> int:
        """By how much the files are shrunk as they are read."""
        return self.shrink

    def inside(self, name: str, where: str) -> Path:
        """The path of a file that a file of the folder names.

        Raises:
            UserError: it lies outside the folder, which data.allow_outside=true permits.
        """
        try:
            found = neighbour(str(self.path), name, file=where, line=None, allow_outside=self.allow_outside)
        except MeshFormatError as error:
            raise UserError(
                f"{where}: {error.why}: {name!r}; data.allow_outside=true reads files outside {self.path}"
            ) from error
        return Path(found)

    def divided(self, photographs: Sequence[Photograph]) -> tuple[list[Photograph], list[Photograph]]:
        """Those to train on and those that are held out, the first one and every `hold_out`th after it."""
        if len(photographs) < 2:
            raise UserError(
                f"{self.path} has {len(photographs)} photograph; one to train on and one to test are needed"
            )
        held = photographs[:: self.hold_out]
        return [p for i, p in enumerate(photographs) if i % self.hold_out], list(held)

    def _box(self, train: PosedImages, capture: Capture, depth_range: tuple[float, float] | None) -> Tensor:
        if self.box is not None:
            return self.box
        if capture.box is not None:
            return capture.box
        if capture.points is not None and len(capture.points) >= _FEWEST_POINTS and not has_silhouettes(train):
            return box_of_points(capture.points)
        return estimate_box(train, depth_range)


def box_of_points(points: Tensor) -> Tensor:
    """The box (2, 3) of nearly all points (P, 3): half a per cent beyond each wall may be wrong."""
    count = len(points)
    beyond = int(_OUTLIERS * count)
    ordered = points.double().sort(0).values
    lowest, highest = ordered[beyond], ordered[count - 1 - beyond]
    margin = _MARGIN * (highest - lowest).clamp_min(0.05 * float((highest - lowest).amax().clamp_min(1e-6)))
    return torch.stack([lowest - margin, highest + margin]).float()


def folder_of_images(root: Path, shrink: int) -> tuple[Path, int]:
    """The folder of photographs, `images_4` for shrink=4 where there is one, and by how much to shrink those."""
    small = root / f"images_{shrink}"
    if shrink > 1 and small.is_dir():
        return small, 1
    if not (root / "images").is_dir():
        raise UserError(f"there is no folder {root / 'images'} of photographs")
    return root / "images", shrink


def pictures_in(folder: Path) -> list[Path]:
    """The pictures of a folder, by name."""
    return sorted(
        path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
    )


def demand_unique(paths: Sequence[Path], where: Sequence[str]) -> None:
    """Refuse a picture that is named twice."""
    first: dict[Path, str] = {}
    for path, place in zip(paths, where, strict=True):
        known = first.setdefault(path, place)
        if known != place:
            raise UserError(f"{place}: the picture {path} is named a second time; {known} has it already")


def _given_box(box: Any) -> Tensor:
    try:
        corners = torch.tensor([[float(x) for x in corner] for corner in box])
    except (TypeError, ValueError) as error:
        raise UserError(f"data.box must be [[x,y,z],[x,y,z]], got {box!r}") from error
    if corners.shape != (2, 3) or not bool(corners.isfinite().all() and (corners[0] < corners[1]).all()):
        raise UserError(f"data.box must be [[x,y,z],[x,y,z]], the lowest corner first, got {box!r}")
    return corners


def _given_range(depth_range: Any) -> tuple[float, float]:
    try:
        near, far = (float(depth) for depth in depth_range)
    except (TypeError, ValueError) as error:
        raise UserError(f"data.depth_range must be [near,far], got {depth_range!r}") from error
    if not 0 <= near < far < math.inf:
        raise UserError(f"data.depth_range must be [near,far] with 0 <= near < far, got {depth_range!r}")
    return near, far


def _summary(path: Path, scene: Scene, capture: Capture) -> str:
    held = len(scene.test) + (0 if scene.val is scene.test else len(scene.val))
    sizes = sorted({(width, height) for height, width in scene.train.sizes.tolist()})
    shown = ", ".join(f"{width} x {height}" for width, height in sizes[:3]) + (", ..." if len(sizes) > 3 else "")
    lowest, highest = (" ".join(f"{x:.3g}" for x in corner) for corner in scene.box.tolist())
    depths = (
        "all of the box" if scene.depth_range is None else f"{scene.depth_range[0]:.3g} to {scene.depth_range[1]:.3g}"
    )
    alpha = ", with alpha" if scene.train.has_alpha else ""
    return (
        f"{path}: {len(scene.train)} images to train on, {held} held out, {shown} pixels{alpha}; "
        f"box ({lowest}) to ({highest}), depths {depths}{'; ' if capture.remark else ''}{capture.remark}"
    )
