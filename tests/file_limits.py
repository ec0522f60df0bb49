"""What every reader of files must keep to, whatever it reads."""

import contextlib
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

LONGEST_S = 5.0
LARGEST_BYTES = 1 << 30


@contextlib.contextmanager
def within_limits() -> Iterator[None]:
    """At most five seconds of computing and a gigabyte of new memory; no warning but those meant for users."""
    start = time.process_time()
    with warnings.catch_warnings(), _bounded_memory():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", UserWarning)
        yield
    assert time.process_time() - start < LONGEST_S


@contextlib.contextmanager
def _bounded_memory() -> Iterator[None]:
    """Refuse the process any further memory; elsewhere than on Linux it takes what it likes."""
    if not sys.platform.startswith("linux"):
        yield
        return
    import resource

    limits = resource.getrlimit(resource.RLIMIT_AS)
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + LARGEST_BYTES, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
