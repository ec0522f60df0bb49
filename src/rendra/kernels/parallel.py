"""How Numba kernels run: compilation, its cache, threads and forks. The one place with a policy on them.

- Kernels are compiled on first use and cached on disk; the first compilation is reported by one log line.
- The number of threads follows `torch.get_num_threads()`.
- Torch brings an OpenMP runtime of its own beside Numba's. Where several such processes share a machine, start them
  with GOMP_SPINCOUNT=2000: threads that spin for long while they wait keep the cores from those that have work.
- One kernel runs at a time in a process: Numba's `workqueue` layer aborts when two Python threads enter it.
- A child made by `fork` after a kernel ran in the parent would be killed by the OpenMP runtime; there a kernel
  raises instead and names the remedy.
"""

import logging
import os
import threading
import time
from collections.abc import Callable
from typing import Any

import numba
import torch

_log = logging.getLogger("rendra")


class _Process:
    """What this process knows of its own threads."""

    lock = threading.Lock()
    has_run = False
    forked_after_run = False

    @classmethod
    def note_fork(cls) -> None:
        cls.lock = threading.Lock()
        cls.forked_after_run = cls.has_run and numba.threading_layer() == "omp"


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_Process.note_fork)


def num_threads() -> int:
    """Threads that a kernel uses: torch's number, within what Numba started with."""
    return max(1, min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]


def parallel_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function of NumPy arrays for all cores; see the module's policy.

    Division by zero follows IEEE 754 (infinity or NaN, no exception), so that loops can be vectorised.

    Raises:
        RuntimeError: when called in a process forked after kernels had run in its parent.
    """
    compiled = numba.njit(function, cache=True, parallel=True, nogil=True, error_model="numpy")

    def run(*arguments: Any) -> Any:
        if _Process.forked_after_run:
            raise RuntimeError(
                "a rendra kernel was called in a forked process, where OpenMP cannot run; start the workers with "
                "multiprocessing_context='forkserver' or 'spawn', or render in the main process"
            )
        with _Process.lock:
            _Process.has_run = True
            threads = torch.get_num_threads()
            numba.set_num_threads(num_threads())
            if torch.get_num_threads() != threads:  # Numba, when it starts its threads, tells OpenMP to use them all
                torch.set_num_threads(threads)
            known = len(compiled.overloads)
            started = time.perf_counter()
            result = compiled(*arguments)
            if len(compiled.overloads) > known and compiled.stats.cache_misses:
                seconds = time.perf_counter() - started
                _log.info("compiled kernel %s in %.1f s, once: it is cached now", _short_name(function), seconds)
        return result

    run.__name__ = function.__name__
    run.__doc__ = function.__doc__
    return run


def _short_name(function: Callable[..., Any]) -> str:
    return f"{function.__module__.removeprefix('rendra.kernels.').removesuffix('.numba_cpu')}.{function.__name__}"


scalar_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")
"""Decorator for the small functions that kernels call."""

inlined_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
"""The same for what an inner loop calls with many arguments: a copy goes into every caller."""

reassociating_kernel = numba.njit(
    cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "nsz", "contract"}
)
"""The same for sums whose order may follow the vector units: still the same on every run and thread count."""
