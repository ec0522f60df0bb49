"""The file of a checkpoint: written whole or not at all, and read as if anyone had written it.

It is a zip archive of plain members: `data.pkl`, which describes a tree of values, and one member for the bytes of
each tensor. Nothing is allocated on the word of a header: members are uncompressed and together no larger than the
file, every tensor lies inside its member, and each member has its checksum. The description is walked by an
unpickler that can build plain values and names of tensors, and calls nothing that the file asks for.
"""

from __future__ import annotations

import errno
import io
import math
import pickle
import struct
import zipfile
from _compat_pickle import IMPORT_MAPPING, NAME_MAPPING
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import torch

from rendra_lab import report
from rendra_lab.durable import write_durably
from rendra_lab.errors import UserError

FORMAT = 1  # of what stands under KEY; a newer one is refused
KEY = "rendra_lab"

_LARGEST_DESCRIPTION = 1 << 24  # bytes of data.pkl; a list in it takes a byte there and fifty in memory
_LARGEST_VIEW = 1 << 24  # elements of a tensor that repeats a smaller storage
_CHUNK = 1 << 20
_SENSELESS = (
    EOFError,
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    OverflowError,
    AssertionError,
    RuntimeError,
    struct.error,
    pickle.UnpicklingError,
)
_ITEM_BYTES = {
    "BFloat16Storage": 2,
    "BoolStorage": 1,
    "ByteStorage": 1,
    "CharStorage": 1,
    "ComplexDoubleStorage": 16,
    "ComplexFloatStorage": 8,
    "DoubleStorage": 8,
    "FloatStorage": 4,
    "HalfStorage": 2,
    "IntStorage": 4,
    "LongStorage": 8,
    "ShortStorage": 2,
    "UntypedStorage": 1,
}


class CheckpointError(UserError):
    """A file that is no checkpoint to go on from, and why.

    Args:
        path: of the file.
        reason: completes a sentence that begins with its name.
    """

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{report.short_path(path)} {reason}")
        self.path = path
        self.reason = reason


@dataclass(frozen=True)
class CheckpointFacts:
    """What a sound checkpoint says about itself; `task` and `module` are None where it is older than they are."""

    path: Path
    step: int  # optimiser steps taken
    task: str | None = None  # its name on the command line
    module: str | None = None  # the class of its weights


def examine(path: Path, checksums: bool = True) -> CheckpointFacts:
    """Proves a file to be a whole checkpoint, without building a tensor of it.

    Args:
        path: of the file.
        checksums: False leaves the bytes of tensors unread; the claims about them are checked all the same.

    Raises:
        CheckpointError: it is damaged, hostile, no checkpoint, or of a format that is not known yet.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return _facts(path, _walk(path, file, checksums))


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The content of a checkpoint, tensors on the CPU; proves it first, see `examine` for what is raised."""
    with path.open("rb") as file:
        _facts(path, _walk(path, file, checksums=True))
        file.seek(0)
        try:
            return torch.load(file, map_location="cpu", weights_only=True)
        except (pickle.UnpicklingError, RuntimeError, ValueError, KeyError, TypeError) as error:
            raise CheckpointError(path, f"cannot be read: {str(error).splitlines()[0]}") from error


def write_checkpoint(path: Path, content: Mapping[str, Any]) -> None:
    """Replaces a checkpoint by a new one, which is forced to the disk and proven first.

    Raises what `durable.write_durably` does, and CheckpointError where the content is more than tensors and plain
    values, so that no one could read it.
    """
    write_durably(path, lambda sink: torch.save(content, cast(IO[bytes], sink)), examine)


def _facts(path: Path, content: Any) -> CheckpointFacts:
    if not isinstance(content, dict) or not isinstance(content.get("state_dict"), dict):
        raise CheckpointError(path, "is no checkpoint of a run: it holds no state_dict")
    step = content.get("global_step")
    own = content.get(KEY, {})
    if not isinstance(step, int) or not isinstance(own, dict):
        raise CheckpointError(path, "is damaged: it does not say its step, or what it is")
    version = own.get("format", FORMAT)
    if not isinstance(version, int) or version > FORMAT:
        raise CheckpointError(
            path, f"has checkpoint format {version!r}, newer than this program's {FORMAT}: update it"
        )
    names = [own.get(name) if isinstance(own.get(name), str) else None for name in ("task", "module")]
    return CheckpointFacts(path, step, *names)


def _walk(path: Path, file: BinaryIO, checksums: bool) -> Any:
    """The tree that data.pkl describes, with `_Tensor` for each tensor."""
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    if size == 0:
        raise CheckpointError(path, "is damaged: it is empty")
    try:
        with zipfile.ZipFile(file) as archive:
            stored, prefix = _members(path, archive, size)
            if checksums:
                _check_sums(path, archive)
            return _Describer(path, archive.read(f"{prefix}/data.pkl"), stored).load()
    except CheckpointError:
        raise
    except zipfile.BadZipFile as error:
        what = "is cut off, or is no checkpoint" if "not a zip" in str(error) else f"is damaged: {error}"
        raise CheckpointError(path, what) from error
    except _SENSELESS as error:
        words = " ".join(str(error).split()) or type(error).__name__
        raise CheckpointError(path, f"is damaged: its description makes no sense ({words})") from error
    except OSError as error:
        if error.errno != errno.EINVAL:  # that of a place outside of the file
            raise
        raise CheckpointError(path, "is damaged: it refers to places outside of itself") from error


def _members(path: Path, archive: zipfile.ZipFile, size: int) -> tuple[dict[str, int], str]:
    """The bytes of each tensor's member by key, and the folder of all members.

    Whatever Python's reader and torch's could take differently is refused.
    """
    members = archive.infolist()
    for member in members:
        if problem := _problem(member, size):
            raise CheckpointError(path, f"is {problem[0]}: {member.filename} {problem[1]}")
    claimed = sum(member.file_size for member in members)
    if claimed > size:
        raise CheckpointError(path, f"is refused: its members claim {claimed:,} bytes, the file has {size:,}")
    sizes = {member.filename: member.file_size for member in members}
    prefix = next(iter(sizes), "").partition("/")[0]
    start = f"{prefix}/data/"
    if f"{prefix}/data.pkl" not in sizes or not all(name.startswith(f"{prefix}/") for name in sizes):
        raise CheckpointError(path, "is no checkpoint: its members are others")
    if len({name.lower() for name in sizes}) < len(members) or min(member.header_offset for member in members) > 0:
        raise CheckpointError(path, "is refused: it holds several archives, or members of the same name")
    if sizes[f"{prefix}/data.pkl"] > _LARGEST_DESCRIPTION:
        raise CheckpointError(path, f"is refused: data.pkl is larger than {_LARGEST_DESCRIPTION:,} bytes")
    return {name[len(start) :]: count for name, count in sizes.items() if name.startswith(start)}, prefix


def _problem(member: zipfile.ZipInfo, size: int) -> tuple[str, str] | None:
    """What no member of a checkpoint is, in a file of `size` bytes."""
    if member.compress_type != zipfile.ZIP_STORED or member.compress_size != member.file_size:
        return "refused", "is compressed, which no checkpoint is"
    if member.external_attr & 0xFFFF or member.volume:  # torch skips a "folder" and leaves its tensor unset
        return "damaged", "is marked as a folder, or of another volume"
    return None if 0 <= member.header_offset < size else ("damaged", "would lie outside of it")


def _check_sums(path: Path, archive: zipfile.ZipFile) -> None:
    for member in archive.infolist():
        if not _fits_its_sum(archive, member):
            raise CheckpointError(path, f"is damaged: {member.filename} fails its checksum")


def _fits_its_sum(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bool:
    try:
        with archive.open(member) as content:
            while content.read(_CHUNK):
                pass
    except (zipfile.BadZipFile, EOFError, RuntimeError, ValueError, struct.error):
        return False
    return True


@dataclass(frozen=True)
class _Storage:
    """The elements that a member holds."""

    count: int


class _Tensor:
    """Stands for a tensor."""


class _Name:
    """Stands for a type of elements or storages, which is named and never called."""

    def __init__(self, name: str) -> None:
        self.name = name


class _Describer(pickle._Unpickler):  # the one written in Python: a forged memo index cannot make it allocate
    """Walks a description; whatever it asks for beyond plain values and tensors is refused by name."""

    def __init__(self, path: Path, description: bytes, stored: dict[str, int]) -> None:
        super().__init__(io.BytesIO(description), encoding="bytes")
        self._path = path
        self._stored = stored

    def find_class(self, module: str, name: str) -> Any:
        """What stands for a global; nothing is imported."""
        module, name = NAME_MAPPING.get((module, name), (IMPORT_MAPPING.get(module, module), name))
        full = f"{module}.{name}"
        if full in _ALLOWED:
            return _ALLOWED[full]
        named = module in ("torch", "torch.storage") and name in _ITEM_BYTES
        if named or (module == "torch" and isinstance(getattr(torch, name, None), torch.dtype)):
            return _Name(name)
        raise CheckpointError(self._path, f"is refused: it asks for {full}, which could run code; nothing was run")

    def persistent_load(self, pid: Any) -> _Storage:
        """What stands for the bytes of a tensor, if the archive has as many as it claims."""
        kind, storage, key, _, count = pid
        if kind not in ("storage", b"storage") or not isinstance(storage, _Name) or type(count) is not int:
            raise CheckpointError(self._path, "is damaged: it refers to something that is no tensor")
        if self._stored.get(str(key)) != count * _ITEM_BYTES[storage.name]:
            raise CheckpointError(
                self._path, f"is refused: it claims {count:,} elements that member data/{key} lacks"
            )
        return _Storage(count)

    def load_reduce(self) -> None:
        """A call: only of what stands for an allowed global."""
        arguments = self.stack.pop()  # type: ignore[attr-defined]
        function = self.stack[-1]  # type: ignore[attr-defined]
        if function not in _ALLOWED.values():
            raise CheckpointError(self._path, "is refused: it calls what is no function of a checkpoint")
        self.stack[-1] = function(*arguments)  # type: ignore[attr-defined]

    def load_build(self) -> None:
        """Attributes: of an ordered dictionary (the versions of modules), and of tensors, which are not needed."""
        self.stack.pop()  # type: ignore[attr-defined]
        if not isinstance(self.stack[-1], OrderedDict | _Tensor):  # type: ignore[attr-defined]
            raise CheckpointError(self._path, "is refused: it sets attributes of what is no tensor")

    def load_setitems(self) -> None:
        """Entries of a dictionary."""
        items = self.pop_mark()  # type: ignore[attr-defined]
        for key, value in zip(items[::2], items[1::2], strict=True):
            self._set(key, value)

    def load_setitem(self) -> None:
        """An entry of a dictionary."""
        value, key = self.stack.pop(), self.stack.pop()  # type: ignore[attr-defined]
        self._set(key, value)

    def _set(self, key: Any, value: Any) -> None:
        target = self.stack[-1]  # type: ignore[attr-defined]
        if not isinstance(target, dict) or not _is_plain_key(key):
            raise CheckpointError(self._path, "is refused: it has a key that is neither word nor number")
        target[key] = value

    dispatch = {  # type: ignore[assignment]
        code[0]: pickle._Unpickler.dispatch[code[0]]
        for code in (
            pickle.PROTO,
            pickle.STOP,
            pickle.MARK,
            pickle.GLOBAL,
            pickle.BINPERSID,
            pickle.NONE,
            pickle.NEWTRUE,
            pickle.NEWFALSE,
            pickle.BININT,
            pickle.BININT1,
            pickle.BININT2,
            pickle.LONG1,
            pickle.BINFLOAT,
            pickle.BINUNICODE,
            pickle.SHORT_BINSTRING,
            pickle.EMPTY_TUPLE,
            pickle.TUPLE,
            pickle.TUPLE1,
            pickle.TUPLE2,
            pickle.TUPLE3,
            pickle.EMPTY_LIST,
            pickle.APPEND,
            pickle.APPENDS,
            pickle.EMPTY_DICT,
            pickle.EMPTY_SET,
            pickle.BINGET,
            pickle.LONG_BINGET,
            pickle.BINPUT,
            pickle.LONG_BINPUT,
        )
    } | {
        pickle.REDUCE[0]: load_reduce,
        pickle.BUILD[0]: load_build,
        pickle.SETITEM[0]: load_setitem,
        pickle.SETITEMS[0]: load_setitems,
    }


def _is_plain_key(key: Any) -> bool:
    plain = (str, int, float, bytes, type(None), _Name)
    return isinstance(key, plain) or (isinstance(key, tuple) and all(isinstance(part, plain) for part in key))


def _tensor(storage: Any, offset: Any, size: Any, *_: Any) -> _Tensor:
    if not isinstance(storage, _Storage):
        raise ValueError("a tensor without a storage")
    if math.prod(size) > max(storage.count, _LARGEST_VIEW):
        raise ValueError(f"a tensor of {math.prod(size):,} elements, repeated from {storage.count:,}")
    return _Tensor()


def _wrapped(*arguments: Any) -> _Tensor:
    """A parameter, or a tensor of another layout: made of tensors that were looked at already."""
    if not any(isinstance(part, _Tensor) for item in arguments for part in (item if type(item) is tuple else [item])):
        raise ValueError("a tensor made of no tensor")
    return _Tensor()


def _subclassed(function: Any, kind: Any, arguments: Any, state: Any) -> Any:
    """A tensor with attributes."""
    if function not in (_tensor, _wrapped):
        raise ValueError("a tensor made by what makes none")
    return function(*arguments)


def _set(items: Any = ()) -> set[Any]:
    if not all(_is_plain_key(item) for item in items):
        raise ValueError("a set of neither words nor numbers")
    return set(items)


def _bytes(text: Any, encoding: Any) -> bytes:
    """How bytes are written: as text of Latin letters."""
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise ValueError("bytes in an unknown coding")
    return text.encode("latin-1")


def _byte_array(content: Any = b"", encoding: Any = None) -> bytearray:
    if isinstance(content, int):
        raise ValueError("room for bytes that the file does not hold")
    return bytearray(content if encoding is None else _bytes(content, encoding))


def _ordered() -> OrderedDict[Any, Any]:
    return OrderedDict()


def _plainly(*values: Any) -> tuple[Any, ...]:
    """A size, a device, a layout or a complex number: short plain values."""
    return values


_ALLOWED: dict[str, Callable[..., Any]] = {
    "collections.OrderedDict": _ordered,
    "builtins.set": _set,
    "builtins.complex": _plainly,
    "builtins.bytearray": _byte_array,
    "_codecs.encode": _bytes,
    "torch.Size": _plainly,
    "torch.device": _plainly,
    "torch.serialization._get_layout": _plainly,
    "torch.Tensor": _subclassed,  # named, as the class of a tensor with attributes
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_tensor_v3": _tensor,
    "torch._utils._rebuild_parameter": _wrapped,
    "torch._utils._rebuild_parameter_with_state": _wrapped,
    "torch._utils._rebuild_sparse_tensor": _wrapped,
    "torch._tensor._rebuild_from_type_v2": _subclassed,
}
