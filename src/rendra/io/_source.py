"""Where bytes come from and go to: paths, open handles, path managers, and the folder that nothing may leave."""

import contextlib
import io
import os
import re
import uuid
from dataclasses import dataclass
from typing import IO, Any, Protocol, TypeAlias

from rendra.io.errors import MeshFormatError

PathOrStr: TypeAlias = str | os.PathLike[str]
FileLike: TypeAlias = PathOrStr | IO[Any]

_UTF8_MARK = b"\xef\xbb\xbf"
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")  # file:, https:, s3:; two letters, so that C: is a drive
_DRIVE = re.compile(r"[A-Za-z]:")


class PathManager(Protocol):
    """What this package asks of an `iopath` PathManager."""

    def open(self, path: str, mode: str = "r") -> IO[Any]:
        """Open what `path` names."""

    def get_local_path(self, path: str) -> str:
        """Name a local copy of what `path` names."""


@dataclass(frozen=True)
class Source:
    """The whole content of one file.

    Attributes:
        name: what messages call it.
        data: its bytes, without a UTF-8 byte order mark.
        folder: where the files that it names are looked for.
    """

    name: str
    data: bytes
    folder: str


def is_path(f: object) -> bool:
    """Whether `f` is a str or path object rather than an open handle."""
    return isinstance(f, str | os.PathLike)


def path_text(f: PathOrStr) -> str:
    """The path as str; bytes paths are refused."""
    path = os.fspath(f)
    if not isinstance(path, str):
        raise TypeError(f"expected a str path or pathlib.Path, got {type(path).__name__}")
    return path


def read_source(f: FileLike, path_manager: PathManager | None = None) -> Source:
    """Read all of a path or of an open text or binary handle.

    Raises:
        OSError: the path cannot be opened.
        TypeError: `f` is neither a path nor something with `read`.
        MeshFormatError: a text handle met bytes that are no text.
    """
    if is_path(f):
        path = path_text(f)  # type: ignore[arg-type]
        with _open(path, path_manager) as handle:
            data = handle.read()
        return Source(path, _plain(data), os.path.dirname(path) or ".")
    if not hasattr(f, "read"):
        raise TypeError(f"expected a path or an open file, got {type(f).__name__}")
    label = getattr(f, "name", None)
    name = label if isinstance(label, str) else f"<{type(f).__name__}>"
    folder = os.path.dirname(name) if isinstance(label, str) else ""
    try:
        data = f.read()  # type: ignore[union-attr]
    except UnicodeDecodeError as error:
        raise MeshFormatError(
            "the file was opened as text, but its bytes are no text", name, expected="a handle opened with 'rb'"
        ) from error
    return Source(name, _plain(data), folder or ".")


def _open(path: str, path_manager: PathManager | None) -> IO[Any]:
    return open(path, "rb") if path_manager is None else path_manager.open(path, "rb")


def _plain(data: bytes | str) -> bytes:
    raw = data.encode("utf-8", "replace") if isinstance(data, str) else bytes(data)
    return raw.removeprefix(_UTF8_MARK)


def neighbour(
    folder: str,
    name: str,
    *,
    file: str,
    line: int | None,
    path_manager: PathManager | None = None,
    allow_outside: bool = False,
) -> str:
    """Path of a file that another file names, guaranteed to lie in that file's folder or below it.

    Symbolic links are followed before the check. With a path manager the folder may be remote, so there the
    check is on the text of the path alone.

    Args:
        folder: folder of the file that names.
        name: the name as written; Windows separators are understood.
        file, line: where it is written, for the error; no line where lines mean nothing.
        path_manager: interprets the paths where given.
        allow_outside: accept absolute paths and paths that climb out of the folder.

    Raises:
        MeshFormatError: the name leaves the folder, is a URL, or holds a NUL character.
    """

    def refuse(why: str) -> MeshFormatError:
        return MeshFormatError(why, file, line, name, "a file inside the same folder (or allow_outside=True)")

    if "\0" in name:
        raise refuse("a file name holds a NUL character")
    if _SCHEME.match(name):
        raise refuse("a file name is a URL")
    tidy = name.replace("\\", "/")
    rooted = tidy.startswith("/") or _DRIVE.match(tidy) is not None
    if rooted and not allow_outside:
        raise refuse("a file name is absolute")
    path = tidy if rooted else os.path.join(folder, tidy)
    if allow_outside:
        return path
    if os.path.normpath(tidy).split(os.sep)[0] == "..":
        raise refuse("a file name leaves the folder")
    if path_manager is None and not _lies_within(path, folder):
        raise refuse("a file name leaves the folder through a link")
    return path


def _lies_within(path: str, folder: str) -> bool:
    root = os.path.realpath(folder)
    return os.path.commonpath([root, os.path.realpath(path)]) == root


def read_neighbour(path: str, path_manager: PathManager | None = None) -> bytes | None:
    """Bytes of a plain file, or None where there is no such file."""
    if path_manager is None and not os.path.isfile(path):
        return None  # nor a folder, a pipe or a device
    try:
        with _open(path, path_manager) as handle:
            data = handle.read()
    except (FileNotFoundError, IsADirectoryError):
        return None
    return data.encode() if isinstance(data, str) else data


def write_sink(f: FileLike, data: bytes, path_manager: PathManager | None = None) -> None:
    """Write all of `data` to a path (atomically, where it is local) or to an open text or binary handle.

    Raises:
        OSError: the path cannot be written; what stood there before is untouched.
        TypeError: `f` is neither a path nor something with `write`, or a text handle was given for binary data.
    """
    if is_path(f):
        _write_path(path_text(f), data, path_manager)  # type: ignore[arg-type]
    elif not hasattr(f, "write"):
        raise TypeError(f"expected a path or an open file, got {type(f).__name__}")
    elif isinstance(f, io.TextIOBase) or hasattr(f, "encoding"):
        if not data.isascii():
            raise TypeError("binary data cannot go to a handle opened as text: open it with 'wb'")
        f.write(data.decode("ascii"))  # type: ignore[union-attr]
    else:
        f.write(data)  # type: ignore[union-attr]


def _write_path(path: str, data: bytes, path_manager: PathManager | None) -> None:
    if path_manager is not None:
        with path_manager.open(path, "wb") as handle:
            handle.write(data)
        return
    target = os.path.realpath(path)  # a link keeps pointing, its target is replaced
    folder, name = os.path.split(target)
    draft = os.path.join(folder, f".{name[:64]}.{uuid.uuid4().hex}.tmp")
    try:
        with open(draft, "xb") as handle:
            handle.write(data)
        os.replace(draft, target)
    except OSError as error:
        with contextlib.suppress(OSError):
            os.unlink(draft)
        raise OSError(error.errno, error.strerror, path) from error  # nobody knows the draft
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(draft)
        raise
