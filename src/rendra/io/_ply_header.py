"""The header of a PLY file: which elements follow, how many, and how each is stored."""

import re
from dataclasses import dataclass
from typing import NoReturn

from rendra.io._source import Source
from rendra.io.errors import MeshFormatError

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_MOST_COLUMNS = 10_000  # elements and properties together
_ENCODINGS = {"ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class Property:
    """One column of an element.

    Attributes:
        name: as the file calls it.
        kind: NumPy's code of the value, or of each value of the list: "f4", "u1", ...
        length_kind: NumPy's code of a list's length; None for a single value.
    """

    name: str
    kind: str
    length_kind: str | None = None


@dataclass(frozen=True)
class Element:
    """One table of the file: `count` rows with these properties, declared on `line`."""

    name: str
    count: int
    line: int
    properties: list[Property]


@dataclass(frozen=True)
class Header:
    """What the header says.

    Attributes:
        encoding: "ascii", or the byte order "<" or ">".
        elements: the tables, in file order.
        body: offset of the first byte behind the header.
        body_line: its line, from 1.
    """

    encoding: str
    elements: list[Element]
    body: int
    body_line: int


class _HeaderReader:
    """Takes a header line by line."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._line = 0
        self._text = ""
        self._position = 0
        self._encoding: str | None = None
        self._elements: list[Element] = []
        self._names: set[tuple[int, str]] = set()  # of elements behind 0, of properties behind their element's number

    def read(self) -> Header:
        """All lines up to end_header."""
        if self._next_line() != ["ply"]:
            self._fail("no PLY file", "'ply' on the first line")
        while (words := self._next_line()) != ["end_header"]:
            if not words or words[0] in ("comment", "obj_info"):
                continue
            statements = {"format": self._take_format, "element": self._take_element, "property": self._take_property}
            if words[0] not in statements:
                self._fail("unknown header statement", "format, element, property, comment, obj_info or end_header")
            statements[words[0]](words[1:])
        if self._encoding is None:
            self._fail("the header has no format line", f"format and one of {', '.join(_ENCODINGS)}")
        self._demand_columns()
        return Header(self._encoding, self._elements, self._position, self._line + 1)

    def _next_line(self) -> list[str]:
        data = self._source.data
        if self._position >= len(data):
            self._text = ""
            self._fail("the file ends within its header", "end_header")
        match = re.compile(rb"[^\r\n]*").match(data, self._position)
        assert match is not None  # it matches nothing at least
        end = match.end()
        self._position = end + (2 if data[end : end + 2] == b"\r\n" else 1)
        self._line += 1
        self._text = match[0].decode("latin-1")
        return self._text.split()

    def _fail(self, why: str, expected: str | None = None) -> NoReturn:
        raise MeshFormatError(why, self._source.name, max(self._line, 1), self._text, expected)

    def _take_format(self, words: list[str]) -> None:
        if self._encoding is not None:
            self._fail("a second format line")
        if len(words) != 2 or words[0] not in _ENCODINGS or words[1] != "1.0":
            self._fail("unknown format", f"one of {', '.join(_ENCODINGS)}, and version 1.0")
        self._encoding = _ENCODINGS[words[0]]

    def _take_element(self, words: list[str]) -> None:
        if len(words) != 2 or re.fullmatch(r"[0-9]{1,18}", words[1]) is None:
            self._fail("bad element", "element <name> <number of rows>")
        self._name(0, words[0], "an element is declared twice")
        self._elements.append(Element(words[0], int(words[1]), self._line, []))

    def _name(self, owner: int, name: str, twice: str) -> None:
        if (owner, name) in self._names:
            self._fail(twice)
        self._names.add((owner, name))
        if len(self._names) > _MOST_COLUMNS:
            self._fail("too many elements and properties", f"at most {_MOST_COLUMNS:,}")

    def _take_property(self, words: list[str]) -> None:
        if not self._elements:
            self._fail("a property before any element", "element <name> <number of rows>")
        properties = self._elements[-1].properties
        if len(words) == 2 and words[0] in _TYPES:
            new = Property(words[1], _TYPES[words[0]])
        elif len(words) == 4 and words[0] == "list" and words[1] in _TYPES and words[2] in _TYPES:
            new = Property(words[3], _TYPES[words[2]], _TYPES[words[1]])
            if new.length_kind in ("f4", "f8"):
                self._fail("the length of a list is no integer", "property list <integer type> <type> <name>")
        else:
            self._fail("bad property", "property <type> <name>, or property list <type> <type> <name>")
        self._name(len(self._elements), new.name, "a property is declared twice")
        properties.append(new)

    def _demand_columns(self) -> None:
        for element in self._elements:
            if element.count and not element.properties:
                self._line, self._text = element.line, f"element {element.name} {element.count}"
                self._fail("an element has rows, but no property")


def parse_header(source: Source) -> Header:
    """Read the header of a PLY file.

    Raises:
        MeshFormatError: it is malformed, or this is no PLY file.
    """
    return _HeaderReader(source).read()
