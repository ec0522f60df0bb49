"""NumPy's .npy files that others made: no pickles, and no more memory than the file has bytes."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rendra_lab.errors import UserError

_MOST_BYTES = 1 << 30


def read_npy(path: Path) -> npt.NDArray[np.float64]:
    """An array of numbers.

    Raises:
        UserError: no file, no .npy, objects in place of numbers, or a size that is not the file's.
    """
    if not path.is_file():
        raise UserError(f"there is no file {path}")
    held = path.stat().st_size
    if held > _MOST_BYTES:
        raise UserError(f"{path} has {held:,} bytes; at most {_MOST_BYTES:,} are read")
    try:
        with path.open("rb") as handle:
            version = np.lib.format.read_magic(handle)
            read = np.lib.format.read_array_header_1_0 if version[0] == 1 else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(handle)
            held -= handle.tell()
            handle.seek(0)
            _demand_numbers(path, shape, dtype, held)
            return np.lib.format.read_array(handle, allow_pickle=False).astype(np.float64)
    except UserError:
        raise
    except Exception as error:  # the parser of the header evaluates text, and raises what that raises
        raise UserError(f"{path} is no .npy file that can be read: {error}") from error


def _demand_numbers(path: Path, shape: tuple[int, ...], dtype: np.dtype, held: int) -> None:
    if dtype.kind not in "fiu":
        raise UserError(f"{path} holds {dtype}; expected numbers (pickled objects are never read)")
    if any(side < 0 for side in shape) or math.prod(shape) * dtype.itemsize != held:
        raise UserError(f"{path} declares {' x '.join(map(str, shape))} of {dtype}, but holds {held:,} bytes of them")
