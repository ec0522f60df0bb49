"""Text files with numbers in their lines, such as cameras come in; whatever is wrong names file and line."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from rendra_lab.data.photographs import demand_rotations
from rendra_lab.errors import UserError

_MOST_BYTES = 64 << 20
_LONGEST_QUOTE = 40


def read_lines(path: Path, expected: str) -> list[tuple[str, list[str]]]:
    """The words of each line that is not empty, and where it stands: "FILE, line 3".

    Args:
        path: of the file.
        expected: what it should hold, for the complaint about a file without any: "pairs of frames".

    Raises:
        UserError: no file, one of more than 64 MiB, no text, or nothing in it.
    """
    if not path.is_file():
        raise UserError(f"there is no file {path}; expected {expected} in it")
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise UserError(f"{path} has {path.stat().st_size:,} bytes; at most {_MOST_BYTES:,} are read")
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is no text: {error.reason} at byte {error.start}; expected {expected}") from error
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    lines = [(f"{path}, line {number}", line.split()) for number, line in enumerate(text.splitlines(), 1)]
    lines = [(where, words) for where, words in lines if words]
    if not lines:
        raise UserError(f"{path} is empty; expected {expected}")
    return lines


def numbers(words: Sequence[str], count: int, where: str, expected: str) -> list[float]:
    """The numbers that words stand for.

    Args:
        words: of a line.
        count: how many there must be.
        where: they stand, for complaints.
        expected: what they should be: "12 numbers of a pose".

    Raises:
        UserError: another count; a word that is no number, or not a finite one.
    """
    if len(words) != count:
        raise UserError(f"{where} has {len(words)} of them; expected {expected}")
    try:
        found = [float(word) for word in words]
    except ValueError:
        found = [math.nan]
    if all(map(math.isfinite, found)):
        return found
    place, bad = next((i, word) for i, word in enumerate(words, 1) if not _is_finite(word))
    raise UserError(f"{where}: number {place} is {bad[:_LONGEST_QUOTE]!r}; expected {expected}, all of them finite")


def rigid_motions(rows: npt.NDArray[np.float64], places: Sequence[str]) -> npt.NDArray[np.float64]:
    """Matrices (N, 4, 4) of rows (N, 12), which hold the upper three lines of each.

    Raises:
        UserError: one that scales, shears or mirrors; `places` says which one it is.
    """
    motions = np.zeros((len(rows), 4, 4))
    motions[:, :3] = rows.reshape(-1, 3, 4)
    motions[:, 3, 3] = 1
    demand_rotations(torch.from_numpy(np.ascontiguousarray(motions[:, :3, :3])), places)
    return motions


def _is_finite(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False
