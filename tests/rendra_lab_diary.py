"""A toy that writes down when it starts and ends, so that tests can count."""

import os
from pathlib import Path

from rendra_lab_toy import ToyTask


class DiaryToy(ToyTask):
    """Appends a line to `outputs/diary.txt` at the start of the fit and at the end of the test."""

    def on_fit_start(self) -> None:
        self._write("start")

    def on_test_end(self) -> None:
        self._write("end")

    def _write(self, what: str) -> None:
        with Path("outputs/diary.txt").open("a") as diary:
            diary.write(f"{what} {Path(self.trainer.default_root_dir).name} {os.getpid()} -\n")
