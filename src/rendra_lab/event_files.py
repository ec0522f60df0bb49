"""Event files of TensorBoard that no thread writes, and whose failure ends no run."""

from __future__ import annotations

import io
import logging
import os
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter
from torch.utils.tensorboard import FileWriter, SummaryWriter

log = logging.getLogger(__name__)

_FLUSH_EVERY_S = 10.0
_MOST_BYTES = 1 << 20  # that wait in memory
_HEAD, _TAIL = 12, 4  # bytes of a record about its content: length and checksum, checksum
_FORMAT = "brain.Event:2"


class EventWriter(SummaryWriter):
    """torch's `SummaryWriter` on an event file of ours.

    TensorBoard's own hands events to a thread, which a full disk ends: the next call then raises into the fit. Here
    the first failure is said once, and nothing is written from then on.

    Args:
        folder: of the file.
    """

    file_writer: Any
    all_writers: Any

    def __init__(self, folder: str) -> None:
        super().__init__(folder)

    def add_summary(self, summary: Any, step: int | None = None) -> None:
        """Adds a summary as it is, whichever package made its class."""
        self.file_writer.add_summary(Summary.FromString(summary.SerializeToString()), step)

    def _get_file_writer(self) -> FileWriter:
        if self.file_writer is None:
            self.file_writer = _Events(self.log_dir)
            self.all_writers = {self.log_dir: self.file_writer}
        return self.file_writer


def cut_events(folder: Path, step: int) -> None:
    """Drops from the event files of a folder what they say about this step and later ones, and its row of HPARAMS.

    TensorBoard's `purge_step` leaves it to readers to forget, and not all of them do.
    """
    for path in folder.glob("*tfevents*"):
        kept = io.BytesIO()
        for event in _events(path.read_bytes()):
            tags = [value.tag for value in event.summary.value]
            if not tags or (event.step < step and not any(tag.startswith("_hparams_") for tag in tags)):
                RecordWriter(kept).write(event.SerializeToString())
        partial = path.with_name(f".cut.{os.getpid()}.tmp")  # not a name that TensorBoard reads
        try:
            partial.write_bytes(kept.getbuffer())
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)


def _events(content: bytes) -> Iterator[Event]:
    """The events of a file; a last one that was cut off is left out."""
    place = 0
    while place + _HEAD <= len(content):
        (length,) = struct.unpack_from("<Q", content, place)
        end = place + _HEAD + length + _TAIL
        if end > len(content):
            return
        yield Event.FromString(content[place + _HEAD : end - _TAIL])
        place = end


class _Events(FileWriter):
    """What `SummaryWriter` speaks to, without a thread behind it."""

    def __init__(self, folder: str) -> None:
        self.event_writer = _EventFile(Path(folder))


class _EventFile:
    """One event file, as TensorBoard's `EventFileWriter`; open only while something is brought to disk."""

    def __init__(self, folder: Path) -> None:
        name = f"events.out.tfevents.{time.time():017.6f}.{socket.gethostname()}.{os.getpid()}"
        self._path = folder / name
        self._waiting = io.BytesIO()
        self._next_flush = time.monotonic() + _FLUSH_EVERY_S
        self._is_broken = False
        self.add_event(Event(wall_time=time.time(), file_version=_FORMAT))

    def get_logdir(self) -> str:
        """The folder."""
        return str(self._path.parent)

    def add_event(self, event: Event) -> None:
        """Writes an event; it reaches the disk within ten seconds of the next one, or by `flush`."""
        if self._is_broken:
            return
        RecordWriter(self._waiting).write(event.SerializeToString())
        if time.monotonic() >= self._next_flush or self._waiting.tell() >= _MOST_BYTES:
            self.flush()

    def flush(self) -> None:
        """Brings everything to disk."""
        self._next_flush = time.monotonic() + _FLUSH_EVERY_S
        waiting, self._waiting = self._waiting, io.BytesIO()
        if self._is_broken:
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("ab") as file:
                file.write(waiting.getbuffer())
        except OSError as problem:
            self._is_broken = True
            log.warning("TensorBoard's events in %s end here, the run goes on: %s", self._path.parent, problem)

    def close(self) -> None:
        """Brings everything to disk."""
        self.flush()
