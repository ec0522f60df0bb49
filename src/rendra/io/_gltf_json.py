"""The JSON of a glTF file: strictly read, and asked field by field, each answer checked.

Positions in errors read like `meshes[2].primitives[0].mode`.
"""

import contextlib
import gc
import json
import math
from collections.abc import Iterator
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from rendra.io.errors import MeshFormatError

_LARGEST_EXACT = 1 << 53  # beyond it a JSON number may not be the integer that was meant
_MOST_ITEMS = 1 << 16  # of one list; each takes some 20 microseconds and a quarter of a kilobyte
_MISSING: Any = object()


class _RefusedError(ValueError):
    """JSON that parses, but says something that glTF forbids."""


def parse_json(data: bytes, name: str, offset: int, what: str = "the JSON") -> dict[str, Any]:
    """Read one JSON object.

    Args:
        data: its bytes, UTF-8.
        name: what errors call the file.
        offset: where `data` begins in the file; errors name bytes where it is not 0, else lines.
        what: what errors call the text.

    Raises:
        MeshFormatError: no UTF-8, no JSON, no object; a key that comes twice, NaN or Infinity, or nesting beyond
            what Python's parser follows.
    """
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        why = f"{what} is not UTF-8 at byte {offset + error.start}"
        raise MeshFormatError(why, name, expected="UTF-8 text") from error
    try:
        with _without_collector():
            value = json.loads(text, object_pairs_hook=_unique, parse_constant=_refuse_constant)
    except json.JSONDecodeError as error:
        near = text[error.pos : error.pos + 40]
        place = f" at byte {offset + len(text[: error.pos].encode())}" if offset else ""
        raise MeshFormatError(
            f"{what} is malformed{place} ({error.msg})", name, None if offset else error.lineno, near
        ) from error
    except RecursionError:
        raise MeshFormatError(f"{what} is nested too deeply", name) from None
    except ValueError as error:  # what the hooks refuse, and integers of thousands of digits
        raise MeshFormatError(f"{what} is malformed ({error})", name) from error
    if not isinstance(value, dict):
        raise MeshFormatError(f"{what} is no object", name, found=text[:40], expected="{...}")
    return value


@contextlib.contextmanager
def _without_collector() -> Iterator[None]:
    """No search for circles, which JSON cannot have, and which takes most of the time of a million lists."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise _RefusedError(f"the key {twice[:40]!r} comes twice in one object")
    return found


def _refuse_constant(constant: str) -> NoReturn:
    raise _RefusedError(f"{constant} is no JSON number")


class Item:
    """One JSON object, and where it stands.

    Args:
        value: the object.
        where: its position, "" for the whole document.
        file: name of the file.
    """

    __slots__ = ("_value", "file", "where")

    def __init__(self, value: dict[str, Any], where: str, file: str) -> None:
        self._value, self.where, self.file = value, where, file

    def fail(self, key: str | None, why: str, found: object = _MISSING, expected: str | None = None) -> NoReturn:
        """Raise the error of one field, or of the whole object."""
        place = self.where if key is None else f"{self.where}.{key}".lstrip(".")
        shown = None if found is _MISSING else str(found)[:200]
        raise MeshFormatError(f"{place}: {why}" if place else why, self.file, found=shown, expected=expected)

    def __contains__(self, key: str) -> bool:
        """Whether the field is given."""
        return key in self._value

    def integer(self, key: str, default: int | None = None, low: int = 0, high: int | None = None) -> int:
        """A whole number from `low` to `high`, both included; `default` where the field is missing."""
        value = self._value.get(key, default)
        expected = f"a whole number from {low}" + ("" if high is None else f" to {high}")
        if value is None:
            self.fail(key, "is missing", expected=expected)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int):
            self.fail(key, "is no whole number", value, expected)
        if not low <= value <= (_LARGEST_EXACT if high is None else high):
            self.fail(key, "is out of range", value, expected)
        return value

    def index(self, key: str, count: int, of: str) -> int | None:
        """A reference to one of `count` things called `of`; None where the field is missing."""
        if key not in self._value:
            return None
        value = self.integer(key)
        if value >= count:
            self.fail(key, f"there is no such one among the {of}", value, f"less than {count}")
        return value

    def number(self, key: str, default: float) -> float:
        """A finite number."""
        return _finite(self, key, self._value.get(key, default))

    def numbers(self, key: str, default: list[float]) -> npt.NDArray[np.float64]:
        """(len(default),) finite numbers."""
        value = self._value.get(key, default)
        if not isinstance(value, list) or len(value) != len(default):
            self.fail(key, "is no list of this length", value, f"{len(default)} numbers")
        return np.array([_finite(self, f"{key}[{i}]", each) for i, each in enumerate(value)])

    def text(self, key: str, default: str | None = None) -> str:
        """A string."""
        value = self._value.get(key, default)
        if not isinstance(value, str):
            why = "is missing" if value is None else "is no text"
            self.fail(key, why, _MISSING if value is None else value, "a string")
        return value

    def flag(self, key: str) -> bool:
        """True or false; false where the field is missing."""
        value = self._value.get(key, False)
        if not isinstance(value, bool):
            self.fail(key, "is no truth value", value, "true or false")
        return value

    def item(self, key: str) -> "Item | None":
        """An object; None where the field is missing."""
        if key not in self._value:
            return None
        value = self._value[key]
        if not isinstance(value, dict):
            self.fail(key, "is no object", value, "{...}")
        return Item(value, f"{self.where}.{key}".lstrip("."), self.file)

    def items(self, key: str) -> "list[Item]":
        """A list of at most 65,536 objects; none where the field is missing."""
        place = f"{self.where}.{key}".lstrip(".")
        found, values = [], self._list(key)
        if len(values) > _MOST_ITEMS:
            self.fail(key, "is too long", f"{len(values):,} entries", f"at most {_MOST_ITEMS:,}")
        for i, value in enumerate(values):
            if not isinstance(value, dict):
                self.fail(f"{key}[{i}]", "is no object", value, "{...}")
            found.append(Item(value, f"{place}[{i}]", self.file))
        return found

    def indices(self, key: str, count: int, of: str) -> list[int]:
        """References to `count` things called `of`; none where the field is missing."""
        values = self._list(key)
        for i, value in enumerate(values):
            if type(value) is not int or not 0 <= value < count:
                Item({str(i): value}, f"{self.where}.{key}", self.file).index(str(i), count, of)
        return [int(value) for value in values]

    def texts(self, key: str) -> list[str]:
        """A list of strings; none where the field is missing."""
        values = self._list(key)
        for i, value in enumerate(values):
            if not isinstance(value, str):
                self.fail(f"{key}[{i}]", "is no text", value, "a string")
        return values

    def extension(self, name: str) -> "Item | None":
        """What an extension says of this object; None where it says nothing."""
        extensions = self.item("extensions")
        return None if extensions is None else extensions.item(name)

    def _list(self, key: str) -> list[Any]:
        value = self._value.get(key, [])
        if not isinstance(value, list):
            self.fail(key, "is no list", value, "[...]")
        return value


def _finite(item: Item, key: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        item.fail(key, "is no number", value, "a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        item.fail(key, "is not finite", value, "a finite number")
    return number
