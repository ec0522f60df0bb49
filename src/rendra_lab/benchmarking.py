"""Times named operations, and reports only those whose tests pass. What is timed stands in `benchmarks.py`."""

from __future__ import annotations

import fnmatch
import gc
import hashlib
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rendra_lab.errors import UserError

Run = Callable[[], object]

_RUNS = (3, 30)  # at least and at most
_SECONDS = 3.0  # after which no further run starts
_TOO_LONG = 20.0  # seconds of a run that is not repeated
_TEST_TIMEOUT = 600.0  # seconds of one test file


@dataclass(frozen=True)
class Benchmark:
    """One operation or command that can be timed.

    Attributes:
        name: what the command line calls it.
        what: the operation and its settings, for people.
        prepare: (library, scene) -> the function to time; what it does before it returns is not timed.
        proofs: test files, relative to the root of the project, that must pass.
        must_ms, aim_ms: what it has to take and what it should take on the reference machine; None where nothing
            was agreed.
        is_public: whether the operation is part of PyTorch3D's API too, so that `prepare` serves both libraries.
        is_command: whether it is a whole command of many seconds, timed only where it is named.
    """

    name: str
    what: str
    prepare: Callable[[Any, Any], Run]
    proofs: tuple[str, ...]
    must_ms: float | None = None
    aim_ms: float | None = None
    is_public: bool = True
    is_command: bool = False


@dataclass(frozen=True)
class Timing:
    """Wall times of repeated runs, in ms; the first call, which may compile, is kept apart."""

    median_ms: float
    min_ms: float
    lower_quartile_ms: float
    upper_quartile_ms: float
    max_ms: float
    runs: int
    first_call_ms: float

    @classmethod
    def of(cls, seconds: Sequence[float], first_call: float) -> Timing:
        """The statistics of at least one run; quartiles are interpolated between the runs."""
        if not seconds:
            raise ValueError("there is nothing to summarise: no run was timed")
        ms = [1e3 * value for value in seconds]
        lower, middle, upper = statistics.quantiles(ms, n=4, method="inclusive") if len(ms) > 1 else ms * 3
        return cls(middle, min(ms), lower, upper, max(ms), len(ms), 1e3 * first_call)


@dataclass(frozen=True)
class Result:
    """What became of a benchmark: timings, or the reason why there are none."""

    benchmark: Benchmark
    timing: Timing | None = None
    refusal: str | None = None
    is_tested: bool = True
    rival: Timing | None = None  # PyTorch3D's

    @property
    def ratio(self) -> float | None:
        """How many times longer PyTorch3D takes."""
        return self.rival.median_ms / self.timing.median_ms if self.rival and self.timing else None

    def as_dict(self) -> dict[str, Any]:
        """Everything, for JSON."""
        return {
            "name": self.benchmark.name,
            "what": self.benchmark.what,
            "must_ms": self.benchmark.must_ms,
            "aim_ms": self.benchmark.aim_ms,
            "tested": self.is_tested,
            "refused": self.refusal,
            "rendra": asdict(self.timing) if self.timing else None,
            "pytorch3d": asdict(self.rival) if self.rival else None,
            "ratio": self.ratio,
        }


class Proofs:
    """Runs test files, each once for as long as neither it nor the source changes.

    Args:
        root: of the project, with `tests` and `src`.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._answers: dict[str, str | None] = {}

    def objection(self, files: Iterable[str]) -> str | None:
        """Why an operation that these test files prove must not be reported; None where they all pass."""
        for file in files:
            if not (self.root / file).is_file():
                return f"{file} is missing"
            state = self._state(file)
            if state not in self._answers:
                self._answers[state] = self._run(file)
            if self._answers[state]:
                return self._answers[state]
        return None

    def _state(self, file: str) -> str:
        """A hash of the test file and of the source."""
        content = hashlib.sha256(file.encode())
        for path in (self.root / file, *sorted((self.root / "src").rglob("*.py"))):
            content.update(path.read_bytes())
        return content.hexdigest()

    def _run(self, file: str) -> str | None:
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", file]
        try:
            done = subprocess.run(
                command, cwd=self.root, capture_output=True, text=True, timeout=_TEST_TIMEOUT, check=False
            )
        except subprocess.TimeoutExpired:
            return f"{file} did not end within {_TEST_TIMEOUT:.0f} s"
        if done.returncode == 0:
            return None
        failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        lines = (done.stdout + done.stderr).strip().splitlines()
        return f"{file}: {(failed or lines or ['pytest said nothing'])[-1]}"


def select(benchmarks: Sequence[Benchmark], patterns: Sequence[str]) -> list[Benchmark]:
    """Those that match a name or glob, in their own order; without patterns all but whole commands.

    Raises:
        UserError: a pattern that matches none.
    """
    if not patterns:
        return [benchmark for benchmark in benchmarks if not benchmark.is_command]
    names = [benchmark.name for benchmark in benchmarks]
    for pattern in patterns:
        if not fnmatch.filter(names, pattern):
            raise UserError(f"no benchmark is called {pattern!r}; there are: {', '.join(names)}")
    return [b for b in benchmarks if any(fnmatch.fnmatchcase(b.name, pattern) for pattern in patterns)]


def measure(run: Run, finish: Callable[[], None] = lambda: None) -> Timing:
    """Time a function: one first call, then 3 to 30 runs within about 3 s, or a single one of over 20 s.

    `finish` waits for work that a run left on a device.
    """

    def seconds() -> float:
        started = time.perf_counter()
        run()
        finish()
        return time.perf_counter() - started

    first_call = seconds()
    gc.collect()
    collects = gc.isenabled()
    gc.disable()
    try:
        return Timing.of(list(_enough(seconds)), first_call)
    finally:
        if collects:
            gc.enable()


def _enough(seconds: Callable[[], float]) -> Iterator[float]:
    """As many samples as the module's limits allow."""
    least, most = _RUNS
    spent, runs = 0.0, 0
    while runs < most and (runs < least or spent < _SECONDS):
        sample = seconds()
        spent, runs = spent + sample, runs + 1
        yield sample
        if sample > _TOO_LONG:
            return


def run_benchmark(
    benchmark: Benchmark,
    scene: Any,
    ours: Any,
    rival: Any | None,
    proofs: Proofs | None,
    finish: Callable[[], None] = lambda: None,
) -> Result:
    """Prove, prepare and time one benchmark, with the rival library beside ours where it has the operation.

    `proofs` is None for untested numbers.
    """
    objection = proofs.objection(benchmark.proofs) if proofs else None
    if objection:
        return Result(benchmark, refusal=objection)
    timing = measure(benchmark.prepare(ours, scene), finish)
    other = None
    if rival is not None and benchmark.is_public:
        other = measure(benchmark.prepare(rival, scene), finish)
    return Result(benchmark, timing, is_tested=proofs is not None, rival=other)


def machine(device: str) -> dict[str, Any]:
    """What numbers depend on besides the program: processor, threads, versions and how busy the machine is."""
    import torch

    from rendra.kernels.parallel import num_threads
    from rendra_lab.report import versions

    packages = versions()
    graphics = torch.cuda.get_device_name(device) if device.startswith("cuda") else None
    return {
        "cpu": cpu_name(),
        "cores": os.cpu_count(),
        "gpu": graphics,
        "device": device,
        "threads": num_threads(),
        **{name: os.environ[name] for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT") if name in os.environ},
        "load_average": [round(value, 2) for value in os.getloadavg()] if hasattr(os, "getloadavg") else None,
        **{name: packages[name] for name in ("python", "torch", "numba", "numpy", "rendra")},
    }


def cpu_name() -> str:
    """The processor in its maker's words, as far as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def table_of(results: Sequence[Result]) -> Any:
    """The results as a rich table."""
    from rich.table import Table

    compared = any(result.rival for result in results)
    table = Table(title="milliseconds, median of the runs")
    table.add_column("benchmark", no_wrap=True)
    table.add_column("what")
    for name in ("median", "min", "quartiles", "max", "runs", "must", "aim"):
        table.add_column(name, justify="right", no_wrap=name != "median")
    for name in ("PyTorch3D", "times") if compared else ():
        table.add_column(name, justify="right", no_wrap=True)
    for result in results:
        table.add_row(*_row(result, compared))
    return table


def first_calls(results: Sequence[Result]) -> str:
    """One line on the calls that came before: compilation, or its cache."""
    slow = [(r.benchmark.name, r.timing.first_call_ms) for r in results if r.timing]
    return "first calls, not counted: " + ", ".join(f"{name} {ms:.0f} ms" for name, ms in slow)


def _row(result: Result, compared: bool) -> list[str]:
    benchmark, timing = result.benchmark, result.timing
    targets = [_ms(benchmark.must_ms), _ms(benchmark.aim_ms)]
    if timing is None:
        return [benchmark.name, f"[red]refused: {_plain(result.refusal or '')}[/red]", *[""] * 5, *targets]
    cells = [
        benchmark.name,
        _plain(benchmark.what),
        _coloured(timing.median_ms, benchmark) + ("" if result.is_tested else " untested"),
        _ms(timing.min_ms),
        f"{_ms(timing.lower_quartile_ms)} - {_ms(timing.upper_quartile_ms)}",
        _ms(timing.max_ms),
        str(timing.runs),
        *targets,
    ]
    rivals = [_ms(result.rival.median_ms), f"{result.ratio:.1f}"] if result.rival else ["", ""]
    return cells + (rivals if compared else [])


def _coloured(median_ms: float, benchmark: Benchmark) -> str:
    if benchmark.must_ms is None or benchmark.aim_ms is None:
        return _ms(median_ms)
    color = "green" if median_ms <= benchmark.aim_ms else "yellow" if median_ms <= benchmark.must_ms else "red"
    return f"[{color}]{_ms(median_ms)}[/{color}]"


def _ms(value: float | None) -> str:
    """Three digits."""
    if value is None:
        return ""
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def _plain(text: str) -> str:
    from rich.markup import escape

    return escape(text)
