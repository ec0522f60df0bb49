"""Pictures of any folder: what a user has of CelebA, Cars, FFHQ, LSUN, or of anything else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch

from rendra_lab import report
from rendra_lab.data.square_pictures import Framing, OnBroken, PictureReader, find_pictures
from rendra_lab.errors import UserError
from rendra_lab.random_state import seeded
from rendra_lab.settings import Amount, Count, Fraction, Positive, Range, check_numbers
from rendra_lab.tasks.giraffe.picture_data import PictureData, PictureSplits
from rendra_lab.tasks.giraffe.records import PictureBatch

_Side = Annotated[int, Range(8, 1024)]


class ImageFolder(PictureData):
    """Pictures in files, read when a step asks for them; nobody knows what is true of them.

    As published, scores compare with pictures of training, which are cropped and flipped as there: `hold_out` above 0
    keeps others for them.

    Args:
        path: a folder with all that is in it, a pattern such as `photos/**/*.jpg`, or a list of these.
        image_size: S, pixels.
        crop: pixels of the file along the sides of the square that is taken; None: the largest square.
        random_crop: the square lies anywhere in the picture; else in its middle.
        flip: show every other picture in a mirror.
        behind: grey in [0, 1] behind what is transparent.
        on_broken: `stop` at a picture that cannot be read, or `skip` it; either names it.
        hold_out: share of the pictures that training does not see.
        val_pictures: that validation takes, of those that are held out if any are.
        test_pictures: that the test takes, of the same, those of validation first.
        kept_mb: memory for pictures that were read, unless cropped at random; each worker has its own.
        **loading: settings of `SampleData`.

    Raises:
        UserError: settings that cannot be.
    """

    splits: PictureSplits

    def __init__(
        self,
        path: str | Path | Sequence[str],
        image_size: _Side = 64,
        crop: Positive | None = None,
        random_crop: bool = False,
        flip: bool = True,
        behind: Fraction = 1.0,
        on_broken: OnBroken = "stop",
        hold_out: Fraction = 0.0,
        val_pictures: Count = 500,
        test_pictures: Count = 2000,
        kept_mb: Amount = 256.0,
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        check_numbers("data", _Side, image_size=image_size)
        check_numbers("data", Positive | None, crop=crop)
        check_numbers("data", Fraction, behind=behind, hold_out=hold_out)
        check_numbers("data", Count, val_pictures=val_pictures, test_pictures=test_pictures)
        check_numbers("data", Amount, kept_mb=kept_mb)
        self.path = path
        self.framing = Framing(image_size, crop, random_crop, behind)
        self.flip = flip
        self.on_broken = on_broken
        self.hold_out = hold_out
        self.val_pictures = val_pictures
        self.test_pictures = test_pictures
        self.kept = int(kept_mb * 2**20 / (3 * image_size**2))
        self._said = 0

    def load(self) -> PictureSplits:
        """Finds the pictures, and reads none."""
        paths = find_pictures(self.path)
        self.reader = PictureReader(paths, self.framing, self.on_broken, self.kept, shared=self.num_workers > 0)
        order = np.random.default_rng(self.seed).permutation(len(paths)).tolist()
        held = round(self.hold_out * len(order))
        if held == len(order):
            raise UserError(f"data.hold_out={self.hold_out:g} leaves none of the {held} pictures to training")
        rest = order[:held] or order
        return PictureSplits(
            train=FramedPictures(self.reader, sorted(order[held:]), self.flip),
            val=SettledPictures(FramedPictures(self.reader, rest[: self.val_pictures], self.flip), self.seed),
            test=SettledPictures(FramedPictures(self.reader, rest[: self.test_pictures], self.flip), self.seed),
        )

    def teardown(self, stage: str) -> None:
        """Lightning's hook, after the fit and after the test: says how many pictures were skipped."""
        broken = len(self.reader.broken) if hasattr(self, "reader") else 0
        if broken > self._said:
            report.say(f"{broken} of {len(self.reader.paths)} pictures could not be read and were skipped")
            self._said = broken


class FramedPictures:
    """Some of a reader's pictures, as batches of one; torch's global stream says where they are cut and if mirrored.

    In the place of a broken picture comes the next one that is whole.

    Args:
        reader: of all pictures.
        numbers: of those that are taken.
        flip: mirror every other one.
    """

    def __init__(self, reader: PictureReader, numbers: Sequence[int], flip: bool) -> None:
        self.reader = reader
        self.numbers = numbers
        self.flip = flip

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int) -> PictureBatch:
        if not 0 <= index < len(self):
            raise IndexError(f"there are {len(self)} pictures, asked for number {index}")
        for step in range(len(self)):
            pixels = self.reader.read(self.numbers[(index + step) % len(self)])
            if pixels is not None:
                mirror = self.flip and bool(torch.rand(()) < 0.5)
                return PictureBatch((pixels.flip(2) if mirror else pixels)[None] / 255)
        raise UserError(f"none of the {len(self)} pictures can be read; the first is {self._first()}")

    def _first(self) -> str:
        return self.reader.paths[self.numbers[0]]


class SettledPictures:
    """The same pictures, each cut and mirrored the same way whenever it is asked for.

    Args:
        pictures: that draw from torch's global stream.
        seed: of what they draw.
    """

    def __init__(self, pictures: FramedPictures, seed: int) -> None:
        self.pictures = pictures
        self.seed = seed

    def __len__(self) -> int:
        return len(self.pictures)

    def __getitem__(self, index: int) -> PictureBatch:
        with seeded(self.seed, index):
            return self.pictures[index]
