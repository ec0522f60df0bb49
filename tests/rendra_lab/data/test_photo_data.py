"""Annotated pictures as batches: joining keeps everything, and a mirror shows what a mirrored world would."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rendra_lab.data.photo_data import Mirrored, PhotoData, PhotoSplits, joined, joined_shapes, mirrored
from rendra_lab.detection.records import Instances, PhotoBatch
from rendra_lab.errors import UserError
from rendra_lab.frustums import Frustums
from rendra_lab.shape_records import Shapes


def shapes(count: int) -> Shapes:
    """Lopsided grids and tetrahedra before the camera."""
    matrix = torch.eye(4).repeat(count, 1, 1)
    matrix[:, :3, 3] = torch.tensor([0.4, -0.2, 5.0])
    corners = torch.tensor([[0.0, 0, 4], [1, 0, 4], [0, 1, 4], [0, 0, 5]])
    return Shapes(
        points=torch.randn(count, 6, 3) + torch.tensor([0.0, 0.0, 5.0]),
        normals=torch.nn.functional.normalize(torch.randn(count, 6, 3), dim=2),
        voxels=torch.rand(count, 4, 4, 4) < 0.4,
        voxels_to_camera=matrix,
        verts=tuple(corners + i for i in range(count)),
        faces=tuple(torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]) for _ in range(count)),
    )


def photo(size: tuple[int, int] = (6, 8), count: int = 2, with_shapes: bool = True, name: str = "one") -> PhotoBatch:
    height, width = size
    return PhotoBatch(
        rgb=torch.rand(1, 3, height, width),
        sizes=torch.tensor([[height, width]]),
        intrinsics=torch.tensor([[[10.0, 0.5, 3.0], [0.0, 10.0, 2.5], [0.0, 0.0, 1.0]]]),
        instances=Instances(
            picture=torch.zeros(count, dtype=torch.int64),
            boxes=torch.tensor([[1.0, 2.0, 4.0, 5.0]]).repeat(count, 1),
            labels=torch.arange(count),
            masks=torch.rand(count, height, width) < 0.5,
            shapes=shapes(count) if with_shapes else None,
        ),
        picture_ids=[name],
    )


def pixels(points: Tensor, K: Tensor) -> Tensor:
    flat = points @ K.mT
    return flat[..., :2] / flat[..., 2:]


def test_pictures_of_all_sizes_are_filled_up_to_one() -> None:
    small, large = photo((4, 9), 1, name="small"), photo((6, 8), 3, name="large")
    both = joined([small, photo(count=0, name="empty"), large])
    assert both.rgb.shape == (3, 3, 6, 9)
    assert both.sizes.tolist() == [[4, 9], [6, 8], [6, 8]]
    assert both.picture_ids == ["small", "empty", "large"]
    assert both.instances.picture.tolist() == [0, 2, 2, 2]
    torch.testing.assert_close(both.rgb[0, :, :4], small.rgb[0])
    assert not both.rgb[0, :, 4:].any()
    assert not both.rgb[2, :, :, 8:].any()
    assert torch.equal(both.instances.masks[1:, :, :8], large.instances.masks)
    assert both.instances.shapes is not None
    assert len(both.instances.shapes.points) == len(both.instances.shapes.verts) == 4
    again = joined([both])
    assert torch.equal(again.instances.masks, both.instances.masks)


def test_joining_is_associative() -> None:
    one, two, three = (photo((5, 7), count, name=str(count)) for count in (1, 0, 2))
    left, right = joined([joined([one, two]), three]), joined([one, joined([two, three])])
    assert torch.equal(left.instances.picture, right.instances.picture)
    assert left.picture_ids == right.picture_ids
    assert torch.equal(left.rgb, right.rgb)


def test_pictures_without_shapes_join_and_mixed_ones_do_not() -> None:
    assert joined([photo(with_shapes=False)] * 2).instances.shapes is None
    none_and_some = joined([photo(count=0, with_shapes=False), photo()])
    assert none_and_some.instances.shapes is not None
    assert joined([photo(count=0), photo(count=0)]).instances.shapes is not None
    with pytest.raises(ValueError, match="some objects of a batch have shapes and others have none"):
        joined([photo(), photo(with_shapes=False)])
    with pytest.raises(ValueError, match="no pictures"):
        joined([])
    with pytest.raises(ValueError, match="no shapes"):
        joined_shapes([])


def test_two_mirrors_show_the_thing_itself() -> None:
    one = photo()
    two = mirrored(mirrored(one))
    torch.testing.assert_close(two.rgb, one.rgb)
    torch.testing.assert_close(two.intrinsics, one.intrinsics)
    torch.testing.assert_close(two.instances.boxes, one.instances.boxes)
    assert torch.equal(two.instances.masks, one.instances.masks)
    assert one.instances.shapes is not None
    assert two.instances.shapes is not None
    torch.testing.assert_close(two.instances.shapes.voxels_to_camera, one.instances.shapes.voxels_to_camera)
    assert torch.equal(two.instances.shapes.faces[0], one.instances.shapes.faces[0])


def test_points_appear_at_the_mirrored_pixels_and_surfaces_look_outwards() -> None:
    one = photo()
    other = mirrored(one)
    assert one.instances.shapes is not None
    assert other.instances.shapes is not None
    seen, there = (pixels(x.instances.shapes.points[0], x.intrinsics[0]) for x in (one, other))
    torch.testing.assert_close(there, torch.stack([8 - seen[:, 0], seen[:, 1]], 1))
    volumes = []
    for each in (one, other):
        corners = each.instances.shapes.verts[0][each.instances.shapes.faces[0]]  # type: ignore[union-attr]
        volumes.append((corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum() / 6)
    torch.testing.assert_close(volumes[0], volumes[1])
    assert volumes[0] > 0
    assert other.instances.boxes[0].tolist() == [4.0, 2.0, 7.0, 5.0]
    assert torch.equal(other.instances.masks, one.instances.masks.flip(2))


def test_the_grid_over_a_mirrored_frustum_is_the_mirrored_grid() -> None:
    one = photo(count=1)
    no_skew = replace(one, intrinsics=one.intrinsics * torch.tensor([[1.0, 0, 1], [1, 1, 1], [1, 1, 1]]))
    grids = []
    for each in (no_skew, mirrored(no_skew)):
        assert each.instances.shapes is not None
        frustum = Frustums(each.instances.boxes, torch.tensor([[3.5, 6.5]]), each.intrinsics)
        grids.append(frustum.voxels_of(each.instances.shapes, 5))
    assert grids[0].any()
    assert torch.equal(grids[1], grids[0].flip(3))


def test_a_picture_that_was_filled_up_is_not_mirrored() -> None:
    with pytest.raises(ValueError, match="mirrored before they are filled up"):
        mirrored(joined([photo((6, 7)), photo((6, 8))]))


def test_half_of_the_training_pictures_are_mirrored() -> None:
    one = photo()
    torch.manual_seed(0)
    shown = Mirrored([one])
    count = sum(torch.equal(shown[0].rgb, one.rgb) for _ in range(200))
    assert 70 < count < 130
    assert len(shown) == 1


class Photos(PhotoData):
    """Three, one and no pictures."""

    classes = ("one", "two")

    def load(self) -> PhotoSplits:
        return PhotoSplits([photo() for _ in range(3)], [photo(count=0)], [])


def test_loaders_give_batches_and_refuse_what_cannot_be() -> None:
    data = Photos(batch_size=2, eval_batch_size=3)
    data.setup("fit")
    assert [len(batch.rgb) for batch in data.train_dataloader()] == [2]
    assert [len(batch.rgb) for batch in data.val_dataloader()] == [1]
    assert list(data.test_dataloader()) == []
    few = Photos(batch_size=4)
    few.setup("fit")
    with pytest.raises(UserError, match=r"data\.batch_size=4 is more than the 3 training pictures"):
        few.train_dataloader()
    with pytest.raises(UserError, match=r"data\.batch_size must be"):
        Photos(batch_size=0)
