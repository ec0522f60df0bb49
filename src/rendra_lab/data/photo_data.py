"""Annotated pictures as batches: what generated rooms and folders of photographs have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.data.epochs import Samples
from rendra_lab.data.sample_data import SampleData, SampleSplits
from rendra_lab.detection.records import Instances, PhotoBatch
from rendra_lab.settings import Positive
from rendra_lab.shape_records import Shapes

PhotoSplits = SampleSplits[PhotoBatch]


class PhotoData(SampleData[PhotoBatch]):
    """Annotated pictures; subclasses say where they come from.

    Args:
        batch_size: pictures of a training step, of all processes together.
        flip: show every other training picture in a mirror, with all that belongs to it.
        **loading: settings of `SampleData`.
    """

    what = "pictures"
    classes: tuple[str, ...]  # by label: subclasses know them once they are set up

    def __init__(self, batch_size: Positive = 4, flip: bool = True, **loading: Any) -> None:
        super().__init__(batch_size, **loading)
        self.flip = flip

    def for_training(self, samples: Samples[PhotoBatch]) -> Samples[PhotoBatch]:
        """Every other one in a mirror, where that is asked for."""
        return Mirrored(samples) if self.flip else samples

    @staticmethod
    def joined(batches: Sequence[PhotoBatch]) -> PhotoBatch:
        """See `joined`."""
        return joined(batches)


class Mirrored:
    """The same pictures, every other one in a mirror; torch's global stream says which."""

    def __init__(self, photos: Samples[PhotoBatch]) -> None:
        self.photos = photos

    def __len__(self) -> int:
        return len(self.photos)

    def __getitem__(self, index: int) -> PhotoBatch:
        photo = self.photos[index]
        return mirrored(photo) if torch.rand(()) < 0.5 else photo


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
