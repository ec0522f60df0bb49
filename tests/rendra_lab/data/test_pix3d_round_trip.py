"""Generated rooms, written in Pix3D's and COCO's layout, are read back as they were."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from rendra_lab.data.coco import Coco
from rendra_lab.data.furniture_rooms import FurnitureRooms
from rendra_lab.data.photo_data import PhotoData, mirrored
from rendra_lab.data.pix3d import Pix3D
from rendra_lab.detection.records import PhotoBatch

PARTS = ("train", "val", "test")
WHOLE = {"shortest_px": None, "longest_px": None}


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> tuple[FurnitureRooms, Path]:
    """A few rooms, and the folder that they were written to."""
    made = FurnitureRooms((48, 60), (3, 1, 2), models_per_name=2, points=20, voxels=12, flip=False)
    return made, made.write(tmp_path_factory.mktemp("rooms") / "set")


def pairs(one: PhotoData, other: PhotoData) -> Iterator[tuple[PhotoBatch, PhotoBatch]]:
    """The same pictures of both."""
    for data in (one, other):
        data.setup("fit")
    for part in PARTS:
        mine, yours = getattr(one.splits, part), getattr(other.splits, part)
        assert len(mine) == len(yours)
        yield from ((mine[index], yours[index]) for index in range(len(mine)))


def test_pix3d_reads_what_was_generated(rooms: tuple[FurnitureRooms, Path]) -> None:
    made, folder = rooms
    assert Pix3D.classes == made.classes
    for ours, read in pairs(made, Pix3D(folder, points=20, voxels=12, flip=False, **WHOLE)):
        assert torch.equal(ours.rgb, read.rgb)
        assert torch.equal(ours.intrinsics, read.intrinsics)
        for name in ("boxes", "labels", "masks", "picture"):
            assert torch.equal(getattr(ours.instances, name), getattr(read.instances, name))
        one, other = ours.instances.shapes, read.instances.shapes
        assert one is not None
        assert other is not None
        assert torch.equal(one.voxels, other.voxels)
        torch.testing.assert_close(one.voxels_to_camera, other.voxels_to_camera, atol=1e-5, rtol=0)
        for mine, yours in zip(one.verts, other.verts, strict=True):
            torch.testing.assert_close(mine, yours, atol=1e-5, rtol=0)
        assert all(torch.equal(mine, yours) for mine, yours in zip(one.faces, other.faces, strict=True))
        assert other.points.shape == one.points.shape


def test_coco_reads_what_was_generated(rooms: tuple[FurnitureRooms, Path]) -> None:
    made, folder = rooms
    coco = Coco(folder, flip=False, class_count=9, **WHOLE)
    for ours, read in pairs(made, coco):
        assert torch.equal(ours.rgb, read.rgb)
        for name in ("boxes", "labels", "masks", "picture"):
            assert torch.equal(getattr(ours.instances, name), getattr(read.instances, name))
    assert coco.classes == made.classes


def test_what_is_read_may_be_mirrored(rooms: tuple[FurnitureRooms, Path]) -> None:
    data = Pix3D(rooms[1], points=20, voxels=12, **WHOLE)
    data.setup("fit")
    photo = data.splits.test[0]
    shapes, over = photo.instances.shapes, mirrored(photo).instances.shapes
    assert shapes is not None
    assert over is not None
    torch.testing.assert_close(over.points[..., 0], -shapes.points[..., 0])
    torch.testing.assert_close(mirrored(mirrored(photo)).instances.boxes, photo.instances.boxes)
