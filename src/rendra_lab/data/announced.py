"""Lines that say how far something that takes long has come."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from time import perf_counter
from typing import TypeVar

from rendra_lab import report
from rendra_lab.progress import clock_time

_LINE_S = 10.0  # between lines
_PATIENCE_S = 3.0  # what takes no longer is not worth a line

T = TypeVar("T")


def announced(things: Iterable[T], total: int, what: str) -> Iterator[T]:
    """The same things; says now and then how many there are, where it takes long.

    Args:
        things: made one after the other.
        total: how many there will be.
        what: they are: "generated places".
    """
    begin = last = perf_counter()
    for done, thing in enumerate(things, 1):
        yield thing
        now = perf_counter()
        is_last = done == total
        if now - last >= _LINE_S or (is_last and now - begin >= _PATIENCE_S):
            left = "" if is_last else f", {clock_time((now - begin) / done * (total - done))} left"
            report.say(f"{what} {done}/{total} in {clock_time(now - begin)}{left}")
            last = now
