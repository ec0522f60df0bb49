"""Generated pictures: splits share none, a cache is what was made, and the truth is for scores alone."""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from rendra_lab.errors import UserError
from rendra_lab.synthesis.clevr_like import camera_at
from rendra_lab.synthesis.object_pictures import ObjectPictures
from rendra_lab.tasks.giraffe.camera_sampler import CameraSampler
from rendra_lab.tasks.giraffe.generated_pictures import GeneratedPictures, KnownPictures, boxes_around, masks_of
from rendra_lab.tasks.giraffe.picture_data import WithoutTruth, joined
from rendra_lab.tasks.giraffe.records import PictureBatch


class Spots:
    """A bright pixel at a place that follows from the seed; up to two objects."""

    def __init__(self, edition: int = 1) -> None:
        self.edition = edition
        self.asked = 0

    def settings(self) -> tuple[object, ...]:
        return (self.edition,)

    def pictures(self, seeds: Sequence[int], side: int) -> ObjectPictures:
        self.asked += len(seeds)
        owners = torch.zeros(len(seeds), side, side, dtype=torch.uint8)
        for row, seed in enumerate(seeds):
            owners[row, seed % side, (seed // side) % side] = 1
        rgb = (owners[:, None] * 255).expand(-1, 3, -1, -1).contiguous()
        kind = torch.tensor([[seed % 7, -1] for seed in seeds]).reshape(-1, 2)
        return ObjectPictures(rgb, owners, torch.full((len(seeds), 2), float("nan")), kind)


def data(world: object, **settings: object) -> GeneratedPictures:
    small = {"image_size": 8, "counts": (5, 2, 3), "batch_size": 2}
    made = GeneratedPictures(world, **{**small, **settings})  # type: ignore[arg-type]
    made.setup("fit")
    return made


def test_training_sees_no_truth_and_evaluation_all_of_it() -> None:
    made = data(Spots())
    batches = list(made.train_dataloader())
    assert [tuple(batch.rgb.shape) for batch in batches] == [(2, 3, 8, 8)] * 2
    assert all(batch.truth is None for batch in batches)
    (val,) = made.val_dataloader()
    assert val.truth is not None
    assert torch.equal(val.truth.masks[:, 0], val.rgb[:, 0] == 1)
    assert not val.truth.masks[:, 1].any()
    assert val.truth.kind[:, 1].tolist() == [-1, -1]
    assert sum(len(batch.rgb) for batch in made.test_dataloader()) == 3
    assert (float(val.rgb.min()), float(val.rgb.max())) == (0, 1)


def test_no_picture_is_in_two_splits_and_more_of_them_leave_the_others_alone() -> None:
    few, many = data(Spots()), data(Spots(), counts=(300, 4, 0))
    seeds = {few.picture_seed(split, i) for split in ("train", "val", "test") for i in range(300)}
    assert len(seeds) == 900
    assert all(torch.equal(few.splits.train[i].rgb, many.splits.train[i].rgb) for i in range(5))
    assert torch.equal(few.splits.val[1].rgb, many.splits.val[1].rgb)
    assert len(many.splits.train) == 300
    assert many.splits.train[299].rgb.shape == (1, 3, 8, 8)
    assert list(many.test_dataloader()) == []
    with pytest.raises(IndexError, match="there are 300 pictures, asked for number 300"):
        many.splits.train[300]


def test_a_cache_is_what_was_made_and_another_world_has_another(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first, second, other = Spots(), Spots(), Spots(2)
    made = data(first, cache=tmp_path)
    again = data(second, cache=tmp_path)
    assert (first.asked, second.asked) == (10, 0)
    assert torch.equal(made.splits.test[2].rgb, again.splits.test[2].rgb)
    data(other, cache=tmp_path)
    assert other.asked == 10
    broken = next(tmp_path.rglob("train*.safetensors"))
    broken.write_bytes(broken.read_bytes()[:-3])
    with caplog.at_level(logging.WARNING):
        mended = data(Spots(), cache=tmp_path)
    assert "made anew" in caplog.text
    assert torch.equal(mended.splits.train[0].rgb, made.splits.train[0].rgb)


@pytest.mark.parametrize("v", [0.1, 1 / 3, 0.5])
def test_the_camera_of_solids_is_that_of_the_generator(v: float) -> None:
    zero = torch.zeros(1)
    theirs = CameraSampler().at(zero, torch.tensor([v]), torch.tensor([2.732]), zero).camera_to_world[0]
    assert np.abs(camera_at(v) - theirs.double().numpy()).max() < 1e-6


def test_boxes_hold_masks_and_nothing_more() -> None:
    owners = torch.zeros(1, 6, 7, dtype=torch.uint8)
    owners[0, 2:4, 1:6] = 2
    masks = masks_of(owners, 3)
    assert masks.sum((2, 3)).tolist() == [[0, 10, 0]]
    assert boxes_around(masks).tolist() == [[[0, 0, 0, 0], [1, 2, 6, 4], [0, 0, 0, 0]]]
    full = torch.ones(1, 1, 4, 4, dtype=torch.bool)
    assert boxes_around(full).tolist() == [[[0, 0, 4, 4]]]
    assert boxes_around(torch.zeros(0, 2, 4, 4, dtype=torch.bool)).shape == (0, 2, 4)


def test_batches_join_with_truth_only_if_all_have_it() -> None:
    known = KnownPictures([Spots().pictures([3, 4], 8)])
    assert joined([known[0], known[1]]).truth is not None
    assert joined([known[0], WithoutTruth(known)[1]]).truth is None
    assert isinstance(known[0], PictureBatch)
    with pytest.raises(ValueError, match="no pictures to join"):
        joined([])
    assert len(KnownPictures([])) == 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"counts": (0, 1, 1)}, r"data.counts are three: pictures in training \(at least 1\)"),
        ({"image_size": 4}, "data.image_size must be a whole number from 8 to 1024, got 4"),
        ({"pictures_seed": -1}, "data.pictures_seed"),
    ],
)
def test_what_cannot_be_is_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        data(Spots(), **settings)
