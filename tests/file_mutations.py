"""Damage to files: what disks, editors, bad exporters and attackers do, as strategies for Hypothesis."""

import json
import re
import struct
from collections.abc import Callable
from typing import Any, TypeAlias

from hypothesis import strategies as st
from small_files import pack_glb, unpack_glb

Edit: TypeAlias = tuple[str, int, int]  # what to do, where, and with what; the numbers wrap around

_NUMBER = re.compile(rb"(?<![A-Za-z_.])[+-]?\d+(\.\d*)?([eE][+-]?\d+)?")
_HEADER = 500  # bytes in which the counts of every format stand
_WORDS = re.compile(rb"[A-Za-z_]+")
_BYTES = b"\0\t\n\r -/.#\\\"'eE9\x7f\x80\xc3\xff\xef\xbb\xbf{}[],:"
_NUMBERS = (
    b"0", b"-1", b"1", b"2", b"4", b"5", b"6", b"255", b"256", b"65535", b"65536", b"1000000000", b"2147483647",
    b"2147483648", b"4294967295", b"4294967296", b"9223372036854775807", b"9223372036854775808", b"9" * 40,
    b"-2147483648", b"-9999999999999999999", b"1.5", b"1e9", b"1e39", b"1e400", b"-1e-400", b"nan", b"-nan", b"inf",
    b"-inf", b"", b"0x10", b"1_0", b"1,5", b"--1", b"1e", b".", b"/", b"1/2/3/4", b"\xd9\xa1", b"true", b"null",
)  # fmt: skip
_WORDS_OF_FORMATS = (
    b"v", b"vt", b"vn", b"f", b"usemtl", b"mtllib", b"newmtl", b"Kd", b"Ns", b"map_Kd", b"ply", b"format", b"ascii",
    b"binary_little_endian", b"binary_big_endian", b"element", b"property", b"list", b"uchar", b"char", b"double",
    b"float", b"uint", b"vertex", b"face", b"vertex_indices", b"end_header", b"x", b"nx", b"red", b"OFF", b"COFF",
    b"NOFF", b"STOFF", b"4OFF", b"solid", b"facet", b"endsolid", b"loop", b"../x", b"file:///etc/passwd", b"mesh.obj",
    b"mesh.mtl", b"mesh.gltf", b"mesh.bin", b"VEC4", b"MAT4", b"SCALAR", b"POSITION", b"NORMAL", b"uri", b"sparse",
)  # fmt: skip
_PATTERNS = (
    b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x7f\xff\xff\xff", b"\0\0\0\x80", b"\x80\0\0\0",
    b"\0\xca\x9a\x3b", b"\x3b\x9a\xca\0", b"\0\0\xc0\x7f", b"\x7f\xc0\0\0", b"\0\0\x80\x7f", b"\x7f\x80\0\0",
    b"\x01\0\0\0", b"\0\0\0\x01", b"\xff\xff\x7f\x7f", b"\x05\0", b"\xff\xff",
)  # fmt: skip
_JSON_VALUES: tuple[Any, ...] = (
    None, True, 0, 1, 2, -1, 3, 5, 7, 255, 5121, 5123, 5125, 5126, 2**31, 2**32, 10**9, 10**18, 10**40, 0.5, 1e39,
    float("nan"), float("inf"), "", "x", "../x", "VEC4", "SCALAR", "MAT4", "data:,", "data:;base64,AAAA", "paint.png",
    "data:image/png;base64,!!!!", "file:///etc/passwd", [], {}, [0], [1, 1], [[]], [None] * 3, [1e30] * 16, [0] * 4,
    {"extensions": {}}, {"count": 10**9, "indices": {"bufferView": 0, "componentType": 5125}, "values": {}},
)  # fmt: skip


def _flip(data: bytes, where: int, what: int) -> bytes:
    return _set(data, where, bytes([data[where % len(data)] ^ (1 << what % 8)]))


def _overwrite(data: bytes, where: int, what: int) -> bytes:
    return _set(data, where, _BYTES[what % len(_BYTES) :][:1])


def _pattern(data: bytes, where: int, what: int) -> bytes:
    return _set(data, where, _PATTERNS[what % len(_PATTERNS)])


def _set(data: bytes, where: int, new: bytes) -> bytes:
    at = where % len(data)
    return data[:at] + new + data[at + len(new) :]


def _insert(data: bytes, where: int, what: int) -> bytes:
    at = where % (len(data) + 1)
    return data[:at] + _BYTES[what % len(_BYTES) :][:1] * (1 + what % 7) + data[at:]


def _truncate(data: bytes, where: int, what: int) -> bytes:
    return data[: where % len(data)]


def _remove(data: bytes, where: int, what: int) -> bytes:
    at = where % len(data)
    return data[:at] + data[at + 1 + what % 64 :]


def _repeat(data: bytes, where: int, what: int) -> bytes:
    at = where % len(data)
    end = at + 1 + what % 200
    return data[:end] + data[at:]


def _number(data: bytes, where: int, what: int) -> bytes:
    return _substitute(data, list(_NUMBER.finditer(data)), where, _NUMBERS[what % len(_NUMBERS)])


def _header_number(data: bytes, where: int, what: int) -> bytes:
    return _number(data[:_HEADER], where, what) + data[_HEADER:]


def _word(data: bytes, where: int, what: int) -> bytes:
    return _substitute(data, list(_WORDS.finditer(data)), where, _WORDS_OF_FORMATS[what % len(_WORDS_OF_FORMATS)])


def _substitute(data: bytes, places: list[re.Match[bytes]], where: int, new: bytes) -> bytes:
    if not places:
        return data
    match = places[where % len(places)]
    return data[: match.start()] + new + data[match.end() :]


def _line_twice(data: bytes, where: int, what: int) -> bytes:
    lines = data.split(b"\n")
    lines.insert(what % (len(lines) + 1), lines[where % len(lines)])
    return b"\n".join(lines)


def _line_away(data: bytes, where: int, what: int) -> bytes:
    lines = data.split(b"\n")
    del lines[where % len(lines)]
    return b"\n".join(lines)


def _line_ends(data: bytes, where: int, what: int) -> bytes:
    return data.replace(b"\n", (b"\r\n", b"\r", b"\n\n", b" \\\n")[what % 4])


def _document(data: bytes, where: int, what: int) -> bytes:
    """Another value somewhere in a glTF document, in a container that is whole; other files stay as they are."""
    try:
        document, body = unpack_glb(data) if data[:4] == b"glTF" else (json.loads(data), None)
    except (ValueError, struct.error, RecursionError):
        return data
    if not isinstance(document, dict):
        return data
    places = _places(document)
    if not places:
        return data
    holder, key = places[where % len(places)]
    value = _JSON_VALUES[what % len(_JSON_VALUES)]
    if isinstance(value, str) and value == "x" and isinstance(holder, dict):
        del holder[key]
    else:
        holder[key] = value
    return json.dumps(document).encode() if body is None else pack_glb(document, body)


def _places(value: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) below a value of JSON."""
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found: list[tuple[Any, Any]] = []
    for key, inner in entries:
        found += [(value, key), *_places(inner)]
    return found


_EDITS: dict[str, Callable[[bytes, int, int], bytes]] = {
    "flip": _flip, "overwrite": _overwrite, "pattern": _pattern, "insert": _insert, "truncate": _truncate,
    "remove": _remove, "repeat": _repeat, "number": _number, "header number": _header_number, "word": _word,
    "line twice": _line_twice, "line away": _line_away, "line ends": _line_ends, "document": _document,
}  # fmt: skip

_anywhere = st.integers(0, 2**20)
edits: st.SearchStrategy[list[Edit]] = st.lists(
    st.tuples(st.sampled_from([*_EDITS, "number", "document"]), _anywhere, _anywhere), min_size=1, max_size=4
)


def damaged(data: bytes, steps: list[Edit]) -> bytes:
    """The file after all edits, one after the other."""
    for name, where, what in steps:
        data = _EDITS[name](data, where, what) if data else data
    return data
