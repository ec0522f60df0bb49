"""One batch again and again: the data loader of a fit to a single observation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, TypeVar

BatchT = TypeVar("BatchT")


class Repeated(Generic[BatchT]):
    """Yields the same batch a fixed number of times; one pass is one epoch.

    Args:
        batch: what every step gets.
        times: steps an epoch, at least 1. An epoch costs some milliseconds: let it last the whole fit.
    """

    def __init__(self, batch: BatchT, times: int = 1) -> None:
        if times < 1:
            raise ValueError(f"a batch is repeated at least once, got times={times}")
        self.batch = batch
        self.times = times
        self._given = 0
        self._resume_at = 0

    def __len__(self) -> int:
        return self.times

    def __iter__(self) -> Iterator[BatchT]:
        start, self._resume_at = self._resume_at, 0
        for given in range(start + 1, self.times + 1):
            self._given = given
            yield self.batch

    def state_dict(self) -> dict[str, int]:
        """How far the running epoch is; Lightning keeps it in checkpoints."""
        return {"given": self._given}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Lets the next epoch be the rest of one that a checkpoint interrupted."""
        self._resume_at = min(state["given"], self.times) % self.times
