"""The tables of a PLY file as arrays, from text or from bytes of either order.

Nothing is allocated before the file is known to be long enough for it.
"""

import struct
import warnings
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
import numpy.typing as npt

from rendra.io._bulk_text import Block, Lines, Positions, ragged_ranges
from rendra.io._ply_header import Element, Header, Property
from rendra.io._source import Source
from rendra.io.errors import MeshFormatError

Values = npt.NDArray[np.generic]


@dataclass(frozen=True)
class Lists:
    """A column of lists: all their values in a row, and (n,) how many each row has."""

    values: Values
    lengths: Positions


@dataclass(frozen=True)
class Table:
    """The rows of one element.

    Attributes:
        element: its declaration.
        columns: by property name, (n,) values, or lists.
        file: name of the file.
        lines: (n,) file line of each row; None in binary files.
    """

    element: Element
    columns: dict[str, Values | Lists]
    file: str
    lines: Positions | None

    def fail(self, row: int, why: str, found: str | None = None, expected: str | None = None) -> NoReturn:
        """Raise the error of one row."""
        line = None if self.lines is None else int(self.lines[row])
        raise MeshFormatError(f"{self.element.name} {row}: {why}", self.file, line, found, expected)


def read_tables(source: Source, header: Header) -> dict[str, Table]:
    """All elements of a file, by name.

    Raises:
        MeshFormatError: the body is shorter than the header says, or does not fit its types.
    """
    if header.encoding == "ascii":
        return _read_ascii(source, header)
    return _BinaryReader(source, header).read()


def _read_ascii(source: Source, header: Header) -> dict[str, Table]:
    lines = Lines(source.name, source.data[header.body :], first_number=header.body_line, continued=False)
    rows = np.flatnonzero(lines.chars[lines.firsts] > 32)
    declared = sum(element.count for element in header.elements)
    if declared > len(rows):
        _fail_short(source, header.elements, len(rows), "lines")
    if declared < len(rows):
        lost = f"line {lines.number(int(rows[declared]))}"
        warnings.warn(f"{source.name}: {lost} and what follows belongs to no element; it is ignored", stacklevel=5)
    block = lines.block(rows[:declared])
    values = block.floats()
    tables, start = {}, 0
    for element in header.elements:
        stop = start + element.count
        cursor, columns = block.offsets[start:stop].copy(), {}
        for each in element.properties:
            columns[each.name], cursor = _ascii_column(block, start, each, values, cursor)
        surplus = cursor < block.offsets[start + 1 : stop + 1]
        if surplus.any():
            block.fail(start + int(surplus.argmax()), f"more values than '{element.name}' has properties")
        numbers = rows[start:stop] + header.body_line
        tables[element.name] = Table(element, columns, source.name, numbers)
        start = stop
    return tables


def _ascii_column(
    block: Block, start: int, each: Property, values: npt.NDArray[np.float64], cursor: Positions
) -> tuple[Values | Lists, Positions]:
    """One column, and where the next one begins in each row."""
    ends = block.offsets[start + 1 : start + 1 + len(cursor)]
    _demand_room(block, start, cursor < ends, each)
    if each.length_kind is None:
        return _cast(block, values, cursor, each.kind, each), cursor + 1
    lengths = _cast(block, values, cursor, each.length_kind, each).astype(np.int64)
    if (lengths < 0).any():
        block.fail(start + int((lengths < 0).argmax()), f"list '{each.name}' has a negative length")
    _demand_room(block, start, cursor + lengths < ends, each)
    tokens = ragged_ranges(cursor + 1, lengths)
    return Lists(_cast(block, values, tokens, each.kind, each), lengths), cursor + 1 + lengths


def _demand_room(block: Block, start: int, fits: npt.NDArray[np.bool_], each: Property) -> None:
    if not fits.all():
        block.fail(start + int((~fits).argmax()), f"the line ends before '{each.name}' does")


def _cast(block: Block, values: npt.NDArray[np.float64], tokens: Positions, kind: str, each: Property) -> Values:
    """Numbers in the type that the header gives them; what the type cannot hold is an error."""
    picked = values[tokens]
    if kind in ("f4", "f8"):
        with np.errstate(over="ignore"):
            return picked.astype(kind)
    limits = np.iinfo(kind)
    bad = ~((picked >= limits.min) & (picked <= limits.max) & (picked == np.floor(picked)))
    if bad.any():
        expected = f"a whole number from {limits.min} to {limits.max}"
        block.fail_token(int(tokens[bad.argmax()]), f"bad value for '{each.name}'", expected)
    return picked.astype(kind)


def _fail_short(source: Source, elements: list[Element], have: int, unit: str) -> NoReturn:
    wanted = ", ".join(f"{element.count} of '{element.name}'" for element in elements)
    raise MeshFormatError(
        "the file is shorter than its header says",
        source.name,
        elements[0].line if elements else None,
        f"{have} {unit}",
        wanted,
    )


class _BinaryReader:
    """Walks the bytes behind the header, one element after the other."""

    def __init__(self, source: Source, header: Header) -> None:
        self._source, self._header = source, header
        self._bytes = np.frombuffer(source.data, dtype=np.uint8)
        self._position = header.body

    def read(self) -> dict[str, Table]:
        """All elements."""
        tables = {}
        for element in self._header.elements:
            tables[element.name] = Table(element, self._read_element(element), self._source.name, None)
        left = len(self._source.data) - self._position
        if left:
            warnings.warn(f"{self._source.name}: {left} bytes behind the last element are ignored", stacklevel=6)
        return tables

    def _read_element(self, element: Element) -> dict[str, Values | Lists]:
        fewest = sum(_width(each.length_kind or each.kind) for each in element.properties)
        left = len(self._source.data) - self._position
        if element.count * fewest > left:
            raise MeshFormatError(
                f"the file is too short for its {element.count} rows of '{element.name}'",
                self._source.name,
                element.line,
                f"{left} bytes",
                f"at least {element.count * fewest}",
            )
        if not element.count:
            return {each.name: self._nothing(each) for each in element.properties}
        return self._read_uniform(element) or self._read_ragged(element)

    def _nothing(self, each: Property) -> Values | Lists:
        empty = np.zeros(0, dtype=each.kind)
        return empty if each.length_kind is None else Lists(empty, np.zeros(0, dtype=np.int64))

    def _read_uniform(self, element: Element) -> dict[str, Values | Lists] | None:
        """All rows at once, if all lists are as long as those of the first row."""
        order, fields, lengths, position = self._header.encoding, [], {}, self._position
        for i, each in enumerate(element.properties):
            if each.length_kind is None:
                fields.append((f"v{i}", order + each.kind))
                position += _width(each.kind)
                continue
            lengths[i] = length = self._length_at(position, each.length_kind)
            position += _width(each.length_kind) + length * _width(each.kind)
            if length < 0 or position > len(self._source.data):
                return None
            fields += [(f"n{i}", order + each.length_kind), (f"v{i}", order + each.kind, (length,))]  # type: ignore[list-item]
        row = np.dtype(fields)
        if self._position + element.count * row.itemsize > len(self._source.data):
            return None
        rows = np.frombuffer(self._source.data, row, element.count, self._position)
        if any((rows[f"n{i}"] != length).any() for i, length in lengths.items()):
            return None
        self._position += element.count * row.itemsize
        columns: dict[str, Values | Lists] = {}
        for i, each in enumerate(element.properties):
            values = rows[f"v{i}"].astype(each.kind)
            columns[each.name] = values
            if i in lengths:
                columns[each.name] = Lists(values.reshape(-1), np.full(element.count, lengths[i], dtype=np.int64))
        return columns

    def _length_at(self, position: int, kind: str) -> int:
        """The length of a list; -1 where the file ends before it."""
        raw = self._source.data[position : position + _width(kind)]
        return int(np.frombuffer(raw, self._header.encoding + kind)[0]) if len(raw) == _width(kind) else -1

    def _read_ragged(self, element: Element) -> dict[str, Values | Lists]:
        """Walk the rows to learn where each list is, then gather whole columns."""
        cursor, starts, lengths = self._walk(element)
        columns: dict[str, Values | Lists] = {}
        seen = 0
        for each in element.properties:
            width = _width(each.kind)
            if each.length_kind is None:
                columns[each.name] = self._gather(cursor, each.kind)
                cursor = cursor + width
                continue
            start, length = starts[:, seen], lengths[:, seen]
            offsets = width * ragged_ranges(np.zeros_like(length), length)
            columns[each.name] = Lists(self._gather(np.repeat(start, length) + offsets, each.kind), length)
            cursor, seen = start + width * length, seen + 1
        return columns

    def _walk(self, element: Element) -> tuple[Positions, Positions, Positions]:
        """(n,) where each row begins, (n, lists) where each of its lists begins and how long it is."""
        steps, skip = [], 0
        for each in element.properties:
            if each.length_kind is None:
                skip += _width(each.kind)
            else:
                reader = struct.Struct(self._header.encoding + _STRUCT[each.length_kind])
                steps.append((skip, reader.unpack_from, reader.size, _width(each.kind)))
                skip = 0
        rows, starts, lengths = array("q"), array("q"), array("q")
        data, position, end = self._source.data, self._position, len(self._source.data)
        try:
            for _ in range(element.count):
                rows.append(position)
                for before, unpack_from, size, width in steps:
                    position += before
                    (length,) = unpack_from(data, position)
                    position += size
                    starts.append(position)
                    lengths.append(length)
                    if length < 0:
                        raise IndexError
                    position += length * width
                position += skip
                if position > end:
                    raise IndexError
        except (IndexError, struct.error) as error:
            self._fail_row(element, len(rows) - 1, lengths[-1:], error)
        self._position = position
        shape = (element.count, len(steps))
        return (
            np.array(rows, dtype=np.int64),
            np.array(starts, dtype=np.int64).reshape(shape),
            np.array(lengths, dtype=np.int64).reshape(shape),
        )

    def _fail_row(self, element: Element, row: int, last_length: Sequence[int], cause: Exception) -> NoReturn:
        found = f"a list of {last_length[0]}" if last_length else None
        raise MeshFormatError(
            f"{element.name} {row} of {element.count} has a negative length, or runs past the end of the file",
            self._source.name,
            element.line,
            found,
            f"at most {len(self._source.data)} bytes in all",
        ) from cause

    def _gather(self, places: Positions, kind: str) -> Values:
        """Values that lie at any byte offsets."""
        width = _width(kind)
        raw = self._bytes[places[:, None] + np.arange(width)]
        return np.ascontiguousarray(raw).view(self._header.encoding + kind).reshape(-1).astype(kind)


_STRUCT = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I"}


def _width(kind: str) -> int:
    return int(kind[1])
