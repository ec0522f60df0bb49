"""Signals that end a program (SIGINT, SIGTERM, SIGUSR1) become one exception, raised where it harms nothing.

Imported before anything else runs: stays light.
"""

from __future__ import annotations

import _thread
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import Any

WATCHED = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGUSR1") if hasattr(signal, name))

_SECOND_THOUGHT_S = 0.3  # terminals, srun and torchrun deliver one wish twice, at once
_IMPORT_S = 30.0  # longer than a module takes to load
_LOOK_AGAIN_S = 0.05


class Interrupted(BaseException):
    """A signal asked the program to end. No `Exception`: nothing on the way may take it for a failure.

    Args:
        number: of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(f"interrupted by {signal.Signals(number).name}")
        self.number = number

    @property
    def code(self) -> int:
        """The exit code, as shells count it: 130 for SIGINT, 143 for SIGTERM, 138 for SIGUSR1."""
        return 128 + self.number


def leave_at_once() -> None:
    """From here on a signal ends the program with one line and no more.

    Until something is `listening`, and within imports until something has `begun` that would have to be put away.
    Once nothing is `listening` any more, signals are handled as they were before.
    """
    _watch.in_a_hurry = True
    for number in WATCHED:
        if (handler := signal.getsignal(number)) in _OURS_TO_TAKE and handler is not _leave:
            _watch.at_first[number] = signal.signal(number, _leave)


def begun() -> None:
    """From here on a program that a signal ends has something to put away."""
    _watch.in_a_hurry = False


def _leave(number: int, _: FrameType | None) -> None:
    if os.environ.get("LOCAL_RANK", "0") == "0":
        line = f"{os.path.basename(sys.argv[0])}: {Interrupted(number)}\n"
        os.write(2, line.encode(errors="replace"))
    os._exit(128 + number)


_OURS_TO_TAKE = (signal.SIG_DFL, signal.default_int_handler, _leave)


def behind(error: BaseException | None) -> Interrupted | None:
    """The interruption that an exception is or came out of: tidying up, half done, fails easily. None for others."""
    seen = set()
    while error is not None and id(error) not in seen:
        if isinstance(error, Interrupted):
            return error
        seen.add(id(error))
        error = error.__context__
    return None


class _Watch:
    """The state of the one watch of a process."""

    def __init__(self) -> None:
        self.at_first: dict[int, Any] = {}
        self.before: dict[int, Any] = {}
        self.owner = 0
        self.patience = 0
        self.caught: int | None = None
        self.caught_at = 0.0
        self.postponed_at: float | None = None
        self.comes_again = False
        self.in_a_hurry = False

    def handle(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self.owner:  # a forked worker, whose parent decides
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        if self.patience == 0 and self._postpones(number, frame):
            return
        first, now = self.caught is None, time.monotonic()
        insists = not first and number == signal.SIGINT and now - self.caught_at > _SECOND_THOUGHT_S
        if first:
            self.caught, self.caught_at = number, now
        if self.patience == 0 or (insists and self.patience == 1):
            raise Interrupted(self.caught or number)
        if first and number == signal.SIGINT and os.environ.get("LOCAL_RANK", "0") == "0":
            sys.stderr.write("stopping after this step; Ctrl-C once more to stop at once\n")

    def _postpones(self, number: int, frame: FrameType | None) -> bool:
        """Whether a signal comes again later, as a module is being loaded.

        Not every importer hands an exception on: torch, for one, goes on with half of NumPy.
        """
        now, loads = time.monotonic(), _loads_a_module(frame)
        if loads and self.in_a_hurry:
            _leave(number, frame)
        since = now if self.postponed_at is None else self.postponed_at
        self.postponed_at = since if loads and now - since < _IMPORT_S else None
        if self.postponed_at is not None and not self.comes_again:
            self.comes_again = True
            _thread.start_new_thread(self._send_again, (number,))  # takes no lock, unlike threading's
        return self.postponed_at is not None

    def _send_again(self, number: int) -> None:
        time.sleep(_LOOK_AGAIN_S)
        self.comes_again = False
        os.kill(os.getpid(), number)


def _loads_a_module(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


_watch = _Watch()


@contextlib.contextmanager
def listening() -> Iterator[None]:
    """Signals raise `Interrupted` meanwhile; within another such block, or outside the main thread, nothing changes.

    A signal that somebody else handles already, such as submitit, stays theirs.
    """
    if _watch.patience == 0:
        _watch.caught = None
    if _watch.before or threading.current_thread() is not threading.main_thread():
        yield
        return
    _watch.owner, _watch.patience = os.getpid(), 0
    found = {number: signal.getsignal(number) for number in WATCHED}
    _watch.before = {number: handler for number, handler in found.items() if handler in _OURS_TO_TAKE}
    take_over()
    try:
        yield
    finally:
        for number, handler in _watch.before.items():
            signal.signal(number, _watch.at_first.get(number, handler))
        _watch.before, _watch.at_first, _watch.in_a_hurry = {}, {}, False


def take_over() -> None:
    """Puts the handlers of this watch back in place, where a library has laid its own over them."""
    if threading.current_thread() is threading.main_thread():
        for number in _watch.before:
            signal.signal(number, _watch.handle)


@contextlib.contextmanager
def patient(for_all: bool = False) -> Iterator[None]:
    """Signals wait meanwhile, for who asks `waiting`; a second Ctrl-C does not.

    Args:
        for_all: a second Ctrl-C waits too: for what must not be torn, such as a file that is written.
    """
    weight = 2 if for_all else 1
    _watch.patience += weight
    try:
        yield
    finally:
        _watch.patience -= weight


def waiting() -> int | None:
    """The number of the signal that has come, if any."""
    return _watch.caught
