"""Pairs of frames out of folders: which frames make a pair, and the data module that all such folders share."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from rendra_lab.errors import UserError
from rendra_lab.settings import Amount, Positive, Size, check_numbers
from rendra_lab.tasks.synsin.frames import Film, Frame, PictureReader
from rendra_lab.tasks.synsin.pair_data import PairData, PairSplits
from rendra_lab.tasks.synsin.records import PairBatch

log = logging.getLogger(__name__)

FramePair = tuple[Frame, Frame]
"""The input and the target."""


class PairChoice(ABC):
    """Pairs to draw from; what is drawn follows from the index and the random numbers alone."""

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def draw(self, index: int, rng: np.random.Generator) -> FramePair:
        """One of the pairs that an index stands for."""


@dataclass(frozen=True)
class Nearness:
    """When two frames of a film make a pair: when all that is given holds.

    Attributes:
        max_offset: frames that they may lie apart in the film.
        max_turn_deg: degrees that the one camera may be turned against the other.
        max_move: units of the poses that they may stand apart.
    """

    max_offset: int | None = None
    max_turn_deg: float | None = None
    max_move: float | None = None

    def partners(self, film: Film, index: int) -> npt.NDArray[np.int64]:
        """The frames (M,) that make a pair with one, in their order; never itself."""
        reach = len(film) if self.max_offset is None else self.max_offset
        others = np.arange(max(0, index - reach), min(len(film), index + reach + 1))
        others = others[others != index]
        if self.max_turn_deg is not None:
            others = others[film.turns_deg(index, others) <= self.max_turn_deg]
        if self.max_move is not None:
            others = others[film.moves(index, others) <= self.max_move]
        return others

    def __str__(self) -> str:
        given = {name: value for name, value in vars(self).items() if value is not None}
        return ", ".join(f"data.{name}={value:g}" for name, value in given.items())


class NearFrames(PairChoice):
    """Every frame that has a partner, once, with one of its partners.

    Args:
        films: to choose from; pairs stay within one.
        nearness: what makes a partner.
        kept_away: (film, frame) that must not be in any pair.
    """

    def __init__(
        self, films: Sequence[Film], nearness: Nearness, kept_away: Collection[tuple[int, int]] = ()
    ) -> None:
        self.films = films
        self.nearness = nearness
        self.kept_away = frozenset(kept_away)
        self.inputs = [
            (number, frame)
            for number, film in enumerate(films)
            for frame in range(len(film))
            if (number, frame) not in self.kept_away and len(self._partners(number, frame)) > 0
        ]

    def __len__(self) -> int:
        return len(self.inputs)

    def draw(self, index: int, rng: np.random.Generator) -> FramePair:
        """The frame of that index, and any of its partners."""
        number, first = self.inputs[index]
        second = int(rng.choice(self._partners(number, first)))
        film = self.films[number]
        return film.frame(first), film.frame(second)

    def _partners(self, number: int, frame: int) -> npt.NDArray[np.int64]:
        found = self.nearness.partners(self.films[number], frame)
        if not self.kept_away:
            return found
        return np.array([other for other in found.tolist() if (number, other) not in self.kept_away], np.int64)


def fixed_pairs(choice: PairChoice, most: int, seed: int) -> list[FramePair]:
    """Pairs spread evenly over all that can be drawn, the same ones for the same seed; at most one an index."""
    total = min(most, len(choice))
    return [
        choice.draw(number * len(choice) // total, np.random.default_rng([seed, number])) for number in range(total)
    ]


@dataclass(frozen=True)
class FoundPairs:
    """All pairs of a folder, divided."""

    train: PairChoice
    val: Sequence[FramePair]
    test: Sequence[FramePair]


class PairFolders(PairData):
    """Pairs out of folders; subclasses know the format and say which frames make pairs.

    Setup reads cameras; pictures are read when their turn comes. In training an input's partner is drawn anew each
    time, by the sample's own random numbers. Validation and test are lists that the seed fixes.

    Args:
        image_size: pixels of a side of the square that pictures are brought to, or [height,width].
        fit: how they are brought there, see PictureReader.
        val_pairs, test_pairs: how many at most, spread evenly over what is held out.
        scale: metres of a unit of the poses: what depths are measured in.
        kept_mb: memory for pictures that were read, so that small sets are decoded once; each worker has its own.
        **loading: see PairData.

    Raises:
        UserError: settings that cannot be.
    """

    def __init__(
        self,
        image_size: int | Sequence[int] = 256,
        fit: str = "squeeze",
        val_pairs: Positive = 64,
        test_pairs: Positive = 512,
        scale: Size = 1.0,
        kept_mb: Amount = 512.0,
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        if self.truth_in_training:
            raise UserError("data.truth_in_training=true: nobody knows the depth of pictures in folders")
        check_numbers("data", Positive, val_pairs=val_pairs, test_pairs=test_pairs)
        check_numbers("data", Size, scale=scale)
        check_numbers("data", Amount, kept_mb=kept_mb)
        height, width = _size(image_size)
        kept = int(kept_mb * 2**20 / (3 * height * width))
        self.reader = PictureReader((height, width), fit, kept, scale)
        self.val_pairs = val_pairs
        self.test_pairs = test_pairs

    @abstractmethod
    def find(self) -> FoundPairs:
        """What to train on and what is held out; UserError names the file and what is wrong with it."""

    def load(self) -> PairSplits:
        """The pairs by their numbers; nothing is read of the pictures."""
        found = self.find()
        log.info(
            "%s training samples, %s validation and %s test pairs",
            f"{len(found.train):,}",
            f"{len(found.val):,}",
            f"{len(found.test):,}",
        )
        return PairSplits(
            train=DrawnPairs(found.train, self.reader),
            val=ListedPairs(found.val, self.reader),
            test=ListedPairs(found.test, self.reader),
        )


class DrawnPairs:
    """Batches of one; what is drawn follows from torch's stream as the sample finds it."""

    def __init__(self, choice: PairChoice, reader: PictureReader) -> None:
        self.choice = choice
        self.reader = reader

    def __len__(self) -> int:
        return len(self.choice)

    def __getitem__(self, index: int) -> PairBatch:
        rng = np.random.default_rng(int(torch.randint(2**62, ())))
        return self.reader.pair(*self.choice.draw(index, rng))


class ListedPairs:
    """Batches of one, always the same."""

    def __init__(self, pairs: Sequence[FramePair], reader: PictureReader) -> None:
        self.pairs = pairs
        self.reader = reader

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> PairBatch:
        return self.reader.pair(*self.pairs[index])


def _size(image_size: Any) -> tuple[int, int]:
    sides = [image_size] * 2 if isinstance(image_size, int) else list(image_size)
    if len(sides) != 2 or not all(isinstance(side, int) and 1 <= side <= 8192 for side in sides):
        raise UserError(f"data.image_size must be one side or [height,width], 1 to 8192 pixels, got {image_size!r}")
    return sides[0], sides[1]
