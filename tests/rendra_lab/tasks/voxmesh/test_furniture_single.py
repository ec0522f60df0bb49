"""Generated furniture as data: classes in turn, models apart, points anew in training, and the cache."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from rendra_lab.data.epochs import ShuffledEpochs
from rendra_lab.errors import UserError
from rendra_lab.synthesis.furniture import CLASSES
from rendra_lab.tasks.voxmesh.furniture_single import FurnitureSingle
from rendra_lab.tasks.voxmesh.shape_data import joined


def data(**settings: Any) -> FurnitureSingle:
    small = {"image_size": 24, "counts": [2, 1, 1], "views": 2, "eval_views": 1, "points": 20, "voxels": 8}
    made = FurnitureSingle(**{**small, "batch_size": 2, **settings})
    made.setup("fit")
    return made


@pytest.fixture(scope="module")
def small() -> FurnitureSingle:
    return data()


def test_batches_have_the_shapes_of_their_record(small: FurnitureSingle) -> None:
    loader = small.train_dataloader()
    assert isinstance(loader, ShuffledEpochs)
    batches = list(loader)
    assert len(batches) == 2
    for batch in batches:
        assert batch.rgb.shape == (2, 3, 24, 24)
        assert 0 <= float(batch.rgb.min()) < float(batch.rgb.max()) <= 1
        assert batch.shapes.points.shape == batch.shapes.normals.shape == (2, 20, 3)
        assert batch.shapes.voxels.shape == (2, 8, 8, 8)
        assert batch.depth_range.shape == (2, 2)
        assert len(batch.shapes.verts) == len(batch.shapes.faces) == len(batch.shape_ids) == 2
        torch.testing.assert_close(batch.shapes.normals.norm(dim=2), torch.ones(2, 20))
    (only,) = list(small.test_dataloader())
    assert only.labels.tolist() == [0]
    assert only.shape_ids == ["bed_test_0000"]


def test_classes_take_turns_and_no_piece_is_in_two_splits(small: FurnitureSingle) -> None:
    assert small.classes == CLASSES
    seeds = {small.model_seed(split, index) for split in ("train", "val", "test") for index in range(200)}
    assert len(seeds) == 600
    splits = small.splits
    assert [int(splits.train[index].labels) for index in range(4)] == [0, 0, 1, 1]
    ids = [
        {part[index].shape_ids[0] for index in range(len(part))} for part in (splits.train, splits.val, splits.test)
    ]
    assert len(set.union(*ids)) == sum(map(len, ids)) == 4
    assert not torch.equal(splits.val[0].rgb, splits.test[0].rgb)


def test_training_draws_points_anew_and_evaluation_does_not(small: FurnitureSingle) -> None:
    train, val = small.splits.train, small.splits.val
    assert not torch.equal(train[0].shapes.points, train[0].shapes.points)
    assert torch.equal(val[0].shapes.points, val[0].shapes.points)
    assert torch.equal(train[0].shapes.verts[0], train[0].shapes.verts[0])
    with pytest.raises(IndexError, match="there are 4 pictures, asked for number 4"):
        train[4]


def test_fewer_pieces_are_the_first_of_more(small: FurnitureSingle) -> None:
    fewer = data(counts=[1, 0, 1])
    assert torch.equal(fewer.splits.train[1].rgb, small.splits.train[1].rgb)
    assert torch.equal(fewer.splits.test[0].rgb, small.splits.test[0].rgb)
    assert list(fewer.val_dataloader()) == []
    other = data(counts=[1, 0, 0], models_seed=1)
    assert not torch.equal(other.splits.train[0].rgb, small.splits.train[0].rgb)


def test_the_cache_gives_back_what_was_made(
    small: FurnitureSingle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data(cache=str(tmp_path)).prepare_data()
    files = list(tmp_path.rglob("*.safetensors"))
    assert len(files) == 4
    monkeypatch.setattr("rendra_lab.synthesis.single_furniture.FurnitureStudio.views", None)
    again = data(cache=str(tmp_path))
    for split in ("train", "val", "test"):
        one, other = getattr(again.splits, split)[0], getattr(small.splits, split)[0]
        assert torch.equal(one.rgb, other.rgb)
        assert torch.equal(one.shapes.voxels, other.shapes.voxels)
        assert torch.equal(one.shapes.verts[0], other.shapes.verts[0])


def test_settings_that_cannot_be_are_refused() -> None:
    for settings, message in (
        ({"counts": [0, 1, 1]}, "data.counts are three: pieces in training"),
        ({"views": 0}, "data.views must be a whole number from 1 to 64, got 0"),
        ({"voxels": 2}, "data.voxels must be a whole number from 4 to 256, got 2"),
        ({"image_size": 8}, "data.image_size must be a whole number from 16 to 1024, got 8"),
        ({"batch_size": 0}, "data.batch_size must be a whole number of at least 1, got 0"),
    ):
        with pytest.raises(UserError, match=message):
            FurnitureSingle(**settings)
    with pytest.raises(UserError, match="batch_size=9 is more than the 4 training pictures"):
        data(batch_size=9).train_dataloader()
    with pytest.raises(ValueError, match="no pictures of shapes to join"):
        joined([])
