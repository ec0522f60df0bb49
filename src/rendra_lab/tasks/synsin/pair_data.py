"""Pairs of pictures as batches: what generated worlds and folders of photographs have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from rendra_lab.data.epochs import Samples
from rendra_lab.data.sample_data import SampleData, SampleSplits
from rendra_lab.tasks.synsin.records import PairBatch, PairTruth

PairSplits = SampleSplits[PairBatch]  # that share no place


class PairData(SampleData[PairBatch]):
    """Pairs of pictures; subclasses say where they come from.

    Args:
        truth_in_training: give training what only evaluation should know: for upper bounds.
        **loading: settings of `SampleData`.
    """

    what = "pairs"

    def __init__(self, truth_in_training: bool = False, **loading: Any) -> None:
        super().__init__(**loading)
        self.truth_in_training = truth_in_training

    def typical_depth(self) -> float | None:
        """The median depth (metres) of what training pictures show, for comparisons; None where nobody knows it."""
        return None

    def for_training(self, samples: Samples[PairBatch]) -> Samples[PairBatch]:
        """Without their truth unless it is asked for."""
        return samples if self.truth_in_training else WithoutTruth(samples)

    @staticmethod
    def joined(batches: Sequence[PairBatch]) -> PairBatch:
        """See `joined`."""
        return joined(batches)


class WithoutTruth:
    """The same pairs as somebody sees them who has cameras alone."""

    def __init__(self, pairs: Samples[PairBatch]) -> None:
        self.pairs = pairs

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> PairBatch:
        return replace(self.pairs[index], truth=None)


def joined(batches: Sequence[PairBatch]) -> PairBatch:
    """One batch of all pairs of some batches; with truth if the first has it.

    Raises:
        ValueError: no batches.
    """
    if not batches:
        raise ValueError("no pairs to join")

    def column(name: str) -> Tensor:
        return torch.cat([getattr(batch, name) for batch in batches])

    tensors = {name: column(name) for name in PairBatch.names() if name != "truth"}
    truths = [batch.truth for batch in batches if batch.truth is not None]
    truth = {name: torch.cat([getattr(truth, name) for truth in truths]) for name in PairTruth.names() if truths}
    return PairBatch(**tensors, truth=PairTruth(**truth) if truth else None)
