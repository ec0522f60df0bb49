"""Numbers out of text, millions at a time: lines and tokens are found with NumPy and parsed in one call.

Characters up to the space count as blank. A token is a run of characters that are not blank, and no token spans
two lines. Positions are byte offsets; rows are counted from 0, file lines from 1.
"""

import re
import warnings
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from rendra.io.errors import MeshFormatError

Positions = npt.NDArray[np.int64]

_NEWLINE, _SPACE, _HASH = 10, 32, 35
_NUMBER = re.compile(rb"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)


class Lines:
    """The lines of a text, where each begins and what its number is.

    A backslash at the end of a line that is no comment may join it with the next; numbers stay those of the file.

    Args:
        name: what errors call the file.
        data: its bytes; line ends may be LF, CRLF or CR.
        first_number: number of the first line.
        continued: whether a backslash joins lines.
    """

    def __init__(self, name: str, data: bytes, first_number: int = 1, continued: bool = True) -> None:
        self.name, self._first_number = name, first_number
        if b"\r" in data and b"\n" not in data:
            data = data.replace(b"\r", b"\n")
        self._file_breaks: Positions | None = None
        if continued and (b"\\\n" in data or b"\\\r\n" in data):
            self._file_breaks = np.flatnonzero(np.frombuffer(data, dtype=np.uint8) == _NEWLINE)
            data = _join_continued(data)
        self.data = data + b"\n\n\n"  # so that the two characters after any first one can be looked at
        self.chars = np.frombuffer(self.data, dtype=np.uint8)
        self.ends: Positions = np.flatnonzero(self.chars == _NEWLINE)[:-2]
        self.starts: Positions = np.concatenate([[0], self.ends[:-1] + 1])
        self.firsts = self._first_characters()

    def _first_characters(self) -> Positions:
        """Offset of each line's first character that is not blank; its end where all are."""
        firsts = self.starts.copy()
        indented = (self.chars[firsts] <= _SPACE) & (firsts < self.ends)
        for row in np.flatnonzero(indented).tolist():
            start, end = int(self.starts[row]), int(self.ends[row])
            line = self.data[start:end]
            firsts[row] = start + len(line) - len(line.lstrip(_BLANKS))
        return firsts

    def number(self, row: int) -> int:
        """File line, from 1, on which a row begins."""
        if self._file_breaks is None:
            return row + self._first_number
        return int(np.searchsorted(self._file_breaks, self.starts[row])) + self._first_number

    def text(self, row: int) -> str:
        """A row without its blanks at both ends."""
        line = self.data[int(self.starts[row]) : int(self.ends[row])]
        return line.decode("utf-8", "replace").strip()

    def fail(self, row: int, why: str, expected: str | None = None) -> NoReturn:
        """Raise the error of one row, quoting it."""
        raise MeshFormatError(why, self.name, self.number(row), self.text(row), expected)

    def block(self, rows: Positions, keyword_length: int = 0) -> "Block":
        """Join the given rows (ascending), their keywords blanked and what follows a # removed."""
        return Block(self, rows, keyword_length)


_BLANKS = bytes(range(_SPACE + 1))


def _join_continued(data: bytes) -> bytes:
    """Blank every backslash that ends a line, and its line end; offsets do not move."""
    joined = bytearray(data)
    for match in re.finditer(rb"\\\r?\n", data):
        line_start = data.rfind(b"\n", 0, match.start()) + 1
        if not data[line_start : match.start()].lstrip().startswith(b"#"):
            joined[match.start() : match.end()] = b" " * (match.end() - match.start())
    return bytes(joined)


class Block:
    """Some rows of a text, back to back, cut into tokens.

    Attributes:
        rows: (n,) which rows of `lines` they are.
        chars: the joined text as codes.
        begins: (T,) where each token begins in `chars`.
        counts: (n,) how many tokens each row has.
        offsets: (n + 1,) index of each row's first token.
    """

    def __init__(self, lines: Lines, rows: Positions, keyword_length: int) -> None:
        self.lines, self.rows = lines, rows
        self.chars, bounds = self._joined(keyword_length)
        blank = self.chars <= _SPACE
        opening = ~blank
        opening[1:] &= blank[:-1]
        self.begins: Positions = np.flatnonzero(opening)
        self.offsets: Positions = np.searchsorted(self.begins, bounds)
        self._bounds = bounds
        self.counts = np.diff(self.offsets)

    def _joined(self, keyword_length: int) -> tuple[npt.NDArray[np.uint8], Positions]:
        lines, rows = self.lines, self.rows
        edges = np.flatnonzero(np.diff(rows) != 1)
        runs_from = lines.starts[rows[np.concatenate([[0], edges + 1])]] if len(rows) else rows
        runs_to = lines.ends[rows[np.concatenate([edges, [len(rows) - 1]])]] + 1 if len(rows) else rows
        view = memoryview(lines.data)
        text = bytearray().join([view[a:b] for a, b in zip(runs_from.tolist(), runs_to.tolist(), strict=True)])
        bounds = np.zeros(len(rows) + 1, dtype=np.int64)
        np.cumsum(lines.ends[rows] + 1 - lines.starts[rows], out=bounds[1:])
        chars = np.frombuffer(text, dtype=np.uint8)
        keywords = bounds[:-1] + lines.firsts[rows] - lines.starts[rows]
        for i in range(keyword_length):
            chars[keywords + i] = _SPACE
        if _HASH in text:
            chars = np.frombuffer(re.sub(rb"#[^\n]*", lambda m: b" " * len(m[0]), text), dtype=np.uint8)
        return chars, bounds

    def row_of_token(self, token: int) -> int:
        """Which row of `lines` a token stands in."""
        return int(self.rows[np.searchsorted(self.offsets, token, side="right") - 1])

    def token(self, index: int) -> bytes:
        """The text of one token."""
        begin = int(self.begins[index])
        return re.match(rb"[^\x00-\x20]*", self.chars[begin : begin + 4096].tobytes())[0]  # type: ignore[index]

    def fail(self, i: int, why: str, expected: str | None = None) -> NoReturn:
        """Raise the error of the i-th row of this block."""
        self.lines.fail(int(self.rows[i]), why, expected)

    def fail_token(self, token: int, why: str, expected: str | None = None) -> NoReturn:
        """Raise the error of the row in which a token stands."""
        self.lines.fail(self.row_of_token(token), why, expected)

    def floats(self) -> npt.NDArray[np.float64]:
        """(T,) every token as a number; NaN and infinities are numbers here.

        Raises:
            MeshFormatError: some token is none.
        """
        values = parse_numbers(self.chars.tobytes(), np.float64)
        if values is None or len(values) != len(self.begins):
            self.blame(lambda token: _NUMBER.fullmatch(token) is not None, "a number")
        return values

    def blame(self, is_good: Callable[[bytes], object], expected: str) -> NoReturn:
        """Raise the error of the first token that is not good; called once it is known that one exists."""
        nul = np.flatnonzero(self.chars == 0)
        if len(nul):
            row = np.searchsorted(self._bounds, nul[0], side="right") - 1
            self.fail(int(row), "a NUL byte", "plain text")
        tokens = enumerate(self.chars.tobytes().translate(_TIDY).split())
        bad = next((i for i, token in tokens if not is_good(token)), 0)
        found = self.token(bad).decode("utf-8", "replace")[:40]
        self.fail_token(bad, f"cannot read {found!r}", expected)


_TIDY = bytes.maketrans(bytes(range(1, _SPACE)), b" " * (_SPACE - 1))


def parse_numbers(text: bytes, dtype: type[np.generic]) -> npt.NDArray[Any] | None:
    """All numbers of a blank-separated text; None where it cannot be read to its end."""
    if not text.strip(_BLANKS):
        return np.zeros(0, dtype=dtype)
    if b"\0" in text:
        return None
    values = _parse_spaced(text, dtype)
    return _parse_spaced(text.translate(_TIDY), dtype) if values is None else values


def _parse_spaced(text: bytes, dtype: type[np.generic]) -> npt.NDArray[Any] | None:
    """As `parse_numbers`; NumPy takes spaces and line ends for blanks, but no other control characters."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # NumPy before 2.4 only warned of unread text
        try:
            return np.fromstring(text, dtype=dtype, sep=" ")
        except (ValueError, DeprecationWarning):
            return None


def ragged_ranges(starts: Positions, lengths: Positions) -> Positions:
    """Concatenate range(start, start + length) of every row."""
    before = np.cumsum(lengths) - lengths
    return np.repeat(starts - before, lengths) + np.arange(int(lengths.sum()), dtype=np.int64)


def fan_triangles(lengths: Positions) -> tuple[Positions, Positions]:
    """Cut polygons, each of at least three corners, into fans around their first corner.

    Args:
        lengths: (F,) corners of each polygon; corners are numbered through all polygons.

    Returns:
        (T, 3) corner numbers, and (T,) the polygon of each triangle.
    """
    if np.all(lengths == 3):
        return np.arange(3 * len(lengths), dtype=np.int64).reshape(-1, 3), np.arange(len(lengths), dtype=np.int64)
    polygon = np.repeat(np.arange(len(lengths), dtype=np.int64), lengths - 2)
    first = (np.cumsum(lengths) - lengths)[polygon]
    second = ragged_ranges(np.cumsum(lengths) - lengths + 1, lengths - 2)
    return np.stack([first, second, second + 1], axis=1), polygon
