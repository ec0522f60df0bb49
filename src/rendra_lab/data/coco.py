"""Pictures with outlines of what stands in them, in COCO's layout: the real set, or anybody's own annotations.

Lin et al., "Microsoft COCO: Common Objects in Context", ECCV 2014, and its readme of the format. A folder holds
`annotations/instances_NAME.json`, and the pictures in NAME, in images/NAME, in images, or beside `annotations`.
A file has `images` (id, file_name, width, height), `annotations` (id, image_id, category_id, bbox [x, y, width,
height], segmentation: polygons or runs, iscrowd) and `categories` (id, name).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from rendra_lab.data.annotated_pictures import Size, Sizing, boxes_at, read_colors, resized_mask, within_picture
from rendra_lab.data.coco_masks import Polygon, Runs, mask_of, read_segmentation
from rendra_lab.data.json_fields import Fields, read_json
from rendra_lab.data.model_files import path_within
from rendra_lab.data.photo_data import PhotoData, PhotoSplits
from rendra_lab.detection.records import Instances, PhotoBatch
from rendra_lab.errors import UserError
from rendra_lab.settings import Positive, check_numbers

log = logging.getLogger(__name__)

_MOST_BYTES = 2 << 30
_FIRST = "instances_"
_STANDARD = {
    "train": ("instances_train.json", "instances_train2017.json", "instances_train2014.json"),
    "val": ("instances_val.json", "instances_val2017.json", "instances_val2014.json"),
    "test": ("instances_test.json",),
}


@dataclass(frozen=True)
class Outlined:
    """An object of a picture: its class by label, its box x0, y0, x1, y1 and its mask."""

    label: int
    box: tuple[float, float, float, float]
    mask: list[Polygon] | Runs


@dataclass(frozen=True)
class OutlinedPhoto:
    """A picture that is yet to be read.

    Attributes:
        name: what the file calls it.
        path: where it is.
        where: the file and the entry, for complaints.
        size: height and width.
        objects: what is annotated in it, crowds left out.
    """

    name: str
    path: Path
    where: str
    size: Size
    objects: tuple[Outlined, ...]


class Coco(PhotoData):
    """The data set as its authors lay it out, or a folder that is laid out like it.

    Crowds, and objects whose boxes hold nothing of their pictures, are left out; so are training pictures without
    objects. Nobody knows the cameras: their focal length is taken to be the longer side of the picture.

    Args:
        path: the folder.
        train, val, test: names of files in `annotations`; null takes instances_train.json or instances_train2017.json
            and the like. Where nothing is for the test, what is for validation is, since COCO keeps its own secret.
        names: of the classes that count, by label; null takes all of the training file, in the order of their ids.
        class_count: how many classes the network has.
        shortest_px, longest_px: to which pictures are brought, see `Sizing`; null leaves them as they are.
        **loading: see PhotoData.

    Raises:
        UserError: settings that cannot be.
    """

    def __init__(
        self,
        path: str | Path,
        train: str | None = None,
        val: str | None = None,
        test: str | None = None,
        names: Sequence[str] | None = None,
        class_count: Positive | None = None,
        shortest_px: Positive | None = 128,
        longest_px: Positive | None = 224,
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        check_numbers("data", Positive | None, class_count=class_count)
        if names is not None and (not names or len(set(names)) < len(names)):
            raise UserError(f"data.names must be different names of classes, one at least; got {list(names)}")
        self.path = Path(path)
        self.given = {"train": train, "val": val, "test": test}
        self.names = None if names is None else tuple(names)
        self.class_count = class_count
        self.sizing = Sizing(shortest_px, longest_px)

    def load(self) -> PhotoSplits:
        """The lists of all parts; pictures are read when their turn comes."""
        files = {part: self._file(part) for part in _STANDARD}
        if files["train"] is None or files["val"] is None:
            raise UserError(
                f"{self.path / 'annotations'} has no file for training or for validation, such as "
                "instances_train2017.json; data.train=NAME and data.val=NAME say which are"
            )
        train = _Annotations(self.path, files["train"], self.names)
        self.classes = train.classes
        if self.class_count not in (None, len(self.classes)):
            raise UserError(
                f"{files['train']} has {len(self.classes)} classes, but the network {self.class_count}: give "
                f"network.classes={len(self.classes)}, or data.names=[...] of those that count"
            )
        val = _Annotations(self.path, files["val"], self.classes).photos()
        test = val if files["test"] is None else _Annotations(self.path, files["test"], self.classes).photos()
        shown = [photo for photo in train.photos() if photo.objects]
        log.info("%s: %s pictures of %s classes", self.path, f"{len(shown):,} training", len(self.classes))
        return PhotoSplits(*(ShownOutlines(photos, self.sizing) for photos in (shown, val, test)))

    def _file(self, part: str) -> Path | None:
        if not self.path.is_dir():
            raise UserError(f"there is no folder {self.path}; data.path is the one that holds annotations")
        given = self.given[part]
        if given is not None:
            path = path_within(self.path / "annotations", given, f"data.{part}")
            if not path.is_file():
                raise UserError(f"data.{part}={given}: there is no file {path}")
            return path
        found = [self.path / "annotations" / name for name in _STANDARD[part]]
        return next((path for path in found if path.is_file()), None)


class ShownOutlines:
    """Batches of one.

    Args:
        photos: to show.
        sizing: at which size.
    """

    def __init__(self, photos: Sequence[OutlinedPhoto], sizing: Sizing) -> None:
        self.photos = photos
        self.sizing = sizing

    def __len__(self) -> int:
        return len(self.photos)

    def __getitem__(self, index: int) -> PhotoBatch:
        photo = self.photos[index]
        shown = self.sizing.of(photo.size)
        height, width = shown
        masks = [resized_mask(mask_of(each.mask, photo.size, shown), shown) for each in photo.objects]
        focal = float(max(shown))
        return PhotoBatch(
            rgb=read_colors(photo.path, photo.where, photo.size, shown)[None],
            sizes=torch.tensor([shown]),
            intrinsics=torch.tensor([[[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]]),
            instances=Instances(
                picture=torch.zeros(len(masks), dtype=torch.int64),
                boxes=boxes_at([each.box for each in photo.objects], photo.size, shown),
                labels=torch.tensor([each.label for each in photo.objects], dtype=torch.int64),
                masks=torch.stack(masks) if masks else torch.zeros(0, height, width, dtype=torch.bool),
            ),
            picture_ids=[photo.name],
        )


class _Annotations:
    """A file of annotations.

    Args:
        folder: of the data set.
        file: to read.
        names: of the classes that count; None takes all.
    """

    def __init__(self, folder: Path, file: Path, names: Sequence[str] | None) -> None:
        self.root = Fields(read_json(file, _MOST_BYTES), str(file))
        name = file.stem.removeprefix(_FIRST)
        self.folders = [folder / name, folder / "images" / name, folder / "images", folder]
        categories = _by_id(self.root, "categories", "category")
        known = {each.text("name"): key for key, each in sorted(categories.items())}
        self.classes = tuple(known) if names is None else tuple(names)
        missing = [each for each in self.classes if each not in known]
        if missing:
            raise UserError(f"{file}: no category is called {missing[0]!r}; it has {', '.join(list(known)[:100])}")
        self.labels = dict.fromkeys(categories) | {known[each]: i for i, each in enumerate(self.classes)}

    def photos(self) -> list[OutlinedPhoto]:
        """All pictures in the order of the file, with what is annotated in them."""
        images = _by_id(self.root, "images", "image")
        sizes = {key: (image.pixels("height"), image.pixels("width")) for key, image in images.items()}
        objects: dict[int, list[Outlined]] = {key: [] for key in images}
        empty = 0
        for index, tree in enumerate(_objects(self.root, "annotations")):
            one = Fields(tree, f"{self.root.where}, annotation {index}")
            image = _id(one, "image_id")
            if image not in images:
                raise one.complaint("image_id", "the id of one of the images")
            found = self._outlined(one, sizes[image])
            empty += found is None
            objects[image] += [] if found is None else [found]
        log.info("%s: %s crowds, empty boxes and other classes are left out", self.root.where, f"{empty:,}")
        return [self._photo(image, sizes[key], objects[key]) for key, image in images.items()]

    def _outlined(self, one: Fields, size: Size) -> Outlined | None:
        category = _id(one, "category_id")
        if category not in self.labels:
            raise one.complaint("category_id", "the id of one of the categories")
        label = self.labels[category]
        x, y, width, height = one.numbers("bbox", 4)
        if label is None or one.tree.get("iscrowd") in (1, True) or min(width, height) <= 0:
            return None
        mask = read_segmentation(one.tree.get("segmentation"), size, one.where)
        if min(x + width, size[1]) <= max(x, 0) or min(y + height, size[0]) <= max(y, 0):
            return None
        return Outlined(label, within_picture((x, y, x + width, y + height), size, one.where), mask)

    def _photo(self, image: Fields, size: Size, objects: list[Outlined]) -> OutlinedPhoto:
        name = image.text("file_name")
        paths = [path_within(folder, name, f"{image.where}, 'file_name'") for folder in self.folders]
        path = next((path for path in paths if path.is_file()), None)
        if path is None:
            places = ", ".join(str(folder) for folder in self.folders)
            raise UserError(f"{image.where}: there is no picture {name!r} in {places}")
        return OutlinedPhoto(name, path, image.where, size, tuple(objects))


def _by_id(root: Fields, key: str, noun: str) -> dict[int, Fields]:
    found: dict[int, Fields] = {}
    for index, tree in enumerate(root.objects(key)):
        one = Fields(tree, f"{root.where}, {noun} {index}")
        number = _id(one, "id")
        if number in found:
            raise UserError(f"{one.where}: the id {number} is there twice; expected each one once")
        found[number] = one
    return found


def _objects(root: Fields, key: str) -> list[dict[str, Any]]:
    """A list of objects, perhaps of none."""
    return [] if root.tree.get(key) == [] else root.objects(key)


def _id(fields: Fields, key: str) -> int:
    value = fields.tree.get(key)
    if not isinstance(value, int) or isinstance(value, bool):
        raise fields.complaint(key, "a whole number")
    return value
