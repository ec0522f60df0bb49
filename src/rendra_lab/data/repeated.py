"""Batches that follow from the number of their step alone, which a resumed run takes up where it was."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Generic, TypeVar

BatchT = TypeVar("BatchT")


class StepByStep(ABC, Generic[BatchT]):
    """Yields the batches of an epoch, one a step; the next pass yields the same."""

    _given = 0
    _resume_at = 0

    @abstractmethod
    def __len__(self) -> int:
        """Steps of an epoch."""

    @abstractmethod
    def batch_of(self, step: int) -> BatchT:
        """What a step gets; steps are counted from 0 in each epoch."""

    def __iter__(self) -> Iterator[BatchT]:
        start, self._resume_at = self._resume_at, 0
        for step in range(start, len(self)):
            self._given = step + 1
            yield self.batch_of(step)

    def state_dict(self) -> dict[str, int]:
        """How far the running epoch is; Lightning keeps it in checkpoints."""
        return {"given": self._given}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Lets the next epoch be the rest of one that a checkpoint interrupted."""
        self._resume_at = min(state["given"], len(self)) % len(self)


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
