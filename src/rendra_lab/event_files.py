"""Event files of TensorBoard that no thread writes, and whose failure ends no run."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter
from torch.utils.tensorboard import FileWriter, SummaryWriter

log = logging.getLogger(__name__)

_FLUSH_EVERY_S = 10.0
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

    def purge(self, step: int) -> None:
        """Lets readers forget what earlier files of the folder say about this step and later ones."""
        if sum(1 for _ in Path(self.log_dir).glob("*tfevents*")) > 1:
            start = SessionLog(status=SessionLog.START)
            self.file_writer.add_event(Event(step=step, session_log=start), step)

    def add_summary(self, summary: Any, step: int | None = None) -> None:
        """Adds a summary as it is, whichever package made its class."""
        self.file_writer.add_summary(Summary.FromString(summary.SerializeToString()), step)

    def _get_file_writer(self) -> FileWriter:
        if self.file_writer is None:
            self.file_writer = _Events(self.log_dir)
            self.all_writers = {self.log_dir: self.file_writer}
        return self.file_writer


class _Events(FileWriter):
    """What `SummaryWriter` speaks to, without a thread behind it."""

    def __init__(self, folder: str) -> None:
        self.event_writer = _EventFile(Path(folder))


class _EventFile:
    """One event file, as TensorBoard's `EventFileWriter`, but patient."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._records: RecordWriter | None = None
        self._next_flush = 0.0
        self._attempt(self._open)

    def get_logdir(self) -> str:
        """The folder."""
        return str(self._folder)

    def add_event(self, event: Event) -> None:
        """Writes an event; it reaches the disk within ten seconds of the next one, or by `flush`."""
        if self._records is not None:
            self._attempt(lambda: self._write(event))

    def flush(self) -> None:
        """Brings everything to disk."""
        if self._records is not None:
            self._attempt(self._records.flush)

    def close(self) -> None:
        """Ends the file."""
        if self._records is not None:
            self._attempt(self._records.close)
            self._records = None

    def _open(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        name = f"events.out.tfevents.{time.time():017.6f}.{socket.gethostname()}.{os.getpid()}"
        self._records = RecordWriter((self._folder / name).open("xb"))
        self._write(Event(wall_time=time.time(), file_version=_FORMAT))

    def _write(self, event: Event) -> None:
        assert self._records is not None
        self._records.write(event.SerializeToString())
        if time.monotonic() >= self._next_flush:
            self._records.flush()
            self._next_flush = time.monotonic() + _FLUSH_EVERY_S

    def _attempt(self, action: Callable[[], Any]) -> None:
        try:
            action()
        except OSError as problem:
            self._records = None
            log.warning("TensorBoard's events in %s end here, the run goes on: %s", self._folder, problem)
