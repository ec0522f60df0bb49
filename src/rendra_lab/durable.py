"""Files that are either there as a whole or not at all, whatever happens while they are written."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

ResultT = TypeVar("ResultT")

_PARTIAL = re.compile(r"\.(?P<name>.+)\.(?P<pid>\d+)\.[0-9a-f]{8}\.tmp")
_BUFFER = 1 << 20
_PATIENCE = 100  # repetitions of a call that a signal cut short
_NO_SUCH_CALL = {errno.EINVAL, errno.ENOTSUP, errno.ENOSYS}


class Sink:
    """What a writer writes to: keeps the first failure for `finish`, as not every writer bears an exception.

    Args:
        descriptor: of a file open for writing.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._pending = bytearray()
        self._failure: BaseException | None = None

    def write(self, data: Any) -> int:
        """Takes bytes; after a failure they go nowhere."""
        try:
            if self._failure is None:
                self._pending += data
                if len(self._pending) >= _BUFFER:
                    self._drain()
        except BaseException as error:
            self._failure = error
        return len(data)

    def flush(self) -> None:
        """For writers that ask for it; `finish` is what counts."""

    def finish(self) -> None:
        """Writes the rest; raises the first failure."""
        if self._failure is None:
            self._drain()
        if self._failure is not None:
            raise self._failure

    def _drain(self) -> None:
        with memoryview(self._pending) as rest:
            done = 0
            while done < len(rest):
                done += _patiently(os.write, self._descriptor, rest[done:])
        self._pending = bytearray()


def write_durably(path: Path, fill: Callable[[Sink], object], verify: Callable[[Path], object] | None = None) -> None:
    """Replaces a file by a new one that has been proven, and is on the disk; until then the old one stays.

    The new content goes to a hidden file in the same folder (a rename between filesystems is a copy, which can be
    cut off), is forced to the disk and verified there, and then takes the name.

    Args:
        path: of the file; its folder is made where it is missing.
        fill: writes the content.
        verify: is given the path of the new file before it takes the name; raises where that is not whole. None for
            content without a checksum.

    Raises whatever failed; then no partial file is left, and what stood at `path` still does. The one exception is a
    failure after the name was taken, to force the folder to the disk: then the new file stands there, whole.
    """
    with draft_of(path) as partial:
        with _held(partial) as descriptor:
            sink = Sink(descriptor)
            fill(sink)
            sink.finish()
            _patiently(os.fsync, descriptor)
        if verify is not None:
            verify(partial)
    _force_folder(path.parent)


@contextlib.contextmanager
def draft_of(path: Path) -> Iterator[Path]:
    """The path of a hidden file in the same folder, to be written within the block; then it takes the name.

    For what can be made again. Nothing is forced to the disk: after the machine itself has failed, the file may be
    empty. Where the block fails, no draft is left, and what stood at `path` still does.

    Args:
        path: of the file; its folder is made where it is missing.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.tmp")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield partial
        _patiently(os.replace, partial, path)
    except BaseException:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise


def sweep_leftovers(folder: Path) -> list[Path]:
    """Removes the partial files of processes that are gone; answers which.

    A file counts as left over when its process is not known here and nobody holds its lock, which a process on
    another machine or in another container would.
    """
    swept = []
    for path in folder.glob(".*.tmp"):
        named = _PARTIAL.fullmatch(path.name)
        if named and not _is_alive(int(named["pid"])) and _is_free(path):
            with contextlib.suppress(FileNotFoundError):
                path.unlink()
                swept.append(path)
    return swept


@contextlib.contextmanager
def _held(partial: Path) -> Iterator[int]:
    """A new file, open for writing and locked for as long as its process lives."""
    descriptor = _patiently(
        os.open, partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666
    )
    try:
        if fcntl is not None:
            with contextlib.suppress(OSError):  # a filesystem without locks
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield descriptor
    finally:
        os.close(descriptor)


def _is_alive(pid: int) -> bool:
    if os.name != "posix":
        return True  # there, asking would end it
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _is_free(path: Path) -> bool:
    try:
        descriptor = os.open(path, os.O_RDWR)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return True


def _force_folder(folder: Path) -> None:
    """Forces the names in a folder to the disk, where the system can."""
    if os.name != "posix":
        return
    descriptor = _patiently(os.open, folder, os.O_RDONLY)
    try:
        _patiently(os.fsync, descriptor)
    except OSError as error:
        if error.errno not in _NO_SUCH_CALL:
            raise
    finally:
        os.close(descriptor)


def _patiently(call: Callable[..., ResultT], *arguments: Any) -> ResultT:
    """Repeats a call that signals cut short."""
    for _ in range(_PATIENCE):
        with contextlib.suppress(InterruptedError):
            return call(*arguments)
    return call(*arguments)
