"""Reads the pickles that body models come as: arrays, and nothing that could run.

The authors' files hold NumPy arrays, SciPy sparse matrices and chumpy arrays, the latter two of packages that
need not be there: they are read into stand-ins. Whatever else a pickle names is refused before anything is made of
it.
"""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any, cast

import numpy as np

_MOST_BYTES = 2**31  # of a file; SMPL-X's largest has 0.8 GB
_ARRAY_MODULES = ("numpy.core.multiarray", "numpy._core.multiarray", "numpy.core.numeric", "numpy._core.numeric")
_HARMLESS = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    *((module, name) for module in _ARRAY_MODULES for name in ("_reconstruct", "scalar", "_frombuffer")),
    ("_codecs", "encode"),
    ("copy_reg", "_reconstructor"),
    ("copyreg", "_reconstructor"),
    ("__builtin__", "object"),
    ("builtins", "object"),
    ("__builtin__", "set"),
    ("builtins", "set"),
    ("collections", "OrderedDict"),
}


class PickleRefused(pickle.UnpicklingError):
    """A pickle that names something else than arrays; says what."""


class SparseMatrix:
    """What a SciPy sparse matrix was pickled from: its attributes."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.state = dict(state)

    def to_dense(self) -> np.ndarray:
        """The matrix, of float64.

        Raises:
            ValueError: none of the formats csc, csr and coo, or indices out of range.
        """
        shape = self.state.get("_shape", self.state.get("shape"))
        if not (isinstance(shape, tuple) and len(shape) == 2):
            raise ValueError("a sparse matrix without its shape")
        rows, columns = self._places(int(shape[0]), int(shape[1]))
        data = np.asarray(self.state["data"], np.float64)
        if len(rows) != len(data) or len(columns) != len(data):
            raise ValueError("a sparse matrix whose parts are not equally long")
        for places, size in ((rows, shape[0]), (columns, shape[1])):
            if len(places) and not (places.min() >= 0 and places.max() < size):
                raise ValueError(f"a sparse matrix with entries outside its shape {shape}")
        dense = np.zeros(shape)
        np.add.at(dense, (rows, columns), data)
        return dense

    def _places(self, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
        if "row" in self.state and "col" in self.state:
            return np.asarray(self.state["row"]), np.asarray(self.state["col"])
        if "coords" in self.state:
            rows, columns = self.state["coords"]
            return np.asarray(rows), np.asarray(columns)
        pointers, indices = np.asarray(self.state["indptr"]), np.asarray(self.state["indices"])
        by_column = len(pointers) == width + 1 and (width != height or self.is_column_format)
        if not by_column and len(pointers) != height + 1:
            raise ValueError(f"a sparse matrix of shape {(height, width)} with {len(pointers)} pointers")
        outer = np.repeat(np.arange(len(pointers) - 1), np.diff(pointers))
        return (indices, outer) if by_column else (outer, indices)

    is_column_format = False


class ColumnSparseMatrix(SparseMatrix):
    """Of format csc."""

    is_column_format = True


class ChumpyArray:
    """What a chumpy array was pickled from; the numbers are its `x`."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.state = dict(state)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """The numbers.

        Raises:
            ValueError: a node of chumpy's graph that is no plain array.
        """
        state = self.state
        if "x" in state:
            return np.array(state["x"], dtype)
        if {"a", "idxs"} <= set(state):  # a selection of another array
            return np.asarray(state["a"], dtype).reshape(-1)[state["idxs"]].reshape(state.get("preferred_shape", -1))
        raise ValueError(f"a chumpy node that is no plain array: it has {', '.join(map(str, state))}")


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _HARMLESS:
            return super().find_class(module, name)
        if module.split(".")[:2] == ["scipy", "sparse"] and name in ("csc_matrix", "csc_array"):
            return ColumnSparseMatrix
        if module.split(".")[:2] == ["scipy", "sparse"] and name in (
            "csr_matrix",
            "coo_matrix",
            "csr_array",
            "coo_array",
        ):
            return SparseMatrix
        if module.split(".")[0] == "chumpy" and name in ("Ch", "Select"):
            return ChumpyArray
        raise PickleRefused(f"it names {module}.{name}, and only arrays are read")


def read_pickle(path: str | Path) -> Any:
    """What a pickle file holds, if that is arrays, numbers, text and containers of them.

    Raises:
        FileNotFoundError: no such file.
        PickleRefused: it names something else; nothing was executed.
        ValueError: no pickle at all, cut off, or larger than 2 GB.
    """
    path = Path(path)
    if path.stat().st_size > _MOST_BYTES:
        raise ValueError(f"{path} has {path.stat().st_size:,} bytes; at most {_MOST_BYTES:,} are read")
    try:
        return _Reader(cast(Any, io.BytesIO(path.read_bytes())), encoding="latin1").load()  # written by Python 2
    except PickleRefused as error:
        raise PickleRefused(f"{path} was not read: {error}") from None
    except Exception as error:  # a hostile stream can make any of them
        raise ValueError(f"{path} is no pickle, or cut off: {type(error).__name__}: {error}") from error
