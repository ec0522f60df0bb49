"""Reads the pickles that body models come as: arrays, and nothing that could run.

The authors' files hold NumPy arrays, SciPy sparse matrices and chumpy arrays. A pickle is a program for a small
machine: it names things, calls them and sets their attributes. Here none of its names is looked up: each of the few
that such files need stands for a class of this module, which checks what it is given; all else is refused before
anything is made of it, and so are the instructions that no such file needs. Nothing is allocated that is larger than
the file, and no number of bytes is believed.
"""

from __future__ import annotations

import math
import pickle
import re
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, cast

import numpy as np

_MOST_BYTES = 2**30  # of a file; SMPL-X's largest has 0.5 GB
_MOST_INSTRUCTIONS = 1_000_000  # the authors' files have some hundred
_MOST_DENSE = 2**24  # numbers of a sparse matrix written out; SMPL-X's joint regressor has 0.6 million
_DTYPE = re.compile(r"[<>|=]?(?:[biuf][1248]|b1|\?|[SU]\d{1,4})")
_KEPT = (
    "PROTO", "FRAME", "STOP", "MARK", "POP", "POP_MARK", "DUP", "NONE", "NEWTRUE", "NEWFALSE", "INT", "BININT",
    "BININT1", "BININT2", "LONG", "LONG1", "FLOAT", "BINFLOAT", "STRING", "BINSTRING", "SHORT_BINSTRING", "BINBYTES",
    "SHORT_BINBYTES", "BINBYTES8", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "TUPLE", "EMPTY_TUPLE",
    "TUPLE1", "TUPLE2", "TUPLE3", "LIST", "EMPTY_LIST", "APPEND", "APPENDS", "EMPTY_DICT", "DICT", "SETITEM",
    "SETITEMS", "EMPTY_SET", "ADDITEMS", "GET", "BINGET", "LONG_BINGET", "PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE",
    "GLOBAL", "STACK_GLOBAL", "REDUCE", "BUILD", "NEWOBJ", "INST", "OBJ", "BYTEARRAY8",
)  # fmt: skip
_INSTRUCTIONS = {getattr(pickle, name)[0] for name in _KEPT}
_NAMES = {
    value[0]: name
    for name, value in vars(pickle).items()
    if name.isupper() and isinstance(value, bytes) and len(value) == 1
}


class PickleRefused(pickle.UnpicklingError):
    """A pickle that is more than arrays; says what."""


class _Sealed(type):
    """Classes that no pickle changes: what it may not do to one reader it could else do to the next."""

    def __setattr__(cls, name: str, value: object) -> None:
        raise PickleRefused(f"it sets an attribute of {cls.__name__}, and only arrays are read")


class _StandIn(metaclass=_Sealed):
    """What stands for something that a pickle names. Made without arguments, or not at all."""

    __slots__ = ("state",)

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, dict):
            raise PickleRefused(f"it sets the state of {_name_of(self)} to a {type(state).__name__}")
        self.state = state

    def get(self, key: str) -> Any:
        """One attribute of what was pickled.

        Raises:
            ValueError: it has none of that name.
        """
        state = getattr(self, "state", {})
        if key not in state:
            raise ValueError(f"{_name_of(self)} without {key!r}; it has: {', '.join(map(str, state)) or 'nothing'}")
        return state[key]


class SparseMatrix(_StandIn):
    """What a SciPy sparse matrix was pickled from: its attributes."""

    __slots__ = ()
    is_column_format = False

    def to_dense(self) -> np.ndarray:
        """The matrix, of float64.

        Raises:
            ValueError: none of the formats csc, csr and coo, indices out of range, or more than 16 million numbers.
        """
        height, width = self._shape()
        rows, columns = self._places(height, width)
        data = _vector("data", self.get("data"), "biuf")
        if not len(rows) == len(columns) == len(data):
            raise ValueError("a sparse matrix whose parts are not equally long")
        for places, size in ((rows, height), (columns, width)):
            if len(places) and not (places.min() >= 0 and places.max() < size):
                raise ValueError(f"a sparse matrix with entries outside its shape {(height, width)}")
        dense = np.zeros((height, width))
        np.add.at(dense, (rows, columns), data)
        return dense

    def _shape(self) -> tuple[int, int]:
        shape = self.get("_shape" if "_shape" in getattr(self, "state", {}) else "shape")
        if not (isinstance(shape, tuple) and len(shape) == 2 and all(_is_count(side) for side in shape)):
            raise ValueError("a sparse matrix without a shape of two sides")
        height, width = int(shape[0]), int(shape[1])
        if height * width > _MOST_DENSE:
            raise ValueError(f"a sparse matrix of {height:,} x {width:,} numbers; at most {_MOST_DENSE:,} are read")
        return height, width

    def _places(self, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
        if "coords" in self.state:
            coords = self.state["coords"]
            if not (isinstance(coords, tuple) and len(coords) == 2):
                raise ValueError("a sparse matrix whose coordinates are not rows and columns")
            return _vector("rows", coords[0], "iu"), _vector("columns", coords[1], "iu")
        if "row" in self.state:
            return _vector("row", self.state["row"], "iu"), _vector("col", self.get("col"), "iu")
        pointers, indices = (_vector(name, self.get(name), "iu") for name in ("indptr", "indices"))
        if len(pointers) != (width if self.is_column_format else height) + 1:
            raise ValueError(f"a sparse matrix of shape {(height, width)} with {len(pointers)} pointers")
        steps = np.diff(pointers)
        if pointers[0] != 0 or pointers[-1] != len(indices) or (len(steps) and steps.min() < 0):
            raise ValueError("a sparse matrix whose pointers do not rise from 0 to the number of its entries")
        outer = np.repeat(np.arange(len(steps)), steps)
        return (indices, outer) if self.is_column_format else (outer, indices)


class ColumnSparseMatrix(SparseMatrix):
    """Of format csc."""

    __slots__ = ()
    is_column_format = True


class ChumpyArray(_StandIn):
    """What a chumpy array was pickled from; the numbers are its `x`, or a selection of another one's."""

    __slots__ = ()

    def numbers(self, depth: int = 8) -> np.ndarray:
        """The numbers.

        Raises:
            ValueError: a node of chumpy's graph that is no plain array.
        """
        state = getattr(self, "state", {})
        if "x" in state and depth > 0:
            return numbers(state["x"], depth - 1)
        if not {"a", "idxs"} <= set(state) or depth <= 0:
            raise ValueError(
                f"a chumpy node that is no plain array: it has {', '.join(map(str, state)) or 'nothing'}"
            )
        source, chosen = numbers(state["a"], depth - 1).reshape(-1), _vector("idxs", state["idxs"], "iu")
        if len(chosen) and not 0 <= chosen.min() <= chosen.max() < len(source):
            raise ValueError("a chumpy selection of numbers that are not there")
        picked, shape = source[chosen], state.get("preferred_shape", (-1,))
        if not (isinstance(shape, tuple) and all(_is_count(side) or side == -1 for side in shape)):
            raise ValueError("a chumpy selection of a shape that is none")
        return picked.reshape(tuple(int(side) for side in shape))


class _DType(_StandIn):
    """`numpy.dtype`: of plain numbers and text, never of objects."""

    __slots__ = ("dtype",)

    def __init__(self, spec: Any, *_: Any) -> None:
        if not (isinstance(spec, str) and _DTYPE.fullmatch(spec)):
            raise PickleRefused(f"it holds an array of {_short(spec)}, and only numbers and text are read")
        self.dtype = np.dtype(spec)

    def __setstate__(self, state: Any) -> None:
        if not (isinstance(state, tuple) and len(state) >= 5 and state[1] in ("<", ">", "|", "=")):
            raise PickleRefused("it holds an array of a type that is none")
        if any(part is not None for part in state[2:5]):
            raise PickleRefused("it holds an array of records, and only numbers and text are read")
        self.dtype = self.dtype.newbyteorder(state[1])


class _Array(_StandIn):
    """`numpy.ndarray`: what its bytes are, which become an array when somebody asks for it.

    A stream may show the same bytes as many arrays; so none is copied before it is known how many there are.
    """

    __slots__ = ("content", "dtype", "is_by_column", "shape")

    def __setstate__(self, state: Any) -> None:
        if not (isinstance(state, tuple) and len(state) in (4, 5)):
            raise PickleRefused("it holds an array that is none")
        shape, dtype, by_column, content = state[-4:]
        self.fill(content, dtype, shape, by_column is True)

    def fill(self, content: Any, dtype: Any, shape: Any, is_by_column: bool) -> None:
        """Takes the bytes of an array of this type and shape and no other."""
        if not (isinstance(dtype, _DType) and isinstance(content, bytes | str)):
            raise PickleRefused("it holds an array of objects, and only numbers and text are read")
        if not (isinstance(shape, tuple) and len(shape) <= 16 and all(_is_count(side) for side in shape)):
            raise PickleRefused("it holds an array whose shape is none")
        claimed = math.prod(shape) * dtype.dtype.itemsize
        if claimed != len(content):
            raise PickleRefused(f"it claims an array of {_short(f'{claimed:,}')} bytes and has {len(content):,}")
        self.content, self.dtype, self.shape, self.is_by_column = content, dtype.dtype, shape, is_by_column

    @property
    def num_bytes(self) -> int:
        """That the array takes; 0 where none was filled in."""
        return len(getattr(self, "content", ()))

    def array(self) -> np.ndarray:
        """The array.

        Raises:
            ValueError: none was filled in, or its text is not what Python 2 calls bytes.
        """
        if not hasattr(self, "content"):
            raise ValueError("an array without its numbers")
        if not self.num_bytes:
            return np.empty(self.shape, self.dtype)
        content = self.content.encode("latin1") if isinstance(self.content, str) else self.content  # of Python 2
        return np.frombuffer(content, self.dtype).reshape(self.shape, order="F" if self.is_by_column else "C")


class _Named(_StandIn):
    """A function that a pickle calls; or a name that it only passes on."""

    __slots__ = ("call", "name")

    def __init__(self, name: str, call: Callable[..., Any] | None = None) -> None:
        self.name, self.call = name, call

    def __call__(self, *arguments: Any) -> Any:
        if self.call is None:
            raise PickleRefused(f"it calls {self.name}, and only arrays are read")
        return self.call(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise PickleRefused(f"it sets attributes of {self.name}, and only arrays are read")


def _reconstruct(of: Any = None, *_: Any) -> _Array:
    if of is not _NDARRAY:
        raise PickleRefused(f"it makes an array of {_name_of(of)}, and only numpy.ndarray is read")
    return _Array()


def _rebuild(of: Any = None, base: Any = None, state: Any = None) -> _StandIn:
    if of not in (ColumnSparseMatrix, SparseMatrix, ChumpyArray) or base is not _OBJECT or state is not None:
        raise PickleRefused(f"it rebuilds {_name_of(of)}, and only arrays are read")
    return of()


def _scalar(dtype: Any = None, content: Any = None) -> Any:
    return _buffer(content, dtype, ()).array()[()]


def _buffer(content: Any = None, dtype: Any = None, shape: Any = None, order: Any = "C") -> _Array:
    array = _Array()
    array.fill(content, dtype, shape, order == "F")
    return array


def _bytes(text: Any = None, encoding: Any = None) -> str:
    """How protocol 2 of Python 3 writes bytes: as text, which arrays take as well."""
    if not isinstance(text, str) or encoding != "latin1":
        raise PickleRefused(f"it encodes as {_short(encoding)}, and only bytes in latin1 are read")
    return text


def _no_bytes(*arguments: Any) -> bytes:
    """How protocol 2 of Python 3 writes those of an empty array."""
    if arguments:
        raise PickleRefused("it makes bytes, and only arrays are read")
    return b""


def _set(items: Any = ()) -> list[Any]:
    if not isinstance(items, list):
        raise PickleRefused("it makes a set of what is no list")
    return items  # nobody asks for its members, and hashing them could take for ever


_NDARRAY, _OBJECT = _Named("numpy.ndarray"), _Named("object")


def _stand_ins() -> dict[tuple[str, str], Any]:
    """What stands for each name that a file of arrays needs, of old and new versions of what wrote it."""
    known: dict[tuple[str, str], Any] = {
        ("numpy", "ndarray"): _NDARRAY,
        ("numpy", "dtype"): _DType,
        ("_codecs", "encode"): _Named("_codecs.encode", _bytes),
    }
    for core in ("numpy.core", "numpy._core"):
        for module, name, call in (
            ("multiarray", "_reconstruct", _reconstruct),
            ("multiarray", "scalar", _scalar),
            ("numeric", "_frombuffer", _buffer),
        ):
            known[f"{core}.{module}", name] = _Named(f"{core}.{module}.{name}", call)
    for copy, builtins in (("copy_reg", "__builtin__"), ("copyreg", "builtins")):
        known[copy, "_reconstructor"] = _Named(f"{copy}._reconstructor", _rebuild)
        known[builtins, "object"] = _OBJECT
        known[builtins, "bytes"] = _Named(f"{builtins}.bytes", _no_bytes)
        known[builtins, "set"] = _Named(f"{builtins}.set", _set)
    for form, matrix in (("csc", ColumnSparseMatrix), ("csr", SparseMatrix), ("coo", SparseMatrix)):
        for module in (f"scipy.sparse.{form}", f"scipy.sparse._{form}"):
            known[module, f"{form}_matrix"] = known[module, f"{form}_array"] = matrix
    known["chumpy.ch", "Ch"] = known["chumpy", "Ch"] = known["chumpy.reordering", "Select"] = ChumpyArray
    return known


_KNOWN = _stand_ins()


class _Instructions:
    """What the machine does at each instruction of a stream; counts them."""

    def __init__(self, known: Mapping[int, Any]) -> None:
        self.known, self.count = known, 0

    def __getitem__(self, code: int) -> Any:
        self.count += 1
        if self.count > _MOST_INSTRUCTIONS:
            raise PickleRefused(f"it has more than {_MOST_INSTRUCTIONS:,} instructions")
        if code in _INSTRUCTIONS:
            return self.known[code]
        if code in _NAMES:
            raise PickleRefused(f"it uses the instruction {_NAMES[code]}, which no file of arrays needs")
        raise ValueError(f"{bytes([code])!r} is no instruction")


_Machine: Any = pickle._Unpickler  # type: ignore[attr-defined]
# Python's own, not the compiled one: that one looks some names up by itself, and believes numbers of bytes.


class _Reader(_Machine):
    def __init__(self, content: bytes) -> None:
        super().__init__(BytesIO(content), encoding="latin1")  # as Python 2 wrote
        own = {
            pickle.BUILD[0]: _Reader.build,
            pickle.BYTEARRAY8[0]: _Machine.load_binbytes8,  # bytes that are there, not room for those claimed
            pickle.EMPTY_SET[0]: _Machine.load_empty_list,
            pickle.ADDITEMS[0]: _Machine.load_appends,
            pickle.SETITEM[0]: _Reader.set_item,
            pickle.SETITEMS[0]: _Reader.set_items,
            pickle.DICT[0]: _Reader.make_dict,
            pickle.NEWOBJ[0]: _Reader.new_object,
        }
        self.dispatch = _Instructions({**_Machine.dispatch, **own})

    def find_class(self, module: str, name: str) -> Any:
        known = _KNOWN.get((module, name)) if isinstance(module, str) and isinstance(name, str) else None
        if known is None:
            raise PickleRefused(f"it names {_short(module)}.{_short(name)}, and only arrays are read")
        return known

    def build(self) -> None:
        state = self.stack.pop()
        target = self.stack[-1]
        if not isinstance(target, _StandIn):
            raise PickleRefused(f"it sets attributes of {_name_of(target)}, and only arrays are read")
        target.__setstate__(state)

    def new_object(self) -> None:
        arguments, of = self.stack.pop(), self.stack.pop()
        if arguments != () or of not in (ColumnSparseMatrix, SparseMatrix, ChumpyArray):
            raise PickleRefused(f"it makes a {_name_of(of)}, and only arrays are read")
        self.append(of())

    def set_item(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._put([key, value])

    def set_items(self) -> None:
        items = self.pop_mark()
        self._put(items)

    def make_dict(self) -> None:
        items = self.pop_mark()
        self.append({})
        self._put(items)

    def _put(self, items: list[Any]) -> None:
        target = self.stack[-1]
        if type(target) is not dict or len(items) % 2:
            raise PickleRefused(f"it sets items of a {type(target).__name__}")
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, str | int):  # hashing a nest of tuples could take for ever
                raise PickleRefused(f"it has a dictionary with a {type(key).__name__} for a key")
            target[key] = value


def read_pickle(path: str | Path) -> Any:
    """What a pickle file holds, if that is arrays, numbers, text and containers of them.

    Arrays that are values of the outermost dictionary are NumPy's, or stand-ins; see `numbers`.

    Raises:
        FileNotFoundError: no such file.
        PickleRefused: it names, does or claims something else; nothing was executed.
        ValueError: no pickle at all, cut off, or larger than 1 GB.
    """
    path = Path(path)
    if path.stat().st_size > _MOST_BYTES:
        raise ValueError(f"{path} has {path.stat().st_size:,} bytes; at most {_MOST_BYTES:,} are read")
    try:
        content = cast(Any, _Reader(path.read_bytes())).load()
    except PickleRefused as error:
        raise PickleRefused(f"{path} was not read: {error}") from None
    except Exception as error:  # a hostile stream can make any of them
        raise ValueError(f"{path} is no pickle, or cut off: {_words_of(error)}") from None
    return _with_arrays(path, content)


def _with_arrays(path: Path, content: Any) -> Any:
    """The arrays themselves instead of what stands for them, if they are no more than the file holds."""
    outer = content if isinstance(content, dict) else {"": content}
    found = {id(value): value for value in outer.values() if isinstance(value, _Array)}
    claimed, held = sum(value.num_bytes for value in found.values()), path.stat().st_size
    if claimed > held:
        raise PickleRefused(f"{path} was not read: it claims arrays of {claimed:,} bytes and has {held:,}")
    try:
        arrays = {key: value.array() for key, value in found.items()}
    except ValueError as error:
        raise ValueError(f"{path} is no pickle of arrays: {error}") from None
    filled = {key: arrays.get(id(value), value) for key, value in outer.items()}
    return filled if isinstance(content, dict) else filled[""]


def numbers(value: Any, depth: int = 8) -> np.ndarray:
    """The array of numbers that a value of `read_pickle`'s is: an array, a sparse matrix or a chumpy array.

    Raises:
        ValueError: it is none, or its numbers are not plain.
    """
    if isinstance(value, _Array):
        value = value.array()
    if isinstance(value, SparseMatrix):
        value = value.to_dense()
    if isinstance(value, ChumpyArray):
        value = value.numbers(depth)
    if isinstance(value, int | float | np.generic):
        value = np.asarray(value)
    if not isinstance(value, np.ndarray):
        raise ValueError(f"a {_name_of(value)}, where an array of numbers is expected")
    if value.dtype.kind not in "biuf":
        raise ValueError(f"an array of {value.dtype}, where numbers are expected")
    return value


def _vector(name: str, value: Any, kinds: str) -> np.ndarray:
    vector = numbers(value)
    if vector.ndim != 1 or vector.dtype.kind not in kinds:
        raise ValueError(f"{name} of {vector.dtype} and shape {vector.shape}, where a row of numbers is expected")
    return vector.astype(np.int64) if kinds == "iu" else vector


def _is_count(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and 0 <= int(value) < 2**40


def _name_of(value: Any) -> str:
    if isinstance(value, _Named):
        return value.name
    return (value if isinstance(value, type) else type(value)).__name__


def _short(value: Any) -> str:
    """At most sixty characters of what a stranger wrote, on one line; containers are not entered."""
    text = value if isinstance(value, str) else f"<{type(value).__name__}>"
    text = text.encode("unicode_escape").decode()
    return text if len(text) <= 60 else f"{text[:57]}..."


def _words_of(error: Exception) -> str:
    return f"{type(error).__name__}: {_short(str(error))}" if str(error) else type(error).__name__
