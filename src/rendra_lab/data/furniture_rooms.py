"""Generated rooms with furniture of Pix3D's nine classes: boxes, masks, cameras and shapes are known to the digit."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from rendra_lab.data.announced import announced
from rendra_lab.data.epochs import Samples
from rendra_lab.data.kept_tensors import Tensors, fingerprint, kept_or_made
from rendra_lab.data.photo_data import PhotoData, PhotoSplits, joined_shapes
from rendra_lab.data.pix3d_writer import checked_folder, keys_of, write_pix3d
from rendra_lab.detection.records import Instances, PhotoBatch
from rendra_lab.errors import UserError
from rendra_lab.settings import Count, Positive, check_numbers
from rendra_lab.shape_records import Shapes
from rendra_lab.synthesis import furnished_rooms
from rendra_lab.synthesis.furnished_rooms import RoomPhoto, room_photos
from rendra_lab.synthesis.furniture import CLASSES, NAMES
from rendra_lab.synthesis.furniture_models import FurnitureModels, model_id
from rendra_lab.synthesis.solid_shapes import SolidShape, shape_of
from rendra_lab.synthesis.solids import weld

SPLITS = ("train", "val", "test")
_PHOTOS_OF_ROOM = 3
_POOL = 4  # points of a surface that are kept for each that is shown: training draws among them
_VAL_SHARE, _TEST_SHARE = 0.15, 0.2  # of the models of each name, where no two parts share any


class FurnitureRooms(PhotoData):
    """Photographs of rooms that nobody has seen before; three of each room.

    Args:
        image_size: side of square pictures, or [height, width], pixels.
        counts: pictures in training, validation and test.
        split: s1: furniture of the same models stands in all parts; s2: models of validation and test are in no
            picture of training. Rooms and materials are new everywhere.
        models_per_name: shapes of each name of furniture that there are; with s2 at least 3.
        points: on the surface of each object; training draws them anew whenever it is shown.
        voxels: cells along a side of objects' own grids.
        rooms_seed: of rooms and models.
        cache: folder of pictures and shapes; null makes them every time.
        **loading: see `PhotoData`.

    Raises:
        UserError: an impossible setting.
    """

    classes = CLASSES

    def __init__(
        self,
        image_size: int | Sequence[int] = (128, 160),
        counts: Sequence[int] = (600, 60, 150),
        split: Literal["s1", "s2"] = "s1",
        models_per_name: Positive = 16,
        points: Positive = 1000,
        voxels: Positive = 32,
        rooms_seed: Count = 0,
        cache: str | Path | None = None,
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        size = [image_size] * 2 if isinstance(image_size, int) else list(image_size)
        if len(size) != 2 or not all(isinstance(side, int) and 32 <= side <= 4096 for side in size):
            raise UserError(
                f"data.image_size must be one side or [height,width], 32 to 4096 pixels, got {image_size!r}"
            )
        if len(counts) != 3 or not all(isinstance(count, int) and count >= 0 for count in counts) or counts[0] < 1:
            raise UserError(
                f"data.counts are three: pictures in training (at least 1), validation and test; got {list(counts)}"
            )
        check_numbers("data", Positive, models_per_name=models_per_name, points=points, voxels=voxels)
        check_numbers("data", Count, rooms_seed=rooms_seed)
        if split not in ("s1", "s2"):
            raise UserError(f"data.split is s1 or s2; got {split!r}")
        if split == "s2" and models_per_name < 3:
            raise UserError(f"data.split=s2 needs data.models_per_name of at least 3, got {models_per_name}")
        self.size = (size[0], size[1])
        self.counts = dict(zip(SPLITS, counts, strict=True))
        self.split = split
        self.rooms_seed = rooms_seed
        self.cache = None if cache is None else Path(cache)
        self.models = FurnitureModels(models_per_name, rooms_seed)
        self.shelf = ModelShapes(self.models, voxels, points, self.cache)

    def prepare_data(self) -> None:
        """Lightning's hook, in one process of each machine: makes what the cache lacks."""
        if self.cache is not None:
            self.setup("fit")

    def load(self) -> PhotoSplits:
        """All pictures, rendered or from the cache."""
        made = itertools.chain.from_iterable(self._photos(part) for part in SPLITS)
        photos = announced(made, sum(self.counts.values()), "generated pictures of rooms")
        parts = {part: list(itertools.islice(photos, self.counts[part])) for part in SPLITS}
        train, val, test = (RoomPhotos(parts[part], self.shelf, part) for part in SPLITS)
        return PhotoSplits(train, val, test)

    def write(self, folder: str | Path, overwrite: bool = False) -> Path:
        """All pictures as a folder of Pix3D's layout, see `pix3d_writer`; it appears when it is complete.

        Returns:
            The folder.

        Raises:
            UserError: a folder that is not empty, or holds something else.
        """
        folder = checked_folder(folder, overwrite)  # before minutes of work
        self.setup("fit")
        parts = {part: self._photos_of(part) for part in SPLITS}
        keys = {key for photos in parts.values() for photo in photos for key in keys_of(photo)}
        shapes = {key: self.shelf.shape(*key) for key in sorted(keys)}
        return write_pix3d(parts, shapes, self.split, folder, overwrite)

    def _photos_of(self, part: str) -> Sequence[RoomPhoto]:
        photos = getattr(self.splits, part)
        assert isinstance(photos, RoomPhotos)
        return photos.photos

    def numbers(self, part: str) -> range:
        """Which models of each name stand in the rooms of train, val or test."""
        total = self.models.per_name
        if self.split == "s1":
            return range(total)
        test = max(1, round(_TEST_SHARE * total))
        val = max(1, round(_VAL_SHARE * total))
        first, last = total - test - val, total - test
        return {"train": range(first), "val": range(first, last), "test": range(last, total)}[part]

    def _photos(self, part: str) -> Iterator[RoomPhoto]:
        """As many pictures as a part has, room after room."""
        rooms = -(-self.counts[part] // _PHOTOS_OF_ROOM)
        photos = itertools.chain.from_iterable(self._room(part, index) for index in range(rooms))
        return itertools.islice(photos, self.counts[part])

    def _room(self, part: str, index: int) -> list[RoomPhoto]:
        """The pictures of a room, by its number within its part; no other room has its seed.

        Classes that are wanted are dealt to rooms in turn, so that all of them come up as often.
        """
        key = [self.rooms_seed, SPLITS.index(part), index]
        seed = int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0] >> np.uint64(1))
        wanted = [CLASSES[self._dealt(part, index * _PHOTOS_OF_ROOM + i)] for i in range(_PHOTOS_OF_ROOM)]
        stock = self.models.stock(self.numbers(part))
        if self.cache is None:
            return room_photos(seed, wanted, stock, self.size)
        path = self.cache / f"rooms_{self._fingerprint(part)}" / f"{seed:016x}.safetensors"
        kept = kept_or_made(path, "pictures of rooms", lambda: _packed(room_photos(seed, wanted, stock, self.size)))
        return _unpacked(kept)

    def _dealt(self, part: str, number: int) -> int:
        """The class that picture number so and so of a part is to show."""
        deck, place = divmod(number, len(CLASSES))
        return int(
            np.random.default_rng([self.rooms_seed, SPLITS.index(part), deck, 1]).permutation(len(CLASSES))[place]
        )

    def _fingerprint(self, part: str) -> str:
        """16 hexadecimal digits that stand for all but the seed that determines the pictures of a room."""
        numbers = self.numbers(part)
        made_by = (
            furnished_rooms.EDITION,
            self.size,
            self.models.per_name,
            self.models.seed,
            numbers.start,
            numbers.stop,
        )
        return fingerprint(made_by)


class ModelShapes:
    """Shapes of the models of a collection, made when they are first asked for.

    Args:
        models: the collection.
        voxels: cells along a side of grids.
        points: on surfaces, of which four times as many are kept.
        cache: folder; None makes them in each process.
    """

    def __init__(self, models: FurnitureModels, voxels: int, points: int, cache: Path | None) -> None:
        self.models = models
        self.voxels = voxels
        self.points = points
        name = f"models_{fingerprint(furnished_rooms.EDITION, models.per_name, models.seed, voxels, points)}"
        self.folder = None if cache is None else cache / name
        self._known: dict[tuple[int, int], SolidShape] = {}

    def shape(self, name: int, number: int) -> SolidShape:
        """Of a model, by the row of its name in furniture.NAMES and its number, with all points that are kept."""
        key = (name, number)
        if key not in self._known:
            path = None if self.folder is None else self.folder / f"{model_id(NAMES[name], number)}.safetensors"
            made = self._made(key) if path is None else kept_or_made(path, "shape", lambda: self._made(key))
            self._known[key] = SolidShape(**made)
        return self._known[key]

    def seen(self, name: int, number: int, model_to_camera: Tensor, fresh: bool) -> Shapes:
        """A model alone before a camera, with the first of its points, or with any."""
        shape = self.shape(name, number)
        rows = torch.randperm(len(shape.points))[: self.points] if fresh else torch.arange(self.points)
        return replace(shape, points=shape.points[rows], normals=shape.normals[rows]).seen(model_to_camera)

    def _made(self, key: tuple[int, int]) -> Tensors:
        name, number = key
        verts, faces, _ = weld(self.models.model(NAMES[name], number).solids)
        generator = torch.Generator().manual_seed(number)
        count = _POOL * self.points
        shape = shape_of(torch.from_numpy(verts), torch.from_numpy(faces), self.voxels, count, generator)
        return {field: getattr(shape, field) for field in SolidShape.names()}


class RoomPhotos(Samples[PhotoBatch]):
    """Pictures of rooms, each a batch of one.

    Args:
        photos: the pictures.
        shelf: of the models in them.
        part: train, val or test, for names; in training points on surfaces are drawn anew.
    """

    def __init__(self, photos: Sequence[RoomPhoto], shelf: ModelShapes, part: str) -> None:
        self.photos = photos
        self.shelf = shelf
        self.part = part

    def __len__(self) -> int:
        return len(self.photos)

    def __getitem__(self, index: int) -> PhotoBatch:
        if not 0 <= index < len(self):
            raise IndexError(f"there are {len(self)} pictures, asked for number {index}")
        photo = self.photos[index]
        fresh = self.part == "train"
        shapes = [
            self.shelf.seen(name, number, matrix, fresh)
            for (name, number), matrix in zip(photo.models.tolist(), photo.model_to_camera, strict=True)
        ]
        masks = masks_of(photo)
        return PhotoBatch(
            rgb=photo.rgb[None] / 255,
            sizes=torch.tensor([photo.owner.shape]),
            intrinsics=photo.intrinsics[None],
            instances=Instances(
                picture=torch.zeros(len(masks), dtype=torch.int64),
                boxes=boxes_about(masks),
                labels=photo.labels,
                masks=masks,
                shapes=joined_shapes(shapes),
            ),
            picture_ids=[f"{self.part}_{index:05d}"],
        )


def masks_of(photo: RoomPhoto) -> Tensor:
    """Where each object is seen: (N, H, W) bool."""
    return photo.owner[None] == torch.arange(len(photo.labels), dtype=torch.uint8)[:, None, None]


def boxes_about(masks: Tensor) -> Tensor:
    """Boxes (N, 4) about masks (N, H, W), none of which is empty."""
    columns, rows = masks.any(1), masks.any(2)
    ends = [(line.int().argmax(1), line.shape[1] - line.flip(1).int().argmax(1)) for line in (columns, rows)]
    (left, right), (top, bottom) = ends
    return torch.stack([left, top, right, bottom], dim=1).float()


def _packed(photos: Sequence[RoomPhoto]) -> Tensors:
    return {f"{i}.{name}": getattr(photo, name) for i, photo in enumerate(photos) for name in RoomPhoto.names()}


def _unpacked(kept: Tensors) -> list[RoomPhoto]:
    count = len(kept) // len(RoomPhoto.names())
    return [RoomPhoto(**{name: kept[f"{i}.{name}"] for name in RoomPhoto.names()}) for i in range(count)]
