"""How processes that fit together divide what they see. Random numbers follow the thing drawn, not the process."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from lightning.pytorch import LightningDataModule
from torch.utils.data import Sampler


@dataclass(frozen=True)
class Share:
    """Every `count`-th thing, from number `index` on: what one of `count` processes takes."""

    index: int = 0
    count: int = 1

    @staticmethod
    def of(data: LightningDataModule) -> Share:
        """That of this process in the run that the data belong to; all of it outside a run."""
        trainer = data.trainer
        return Share() if trainer is None else Share(trainer.global_rank, trainer.world_size)

    @property
    def rows(self) -> slice:
        """Of anything that can be sliced."""
        return slice(self.index, None, self.count)

    def whole_if_few(self, total: int) -> Share:
        """Itself; all of `total` things where some process would get none of them, as all must score something."""
        return self if total >= self.count else Share()


class ShareSampler(Sampler[int]):
    """The indices of one process: no index in two processes, none twice to make shares equal.

    For a `DataLoader`: Lightning's own sampler fills up shares, and then counts samples twice.

    Args:
        total: how many things there are.
        share: of this process.
        shuffle: in an order that follows from seed and epoch, the same in all processes.
        equal: leave out the last few, so that all processes make as many steps: for training. Else each thing is seen
            exactly once: for evaluation, whose steps need not agree.
        seed: of the order.
    """

    def __init__(self, total: int, share: Share, shuffle: bool = False, equal: bool = False, seed: int = 0) -> None:
        self.total = total - total % share.count if equal else total
        self.share = share
        self.shuffle = shuffle
        self.seed = seed
        self.epoch = 0
        self._all = total

    def set_epoch(self, epoch: int) -> None:
        """Lightning's hook: another order."""
        self.epoch = epoch

    def __len__(self) -> int:
        return len(range(self.total)[self.share.rows])

    def __iter__(self) -> Iterator[int]:
        order = np.arange(self._all)
        if self.shuffle:
            order = np.random.default_rng([self.seed, self.epoch]).permutation(self._all)
        return iter(order[: self.total][self.share.rows].tolist())
