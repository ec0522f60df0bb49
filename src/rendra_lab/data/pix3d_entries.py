"""The lists of Pix3D's folders, in its authors' form and Mesh R-CNN's: checked before anything is shown.

What the fields mean: `rendra_lab.data.pix3d`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from rendra_lab.data.annotated_pictures import Size, within_picture
from rendra_lab.data.json_fields import Fields, read_json, read_json_value
from rendra_lab.data.model_files import ModelPath, path_within
from rendra_lab.data.photographs import demand_rotations
from rendra_lab.errors import UserError

CLASSES = ("bed", "bookcase", "chair", "desk", "misc", "sofa", "table", "tool", "wardrobe")
LEFT_OUT = ("img/table/1749.jpg", "img/table/0045.png")  # their masks are those of other pictures
SENSOR_MM = 32.0

_MOST_BYTES = 1 << 30
_TO_OURS = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)  # x left, y up to x right, y down
_FARTHEST = 1e6


@dataclass(frozen=True)
class SeenModel:
    """An object of a picture.

    Attributes:
        where: the file and the entry, for complaints.
        label: index of CLASSES.
        box: x0, y0, x1, y1 within the picture.
        mask: bright where the object is seen.
        model: its surface and cells.
        model_name: what the file calls its surface: divisions keep models apart by it.
        to_camera: (4, 4) float64, columns: the model's coordinates to OpenCV's axes of the camera.
    """

    where: str
    label: int
    box: tuple[float, float, float, float]
    mask: Path
    model: ModelPath
    model_name: str
    to_camera: Tensor


@dataclass(frozen=True)
class View:
    """A picture that is yet to be read.

    Attributes:
        name: what the file calls it.
        path: where it is.
        size: height and width.
        camera: focal length and the middle x, y, pixels.
    """

    name: str
    path: Path
    size: Size
    camera: tuple[float, float, float]


@dataclass(frozen=True)
class ListedPhoto:
    """A picture, and all that is annotated in it."""

    view: View
    objects: tuple[SeenModel, ...]


def read_authors_list(folder: Path, file: Path) -> list[ListedPhoto]:
    """The pictures of pix3d.json.

    Raises:
        UserError: a broken file, a field that is missing or cannot be, a class, picture, mask or model that is not
            there; the file, entry and field are named.
    """
    entries = read_json_value(file, _MOST_BYTES)
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise UserError(f"{file} holds no list of objects, one at least; expected Pix3D's pix3d.json")
    return _gathered(_of_authors(folder, Fields(entry, f"{file}, entry {i}")) for i, entry in enumerate(entries))


def read_divided_list(folder: Path, file: Path) -> list[ListedPhoto]:
    """The pictures of one of Mesh R-CNN's files, pix3d_s1_train.json and the like.

    Raises:
        UserError: as `read_authors_list`.
    """
    root = Fields(read_json(file, _MOST_BYTES), str(file))
    images = {_id(image, "id"): image for image in _members(root, "images", "image")}
    labels = {_id(category, "id"): _label(category, "name") for category in _members(root, "categories", "category")}

    def seen() -> Iterator[tuple[View, SeenModel]]:
        for one in _members(root, "annotations", "annotation"):
            image, label = images.get(_id(one, "image_id")), labels.get(_id(one, "category_id"))
            if image is None:
                raise one.complaint("image_id", "the id of one of the images")
            if label is None:
                raise one.complaint("category_id", "the id of one of the categories")
            size = image.pixels("height"), image.pixels("width")
            x, y, width, height = one.numbers("bbox", 4)
            object_ = _object(folder, one, "segmentation", label, (x, y, x + width, y + height), size)
            yield _view(folder, image, "file_name", size, _camera(one, size)), object_

    return _gathered(seen())


def _of_authors(folder: Path, entry: Fields) -> tuple[View, SeenModel]:
    value = entry.tree.get("img_size")
    if not isinstance(value, list) or len(value) != 2:
        raise entry.complaint("img_size", "a list of width and height, pixels")
    sides = Fields({"width": value[0], "height": value[1]}, f"{entry.where}, 'img_size'")
    size = sides.pixels("height"), sides.pixels("width")
    object_ = _object(folder, entry, "mask", _label(entry, "category"), tuple(entry.numbers("bbox", 4)), size)
    return _view(folder, entry, "img", size, _camera(entry, size)), object_


def _gathered(seen: Iterable[tuple[View, SeenModel]]) -> list[ListedPhoto]:
    """One picture for all objects that were seen in it by one camera, in the order of the file."""
    found: dict[View, list[SeenModel]] = {}
    for view, object_ in seen:
        if view.name not in LEFT_OUT:
            found.setdefault(view, []).append(object_)
    return [ListedPhoto(view, tuple(objects)) for view, objects in found.items()]


def _view(folder: Path, fields: Fields, key: str, size: Size, camera: tuple[float, float, float]) -> View:
    return View(fields.text(key), _file(folder, fields, key), size, camera)


def _object(folder: Path, fields: Fields, mask: str, label: int, box: tuple[float, ...], size: Size) -> SeenModel:
    voxels = _file(folder, fields, "voxel") if "voxel" in fields else None
    return SeenModel(
        where=fields.where,
        label=label,
        box=within_picture(box, size, fields.where),
        mask=_file(folder, fields, mask),
        model=ModelPath(_file(folder, fields, "model"), voxels, _cube(fields)),
        model_name=fields.text("model"),
        to_camera=_pose(fields),
    )


def _pose(fields: Fields) -> Tensor:
    rows = fields.tree.get("rot_mat")
    if not isinstance(rows, list) or len(rows) != 3:
        raise fields.complaint("rot_mat", "a matrix of 3 x 3 numbers")
    where = f"{fields.where}, 'rot_mat'"
    parts = [Fields({"row": row}, where).numbers("row", 3) for row in rows]
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor(parts, dtype=torch.float64)
    demand_rotations(pose[None, :3, :3], [where])
    pose[:3, 3] = torch.tensor(fields.numbers("trans_mat", 3), dtype=torch.float64)
    if not float(pose[2, 3]) > 0 or not bool(pose[:3, 3].abs().lt(_FARTHEST).all()):
        raise fields.complaint("trans_mat", "a place before the camera: x to the left, y up, and z above 0")
    pose[:3] *= _TO_OURS[:, None]
    return pose


def _camera(fields: Fields, size: Size) -> tuple[float, float, float]:
    if "K" in fields:
        focal, x, y = fields.numbers("K", 3)
    else:
        focal, x, y = fields.positive("focal_length") * size[1] / SENSOR_MM, size[1] / 2, size[0] / 2
    if not 1e-3 < focal < _FARTHEST or max(abs(x), abs(y)) > _FARTHEST:
        raise fields.complaint("K" if "K" in fields else "focal_length", "the focal length of a camera")
    return focal, x, y


def _cube(fields: Fields) -> tuple[float, float, float, float] | None:
    if "voxel_cube" not in fields:
        return None
    x, y, z, side = fields.numbers("voxel_cube", 4)
    if not 0 < side < _FARTHEST:
        raise fields.complaint("voxel_cube", "the middle x, y, z of a cube and its side, above 0")
    return x, y, z, side


def _label(fields: Fields, key: str) -> int:
    name = fields.text(key)
    if name not in CLASSES:
        raise fields.complaint(key, f"one of {', '.join(CLASSES)}")
    return CLASSES.index(name)


def _file(folder: Path, fields: Fields, key: str) -> Path:
    path = path_within(folder, fields.text(key), f"{fields.where}, {key!r}")
    if not path.is_file():
        raise UserError(f"{fields.where}, {key!r}: there is no file {path}")
    return path


def _members(root: Fields, key: str, noun: str) -> list[Fields]:
    return [Fields(each, f"{root.where}, {noun} {index}") for index, each in enumerate(root.objects(key))]


def _id(fields: Fields, key: str) -> int:
    value = fields.tree.get(key)
    if not isinstance(value, int) or isinstance(value, bool):
        raise fields.complaint(key, "a whole number")
    return value
