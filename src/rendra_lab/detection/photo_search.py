"""What a trained detector finds in a photograph of one's own: what `scripts/detect.py` makes.

A picture tells neither how far objects are nor, so, how large: each is rebuilt as if its middle lay at a given depth.
Its own depth, over its own width, follows the focal length, of which the photograph may know.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional as F

from rendra.io import IO
from rendra.structures import Meshes, join_meshes_as_scene
from rendra_lab import report, visualization
from rendra_lab.base_task import BaseTask
from rendra_lab.data.photo_data import PhotoData
from rendra_lab.data.picture_files import read_upright
from rendra_lab.detection.drawing import (
    SIDES,
    color_of,
    draw_meshes,
    draw_objects,
    painted,
    phong_view,
    silhouette_view,
    upright,
)
from rendra_lab.detection.mask_pasting import pasted_masks
from rendra_lab.detection.object_frames import rebuilt_in_camera
from rendra_lab.detection.records import Detections, DetectorPrediction, Instances, PhotoBatch
from rendra_lab.errors import UserError
from rendra_lab.settings import Fraction, Positive, Size, check_value, hints_of
from rendra_lab.visualization import Picture

_EXIF_IFD, _FOCAL_35MM = 0x8769, 0xA405
_FILM_DIAGONAL_MM = math.hypot(36, 24)
_LOOKED_AT = 32  # pictures of the run that say what its pictures are like
_VIEW_PX = 224


@dataclass(frozen=True)
class Habits:
    """What the pictures are like from which a detector has learned.

    Attributes:
        side_px: their shorter side.
        focal: their focal length, over their longer side.
        classes: names by label.
    """

    side_px: int
    focal: float
    classes: tuple[str, ...]


@dataclass(frozen=True)
class Search:
    """How to look at a photograph.

    Attributes:
        side_px: the shorter side that it is resized to; None: as the pictures that the run learned from.
        focal_px: its focal length, in pixels of the file; None: what its EXIF data say, else as of those pictures.
        depth: of the middle of each object, in whatever unit its mesh is to have.
        least_score: what is less sure is left out.
        only_highest: keeps the surest object alone.
    """

    side_px: Positive | None = None
    focal_px: Size | None = None
    depth: Size = 2.0
    least_score: Fraction = 0.5
    only_highest: bool = False

    def __post_init__(self) -> None:
        for name, hint in hints_of(Search).items():
            if hasattr(self, name):
                check_value(getattr(self, name), hint, name)


@dataclass(frozen=True)
class FoundObjects:
    """What was found in one photograph.

    Attributes:
        picture: (H, W, 3), upright.
        intrinsics: (3, 3) of it, pixels.
        detections: in its pixels, the surest first.
        names: class of each.
        masks: (M, H, W) bool, or None of a detector without.
        meshes: in the axes of its camera, or None of a detector without.
        surest: score of the surest object that was left out; None: nothing was.
    """

    picture: Picture
    intrinsics: Tensor
    detections: Detections
    names: tuple[str, ...]
    masks: Tensor | None
    meshes: Meshes | None
    surest: float | None

    def titles(self) -> list[str]:
        """Class and score of each."""
        return [
            f"{name} {score:.2f}" for name, score in zip(self.names, self.detections.scores.tolist(), strict=True)
        ]


def habits_of(data: PhotoData) -> Habits:
    """What the pictures of a run are like; its data are set up.

    Raises:
        UserError: there are none.
    """
    photos = data.splits.test if len(data.splits.test) else data.splits.train
    if not len(photos):
        raise UserError("the run has no pictures any more that say what it learned from: give side_px and focal_px")
    seen = [photos[i] for i in range(min(len(photos), _LOOKED_AT))]
    sides = [photo.sizes[0].tolist() for photo in seen]
    focals = [float(photo.intrinsics[0, 1, 1]) / max(side) for photo, side in zip(seen, sides, strict=True)]
    return Habits(round(median(min(side) for side in sides)), median(focals), data.classes)


@torch.no_grad()
def find_objects(
    task: BaseTask[PhotoBatch, DetectorPrediction], image: Path, habits: Habits, search: Search
) -> FoundObjects:
    """Looks at one photograph.

    Args:
        task: a trained detector.
        image: file of the photograph.
        habits: of the pictures that it learned from.
        search: how to look.

    Raises:
        UserError: no picture, or a task that detects nothing.
    """
    picture = read_upright(image, "image")
    height, width = picture.shape[:2]
    focal = search.focal_px or exif_focal_px(image, height, width) or habits.focal * max(height, width)
    lens = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    batch, scale = _as_batch(picture, lens, search.side_px or habits.side_px, image.name)
    found = task.observe(batch).detections
    if found is None:
        raise UserError(f"{type(task).__name__} detects nothing: a run of task=mesh_rcnn or mask_rcnn does")
    found = replace(found, boxes=found.boxes / scale.repeat(2))
    sure = (found.scores >= search.least_score).nonzero()[:, 0][: 1 if search.only_highest else None]
    rest = found.scores[len(sure) :]
    kept = chosen(found, sure)
    masks = None if kept.masks is None else pasted_masks(kept.masks, kept.boxes, height, width)
    meshes = None
    if kept.meshes is not None:
        meshes = rebuilt_in_camera(kept, lens[None], torch.full_like(kept.scores, search.depth))
    names = tuple(habits.classes[label] for label in kept.labels.tolist())
    return FoundObjects(picture, lens, kept, names, masks, meshes, float(rest[0]) if len(rest) else None)


def chosen(found: Detections, rows: Tensor) -> Detections:
    """Some of the found objects, in the order of `rows`."""
    values = {name: getattr(found, name) for name in Detections.names()}
    kept = {name: value.index_select(0, rows) for name, value in values.items() if isinstance(value, Tensor)}
    meshes = found.meshes
    if meshes is not None:
        verts, faces = meshes.verts_list(), meshes.faces_list()
        meshes = Meshes([verts[row] for row in rows.tolist()], [faces[row] for row in rows.tolist()])
    return replace(found, **kept, meshes=meshes)


def exif_focal_px(image: Path, height: int, width: int) -> float | None:
    """The focal length that a camera wrote into its photograph, pixels; None where it did not.

    That of film of 36 x 24 mm, whose diagonal shows as much as the photograph's: it holds as long as the photograph
    was not cropped.
    """
    try:
        with Image.open(image) as opened:
            focal_mm = float(opened.getexif().get_ifd(_EXIF_IFD).get(_FOCAL_35MM, 0))
    except Exception:  # whatever the decoder says of the EXIF data, then they say nothing
        return None
    return focal_mm * math.hypot(height, width) / _FILM_DIAGONAL_MM if 0 < focal_mm < math.inf else None


def save_objects(found: FoundObjects, folder: Path) -> list[Path]:
    """Writes pictures, meshes and numbers of what was found.

    Of all objects `detections.png`, `detections.json` and, with meshes, `meshes.png` (in front of the photograph) and
    `scene.glb`. Of each, such as `00_chair_0.993`: `_mask.png`, its box and mask alone; with meshes `.obj`, `.glb`,
    and `_sides.png`, its mesh and its silhouette from four sides. Files of meshes have axes x right, y up, z towards
    the viewer, and the camera at the origin.
    """
    boxes, titles, masks = found.detections.boxes, found.titles(), found.masks
    everything = draw_objects(found.picture, boxes, titles, masks)
    written = [visualization.save_picture(folder / "detections.png", everything)]
    for number, (name, score) in enumerate(zip(found.names, found.detections.scores.tolist(), strict=True)):
        stem = folder / f"{number:02d}_{name.replace('/', '_')}_{score:.3f}"
        row, color = slice(number, number + 1), color_of(number)
        alone = draw_objects(found.picture, boxes[row], titles[row], None if masks is None else masks[row], [color])
        written.append(visualization.save_picture(_named(stem, "_mask.png"), alone))
        if found.meshes is not None:
            written += _save_mesh(found.meshes[number], stem, number)
    if found.meshes is not None and len(found.meshes):
        front = draw_meshes(found.picture, found.meshes, found.intrinsics)
        written.append(visualization.save_picture(folder / "meshes.png", front))
        scene = join_meshes_as_scene([painted(mesh, color_of(i)) for i, mesh in enumerate(_each(found.meshes))])
        IO().save_mesh(upright(scene), folder / "scene.glb")
        written.append(folder / "scene.glb")
    report.write_json(folder / "detections.json", numbers_of(found))
    return [*written, folder / "detections.json"]


def numbers_of(found: FoundObjects) -> dict[str, Any]:
    """What was found, for other programs: boxes x0, y0, x1, y1 in pixels of the photograph."""
    height, width = found.picture.shape[:2]
    detections = found.detections
    rows: list[dict[str, Any]] = []
    for number, name in enumerate(found.names):
        row = {"class": name, "score": float(detections.scores[number]), "box": detections.boxes[number].tolist()}
        if found.masks is not None:
            row["mask_pixels"] = int(found.masks[number].sum())
        if detections.depth_extents is not None:
            row["depth_extent"] = float(detections.depth_extents[number])
        rows.append(row)
    return {"width": width, "height": height, "intrinsics": found.intrinsics.tolist(), "objects": rows}


def sides_sheet(mesh: Meshes, number: int) -> Picture:
    """One mesh from four sides, lit and below as its silhouette; colour by its number."""
    lit = {side: phong_view(mesh, camera, color_of(number), _VIEW_PX) for side, camera in SIDES.items()}
    outlines = {f"silhouette {side}": silhouette_view(mesh, camera, _VIEW_PX) for side, camera in SIDES.items()}
    rows = [visualization.captioned_row(row, _VIEW_PX) for row in (lit, outlines)]
    return visualization.tile(rows, columns=1)


def _save_mesh(mesh: Meshes, stem: Path, number: int) -> list[Path]:
    paths = [_named(stem, ending) for ending in (".obj", ".glb")]
    own = upright(mesh)
    IO().save_mesh(own, paths[0])
    IO().save_mesh(painted(own, color_of(number)), paths[1])
    return [*paths, visualization.save_picture(_named(stem, "_sides.png"), sides_sheet(mesh, number))]


def _named(stem: Path, ending: str) -> Path:
    """`Path.with_suffix` takes what follows the point of a score for a suffix."""
    return stem.parent / f"{stem.name}{ending}"


def _each(meshes: Meshes) -> list[Meshes]:
    return [meshes[index] for index in range(len(meshes))]


def _as_batch(picture: Picture, lens: Tensor, side_px: int, name: str) -> tuple[PhotoBatch, Tensor]:
    """The picture at another size, and by how much it was scaled along x and y."""
    size = picture.shape[:2]
    small = [max(1, round(side * side_px / min(size))) for side in size]
    rgb = torch.from_numpy(np.ascontiguousarray(picture)).movedim(-1, 0)[None] / 255
    if small != list(size):
        rgb = F.interpolate(rgb, small, mode="bilinear", antialias=True).clamp(0, 1)
    scale = torch.tensor([small[1] / size[1], small[0] / size[0]])
    lenses = lens[None].clone()
    lenses[:, :2] *= scale[:, None]
    return PhotoBatch(rgb, torch.tensor([small]), lenses, _nothing(small), [name]), scale


def _nothing(size: Sequence[int]) -> Instances:
    none = torch.zeros(0, dtype=torch.int64)
    return Instances(none, torch.zeros(0, 4), none, torch.zeros(0, *size, dtype=torch.bool))
