"""Pairs of generated places: splits share no place, a cache is what was made, and the truth is for scores alone."""

import itertools
from pathlib import Path

import pytest
import torch

from rendra_lab.errors import UserError
from rendra_lab.synthesis.posed_views import PosedViews
from rendra_lab.synthesis.streets import StreetWorld
from rendra_lab.tasks.synsin.generated_pairs import GeneratedPairs, ViewPairs, pair_of
from rendra_lab.tasks.synsin.pair_data import joined
from rendra_lab.tasks.synsin.records import PairBatch


class Walls:
    """A flat wall of one grey, seen by cameras side by side."""

    def __init__(self, edition: int = 1) -> None:
        self.edition = edition
        self.seeds: list[int] = []

    def settings(self) -> tuple[object, ...]:
        return (self.edition,)

    def views(self, seed: int, count: int, size: tuple[int, int]) -> PosedViews:
        self.seeds.append(seed)
        poses = torch.eye(4).repeat(count, 1, 1)
        poses[:, 0, 3] = 0.5 * torch.arange(count)
        K = torch.tensor([[8.0, 0, size[1] / 2], [0, 8.0, size[0] / 2], [0, 0, 1]])
        grey = torch.arange(count, dtype=torch.uint8)[:, None, None, None] + seed % 200
        return PosedViews(
            rgb=grey.expand(count, 3, *size).clone(),
            depth=torch.full((count, 1, *size), 4.0),
            intrinsics=K.repeat(count, 1, 1),
            world_to_camera=poses,
        )


def data(world: object, **settings: object) -> GeneratedPairs:
    small = {"image_size": [8, 12], "counts": (3, 2, 2), "views_per_scene": 3, "batch_size": 4}
    made = GeneratedPairs(world, **{**small, **settings})  # type: ignore[arg-type]
    made.setup("fit")
    return made


def test_training_takes_every_ordered_pair_and_evaluation_one_of_each_place() -> None:
    splits = data(Walls()).splits
    assert (len(splits.train), len(splits.val), len(splits.test)) == (3 * 6, 2, 2)
    first = [splits.train[i] for i in range(6)]
    offsets = {round(float(batch.input_to_target[0, 0, 3]), 3) for batch in first}
    assert offsets == {-1.0, -0.5, 0.5, 1.0}
    pairs = {(int(255 * b.input[0, 0, 0, 0]), int(255 * b.target[0, 0, 0, 0])) for b in first}
    assert len(pairs) == 6
    with pytest.raises(IndexError, match="there are 2 pairs, asked for number 2"):
        splits.val[2]


def test_no_place_is_in_two_splits_and_more_places_leave_the_others_alone() -> None:
    small, large = Walls(), Walls()
    data(small)
    data(large, counts=(5, 3, 2))
    assert len(set(large.seeds)) == 10
    assert set(small.seeds) < set(large.seeds)
    other = Walls()
    data(other, scenes_seed=1)
    assert not set(other.seeds) & set(large.seeds)


def test_training_does_not_see_the_truth_unless_it_is_asked_for() -> None:
    quiet = data(Walls())
    batch = next(iter(quiet.train_dataloader()))
    assert batch.truth is None
    assert batch.input.shape == (4, 3, 8, 12)
    told = next(iter(data(Walls(), truth_in_training=True).train_dataloader()))
    assert told.truth is not None
    assert told.truth.depth.shape == (4, 1, 8, 12)
    torch.testing.assert_close(told.input, batch.input)  # in the same order
    for loader in (quiet.val_dataloader(), quiet.test_dataloader()):
        assert all(batch.truth is not None for batch in loader)


def test_a_pair_is_posed_and_its_mask_is_right() -> None:
    views = Walls().views(7, 2, (8, 12))
    batch = pair_of(views, 0, 1)
    point = torch.tensor([0.3, -0.2, 4.0, 1.0])
    torch.testing.assert_close(
        batch.input_to_target[0] @ views.world_to_camera[0] @ point, views.world_to_camera[1] @ point
    )
    assert batch.truth is not None
    # the wall moves by 8 * 0.5 / 4 = 1 pixel to the right: the target's first column was not in the input
    assert not batch.truth.visible[..., 0].any()
    assert batch.truth.visible[..., 1:].all()
    assert pair_of(views, 0, 1, with_truth=False).truth is None


def test_what_is_kept_is_what_was_made_and_is_not_made_again(tmp_path: Path) -> None:
    world = Walls()
    first = data(world, cache=tmp_path)
    made = len(world.seeds)
    assert made == 7
    again = data(world, cache=tmp_path)
    assert len(world.seeds) == made
    for one, other in zip(first.splits.test, again.splits.test, strict=False):
        torch.testing.assert_close(one.input, other.input, atol=0, rtol=0)
        assert one.truth is not None
        assert other.truth is not None
        torch.testing.assert_close(one.truth.depth, other.truth.depth)
    data(world, cache=tmp_path, counts=(4, 2, 2))
    assert len(world.seeds) == made + 1  # the new place alone
    for changed in ({"image_size": [8, 8]}, {"scenes_seed": 3}):
        before = len(world.seeds)
        data(world, cache=tmp_path, **changed)
        assert len(world.seeds) == before + 7
    edited = Walls(edition=2)
    data(edited, cache=tmp_path)
    assert len(edited.seeds) == 7


def test_a_broken_file_is_made_anew(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    world = Walls()
    data(world, cache=tmp_path)
    broken = sorted(tmp_path.rglob("*.safetensors"))[0]
    broken.write_bytes(broken.read_bytes()[:100])
    data(world, cache=tmp_path)
    assert len(world.seeds) == 8
    assert "made anew" in caplog.text


def test_the_order_follows_from_the_seed_and_resumes() -> None:
    def greys(seed: int) -> list[float]:
        return [float(b.input.sum()) for b in data(Walls(), seed=seed).train_dataloader()]

    assert greys(0) == greys(0) != greys(1)
    loader = data(Walls()).train_dataloader()
    whole = [float(b.input.sum()) for b in loader]
    assert len(whole) == len(loader) == 4  # 18 pairs in batches of 4, the rest left out
    half = data(Walls()).train_dataloader()
    list(itertools.islice(half, 2))
    resumed = data(Walls()).train_dataloader()
    resumed.load_state_dict(half.state_dict())
    assert [float(b.input.sum()) for b in resumed] == whole[2:]


def test_a_street_makes_pairs_that_agree_with_themselves() -> None:
    views = StreetWorld().views(5, 2, (32, 32))
    batch = joined([pair_of(views, 0, 1), pair_of(views, 1, 0)])
    assert isinstance(batch, PairBatch)
    both = batch.input_to_target[0] @ batch.input_to_target[1]
    torch.testing.assert_close(both, torch.eye(4), atol=1e-5, rtol=0)
    assert torch.equal(batch.input[0], batch.target[1])
    assert batch.truth is not None
    shares = batch.truth.visible.float().mean((1, 2, 3))
    assert 0.3 < float(shares.min()) <= float(shares.max()) < 1


def test_no_places_to_evaluate() -> None:
    empty = data(Walls(), counts=(2, 0, 0))
    assert len(empty.val_dataloader()) == len(empty.test_dataloader()) == 0
    assert len(ViewPairs([])) == 0
    with pytest.raises(ValueError, match="no pairs to join"):
        joined([])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"image_size": [8, 8, 8]}, "image_size must be one side or"),
        ({"image_size": 4}, "image_size must be one side or"),
        ({"counts": (1, 1)}, "counts are three"),
        ({"counts": (0, 1, 1)}, "counts are three"),
        ({"views_per_scene": 1}, "data.views_per_scene"),
        ({"scenes_seed": -1}, "data.scenes_seed"),
        ({"batch_size": 0}, "data.batch_size"),
        ({"num_workers": -1}, "data.num_workers"),
    ],
)
def test_impossible_settings(settings: dict, message: str) -> None:
    with pytest.raises(UserError, match=message):
        data(Walls(), **settings)


def test_more_pairs_in_a_batch_than_there_are() -> None:
    with pytest.raises(UserError, match="batch_size=50 is more than the 18 training pairs"):
        data(Walls(), batch_size=50).train_dataloader()
