"""`report.html`: everything that a run or a sweep left behind, as one file that needs no network.

Three layers: what is read (`settings`, `curves`, `media`), the two pages (`run_page`, `sweep_page`), and how text
becomes a page in which nothing from outside can run (`markup`). Imports stay light: a report is made at the end of
every run, within its time.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from rendra_lab.report import write_text

__all__ = ["leave_run_report", "leave_sweep_report", "write_run_report", "write_sweep_report"]

log = logging.getLogger(__name__)


def write_run_report(folder: str | Path, max_mb: float = 25.0) -> Path:
    """Writes `report.html` into the folder of a run, finished or not; answers its path.

    Args:
        folder: of the run.
        max_mb: upper limit of the file in MB of 10^6 bytes; what does not fit is named on the page.

    Raises UserError where the folder holds nothing of a run.
    """
    from rendra_lab.html_report.run_page import run_page

    return _write(Path(folder) / "report.html", run_page(Path(folder), int(max_mb * 1e6)))


def write_sweep_report(folder: str | Path, max_mb: float = 25.0) -> Path:
    """Writes `report.html` into the folder of a sweep: its runs compared, each with a link to its own report,
    which is made where there is none.

    Args:
        folder: of the sweep.
        max_mb: upper limit of the file in MB of 10^6 bytes; what does not fit is named on the page.

    Raises UserError where the folder holds no job of a sweep.
    """
    from rendra_lab.html_report.sweep_page import sweep_page

    for job in sorted(Path(folder).glob("*/.hydra")):
        if not (job.parent / "report.html").exists():
            leave_run_report(job.parent)
    return _write(Path(folder) / "report.html", sweep_page(Path(folder), int(max_mb * 1e6)))


def leave_run_report(folder: Path, wanted: bool = True) -> Path | None:
    """The report at the end of a run, however it ended. Never raises an Exception: one line in the log instead.

    None where it is not wanted, where the run has reached nothing that could be shown, or where it cannot be made.
    """
    reached = any((folder / name).exists() for name in ("metrics.csv", "images", "exports"))
    return _attempt(write_run_report, folder) if wanted and reached else None


def leave_sweep_report(folder: Path, wanted: bool = True) -> Path | None:
    """The report at the end of a sweep, as `leave_run_report`."""
    return _attempt(write_sweep_report, folder) if wanted else None


def _attempt(write: Callable[[Path], Path], folder: Path) -> Path | None:
    try:
        return write(folder)
    except Exception as error:  # a run is worth more than its report
        reason = " ".join(str(error).split()) or "no reason given"
        log.warning("no report.html: %s: %s", type(error).__name__, reason[:300])
        log.debug("the report failed here", exc_info=True)
        return None


def _write(path: Path, page: str) -> Path:
    write_text(path, page)
    return path
