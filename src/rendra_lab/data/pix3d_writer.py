"""Generated photographs of rooms as a folder of Pix3D's layout, with Mesh R-CNN's files of divisions and COCO's.

What the fields mean: `rendra_lab.data.pix3d`, which reads such folders. Models are written about their middles, in
metres, y up. Beside Pix3D's files stand annotations/instances_train.json and the like, as COCO has them: boxes
x, y, width, height, and masks as uncompressed lengths of runs, column after column, of background first.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.io
from PIL import Image
from torch import Tensor

from rendra.io import save_obj
from rendra_lab.data.pix3d_entries import SENSOR_MM
from rendra_lab.data.scene_folders import check_folder, folder_in_making
from rendra_lab.synthesis.furnished_rooms import RoomPhoto
from rendra_lab.synthesis.furniture import CLASSES, NAMES
from rendra_lab.synthesis.furniture_models import model_id
from rendra_lab.synthesis.solid_shapes import SolidShape

Entry = dict[str, Any]
Key = tuple[int, int]
"""The row of a model's name in furniture.NAMES, and its number."""

_OURS = {"img", "mask", "model", "annotations", "pix3d.json"} | {
    f"pix3d_{split}_{part}.json" for split in ("s1", "s2") for part in ("train", "val", "test")
}
_OCCLUDED, _SLIGHTLY_OCCLUDED, _WHOLE = (
    0.7,
    0.98,
    0.999,
)  # shares of what nothing hides, and of what is in the picture
_TO_LEFT_AND_UP = np.array([-1.0, -1.0, 1.0])  # OpenCV's axes to those of Pix3D's cameras


def write_pix3d(
    parts: Mapping[str, Sequence[RoomPhoto]],
    shapes: Mapping[Key, SolidShape],
    split: str,
    folder: str | Path,
    overwrite: bool = False,
) -> Path:
    """Write photographs, masks, models and what is known of them; the folder appears when it is complete.

    Args:
        parts: photographs of train, val and test.
        shapes: of all models in them, by the rows of their names in furniture.NAMES and their numbers.
        split: s1 or s2, by which they are divided.
        folder: made, with its parents.
        overwrite: replace a folder that was so written.

    Returns:
        The folder.

    Raises:
        UserError: a folder that is not empty, or holds something else.
    """
    folder = checked_folder(folder, overwrite)
    with folder_in_making(folder) as partial:
        models = {key: _write_model(shapes[key], key, kind, partial) for key, kind in _kinds(parts).items()}
        entries = {
            part: [
                _write_photo(photo, f"{part}_{index:05d}", models, shapes, partial)
                for index, photo in enumerate(photos)
            ]
            for part, photos in parts.items()
        }
        _write_json([one for several in entries.values() for each in several for one in each], partial / "pix3d.json")
        for part, several in entries.items():
            if several:
                _write_json(_division(several), partial / f"pix3d_{split}_{part}.json")
                _write_json(_coco(several, parts[part]), partial / "annotations" / f"instances_{part}.json")
    return folder


def checked_folder(folder: str | Path, overwrite: bool) -> Path:
    """The absolute path of a folder that may be written; UserError as of `write_pix3d`."""
    folder = Path(folder).absolute()
    check_folder(folder, _OURS, "no folder of Pix3D's layout has", overwrite)
    return folder


def _kinds(parts: Mapping[str, Sequence[RoomPhoto]]) -> dict[Key, str]:
    """The classes of all models that are seen."""
    return {
        key: CLASSES[label]
        for photos in parts.values()
        for photo in photos
        for key, label in zip(keys_of(photo), photo.labels.tolist(), strict=True)
    }


def keys_of(photo: RoomPhoto) -> list[Key]:
    """Which models the objects of a photograph are of."""
    return [(name, number) for name, number in photo.models.tolist()]


def _write_model(shape: SolidShape, key: Key, kind: str, folder: Path) -> Entry:
    """A model's files; what each of its objects says of it."""
    called = model_id(NAMES[key[0]], key[1])
    home = f"model/{kind}/{called}"
    (folder / home).mkdir(parents=True)
    half = float(shape.cube_to_own[0, 0])
    save_obj(folder / home / "model.obj", shape.verts * half, shape.faces)
    # [z, y, x] to [x, against z, y]
    cells = shape.voxels.numpy().transpose(2, 0, 1)[:, ::-1]
    scipy.io.savemat(folder / home / "voxel.mat", {"voxel": cells.astype(np.uint8)}, do_compression=True)
    return {
        "category": kind,
        "model": f"{home}/model.obj",
        "voxel": f"{home}/voxel.mat",
        "voxel_cube": [0.0, 0.0, 0.0, 2 * half],
    }


def _write_photo(
    photo: RoomPhoto,
    called: str,
    models: Mapping[Key, Entry],
    shapes: Mapping[Key, SolidShape],
    folder: Path,
) -> list[Entry]:
    """A photograph and its masks; the entries of its objects."""
    home = CLASSES[int(photo.labels[0])]
    for kind in ("img", "mask"):
        (folder / kind / home).mkdir(parents=True, exist_ok=True)
    picture = f"img/{home}/{called}.png"
    Image.fromarray(photo.rgb.permute(1, 2, 0).contiguous().numpy()).save(folder / picture)
    entries = []
    for number, key in enumerate(keys_of(photo)):
        mask = (photo.owner == number).numpy()
        path = f"mask/{home}/{called}_{number}.png"
        Image.fromarray(mask.astype(np.uint8) * 255).save(folder / path)
        centre = shapes[key].cube_to_own[:3, 3]
        seen = {"img": picture, "mask": path, "bbox": _box(mask), **models[key]}
        entries.append(
            {**seen, **_camera(photo), **_pose(photo.model_to_camera[number], centre), **_flags(photo, number)}
        )
    return entries


def _box(mask: npt.NDArray[np.bool_]) -> list[int]:
    """x0, y0, x1, y1: the edges of what is seen."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return [int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1]


def _camera(photo: RoomPhoto) -> Entry:
    height, width = photo.owner.shape
    focal, x, y = (float(photo.intrinsics[i, j]) for i, j in ((0, 0), (0, 2), (1, 2)))
    return {"img_size": [width, height], "focal_length": focal * SENSOR_MM / width, "K": [focal, x, y]}


def _pose(model_to_camera: Tensor, centre: Tensor) -> Entry:
    """R and t of a model that is written about its centre."""
    matrix = model_to_camera.double().numpy()
    turn = _TO_LEFT_AND_UP[:, None] * matrix[:3, :3]
    place = _TO_LEFT_AND_UP * matrix[:3, 3] + turn @ centre.double().numpy()
    return {"rot_mat": turn.tolist(), "trans_mat": place.tolist()}


def _flags(photo: RoomPhoto, number: int) -> Entry:
    free, inside = float(photo.free[number]), float(photo.inside[number])
    return {
        "truncated": inside < _WHOLE,
        "occluded": free < _OCCLUDED,
        "slightly_occluded": _OCCLUDED <= free < _SLIGHTLY_OCCLUDED,
        "img_source": "rendra",
        "model_source": "rendra",
    }


def _division(several: Sequence[Sequence[Entry]]) -> Entry:
    """One of Mesh R-CNN's files."""
    kept = ("model", "voxel", "voxel_cube", "K", "rot_mat", "trans_mat")

    def annotation(entry: Entry, _: int) -> Entry:
        return {"segmentation": entry["mask"], **{name: entry[name] for name in kept}}

    return _of_images(several, annotation)


def _coco(several: Sequence[Sequence[Entry]], photos: Sequence[RoomPhoto]) -> Entry:
    """COCO's annotations."""
    masks = [photo.owner.numpy() == number for photo in photos for number in range(len(photo.labels))]

    def annotation(entry: Entry, index: int) -> Entry:
        mask = masks[index]
        runs = {"size": list(mask.shape), "counts": _runs(mask)}
        return {"segmentation": runs, "area": int(mask.sum()), "iscrowd": 0}

    return _of_images(several, annotation)


def _of_images(several: Sequence[Sequence[Entry]], annotation: Callable[[Entry, int], Entry]) -> Entry:
    """Images, annotations and categories, each with an id from 1."""
    images = [
        {
            "id": i,
            "file_name": entries[0]["img"],
            "width": entries[0]["img_size"][0],
            "height": entries[0]["img_size"][1],
        }
        for i, entries in enumerate(several, 1)
    ]
    annotations: list[Entry] = []
    for image, entries in enumerate(several, 1):
        for entry in entries:
            left, top, right, bottom = entry["bbox"]
            found = annotation(entry, len(annotations))
            ids = {"id": len(annotations) + 1, "image_id": image, "category_id": CLASSES.index(entry["category"]) + 1}
            annotations.append({**ids, "bbox": [left, top, right - left, bottom - top], **found})
    categories = [{"id": i, "name": name} for i, name in enumerate(CLASSES, 1)]
    return {"images": images, "annotations": annotations, "categories": categories}


def _runs(mask: npt.NDArray[np.bool_]) -> list[int]:
    """Lengths of runs of a mask, column after column, the first of them of what is false."""
    flat = mask.T.reshape(-1)
    stops = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    lengths = np.diff(np.concatenate([[0], stops, [flat.size]])).tolist()
    return [0, *lengths] if flat[0] else lengths


def _write_json(tree: object, path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(tree) + "\n", encoding="utf-8")
