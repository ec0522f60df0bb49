"""Pictures of single objects as batches: what generated furniture and ShapeNet have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from rendra_lab.data.epochs import Samples, ShuffledEpochs
from rendra_lab.data.photo_data import joined_shapes
from rendra_lab.data.shares import Share, ShareSampler
from rendra_lab.errors import UserError
from rendra_lab.settings import Count, Positive, check_numbers
from rendra_lab.shape_records import ShapeBatch


@dataclass(frozen=True)
class ShapeSplits:
    """Pictures by their numbers, each a batch of one, in three parts that share no model."""

    train: Samples[ShapeBatch]
    val: Samples[ShapeBatch]
    test: Samples[ShapeBatch]


class ShapeData(LightningDataModule, ABC):
    """Pictures of one object each; subclasses say where they come from.

    Several processes divide training batches and validation pictures among them; each of them sees the whole test.

    Args:
        batch_size: pictures of a training step, of all processes together.
        eval_batch_size: pictures of a batch in validation and test; None: as in training.
        num_workers: processes that load training pictures ahead.
        seed: of the order of training pictures and of what they draw.

    Raises:
        UserError: an impossible number.
    """

    is_divisible = True
    classes: tuple[str, ...]  # by label: subclasses know them once they are set up
    splits: ShapeSplits

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
    def load(self) -> ShapeSplits:
        """All pictures; UserError says what is wrong with where they come from."""

    def setup(self, stage: str) -> None:
        """Lightning's hook, before the fit and again before the test: loads the pictures, once."""
        if not hasattr(self, "splits"):
            self.splits = self.load()

    def train_dataloader(self) -> ShuffledEpochs[ShapeBatch]:
        """Shuffled training pictures."""
        pictures = self.splits.train
        if len(pictures) < self.batch_size:
            raise UserError(
                f"data.batch_size={self.batch_size} is more than the {len(pictures)} training pictures that there are"
            )
        return ShuffledEpochs(
            pictures,
            self.batch_size,
            seed=self.seed,
            collate=joined,
            drop_last=True,
            num_workers=self.num_workers,
        )

    def val_dataloader(self) -> Sequence[ShapeBatch] | DataLoader[ShapeBatch]:
        """Validation pictures in their order, a share of them in each process."""
        pictures = self.splits.val
        return self._in_order(pictures, Share.of(self).whole_if_few(len(pictures)))

    def test_dataloader(self) -> Sequence[ShapeBatch] | DataLoader[ShapeBatch]:
        """All test pictures in their order."""
        return self._in_order(self.splits.test, Share())

    def _in_order(self, pictures: Samples[ShapeBatch], share: Share) -> Sequence[ShapeBatch] | DataLoader[ShapeBatch]:
        if len(pictures) == 0:
            return []
        return DataLoader(
            _AsDataset(pictures),
            self.eval_batch_size,
            sampler=ShareSampler(len(pictures), share),
            collate_fn=joined,
            generator=torch.Generator(),  # loaders draw a seed for workers: not from the fit's stream
        )


class _AsDataset(Dataset[ShapeBatch]):
    def __init__(self, pictures: Samples[ShapeBatch]) -> None:
        self.pictures = pictures

    def __getitem__(self, index: int) -> ShapeBatch:
        return self.pictures[index]


def joined(batches: Sequence[ShapeBatch]) -> ShapeBatch:
    """One batch of all pictures of some batches, whose pictures, points and grids have the same sizes.

    Raises:
        ValueError: no batches.
    """
    if not batches:
        raise ValueError("no pictures of shapes to join")

    def column(name: str) -> Tensor:
        return torch.cat([getattr(batch, name) for batch in batches])

    return ShapeBatch(
        rgb=column("rgb"),
        intrinsics=column("intrinsics"),
        depth_range=column("depth_range"),
        labels=column("labels"),
        shapes=joined_shapes([batch.shapes for batch in batches]),
        shape_ids=[name for batch in batches for name in batch.shape_ids],
    )
