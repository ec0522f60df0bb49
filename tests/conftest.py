"""Fixtures that every test may use."""

import os
import signal
from pathlib import Path

# Tests run side by side: threads that wait must sleep, or they take the cores from those that work.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import pytest
import torch

# A shell that starts the tests in the background lets them, and every program they start, ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The real inputs lie beside the project, never in it: a user has no such folder, and then these tests skip.
SHARED_DATA = Path(os.environ.get("RENDRA_SHARED_DATA", Path(__file__).parents[2] / "shared" / "data"))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--update-golden", action="store_true", help="draw the golden images anew")


@pytest.fixture
def shared_data() -> Path:
    """The folder of real inputs; skips where the machine has none."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"no real inputs at {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture(autouse=True)
def _seeded() -> None:
    """Every test starts from the same random state, whatever ran before it."""
    torch.manual_seed(0)


def pytest_configure(config: pytest.Config) -> None:
    """Drop compiled kernels that are older than any kernel's source.

    Numba's cache watches the file of the compiled function alone, not those of the functions that it calls.
    """
    kernels = Path(__file__).parents[1] / "src" / "rendra" / "kernels"
    newest = max(source.stat().st_mtime for source in kernels.rglob("*.py"))
    for compiled in kernels.rglob("*.nb[ic]"):
        if compiled.stat().st_mtime < newest:
            compiled.unlink(missing_ok=True)
