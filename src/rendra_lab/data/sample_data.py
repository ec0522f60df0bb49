"""Samples by their numbers as batches: the loaders of all data sets whose samples are batches of one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader, Dataset

from rendra_lab.data.epochs import Samples, ShuffledEpochs
from rendra_lab.data.shares import Share, ShareSampler
from rendra_lab.errors import UserError
from rendra_lab.settings import Count, Positive, check_numbers

BatchT = TypeVar("BatchT")


@dataclass(frozen=True)
class SampleSplits(Generic[BatchT]):
    """Samples by their numbers, each a batch of one, in three parts."""

    train: Samples[BatchT]
    val: Samples[BatchT]
    test: Samples[BatchT]


class SampleData(LightningDataModule, ABC, Generic[BatchT]):
    """Samples in three parts; subclasses say where they come from and how they are joined.

    Several processes divide training batches and validation samples among them; each of them sees the whole test.

    Args:
        batch_size: samples of a training step, of all processes together.
        eval_batch_size: samples of a batch in validation and test; None: as in training.
        num_workers: processes that load training samples ahead.
        seed: of the order of training samples and of what they draw.

    Raises:
        UserError: an impossible number.
    """

    is_divisible = True
    what: ClassVar[str] = "samples"  # they are called in complaints
    splits: SampleSplits[BatchT]

    def __init__(
        self,
        batch_size: Positive = 8,
        eval_batch_size: Positive | None = None,
        num_workers: Count = 0,
        seed: Count = 0,
    ) -> None:
        super().__init__()
        check_numbers("data", Positive, batch_size=batch_size)
        check_numbers("data", Positive | None, eval_batch_size=eval_batch_size)
        check_numbers("data", Count, num_workers=num_workers, seed=seed)
        self.batch_size = batch_size
        self.eval_batch_size = batch_size if eval_batch_size is None else eval_batch_size
        self.num_workers = num_workers
        self.seed = seed

    @abstractmethod
    def load(self) -> SampleSplits[BatchT]:
        """All samples; UserError says what is wrong with where they come from."""

    @staticmethod
    @abstractmethod
    def joined(batches: Sequence[Any]) -> Any:
        """One batch of all samples of some batches."""

    def for_training(self, samples: Samples[BatchT]) -> Samples[BatchT]:
        """The training samples as the fit sees them."""
        return samples

    def setup(self, stage: str) -> None:
        """Lightning's hook, before the fit and again before the test: loads the samples, once."""
        if not hasattr(self, "splits"):
            self.splits = self.load()

    def train_dataloader(self) -> ShuffledEpochs[BatchT]:
        """Shuffled training samples."""
        samples = self.splits.train
        count = len(samples)
        if count < self.batch_size:
            raise UserError(
                f"data.batch_size={self.batch_size} is more than the {count} training {self.what} that there are"
            )
        return ShuffledEpochs(
            self.for_training(samples),
            self.batch_size,
            seed=self.seed,
            collate=self.joined,
            drop_last=True,
            num_workers=self.num_workers,
        )

    def val_dataloader(self) -> Sequence[BatchT] | DataLoader[BatchT]:
        """Validation samples in their order, a share of them in each process."""
        samples = self.splits.val
        return self._in_order(samples, Share.of(self).whole_if_few(len(samples)))

    def test_dataloader(self) -> Sequence[BatchT] | DataLoader[BatchT]:
        """All test samples in their order."""
        return self._in_order(self.splits.test, Share())

    def _in_order(self, samples: Samples[BatchT], share: Share) -> Sequence[BatchT] | DataLoader[BatchT]:
        if len(samples) == 0:
            return []
        return DataLoader(
            _AsDataset(samples),
            self.eval_batch_size,
            sampler=ShareSampler(len(samples), share),
            collate_fn=self.joined,
            generator=torch.Generator(),  # loaders draw a seed for workers: not from the fit's stream
        )


class _AsDataset(Dataset[Any]):
    def __init__(self, samples: Samples[Any]) -> None:
        self.samples = samples

    def __getitem__(self, index: int) -> Any:
        return self.samples[index]
