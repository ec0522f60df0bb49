"""Batches that follow from the number of their step alone, which a resumed run takes up where it was."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Generic, TypeVar

BatchT = TypeVar("BatchT")


class StepByStep(ABC, Generic[BatchT]):
    """Yields the batches of a fit, one a step; each pass is an epoch, and goes on where the one before has ended."""

    _given = 0

    @abstractmethod
    def __len__(self) -> int:
        """Steps of an epoch."""

    @abstractmethod
    def batch_of(self, step: int) -> BatchT:
        """What a step gets; steps are counted from 0 through all epochs."""

    def __iter__(self) -> Iterator[BatchT]:
        for _ in range(len(self)):
            self._given += 1
            yield self.batch_of(self._given - 1)

    def state_dict(self) -> dict[str, int]:
        """How many batches were given; Lightning keeps it in checkpoints."""
        return {"given": self._given}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Lets the next pass go on where a checkpoint was written; Lightning ends it where the epoch ends."""
        self._given = state["given"]


class Repeated(StepByStep[BatchT]):
    """Yields the same batch a fixed number of times: the data loader of a fit to a single observation.

    Args:
        batch: what every step gets.
        times: steps an epoch, at least 1. An epoch costs some milliseconds: let it last the whole fit.
    """

    def __init__(self, batch: BatchT, times: int = 1) -> None:
        if times < 1:
            raise ValueError(f"a batch is repeated at least once, got times={times}")
        self.batch = batch
        self.times = times

    def __len__(self) -> int:
        return self.times

    def batch_of(self, step: int) -> BatchT:
        """The batch."""
        return self.batch
