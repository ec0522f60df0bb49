"""Unposed pictures as batches: what generated worlds and folders of photographs have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from rendra_lab.data.epochs import Samples
from rendra_lab.data.sample_data import SampleData, SampleSplits
from rendra_lab.tasks.giraffe.records import PictureBatch, PictureTruth

PictureSplits = SampleSplits[PictureBatch]


class PictureData(SampleData[PictureBatch]):
    """Pictures of a collection; subclasses say where they come from. Training never sees what is true of them."""

    what = "pictures"

    def for_training(self, samples: Samples[PictureBatch]) -> Samples[PictureBatch]:
        """Without their truth."""
        return WithoutTruth(samples)

    @staticmethod
    def joined(batches: Sequence[PictureBatch]) -> PictureBatch:
        """See `joined`."""
        return joined(batches)


class WithoutTruth:
    """The same pictures as somebody sees them who knows nothing of what they show."""

    def __init__(self, pictures: Samples[PictureBatch]) -> None:
        self.pictures = pictures

    def __len__(self) -> int:
        return len(self.pictures)

    def __getitem__(self, index: int) -> PictureBatch:
        return replace(self.pictures[index], truth=None)


def joined(batches: Sequence[PictureBatch]) -> PictureBatch:
    """One batch of all pictures of some batches; with truth if all of them have it.

    Raises:
        ValueError: no batches.
    """
    if not batches:
        raise ValueError("no pictures to join")
    truths = [batch.truth for batch in batches if batch.truth is not None]
    truth = {name: torch.cat([getattr(each, name) for each in truths]) for name in PictureTruth.names() if truths}
    return PictureBatch(
        rgb=torch.cat([batch.rgb for batch in batches]),
        truth=PictureTruth(**truth) if len(truths) == len(batches) else None,
    )
