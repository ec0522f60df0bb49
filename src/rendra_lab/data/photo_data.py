"""Annotated pictures as batches: what generated rooms and folders of photographs have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import DataLoader, Dataset

from rendra_lab.data.epochs import Samples, ShuffledEpochs
from rendra_lab.data.shares import Share, ShareSampler
from rendra_lab.detection.records import Instances, PhotoBatch
from rendra_lab.errors import UserError
from rendra_lab.settings import Count, Positive, check_numbers
from rendra_lab.shape_records import Shapes


@dataclass(frozen=True)
class PhotoSplits:
    """Pictures by their numbers, each a batch of one, in three parts."""

    train: Samples[PhotoBatch]
    val: Samples[PhotoBatch]
    test: Samples[PhotoBatch]


class PhotoData(LightningDataModule, ABC):
    """Annotated pictures; subclasses say where they come from.

    Several processes divide training batches and validation pictures among them; each of them sees the whole test.

    Args:
        batch_size: pictures of a training step, of all processes together.
        eval_batch_size: pictures of a batch in validation and test; None: as in training.
        num_workers: processes that load training pictures ahead.
        flip: show every other training picture in a mirror, with all that belongs to it.
        seed: of the order of training pictures and of what they draw.

    Raises:
        UserError: an impossible number.
    """

    is_divisible = True
    classes: tuple[str, ...]  # by label: subclasses know them once they are set up
    splits: PhotoSplits

    def __init__(
        self,
        batch_size: Positive = 4,
        eval_batch_size: Positive | None = None,
        num_workers: Count = 0,
        flip: bool = True,
        seed: Count = 0,
    ) -> None:
        super().__init__()
        check_numbers("data", Positive, batch_size=batch_size)
        check_numbers("data", Positive | None, eval_batch_size=eval_batch_size)
        check_numbers("data", Count, num_workers=num_workers, seed=seed)
        self.batch_size = batch_size
        self.eval_batch_size = batch_size if eval_batch_size is None else eval_batch_size
        self.num_workers = num_workers
        self.flip = flip
        self.seed = seed

    @abstractmethod
    def load(self) -> PhotoSplits:
        """All pictures; UserError says what is wrong with where they come from."""

    def setup(self, stage: str) -> None:
        """Lightning's hook, before the fit and again before the test: loads the pictures, once."""
        if not hasattr(self, "splits"):
            self.splits = self.load()

    def train_dataloader(self) -> ShuffledEpochs[PhotoBatch]:
        """Shuffled training pictures."""
        photos = self.splits.train
        if len(photos) < self.batch_size:
            raise UserError(
                f"data.batch_size={self.batch_size} is more than the {len(photos)} training pictures that there are"
            )
        return ShuffledEpochs(
            Mirrored(photos) if self.flip else photos,
            self.batch_size,
            seed=self.seed,
            collate=joined,
            drop_last=True,
            num_workers=self.num_workers,
        )

    def val_dataloader(self) -> Sequence[PhotoBatch] | DataLoader[PhotoBatch]:
        """Validation pictures in their order, a share of them in each process."""
        photos = self.splits.val
        return self._in_order(photos, Share.of(self).whole_if_few(len(photos)))

    def test_dataloader(self) -> Sequence[PhotoBatch] | DataLoader[PhotoBatch]:
        """All test pictures in their order."""
        return self._in_order(self.splits.test, Share())

    def _in_order(self, photos: Samples[PhotoBatch], share: Share) -> Sequence[PhotoBatch] | DataLoader[PhotoBatch]:
        if len(photos) == 0:
            return []
        return DataLoader(
            _AsDataset(photos),
            self.eval_batch_size,
            sampler=ShareSampler(len(photos), share),
            collate_fn=joined,
            generator=torch.Generator(),  # loaders draw a seed for workers: not from the fit's stream
        )


class Mirrored:
    """The same pictures, every other one in a mirror; torch's global stream says which."""

    def __init__(self, photos: Samples[PhotoBatch]) -> None:
        self.photos = photos

    def __len__(self) -> int:
        return len(self.photos)

    def __getitem__(self, index: int) -> PhotoBatch:
        photo = self.photos[index]
        return mirrored(photo) if torch.rand(()) < 0.5 else photo


class _AsDataset(Dataset[PhotoBatch]):
    def __init__(self, photos: Samples[PhotoBatch]) -> None:
        self.photos = photos

    def __getitem__(self, index: int) -> PhotoBatch:
        return self.photos[index]


def mirrored(photo: PhotoBatch) -> PhotoBatch:
    """What a camera sees whose left is right: pictures that fill their batch, boxes, masks, cameras and shapes.

    Raises:
        ValueError: a picture that was filled up at its right.
    """
    width = photo.rgb.shape[3]
    if not bool((photo.sizes[:, 1] == width).all()):
        raise ValueError(f"pictures of a batch {width} px wide are mirrored before they are filled up to it")
    lenses = photo.intrinsics.clone()
    lenses[:, 0, 1] = -lenses[:, 0, 1]
    lenses[:, 0, 2] = width - lenses[:, 0, 2]
    seen = photo.instances
    left, top, right, bottom = seen.boxes.unbind(1)
    instances = replace(
        seen,
        boxes=torch.stack([width - right, top, width - left, bottom], dim=1),
        masks=seen.masks.flip(2),
        shapes=None if seen.shapes is None else _mirrored_shapes(seen.shapes),
    )
    return replace(photo, rgb=photo.rgb.flip(3), intrinsics=lenses, instances=instances)


def _mirrored_shapes(shapes: Shapes) -> Shapes:
    """The same with x turned over; faces run the other way round, so that they look outwards still."""
    over = shapes.points.new_tensor([-1.0, 1.0, 1.0])
    return replace(
        shapes,
        points=shapes.points * over,
        normals=shapes.normals * over,
        voxels_to_camera=shapes.voxels_to_camera * over.new_tensor([[-1.0], [1.0], [1.0], [1.0]]),
        verts=tuple(verts * over for verts in shapes.verts),
        faces=tuple(faces.flip(1) for faces in shapes.faces),
    )


def joined(photos: Sequence[PhotoBatch]) -> PhotoBatch:
    """One batch of all pictures of some batches, filled up with black at the right and the bottom.

    Raises:
        ValueError: no batches; objects with shapes among objects without.
    """
    if not photos:
        raise ValueError("no pictures to join")
    height, width = (max(photo.rgb.shape[axis] for photo in photos) for axis in (2, 3))
    counts = torch.tensor([0, *(len(photo.rgb) for photo in photos[:-1])]).cumsum(0).tolist()
    seen = [photo.instances for photo in photos]

    def column(name: str) -> Tensor:
        return torch.cat([getattr(photo, name) for photo in photos])

    instances = Instances(
        picture=torch.cat([each.picture + first for each, first in zip(seen, counts, strict=True)]),
        boxes=torch.cat([each.boxes for each in seen]),
        labels=torch.cat([each.labels for each in seen]),
        masks=torch.cat([_filled_up(each.masks, height, width) for each in seen]),
        shapes=_shapes_of_all(seen),
    )
    return PhotoBatch(
        rgb=torch.cat([_filled_up(photo.rgb, height, width) for photo in photos]),
        sizes=column("sizes"),
        intrinsics=column("intrinsics"),
        instances=instances,
        picture_ids=[name for photo in photos for name in photo.picture_ids],
    )


def _filled_up(pictures: Tensor, height: int, width: int) -> Tensor:
    below, right = height - pictures.shape[-2], width - pictures.shape[-1]
    return F.pad(pictures, (0, right, 0, below)) if below or right else pictures


def _shapes_of_all(seen: Sequence[Instances]) -> Shapes | None:
    """Those of all objects; None where no objects have any."""
    known = [each.shapes for each in seen if each.shapes is not None]
    if not known:
        return None
    if any(each.shapes is None and len(each.boxes) for each in seen):
        raise ValueError("some objects of a batch have shapes and others have none")
    return joined_shapes([shapes for shapes in known if len(shapes.points)] or known[:1])  # no objects: any sizes


def joined_shapes(several: Sequence[Shapes]) -> Shapes:
    """All objects of some, which have as many points and cells.

    Raises:
        ValueError: none.
    """
    if not several:
        raise ValueError("no shapes to join")

    def column(name: str) -> Tensor:
        return torch.cat([getattr(shapes, name) for shapes in several])

    return Shapes(
        **{name: column(name) for name in ("points", "normals", "voxels", "voxels_to_camera")},
        verts=tuple(verts for shapes in several for verts in shapes.verts),
        faces=tuple(faces for shapes in several for faces in shapes.faces),
    )
