"""Pix3D: photographs with outlines and models of the furniture in them, as its authors lay it out.

Sun et al., "Pix3D: Dataset and Methods for Single-Image 3D Shape Modeling", CVPR 2018, and its readme; the divisions
are those of Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019. What a folder holds, and a writer must write:

- `img/CLASS/NAME.png|jpg`, `mask/CLASS/NAME.png` (bright where the object is seen, as large as the picture),
  `model/CLASS/NAME/model.obj` (any axes, any unit), `model/CLASS/NAME/voxel.mat`.
- `pix3d.json`, a list with an entry for each object. Objects of one picture are entries with one `img`:
  - `img`, `mask`, `model`, `voxel`: paths within the folder. `category`: one of CLASSES.
  - `img_size`: [width, height]. `bbox`: [x0, y0, x1, y1], pixels, edges as in `rendra_lab.detection.records`.
  - `rot_mat` (3 rows) and `trans_mat` [x, y, z]: R and t. A vertex v of the model is at R v + t before a camera that
    stands in the origin and looks along +z: x grows to the left of the picture, y upwards.
    Hence OpenCV's axes are diag(-1, -1, 1) (R v + t).
  - `focal_length`: in mm on a sensor 32 mm wide, so that f = focal_length * width / 32 pixels, and the middle of the
    picture is the camera's. Or `K`: [f, px, py] in pixels, which counts where it is there, and keeps all digits.
  - `truncated`, `occluded`, `slightly_occluded`, `img_source`, `model_source` and more are not read.
- `voxel.mat`: variable `voxel`, (V, V, V) uint8 or bool, indexed [i, j, k]: i grows with the model's x, j against its
  z, k with its y. The grid's cube is about the model: published files leave open how. They are laid so that the boxes
  about the filled cells and about the model have one middle and one longest side. Where an entry has
  `voxel_cube`: [x, y, z, side], the cube's middle and side in the model's coordinates, it is that (ours; written).
- `pix3d_s1_train.json`, `pix3d_s1_test.json`, `pix3d_s2_*.json` (Mesh R-CNN's): `images` (id, file_name, width,
  height), `annotations` (id, image_id, category_id, bbox [x, y, width, height], segmentation: path of the mask,
  model, voxel, K, rot_mat, trans_mat, perhaps voxel_cube, all as above) and `categories` (id from 1, name). Ours
  writes `pix3d_s1_val.json`, `pix3d_s2_val.json` too; where there is none, about a tenth of training is validation.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from rendra_lab.data.annotated_pictures import Sizing, boxes_at, read_colors, read_mask
from rendra_lab.data.model_files import ModelShelf
from rendra_lab.data.photo_data import PhotoData, PhotoSplits
from rendra_lab.data.pix3d_entries import CLASSES, ListedPhoto, View, read_authors_list, read_divided_list
from rendra_lab.detection.records import Instances, PhotoBatch
from rendra_lab.errors import UserError
from rendra_lab.random_state import seeded
from rendra_lab.settings import Count, Positive, check_numbers

log = logging.getLogger(__name__)

AUTHORS_FILE = "pix3d.json"
_TEST_PERCENT, _VAL_PERCENT = 25, 10


class Pix3D(PhotoData):
    """The data set, or a folder that is laid out like it.

    Objects of one picture by one camera are one sample. The files of Mesh R-CNN's division count where they are in
    the folder. Else pix3d.json is divided, always the same way: a quarter of the pictures (s1) or models (s2), by
    checksums of their names, is for the test. A tenth of what is left is for validation, where no file says which.

    Args:
        path: the folder.
        split: s1 divides pictures; s2 models, so that test shows none that training has shown.
        shortest_px, longest_px: to which pictures are brought, see `Sizing`; null leaves them as they are.
        points: on the surface of each object, drawn anew whenever it is shown, but for evaluation.
        voxels: cells along a side of objects' grids; one is filled where the file's grid is anywhere in it.
        kept_models: that stay in memory; each worker has its own.
        cache: folder for models that were read; null reads their files each time.
        **loading: see PhotoData.

    Raises:
        UserError: settings that cannot be.
    """

    classes = CLASSES

    def __init__(
        self,
        path: str | Path,
        split: Literal["s1", "s2"] = "s1",
        shortest_px: Positive | None = 128,
        longest_px: Positive | None = 224,
        points: Positive = 1000,
        voxels: Positive = 48,
        kept_models: Count = 256,
        cache: str | Path | None = None,
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        if split not in ("s1", "s2"):
            raise UserError(f"data.split is s1 or s2; got {split!r}")
        check_numbers("data", Positive, points=points)
        self.path = Path(path)
        self.split = split
        self.sizing = Sizing(shortest_px, longest_px)
        self.points = points
        self.shelf = ModelShelf(voxels, kept_models, cache)

    def load(self) -> PhotoSplits:
        """The lists; of pictures and models only whether they are there."""
        parts = self.lists()
        counts = ", ".join(f"{len(photos):,} {name}" for name, photos in parts.items())
        log.info("%s, %s: pictures for %s", self.path, self.split, counts)
        train, val, test = (
            ShownPhotos(photos, self.sizing, self.shelf, self.points, is_fixed=name != "train")
            for name, photos in parts.items()
        )
        return PhotoSplits(train, val, test)

    def lists(self) -> dict[str, list[ListedPhoto]]:
        """The pictures of train, val and test.

        Raises:
            UserError: no folder, no list in it, or a broken one.
        """
        if not self.path.is_dir():
            raise UserError(f"there is no folder {self.path}; data.path is that of {AUTHORS_FILE}")
        files = {name: self.path / f"pix3d_{self.split}_{name}.json" for name in ("train", "val", "test")}
        is_divided = files["train"].is_file() and files["test"].is_file()
        if is_divided:
            train, test = (read_divided_list(self.path, files[name]) for name in ("train", "test"))
        elif (self.path / AUTHORS_FILE).is_file():
            train, test = self._parted(read_authors_list(self.path, self.path / AUTHORS_FILE), _TEST_PERCENT, "test")
        else:
            raise UserError(
                f"{self.path} has neither {AUTHORS_FILE} nor {files['train'].name} and {files['test'].name}"
            )
        if is_divided and files["val"].is_file():
            val = read_divided_list(self.path, files["val"])
        else:
            train, val = self._parted(train, _VAL_PERCENT, "val")
        return {"train": train, "val": val, "test": test}

    def _parted(self, photos: Sequence[ListedPhoto], percent: int, part: str) -> tuple[list[ListedPhoto], ...]:
        """Those that are left, and those that go to another part: which, their names alone decide."""

        def names(photo: ListedPhoto) -> list[str]:
            return [photo.view.name] if self.split == "s1" else [each.model_name for each in photo.objects]

        def rank(name: str) -> tuple[int, str]:
            return zlib.crc32(f"{part} {name}".encode()), name

        known = sorted({name for photo in photos for name in names(photo)}, key=rank)
        away = set(known[: min(len(known) - 1, max(1, len(known) * percent // 100))])
        return (
            [photo for photo in photos if away.isdisjoint(names(photo))],
            [photo for photo in photos if not away.isdisjoint(names(photo))],
        )


class ShownPhotos:
    """Batches of one.

    Args:
        photos: to show.
        sizing: at which size.
        shelf: of their models.
        points: on each surface.
        is_fixed: the same points each time; else torch's global stream draws them.
    """

    def __init__(
        self, photos: Sequence[ListedPhoto], sizing: Sizing, shelf: ModelShelf, points: int, is_fixed: bool
    ) -> None:
        self.photos = photos
        self.sizing = sizing
        self.shelf = shelf
        self.points = points
        self.is_fixed = is_fixed

    def __len__(self) -> int:
        return len(self.photos)

    def __getitem__(self, index: int) -> PhotoBatch:
        if not self.is_fixed:
            return self._shown(self.photos[index])
        with seeded(index):
            return self._shown(self.photos[index])

    def _shown(self, photo: ListedPhoto) -> PhotoBatch:
        view, objects = photo.view, photo.objects
        shown = self.sizing.of(view.size)
        rgb = read_colors(view.path, objects[0].where, view.size, shown)
        masks = [read_mask(each.mask, each.where, view.size, shown) for each in objects]
        instances = Instances(
            picture=torch.zeros(len(objects), dtype=torch.int64),
            boxes=boxes_at([each.box for each in objects], view.size, shown),
            labels=torch.tensor([each.label for each in objects]),
            masks=torch.stack(masks),
            shapes=self.shelf.shapes(
                [each.model for each in objects], torch.stack([each.to_camera for each in objects]), self.points
            ),
        )
        return PhotoBatch(
            rgb=rgb[None],
            sizes=torch.tensor([shown]),
            intrinsics=_intrinsics(view, shown)[None],
            instances=instances,
            picture_ids=[view.name],
        )


def _intrinsics(view: View, shown: tuple[int, int]) -> Tensor:
    focal, x, y = view.camera
    across, down = shown[1] / view.size[1], shown[0] / view.size[0]
    return torch.tensor([[focal * across, 0.0, x * across], [0.0, focal * down, y * down], [0.0, 0.0, 1.0]])
