"""Arrays of MATLAB's files that others made, versions 4 to 7.2: no objects, and no more memory than is allowed."""

from __future__ import annotations

import io
import math
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.io

from rendra_lab.errors import UserError

_MOST_BYTES = 64 << 20
_COMPRESSED = 15  # data type of a variable
_HEADER = 128  # bytes before the first one
_NO_ARRAYS = ("cell", "struct", "object", "char", "function", "opaque", "unknown", "sparse")


def read_matlab(path: Path, name: str, expected: str, most: int) -> npt.NDArray[Any]:
    """One variable, real numbers or bools.

    Args:
        path: of the file.
        name: of the variable.
        expected: what it should be, for complaints: "an array (3, 14, N)".
        most: numbers that it may hold.

    Raises:
        UserError: no file, another one, one that takes more than 64 MiB, or no such array in it.
    """
    if not path.is_file():
        raise UserError(f"there is no file {path}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of variables that come twice
            data = _inflated(path)
            _demand_array(path, data, name, expected, most)
            found = scipy.io.loadmat(io.BytesIO(data), variable_names=[name])[name]
    except UserError:
        raise
    except Exception as error:  # scipy raises what it likes; NotImplementedError of version 7.3, which is HDF5
        words = " ".join(str(error).split())[:200] or type(error).__name__
        raise UserError(f"{path} is no MATLAB file that can be read: {words}") from error
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiub":
        raise UserError(f"{path} holds {getattr(found, 'dtype', type(found).__name__)}; expected real numbers")
    return found


def _demand_array(path: Path, data: bytes, name: str, expected: str, most: int) -> None:
    """Refuse a variable by what the file declares of it."""
    known = {name: (shape, kind) for name, shape, kind in scipy.io.whosmat(io.BytesIO(data))}
    if name not in known:
        raise UserError(f"{path}: {name!r} is missing; it holds {', '.join(map(repr, known)) or 'nothing'}")
    shape, kind = known[name]
    if kind in _NO_ARRAYS:
        raise UserError(f"{path}: {name!r} is a {kind}; expected {expected}")
    if math.prod(shape) > most:
        raise UserError(f"{path}: {name!r} has the shape {shape}, {math.prod(shape):,} numbers; at most {most:,}")


def _inflated(path: Path) -> bytes:
    """The file with its variables not compressed, so that none is larger than the file."""
    if path.stat().st_size > _MOST_BYTES:
        raise UserError(f"{path} has {path.stat().st_size:,} bytes; at most {_MOST_BYTES:,} are read")
    data = path.read_bytes()
    if data[126:128] not in (b"IM", b"MI"):
        return data  # version 4, which compresses nothing
    order = "<" if data[126:128] == b"IM" else ">"
    parts, at = [data[:_HEADER]], _HEADER
    left = _MOST_BYTES
    while at + 8 <= len(data):
        kind, size = struct.unpack(f"{order}II", data[at : at + 8])
        body = data[at + 8 : at + 8 + size]
        if kind == _COMPRESSED:
            stream = zlib.decompressobj()
            plain = stream.decompress(body, left)
            if stream.unconsumed_tail:
                raise UserError(f"{path} takes more than {_MOST_BYTES:,} bytes; no more are read")
            left = max(1, left - len(plain))
        else:
            plain = data[at : at + 8 + size]
        parts.append(plain)
        at += 8 + size
    return b"".join(parts)
