"""Tables of numbers on their way into a file: checked, and turned into text many rows at a time."""

import numpy as np
import torch
from torch import Tensor

_ROWS_AT_ONCE = 1 << 15


def check_decimals(decimal_places: int | None) -> None:
    """Demand a whole number from 0 to 30, or None."""
    whole = isinstance(decimal_places, int) and not isinstance(decimal_places, bool)
    if decimal_places is not None and not (whole and 0 <= decimal_places <= 30):
        raise ValueError(f"decimal_places is {decimal_places!r}; expected a whole number from 0 to 30, or None")


def number_format(decimal_places: int | None) -> str:
    """The % format of a coordinate."""
    return "%f" if decimal_places is None else f"%.{decimal_places}f"


def float_rows(values: Tensor, width: int, name: str, count: str) -> np.ndarray:
    """(n, width) float64 of a tensor that has that shape or is empty.

    Raises:
        ValueError: another shape, or a number that is not finite.
    """
    table = _table(values, width, name, count).astype(np.float64)
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        raise ValueError(f"'{name}' is not finite in row {int(bad.argmax())}: {table[bad.argmax()].tolist()}")
    return table


def single_rows(values: Tensor, width: int, name: str, count: str) -> np.ndarray:
    """(n, width) float32, contiguous, of a tensor that has that shape or is empty.

    Raises:
        ValueError: another shape, or a number that is not finite in single precision.
    """
    table = float_rows(values, width, name, count)
    with np.errstate(over="ignore"):
        single = np.ascontiguousarray(table, dtype=np.float32)
    bad = ~np.isfinite(single).all(axis=1)
    if bad.any():
        row = int(bad.argmax())
        raise ValueError(f"'{name}' is not finite in single precision in row {row}: {table[row].tolist()}")
    return single


def int_rows(values: Tensor, limit: int, name: str, count: str) -> np.ndarray:
    """(n, 3) int64 of a tensor of indices that has that shape or is empty.

    Raises:
        ValueError: another shape, no integers, or an index outside [0, limit).
    """
    if values.numel() and values.dtype.is_floating_point:
        raise ValueError(f"'{name}' should hold integers; got {values.dtype}")
    table = _table(values, 3, name, count).astype(np.int64)
    bad = ((table < 0) | (table >= limit)).any(axis=1)
    if bad.any():
        row = int(bad.argmax())
        raise ValueError(f"Faces have invalid indices: row {row} of '{name}' is {table[row].tolist()}, limit {limit}")
    return table


def _table(values: Tensor, width: int, name: str, count: str) -> np.ndarray:
    if values.numel() and (values.dim() != 2 or values.shape[1] != width):
        shape = tuple(values.shape)
        raise ValueError(f"'{name}' should either be empty or of shape ({count}, {width}); got {shape}")
    held = values.detach().cpu()
    wide = held.to(torch.float64) if held.dtype.is_floating_point else held
    return wide.numpy().reshape(-1, width)


def format_rows(template: str, rows: np.ndarray) -> bytes:
    """One line of text for every row, the template filled in with %."""
    parts = []
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        some = rows[start : start + _ROWS_AT_ONCE]
        parts.append((template * len(some)) % tuple(some.ravel().tolist()))
    return "".join(parts).encode("ascii")
