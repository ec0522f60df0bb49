"""Pairs of views of generated places, whose depth is known."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from torch import Tensor

from rendra_lab.data.announced import announced
from rendra_lab.data.kept_tensors import Tensors, fingerprint, kept_or_made
from rendra_lab.errors import UserError
from rendra_lab.settings import Count, Range, check_numbers
from rendra_lab.synthesis.posed_views import PosedViews, World, seen_by
from rendra_lab.tasks.synsin.pair_data import PairData, PairSplits
from rendra_lab.tasks.synsin.records import PairBatch, PairTruth

_SPLITS = ("train", "val", "test")

_Views = Annotated[int, Range(2, 64)]


class GeneratedPairs(PairData):
    """Places that nobody has seen before, in each some views: pairs of one place.

    A place belongs to one split alone, and keeps its views when there are more or fewer of the others.

    Args:
        world: makes the places.
        image_size: side of square pictures, or [height, width], pixels.
        counts: places in training, validation and test.
        views_per_scene: of a training place; each ordered pair of them is a sample. Places of validation and test
            have two views, which are one pair.
        cache: folder of rendered views; null renders them every time.
        scenes_seed: of the places.
        **loading: settings of `PairData`.

    Raises:
        UserError: an impossible setting.
    """

    def __init__(
        self,
        world: World,
        image_size: int | Sequence[int] = 128,
        counts: Sequence[int] = (400, 24, 60),
        views_per_scene: _Views = 3,
        cache: str | Path | None = None,
        scenes_seed: Count = 0,
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        size = [image_size] * 2 if isinstance(image_size, int) else list(image_size)
        if len(size) != 2 or not all(isinstance(side, int) and 8 <= side <= 4096 for side in size):
            raise UserError(
                f"data.image_size must be one side or [height,width], 8 to 4096 pixels, got {image_size!r}"
            )
        if len(counts) != 3 or not all(isinstance(count, int) and count >= 0 for count in counts) or counts[0] < 1:
            raise UserError(
                f"data.counts are three: places in training (at least 1), validation and test; got {list(counts)}"
            )
        check_numbers("data", _Views, views_per_scene=views_per_scene)
        check_numbers("data", Count, scenes_seed=scenes_seed)
        self.world = world
        self.size = (size[0], size[1])
        self.counts = dict(zip(_SPLITS, counts, strict=True))
        self.views_per_scene = views_per_scene
        self.cache = None if cache is None else Path(cache)
        self.scenes_seed = scenes_seed

    def prepare_data(self) -> None:
        """Lightning's hook, in one process of each machine: renders what the cache lacks."""
        if self.cache is not None:
            self.setup("fit")

    def load(self) -> PairSplits:
        """All places, rendered or from the cache."""
        total = sum(self.counts.values())
        made = (self._views(split, i) for split in _SPLITS for i in range(self.counts[split]))
        places = announced(made, total, "generated places")
        parts = {split: list(itertools.islice(places, self.counts[split])) for split in _SPLITS}
        return PairSplits(
            train=ViewPairs(parts["train"], with_truth=self.truth_in_training),
            val=ViewPairs(parts["val"], both_ways=False),
            test=ViewPairs(parts["test"], both_ways=False),
        )

    def typical_depth(self) -> float | None:
        """The median over training places of the median depth of what they show, but sky; None if all is sky."""
        self.setup("test")
        train = self.splits.train
        assert isinstance(train, ViewPairs)
        seen = (place.depth[place.depth.isfinite()] for place in train.places)
        medians = [float(depth.median()) for depth in seen if len(depth)]
        return float(np.median(medians)) if medians else None

    def place_seed(self, split: str, index: int) -> int:
        """Of a place, by its number within its split; no other place has it."""
        key = [self.scenes_seed, _SPLITS.index(split), index]
        return int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0] >> np.uint64(1))

    def _views(self, split: str, index: int) -> PosedViews:
        seed, count = self.place_seed(split, index), self.views_per_scene if split == "train" else 2
        if self.cache is None:
            return self.world.views(seed, count, self.size)
        path = self.cache / f"places_{self._fingerprint(count)}" / f"{seed:016x}.safetensors"
        kept = kept_or_made(path, "views", lambda: _packed(self.world.views(seed, count, self.size)))
        return PosedViews(**{**kept, "depth": kept["depth"].float()})

    def _fingerprint(self, count: int) -> str:
        """16 hexadecimal digits that stand for everything but the seed that determines the views of a place."""
        made_by = (type(self.world).__qualname__, self.world.settings(), self.size, count)
        return fingerprint(made_by)


class ViewPairs:
    """Pairs of views of places, as batches of one.

    Args:
        places: all with as many views of the same size.
        both_ways: every ordered pair of the views of a place; else the first view and the second alone.
        with_truth: give depth and visibility too.
    """

    def __init__(self, places: Sequence[PosedViews], both_ways: bool = True, with_truth: bool = True) -> None:
        self.places = places
        self.with_truth = with_truth
        views = len(places[0].rgb) if places else 2
        self.pairs = list(itertools.permutations(range(views), 2)) if both_ways else [(0, 1)]

    def __len__(self) -> int:
        return len(self.places) * len(self.pairs)

    def __getitem__(self, index: int) -> PairBatch:
        if not 0 <= index < len(self):
            raise IndexError(f"there are {len(self)} pairs, asked for number {index}")
        place, pair = divmod(index, len(self.pairs))
        return pair_of(self.places[place], *self.pairs[pair], with_truth=self.with_truth)


def pair_of(views: PosedViews, first: int, second: int, with_truth: bool = True) -> PairBatch:
    """The pair, a batch of one, in which the second view is to be made of the first."""
    one, other = ({name: getattr(views, name)[[i]] for name in PosedViews.names()} for i in (first, second))
    input_to_target = (other["world_to_camera"].double() @ one["world_to_camera"].double().inverse()).float()
    truth = None
    if with_truth:
        back = input_to_target.double().inverse().float()
        visible = seen_by(other["depth"], other["intrinsics"], back, one["depth"], one["intrinsics"])
        truth = PairTruth(one["depth"], other["depth"], visible)
    return PairBatch(
        input=one["rgb"] / 255,
        target=other["rgb"] / 255,
        intrinsics=one["intrinsics"],
        target_intrinsics=other["intrinsics"],
        input_to_target=input_to_target,
        truth=truth,
    )


def _packed(views: PosedViews) -> Tensors:
    """What is kept of views: depth in half of the bits, to a part in 2000."""
    kept: dict[str, Tensor] = {name: getattr(views, name) for name in PosedViews.names()}
    return {**kept, "depth": views.depth.half()}
