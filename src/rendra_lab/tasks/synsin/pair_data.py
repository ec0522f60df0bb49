"""Pairs of pictures as batches: what generated worlds and folders of photographs have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from rendra_lab.data.epochs import Samples, ShuffledEpochs
from rendra_lab.data.shares import Share, ShareSampler
from rendra_lab.errors import UserError
from rendra_lab.settings import Count, Positive, check_numbers
from rendra_lab.tasks.synsin.records import PairBatch, PairTruth


@dataclass(frozen=True)
class PairSplits:
    """Pairs by their numbers, each a batch of one, in three parts that share no place."""

    train: Samples[PairBatch]
    val: Samples[PairBatch]
    test: Samples[PairBatch]


class PairData(LightningDataModule, ABC):
    """Pairs of pictures; subclasses say where they come from.

    Several processes divide training batches and validation pairs among them; each of them sees the whole test.

    Args:
        batch_size: pairs of a training step, of all processes together.
        eval_batch_size: pairs of a batch in validation and test; None: as in training.
        num_workers: processes that load training pairs ahead.
        truth_in_training: give training what only evaluation should know: for upper bounds.
        seed: of the order of training pairs and of what they draw.

    Raises:
        UserError: an impossible number.
    """

    is_divisible = True
    splits: PairSplits

    def __init__(
        self,
        batch_size: Positive = 8,
        eval_batch_size: Positive | None = None,
        num_workers: Count = 0,
        truth_in_training: bool = False,
        seed: Count = 0,
    ) -> None:
        super().__init__()
        check_numbers("data", Positive, batch_size=batch_size)
        check_numbers("data", Positive | None, eval_batch_size=eval_batch_size)
        check_numbers("data", Count, num_workers=num_workers, seed=seed)
        self.batch_size = batch_size
        self.eval_batch_size = batch_size if eval_batch_size is None else eval_batch_size
        self.num_workers = num_workers
        self.truth_in_training = truth_in_training
        self.seed = seed

    @abstractmethod
    def load(self) -> PairSplits:
        """All pairs; UserError says what is wrong with where they come from."""

    def typical_depth(self) -> float | None:
        """The median depth (metres) of what training pictures show, for comparisons; None where nobody knows it."""
        return None

    def setup(self, stage: str) -> None:
        """Lightning's hook, before the fit and again before the test: loads the pairs, once."""
        if not hasattr(self, "splits"):
            self.splits = self.load()

    def train_dataloader(self) -> ShuffledEpochs[PairBatch]:
        """Shuffled training pairs, without their truth unless it is asked for."""
        pairs = self.splits.train
        if len(pairs) < self.batch_size:
            raise UserError(
                f"data.batch_size={self.batch_size} is more than the {len(pairs)} training pairs that there are"
            )
        return ShuffledEpochs(
            pairs if self.truth_in_training else WithoutTruth(pairs),
            self.batch_size,
            seed=self.seed,
            collate=joined,
            drop_last=True,
            num_workers=self.num_workers,
        )

    def val_dataloader(self) -> Sequence[PairBatch] | DataLoader[PairBatch]:
        """Validation pairs in their order, a share of them in each process."""
        pairs = self.splits.val
        return self._in_order(pairs, Share.of(self).whole_if_few(len(pairs)))

    def test_dataloader(self) -> Sequence[PairBatch] | DataLoader[PairBatch]:
        """All test pairs in their order."""
        return self._in_order(self.splits.test, Share())

    def _in_order(self, pairs: Samples[PairBatch], share: Share) -> Sequence[PairBatch] | DataLoader[PairBatch]:
        if len(pairs) == 0:
            return []
        return DataLoader(
            _AsDataset(pairs),
            self.eval_batch_size,
            sampler=ShareSampler(len(pairs), share),
            collate_fn=joined,
            generator=torch.Generator(),  # loaders draw a seed for workers: not from the fit's stream
        )


class WithoutTruth:
    """The same pairs as somebody sees them who has cameras alone."""

    def __init__(self, pairs: Samples[PairBatch]) -> None:
        self.pairs = pairs

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> PairBatch:
        return replace(self.pairs[index], truth=None)


class _AsDataset(Dataset[PairBatch]):
    def __init__(self, pairs: Samples[PairBatch]) -> None:
        self.pairs = pairs

    def __getitem__(self, index: int) -> PairBatch:
        return self.pairs[index]


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
