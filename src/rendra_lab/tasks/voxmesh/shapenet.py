"""ShapeNet's models, and the pictures of them that 3D-R2N2 rendered.

Chang et al., "ShapeNet", arXiv:1512.03012; Choy et al., "3D-R2N2", ECCV 2016; the division is that of Pixel2Mesh as
Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, have it. What a folder holds:

- `ShapeNetCore.v1/SYNSET/MODEL/model.obj`: y upwards, about the origin, of no unit.
- `ShapeNetRendering/SYNSET/MODEL/rendering/00.png` ... `23.png`, and `rendering_metadata.txt`, a line a picture:
  azimuth and elevation in degrees, a turn that is 0, a distance as a part of 1.75, and an angle that nobody uses.
- `ShapeNetCore.v1.binvox/SYNSET/MODEL/model.binvox`, in the coordinates of model.obj.
- `pix2mesh_splits_val05.json`, there or in `ShapeNetRendering`: {train, val, test: {SYNSET: {MODEL: [numbers of
  pictures]}}}; a list of models in place of an object stands for all of their pictures.

The camera stands in the direction (cos el cos az, sin el, cos el sin az) of the model's axes and looks at the origin,
y upwards; its lens has 35 mm on a sensor of 32 mm.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch

from rendra_lab.data.annotated_pictures import read_colors
from rendra_lab.data.json_fields import Fields, read_json
from rendra_lab.data.model_files import ModelPath, ModelShelf
from rendra_lab.data.photographs import image_size
from rendra_lab.errors import UserError
from rendra_lab.random_state import seeded
from rendra_lab.settings import Count, Positive, check_numbers
from rendra_lab.shape_records import ShapeBatch
from rendra_lab.tasks.voxmesh.shape_data import ShapeData, ShapeSplits

log = logging.getLogger(__name__)

SYNSETS = {
    "02691156": "plane",
    "02828884": "bench",
    "02933112": "cabinet",
    "02958343": "car",
    "03001627": "chair",
    "03211117": "monitor",
    "03636649": "lamp",
    "03691459": "speaker",
    "04090263": "firearm",
    "04256520": "couch",
    "04379243": "table",
    "04401088": "cellphone",
    "04530566": "watercraft",
}
SPLIT_FILE = "pix2mesh_splits_val05.json"
FOCAL_WIDTHS = 35.0 / 32.0  # of the lens, in widths of the picture
FARTHEST = 1.75  # distance of the camera that the files call 1

_NEAR, _FAR = 0.1, 100.0  # planes of Blender's camera
_LEAST, _MOST = 0.67, 0.92  # depth that objects have in its normalised coordinates
_NAME = re.compile(r"[\w.-]{1,128}")
_MOST_TEXT = 1 << 20
_PARTS = ("train", "val", "test")


@dataclass(frozen=True)
class Rendering:
    """A picture that is yet to be read.

    Attributes:
        picture: its file.
        cameras: the file of all cameras of its model.
        view: its line there, from 0.
        model: what it is of.
        shape_id: the model's name.
        label: index of the class.
    """

    picture: Path
    cameras: Path
    view: int
    model: ModelPath
    shape_id: str
    label: int


class ShapeNet(ShapeData):
    """The data set as its authors lay it out.

    Args:
        path: the folder.
        categories: names, such as [chair, table]; null takes all that the division has.
        image_px: side of the pictures, which the files have too.
        background: behind what is transparent: a colour, white or black; null drops alpha, as Mesh R-CNN does.
        binvox: folder of the models' cells within `path`; null fills cells by the meshes.
        points: on the surface of each object, drawn anew whenever it is shown, but for evaluation.
        voxels: cells along a side of objects' grids.
        val_pictures, test_pictures: how many at most, spread evenly; null takes all.
        kept_models: that stay in memory; each worker has its own.
        cache: folder for models that were read; null reads their files each time.
        **loading: see ShapeData.

    Raises:
        UserError: settings that cannot be.
    """

    def __init__(
        self,
        path: str | Path,
        categories: Sequence[str] | None = None,
        image_px: Positive = 137,
        background: Literal["white", "black"] | None = None,
        binvox: str | None = "ShapeNetCore.v1.binvox",
        points: Positive = 1000,
        voxels: Positive = 48,
        val_pictures: Positive | None = 500,
        test_pictures: Positive | None = None,
        kept_models: Count = 256,
        cache: str | Path | None = None,
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        check_numbers("data", Positive, points=points, image_px=image_px)
        check_numbers("data", Positive | None, val_pictures=val_pictures, test_pictures=test_pictures)
        unknown = [name for name in categories or () if name not in SYNSETS.values()]
        if unknown or (categories is not None and not categories):
            raise UserError(f"data.categories are of {', '.join(SYNSETS.values())}; got {unknown or categories}")
        self.path = Path(path)
        self.categories = None if categories is None else tuple(categories)
        self.image_px = image_px
        self.background = background
        self.binvox = binvox
        self.points = points
        self.most = {"train": None, "val": val_pictures, "test": test_pictures}
        self.shelf = ModelShelf(voxels, kept_models, cache)

    def load(self) -> ShapeSplits:
        """The division; of models only whether they are there."""
        file = self._division_file()
        root = Fields(read_json(file), str(file))
        parts = {name: self._members(root, name) for name in _PARTS}
        taken = {synset for part in parts.values() for synset in part}
        synsets = [synset for synset in SYNSETS if synset in taken]
        self.classes = tuple(SYNSETS[synset] for synset in synsets)
        lists = {name: self._listed(part, synsets) for name, part in parts.items()}
        for name, most in self.most.items():
            total = min(most or len(lists[name]), len(lists[name]))
            lists[name] = [lists[name][number * len(lists[name]) // total] for number in range(total)]
        log.info("%s: %s pictures", self.path, ", ".join(f"{len(part):,} {name}" for name, part in lists.items()))
        train, val, test = (
            ShownRenderings(
                lists[name], self.shelf, self.points, self.image_px, self.background, is_fixed=name != "train"
            )
            for name in _PARTS
        )
        return ShapeSplits(train, val, test)

    def _division_file(self) -> Path:
        for folder in (self.path, self.path / "ShapeNetRendering"):
            if (folder / SPLIT_FILE).is_file():
                return folder / SPLIT_FILE
        raise UserError(f"there is no {SPLIT_FILE} in {self.path} or {self.path / 'ShapeNetRendering'}")

    def _members(self, root: Fields, name: str) -> dict[str, dict[str, list[int] | None]]:
        """Numbers of pictures by synset and model; None stands for all of them."""
        part = root.tree.get(name)
        if not isinstance(part, dict):
            raise root.complaint(name, "an object of synsets such as 03001627")
        wanted = {synset for synset, word in SYNSETS.items() if self.categories is None or word in self.categories}
        unknown = sorted(set(part) - set(SYNSETS))
        if unknown:
            raise UserError(f"{root.where}, {name!r}: {unknown[0]!r} is none of {', '.join(SYNSETS)}")
        return {
            synset: _models(part[synset], f"{root.where}, {name!r}, {synset}") for synset in part if synset in wanted
        }

    def _listed(self, part: Mapping[str, Mapping[str, list[int] | None]], synsets: Sequence[str]) -> list[Rendering]:
        found = []
        for label, synset in enumerate(synsets):
            for name, views in part.get(synset, {}).items():
                shape_id = f"{synset}/{name}"
                model, folder = self._model(shape_id), self.path / "ShapeNetRendering" / shape_id / "rendering"
                cameras = folder / "rendering_metadata.txt"
                for file in (model.mesh, model.voxels, cameras):
                    if file is not None and not file.is_file():
                        raise UserError(f"there is no file {file}, but the division has {shape_id}")
                numbers = range(len(read_cameras(cameras))) if views is None else views
                found += [
                    Rendering(folder / f"{number:02d}.png", cameras, number, model, shape_id, label)
                    for number in numbers
                ]
        return found

    def _model(self, shape_id: str) -> ModelPath:
        cells = None if self.binvox is None else self.path / self.binvox / shape_id / "model.binvox"
        return ModelPath(self.path / "ShapeNetCore.v1" / shape_id / "model.obj", cells)


class ShownRenderings:
    """Batches of one.

    Args:
        renderings: to show.
        shelf: of their models.
        points: on each surface.
        image_px: side of the pictures.
        background: see ShapeNet.
        is_fixed: the same points each time; else torch's global stream draws them.
    """

    def __init__(
        self,
        renderings: Sequence[Rendering],
        shelf: ModelShelf,
        points: int,
        image_px: int,
        background: str | None,
        is_fixed: bool,
    ) -> None:
        self.renderings = renderings
        self.shelf = shelf
        self.points = points
        self.image_px = image_px
        self.background = background
        self.is_fixed = is_fixed

    def __len__(self) -> int:
        return len(self.renderings)

    def __getitem__(self, index: int) -> ShapeBatch:
        if not self.is_fixed:
            return self._shown(self.renderings[index])
        with seeded(index):
            return self._shown(self.renderings[index])

    def _shown(self, one: Rendering) -> ShapeBatch:
        where = f"{one.cameras}, line {one.view + 1}"
        cameras = read_cameras(one.cameras)
        if one.view >= len(cameras):
            raise UserError(f"{one.cameras} has {len(cameras)} lines, but the division has picture {one.view}")
        height, width = image_size(one.picture, where)
        if height != width:
            raise UserError(f"{one.picture} is {width} x {height} pixels large; expected a square")
        side = self.image_px
        lens = FOCAL_WIDTHS * side
        pose = torch.from_numpy(model_to_camera(*cameras[one.view].tolist()))
        return ShapeBatch(
            rgb=read_colors(one.picture, where, (height, width), (side, side), self.background)[None],
            intrinsics=torch.tensor([[[lens, 0.0, side / 2], [0.0, lens, side / 2], [0.0, 0.0, 1.0]]]),
            depth_range=torch.tensor([DEPTH_RANGE]),
            labels=torch.tensor([one.label]),
            shapes=self.shelf.shapes([one.model], pose[None], self.points),
            shape_ids=[one.shape_id],
        )


def model_to_camera(azimuth_deg: float, elevation_deg: float, distance: float) -> npt.NDArray[np.float64]:
    """(4, 4), columns: a model's coordinates to the axes of a camera that looks at the origin, x right and y down.

    Args:
        azimuth_deg: from the model's +x to its +z.
        elevation_deg: upwards, to +y; less than 90 either way.
        distance: from the origin.
    """
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    forwards = -np.array(
        [np.cos(elevation) * np.cos(azimuth), np.sin(elevation), np.cos(elevation) * np.sin(azimuth)]
    )
    right = np.array([np.sin(azimuth), 0.0, -np.cos(azimuth)])
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forwards, right), forwards
    pose[2, 3] = distance
    return pose


def read_cameras(path: Path) -> npt.NDArray[np.float64]:
    """Azimuth, elevation (degrees) and distance of each line of a rendering_metadata.txt: (N, 3).

    Raises:
        UserError: no file, one that is no text of such lines, or a camera that cannot be; the line is named.
    """
    expected = "azimuth, elevation, turn, distance and angle: five numbers"
    if not path.is_file():
        raise UserError(f"there is no file {path}")
    if path.stat().st_size > _MOST_TEXT:
        raise UserError(f"{path} has {path.stat().st_size:,} bytes; at most {_MOST_TEXT:,} are read")
    lines = [line.split() for line in path.read_text("utf-8", errors="replace").splitlines()]
    rows = []
    for number, words in enumerate(lines, 1):
        where = f"{path}, line {number}"
        if not words:
            continue
        try:
            values = np.array([float(word) for word in words])
        except ValueError:
            values = np.zeros(0)
        if len(values) != 5 or not np.isfinite(values).all():
            raise UserError(f"{where} is {' '.join(words)[:60]!r}; expected {expected}")
        azimuth, elevation, distance = values[0], values[1], FARTHEST * values[3]
        if abs(elevation) > 89.9 or not 1e-3 < distance < 1e3:
            raise UserError(
                f"{where}: elevation is {elevation:g} and distance {values[3]:g}; expected a camera that sees"
            )
        rows.append([azimuth, elevation, distance])
    if not rows:
        raise UserError(f"{path} is empty; expected lines of {expected}")
    return np.array(rows)


def _models(value: Any, where: str) -> dict[str, list[int] | None]:
    """Numbers of pictures by model, of either form."""
    if isinstance(value, list):
        value = dict.fromkeys(value) if all(isinstance(name, str) for name in value) else None
    if not isinstance(value, dict):
        raise UserError(
            f"{where}: expected an object of models and the numbers of their pictures, or a list of models"
        )
    for name, views in value.items():
        if not _NAME.fullmatch(name) or name.startswith("."):
            raise UserError(f"{where}: {name[:60]!r} is no name of a model")
        if views is not None and not (isinstance(views, list) and views and all(map(_is_view, views))):
            raise UserError(f"{where}, {name}: its pictures are {str(views)[:60]}; expected numbers from 0")
    return value


def _is_view(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1000


def _depth(normalised: float) -> float:
    """The distance before Blender's camera of a normalised depth."""
    return 2 * _FAR * _NEAR / ((_FAR + _NEAR) - (_FAR - _NEAR) * normalised)


DEPTH_RANGE = _depth(_LEAST), _depth(_MOST)
"""Between which depths objects are looked for: the same for all of them."""
