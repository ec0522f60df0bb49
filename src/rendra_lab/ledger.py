"""The ledger of a sweep: which jobs it has, who runs them, how they ended.

A folder, which several processes and machines may share, holds it:
- `ledger.jsonl`: one JSON object a line, only ever appended to. Events: command, queued, running, done, failed,
  interrupted, lost (the process of a job vanished), released (a claim that found its job done).
- `.claims/<job>.<n>`: the n-th claim on a job. The file system lets one process alone create it, on NFS too.
  Its holder rewrites a counter in it. Claims are never removed: whoever takes a job over creates number n + 1,
  which is as exclusive as the first.

A claim is over when the ledger has its end, when its process is gone from this machine, or when its counter has
stood still for `stale_s` by the watcher's own clock: clocks of different machines are never compared.
"""

from __future__ import annotations

import _thread
import contextlib
import json
import os
import platform
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

Event = dict[str, Any]

_ENDS = ("done", "failed", "interrupted", "lost", "released")
_CLAIM_NAME = re.compile(r"(?P<job>[0-9a-f]+)\.(?P<number>[0-9]+)")


@dataclass
class JobState:
    """What the ledger knows of one job."""

    key: str
    number: int
    folder: str  # its name inside the sweep folder
    overrides: list[str]
    status: str = "queued"  # or the last event of this job: running, done, failed, interrupted, lost
    value: float | None = None  # what the job returned
    metrics: dict[str, float | None] = field(default_factory=dict)
    error: str | None = None
    holder: str = ""  # host and process of the last claim
    ended: set[int] = field(default_factory=set)  # numbers of the claims that are over
    failures: list[int] = field(default_factory=list)  # positions of the failures in the ledger


class Ledger:
    """The ledger in one folder.

    Args:
        folder: of the sweep; made when the first line is written.
        stale_s: seconds without a heartbeat after which a claim of another machine is over.
        heartbeat_s: seconds between two heartbeats of the claims made here.
    """

    def __init__(self, folder: Path, stale_s: float = 120.0, heartbeat_s: float = 10.0) -> None:
        self.folder = folder
        self.path = folder / "ledger.jsonl"
        self.stale_s = stale_s
        self.heartbeat_s = heartbeat_s
        self._watched: dict[Path, tuple[bytes, float]] = {}

    def append(self, event: str, **fields: Any) -> None:
        """Adds one event; it is on the disk when this returns."""
        with self._locked() as file:
            _write_line(file, event, fields)

    def events(self) -> list[Event]:
        """Every event, oldest first; a line that a crash has torn is left out."""
        try:
            lines = self.path.read_bytes().splitlines()
        except FileNotFoundError:
            return []
        found = []
        for line in lines:
            with contextlib.suppress(ValueError):
                event = json.loads(line)
                if isinstance(event, dict) and "event" in event:
                    found.append(event)
        return found

    def enqueue(
        self, batch: Sequence[tuple[str, list[str]]], name: Callable[[int, list[str]], str]
    ) -> list[JobState]:
        """Enters the jobs that the ledger does not have yet; returns the state of each job of the batch.

        Args:
            batch: key and overrides of each job.
            name: makes the name of a folder from a job's number and overrides. A taken name gets the key behind.
        """
        with self._locked() as file:
            known = self.states()
            names = {state.folder for state in known.values()}
            for key, overrides in dict(batch).items():
                if key in known:
                    continue
                number = 1 + max((state.number for state in known.values()), default=-1)
                folder = name(number, overrides)
                if folder in names or (self.folder / folder).exists():
                    folder = f"{folder}-{key}"
                names.add(folder)
                known[key] = JobState(key, number, folder, overrides)
                _write_line(file, "queued", {"job": key, "number": number, "folder": folder, "overrides": overrides})
        return [known[key] for key, _ in batch]

    def states(self) -> dict[str, JobState]:
        """What is known of each job, by its key, in the order in which they were entered."""
        states: dict[str, JobState] = {}
        for position, event in enumerate(self.events()):
            key = str(event.get("job"))
            if event["event"] == "queued":
                known = JobState(key, int(event["number"]), str(event["folder"]), list(event["overrides"]))
                states.setdefault(key, known)
            elif key in states:
                _apply(states[key], event, position)
        return states

    def free_after(self, state: JobState) -> int | None:
        """The number of the last claim on a job, if that claim is over; 0 without any, None while it is held."""
        paths = {int(match["number"]): path for path, match in self._claims() if match["job"] == state.key}
        last = max(paths, default=0)
        if last == 0 or last in state.ended or self._is_over(paths[last]):
            return last
        return None

    def claim(self, state: JobState, after: int) -> Claim | None:
        """Makes the claim that follows number `after`; None where someone else was faster."""
        folder = self.folder / ".claims"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{state.key}.{after + 1}"
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            return None
        return Claim(self, state, after + 1, file)

    def _claims(self) -> Iterator[tuple[Path, re.Match[str]]]:
        for path in (self.folder / ".claims").glob("*.*"):
            match = _CLAIM_NAME.fullmatch(path.name)
            if match:
                yield path, match

    def _is_over(self, path: Path) -> bool:
        content = path.read_bytes()
        with contextlib.suppress(ValueError, KeyError, TypeError):
            holder = json.loads(content.partition(b"\n")[2])
            if holder["machine"] == _machine() and holder["started"] is not None:
                return _started(int(holder["pid"])) != holder["started"]
        before, since = self._watched.get(path, (None, 0.0))
        if content != before:
            self._watched[path] = (content, time.monotonic())
            return False
        return time.monotonic() - since > self.stale_s

    @contextlib.contextmanager
    def _locked(self) -> Iterator[int]:
        """The open ledger, with nobody else writing; on NFS only a lock makes appending safe."""
        self.folder.mkdir(parents=True, exist_ok=True)
        file = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
        try:
            with contextlib.suppress(ImportError, OSError):  # Windows; a file system without locks
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX)
            yield file
        finally:
            os.close(file)


class Claim:
    """The right to run one job, as long as its heart beats. A context manager: the beating ends with it.

    Args:
        ledger: that the job stands in.
        state: of the job.
        number: of this claim.
        file: descriptor of the new file of the claim.

    Where another machine has taken the job over, because this one was asleep, the main thread is interrupted and
    `lost` is True.
    """

    def __init__(self, ledger: Ledger, state: JobState, number: int, file: int) -> None:
        self.ledger = ledger
        self.state = state
        self.number = number
        self.lost = False
        self._file = file
        self._over = threading.Event()
        self._holder = json.dumps({"machine": _machine(), "pid": os.getpid(), "started": _started(os.getpid())})
        self._beat(0)
        self._thread = threading.Thread(target=self._keep_beating, name=f"claim {state.key}", daemon=True)
        self._thread.start()

    def __enter__(self) -> Claim:
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()
        os.close(self._file)

    def tell(self, event: str, **fields: Any) -> None:
        """Writes an event of this job into the ledger; one of its ends gives the claim up."""
        who = {"job": self.state.key, "claim": self.number, "host": platform.node(), "pid": os.getpid()}
        self.ledger.append(event, **who, **fields)

    def _keep_beating(self) -> None:
        successor = self.ledger.folder / ".claims" / f"{self.state.key}.{self.number + 1}"
        count = 0
        while not self._over.wait(self.ledger.heartbeat_s):
            count += 1
            with contextlib.suppress(OSError):  # the next beat may come through
                self._beat(count)
            if successor.exists():
                self.lost = True
                _interrupt_main_thread()
                return

    def _beat(self, count: int) -> None:
        os.lseek(self._file, 0, os.SEEK_SET)
        os.write(self._file, f"{count:012d}\n{self._holder}\n".encode())
        os.fsync(self._file)


def _interrupt_main_thread() -> None:
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, signal.SIGINT)  # also out of a sleep
    else:
        _thread.interrupt_main()


def _write_line(file: int, event: str, fields: Event) -> None:
    """One write; a line that a crash has torn before it is ended first."""
    stamp = datetime.now(timezone.utc).isoformat(timespec="seconds")
    line = json.dumps({"event": event, "time": stamp, **fields}, allow_nan=False).encode() + b"\n"
    size = os.lseek(file, 0, os.SEEK_END)
    if size:
        os.lseek(file, size - 1, os.SEEK_SET)
        line = line if os.read(file, 1) == b"\n" else b"\n" + line
    os.write(file, line)
    os.fsync(file)


def _apply(state: JobState, event: Event, position: int) -> None:
    name = event["event"]
    if name in _ENDS:
        state.ended.add(int(event.get("claim", 0)))
    if name == "failed":
        state.failures.append(position)
    if name == "released" or state.status == "done":
        return
    state.status = name
    state.error = event.get("error")
    state.holder = f"{event.get('host')}, process {event.get('pid')}"
    if name == "done":
        state.value = event.get("value")
        state.metrics = event.get("metrics") or {}


def _machine() -> str:
    """Names the world in which a process number means something: host, boot and container."""
    parts = [platform.node()]
    with contextlib.suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
        parts.append(os.readlink("/proc/self/ns/pid"))
    return " ".join(parts)


def _started(pid: int) -> str | None:
    """When a process began, in the kernel's ticks, so that a number used again is not taken for it; None if gone.

    None for all where the system has no /proc: there the heartbeat alone decides.
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else fields[19]
