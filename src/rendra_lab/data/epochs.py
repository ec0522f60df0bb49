"""Shuffled batches of a data set, which a resumed run takes up where a checkpoint was written."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from rendra_lab.errors import UserError
from rendra_lab.random_state import seeded

BatchT = TypeVar("BatchT")
SampleT_co = TypeVar("SampleT_co", covariant=True)

_ORDER, _SAMPLE = 0, 1  # what a stream of random numbers is for


@runtime_checkable
class Samples(Protocol[SampleT_co]):
    """Samples by their numbers; they may draw from Python's, NumPy's and torch's global streams."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> SampleT_co: ...


class ShuffledEpochs(Generic[BatchT]):
    """Every sample once an epoch, in an order that follows from seed and epoch alone.

    The random numbers that a sample draws follow from seed, epoch and sample: neither the number of workers nor that
    of processes changes them, and they leave the streams of the fit alone. With several processes each gets its share
    of every batch, and an epoch whose last batch cannot be shared begins anew for the samples that lack.

    Lightning keeps the position in checkpoints (`state_dict`), so that a resumed run goes on with the next batch.

    Args:
        samples: to take batches of; workers get a copy.
        batch_size: samples of a step, of all processes together.
        seed: of the order and the samples' random numbers, at least 0.
        collate: makes a batch of a list of samples; None stacks tensors as torch does.
        shuffle: False keeps the order of the samples.
        drop_last: leave out the last batch of an epoch where it is smaller.
        num_workers: processes that load ahead; 0 loads in the process of the fit.
        pin_memory: for a faster way to a GPU.

    Raises:
        UserError: numbers that cannot be; no samples; processes that cannot share a batch evenly.
    """

    def __init__(
        self,
        samples: Samples[Any],
        batch_size: int,
        *,
        seed: int = 0,
        collate: Callable[[list[Any]], BatchT] | None = None,
        shuffle: bool = True,
        drop_last: bool = False,
        num_workers: int = 0,
        pin_memory: bool = False,
    ) -> None:
        if batch_size < 1 or num_workers < 0 or seed < 0:
            raise UserError(
                "batch_size must be at least 1, num_workers and seed at least 0, "
                f"got batch_size={batch_size}, num_workers={num_workers}, seed={seed}"
            )
        if len(samples) == 0 or (drop_last and len(samples) < batch_size):
            raise UserError(f"{len(samples)} samples make no batch of {batch_size}")
        self.samples = samples
        self.batch_size = batch_size
        self.seed = seed
        self.shuffle = shuffle
        self.drop_last = drop_last
        self._epoch = 0
        self._position = 0  # samples of the epoch that the fit has had
        self._is_resumed = False
        self._keys: list[list[tuple[int, int]]] = []
        self._loader: DataLoader[Any] = DataLoader(
            _Seeded(samples, seed),
            batch_sampler=self._keys,  # filled anew for each pass
            collate_fn=collate,
            num_workers=num_workers,
            persistent_workers=num_workers > 0,
            pin_memory=pin_memory,
            # forked workers would inherit locks of the kernels' threads
            multiprocessing_context=("spawn" if sys.platform == "win32" else "forkserver") if num_workers else None,
            generator=torch.Generator(),  # for the seed of workers that need none: not drawn from the fit's stream
        )

    def __len__(self) -> int:
        """Batches of an epoch."""
        whole, rest = divmod(len(self.samples), self.batch_size)
        return whole + (rest > 0 and not self.drop_last)

    def __iter__(self) -> Iterator[BatchT]:
        if not self._is_resumed and self._position:
            self._begin_next()
        self._is_resumed = False
        self._keys[:] = self._shares()
        for batch in self._loader:
            self._position += self.batch_size
            yield batch

    def state_dict(self) -> dict[str, int]:
        """Where the fit is: the epoch, and how many of its samples it has had."""
        return {"epoch": self._epoch, "position": self._position}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Lets the next pass be the rest of one that a checkpoint interrupted."""
        self._epoch, self._position, self._is_resumed = state["epoch"], state["position"], True
        if self._position >= len(self) * self.batch_size:
            self._begin_next()

    def order(self, epoch: int) -> list[int]:
        """The samples of an epoch in the order in which they come."""
        if not self.shuffle:
            return list(range(len(self.samples)))
        bits = np.random.SeedSequence([_ORDER, self.seed, epoch])
        return np.random.default_rng(bits).permutation(len(self.samples)).tolist()

    def _begin_next(self) -> None:
        self._epoch, self._position = self._epoch + 1, 0

    def _shares(self) -> list[list[tuple[int, int]]]:
        """What this process gets of each batch that is left of the epoch: pairs of epoch and sample."""
        rank, processes = _place()
        if self.batch_size % processes:
            raise UserError(f"batch_size={self.batch_size} cannot be shared evenly by {processes} processes")
        order = self.order(self._epoch)
        end = len(self) * self.batch_size if self.drop_last else len(order)
        batches = [order[i : min(i + self.batch_size, end)] for i in range(self._position, end, self.batch_size)]
        return [
            [(self._epoch, index) for index in _evenly(batch, order, processes)[rank::processes]] for batch in batches
        ]


class _Seeded(Dataset[Any]):
    """Samples by epoch and number; what they draw follows from both."""

    def __init__(self, samples: Samples[Any], seed: int) -> None:
        self.samples = samples
        self.seed = seed

    def __getitem__(self, key: tuple[int, int]) -> Any:
        epoch, index = key
        with seeded(_SAMPLE, self.seed, epoch, index):
            return self.samples[index]


def _place() -> tuple[int, int]:
    """The number of this process, and how many there are."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1


def _evenly(batch: Sequence[int], order: Sequence[int], processes: int) -> list[int]:
    """A batch, filled up with the first samples of the epoch until every process gets as many."""
    lacking = -len(batch) % processes
    return [*batch, *(order[i % len(order)] for i in range(lacking))]
