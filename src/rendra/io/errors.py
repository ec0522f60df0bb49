"""The one error that every malformed mesh, material or texture file raises, and that of a file that is missing."""

from pathlib import Path

_LONGEST_QUOTE = 80


class MeshFormatError(ValueError):
    """A file does not say what its format demands, or asks for something that is refused.

    Args:
        why: what is wrong, in one phrase.
        file: name of the file, or "<stream>" where there is none.
        line: line of the file, from 1; None where lines mean nothing (a binary body, an image).
        found: the offending text; quoted, escaped and shortened in the message.
        expected: what should have stood there.

    All five are kept as attributes. It is a ValueError, so code that catches what PyTorch3D raised still works.
    """

    def __init__(
        self,
        why: str,
        file: str = "<stream>",
        line: int | None = None,
        found: str | None = None,
        expected: str | None = None,
    ) -> None:
        self.why, self.file, self.line, self.found, self.expected = why, file, line, found, expected
        where = file if line is None else f"{file}, line {line}"
        parts = [f"{where}: {why}"]
        if found is not None:
            parts.append(f"found {_quote(found)}")
        if expected is not None:
            parts.append(f"expected {expected}")
        super().__init__("; ".join(parts))

    def __reduce__(self) -> tuple[type, tuple[str, str, int | None, str | None, str | None]]:
        """Survive the trip out of a DataLoader worker."""
        return type(self), (self.why, self.file, self.line, self.found, self.expected)


def _quote(text: str) -> str:
    shortened = text if len(text) <= _LONGEST_QUOTE else text[: _LONGEST_QUOTE - 3] + "..."
    return repr(shortened)


def require_file(path: Path, what: str = "file") -> None:
    """FileNotFoundError unless `path` is a file; it says where a folder stands in its place.

    Args:
        path: which should be there.
        what: it is, in words, such as "mesh file".
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no {what} {path}{' (it is a folder)' if path.is_dir() else ''}")
