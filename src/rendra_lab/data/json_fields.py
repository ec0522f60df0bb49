"""JSON files that others made: read within limits, each field checked as it is taken."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rendra_lab.errors import UserError

_MOST_BYTES = 64 << 20
_LONGEST_QUOTE = 60


class Fields:
    """The fields of a JSON object.

    Args:
        tree: the object.
        where: file and place in it, for complaints.
    """

    def __init__(self, tree: Mapping[str, Any], where: str) -> None:
        self.tree = tree
        self.where = where

    def __contains__(self, key: str) -> bool:
        return self.tree.get(key) is not None

    def complaint(self, key: str, expected: str) -> UserError:
        """The error that says what stands there instead."""
        if key not in self:
            return UserError(f"{self.where}: {key!r} is missing; expected {expected}")
        found = repr(self.tree[key])
        shortened = found if len(found) <= _LONGEST_QUOTE else found[: _LONGEST_QUOTE - 3] + "..."
        return UserError(f"{self.where}: {key!r} is {shortened}; expected {expected}")

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number; without a default it must be there."""
        if key not in self and default is not None:
            return default
        value = _finite(self.tree.get(key))
        if value is None:
            raise self.complaint(key, "a finite number")
        return value

    def positive(self, key: str) -> float:
        """A finite number above zero."""
        if key not in self or self.number(key) <= 0:
            raise self.complaint(key, "a number above zero")
        return self.number(key)

    def pixels(self, key: str) -> int:
        """A side of an image, in whole pixels."""
        value = self.positive(key)
        if value != int(value) or value > 1 << 20:
            raise self.complaint(key, "a whole number of pixels")
        return int(value)

    def angle(self, key: str) -> float:
        """A field of view in radians."""
        if key not in self or not 0 < self.number(key) < math.pi:
            raise self.complaint(key, "an angle in radians between 0 and pi")
        return self.number(key)

    def text(self, key: str) -> str:
        """A string that is not empty."""
        value = self.tree.get(key)
        if not isinstance(value, str) or not value:
            raise self.complaint(key, "a text")
        return value

    def flag(self, key: str) -> bool:
        """True or false; false where it is missing."""
        value = self.tree.get(key, False)
        if not isinstance(value, bool) and value is not None:
            raise self.complaint(key, "true or false")
        return bool(value)

    def texts(self, key: str) -> list[str]:
        """A list of strings."""
        value = self.tree.get(key)
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise self.complaint(key, "a list of texts")
        return value

    def objects(self, key: str) -> list[dict[str, Any]]:
        """A list of objects, of one at least."""
        value = self.tree.get(key)
        if not isinstance(value, list) or not value or not all(isinstance(item, dict) for item in value):
            raise self.complaint(key, "a list of objects, one at least")
        return value

    def numbers(self, key: str, count: int) -> list[float]:
        """A list of so many finite numbers."""
        value = self.tree.get(key)
        numbers = [_finite(item) for item in value] if isinstance(value, list) else []
        if len(numbers) != count or None in numbers:
            raise self.complaint(key, f"a list of {count} finite numbers")
        return [number for number in numbers if number is not None]

    def pose(self, key: str) -> Tensor:
        """A matrix (4, 4) float64; 0 0 0 1 is added below three rows."""
        rows = self.tree.get(key)
        if (
            not isinstance(rows, list)
            or len(rows) not in (3, 4)
            or not all(isinstance(row, list) and len(row) == 4 for row in rows)
        ):
            raise self.complaint(key, "a matrix of 4 x 4 or 3 x 4 numbers")
        numbers = [[_finite(value) for value in row] for row in rows]
        if any(value is None for row in numbers for value in row):
            bad = next(value for row in rows for value in row if _finite(value) is None)
            raise UserError(f"{self.where}: {key!r} holds {bad!r}; expected finite numbers")
        return torch.tensor([*numbers, [0.0, 0.0, 0.0, 1.0]][:4], dtype=torch.float64)


def read_json(path: Path, most_bytes: int = _MOST_BYTES) -> dict[str, Any]:
    """The object that a JSON file holds.

    Raises:
        UserError: as `read_json_value`, or no object.
    """
    tree = read_json_value(path, most_bytes)
    if not isinstance(tree, dict):
        raise UserError(f"{path} holds a {type(tree).__name__}; expected an object")
    return tree


def read_json_value(path: Path, most_bytes: int = _MOST_BYTES) -> Any:
    """What a JSON file holds, a list perhaps.

    Raises:
        UserError: no file, one of more bytes than that (64 MiB), no JSON, or nested too deeply.
    """
    if not path.is_file():
        raise UserError(f"there is no file {path}")
    if path.stat().st_size > most_bytes:
        raise UserError(f"{path} has {path.stat().st_size:,} bytes; at most {most_bytes:,} are read")
    try:
        return json.loads(path.read_bytes())
    except RecursionError as error:
        raise UserError(f"{path} is nested too deeply") from error
    except ValueError as error:  # also of bytes that are no text, and of numbers without end
        raise UserError(f"{path} is no JSON: {error}") from error
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error


def _finite(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None
