"""STL (stereolithography) files, binary and text.

Letters: V verts, F faces (triangles). The file is a list of separate triangles; corners at exactly equal places
become one vertex. Its normals are passed over, since the corners' order says the same, and so are the colours that
some programs hide in binary files.
"""

import struct
import warnings
from typing import Any

import numpy as np
import torch

from rendra.common.datatypes import Device
from rendra.io._bulk_text import Lines, Positions
from rendra.io._rows import check_decimals, format_rows, int_rows, single_rows
from rendra.io._source import FileLike, PathManager, Source, read_source, write_sink
from rendra.io.errors import MeshFormatError
from rendra.io.pluggable_formats import MeshFormatInterpreter, endswith, single_mesh
from rendra.structures import Meshes

Floats = np.ndarray  # float32

_HEAD = 84
_FACET = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_WORDS = (b"solid", b"facet", b"outer", b"vertex", b"endloop", b"endfacet", b"endsolid")
_CYCLE = np.array([1, 2, 3, 3, 3, 4, 5])  # the words of one triangle


def parse_stl(source: Source) -> tuple[Floats, Positions]:
    """Read the bytes of an STL file; the first bytes and the length tell whether it is text.

    Returns:
        (V, 3) float32 vertices in the order of their first use, and (F, 3) int64 faces.

    Raises:
        MeshFormatError: malformed, shorter than it says, or a corner that is not finite in single precision.
    """
    return _merged(_read_text(source) if _is_text(source.data) else _read_binary(source))


def _is_text(data: bytes) -> bool:
    """Whether it opens as a text does, and is not as long as a binary file with that opening would be."""
    if data[:1024].lstrip()[:5].lower() != b"solid":
        return False
    fits = len(data) >= _HEAD and len(data) == _HEAD + _FACET.itemsize * struct.unpack_from("<I", data, 80)[0]
    return not fits


def _read_binary(source: Source) -> Floats:
    """(F, 3, 3) corners."""
    have = len(source.data)
    if have < _HEAD:
        raise MeshFormatError(
            "the file ends within its header", source.name, None, f"{have} bytes", f"{_HEAD} or more"
        )
    (count,) = struct.unpack_from("<I", source.data, 80)
    need = _HEAD + _FACET.itemsize * count
    if need > have:
        why = f"byte 80: the file is too short for its {count} triangles"
        raise MeshFormatError(why, source.name, None, f"{have} bytes", f"{need}")
    if need < have:
        warnings.warn(f"{source.name}: {have - need} bytes behind the last triangle are ignored", stacklevel=5)
    corners = np.frombuffer(source.data, _FACET, count, _HEAD)["corners"].astype(np.float32)
    bad = ~np.isfinite(corners).all(axis=(1, 2))
    if bad.any():
        row = int(bad.argmax())
        found = str(corners[row].tolist())
        raise MeshFormatError(f"triangle {row}: a coordinate that is not finite", source.name, None, found)
    return corners


def _read_text(source: Source) -> Floats:
    """(F, 3, 3) corners."""
    lines = Lines(source.name, source.data, continued=False)
    rows = np.flatnonzero(lines.chars[lines.firsts] > 32)
    kinds = _kinds(lines, rows)
    inner = (kinds != 0) & (kinds != 6)
    _demand_cycle(lines, rows[inner], kinds[inner])
    block = lines.block(rows[kinds == 3], len("vertex"))
    bad = block.counts != 3
    if bad.any():
        block.fail(int(bad.argmax()), "a corner needs three numbers", "vertex x y z")
    values = block.floats()
    with np.errstate(over="ignore"):
        corners = values.astype(np.float32)
    if not np.isfinite(corners).all():
        block.fail_token(int((~np.isfinite(corners)).argmax()), "a coordinate that is not finite in single precision")
    return corners.reshape(-1, 3, 3)


def _kinds(lines: Lines, rows: Positions) -> Positions:
    """The keyword of each row, by its number in `_WORDS`."""
    length = max(map(len, _WORDS)) + 1
    window = lines.firsts[rows, None] + np.arange(length)
    chars = lines.chars[window.clip(max=len(lines.chars) - 1)]
    chars = np.where((chars >= ord("A")) & (chars <= ord("Z")), chars + 32, chars)
    kinds = np.full(len(rows), -1, dtype=np.int64)
    for number, word in enumerate(_WORDS):
        letters = np.frombuffer(word, dtype=np.uint8)
        matches = (chars[:, : len(word)] == letters).all(axis=1) & (chars[:, len(word)] <= 32)
        kinds[matches] = number
    if (kinds < 0).any():
        words = ", ".join(word.decode() for word in _WORDS)
        lines.fail(int(rows[int((kinds < 0).argmax())]), "a statement unknown to STL", words)
    return kinds


def _demand_cycle(lines: Lines, rows: Positions, kinds: Positions) -> None:
    """Every triangle is facet, outer loop, three corners, endloop, endfacet."""
    expected = np.resize(_CYCLE, len(kinds))
    wrong = kinds != expected
    if wrong.any():
        row = int(wrong.argmax())
        lines.fail(int(rows[row]), "a statement out of order", f"'{_WORDS[expected[row]].decode()}'")
    if len(kinds) % len(_CYCLE):
        lines.fail(int(rows[-1]), "the file ends within a triangle", f"'{_WORDS[_CYCLE[len(kinds) % 7]].decode()}'")


def _merged(corners: Floats) -> tuple[Floats, Positions]:
    """Vertices, equal places once, in the order of first use; and the faces."""
    points = np.ascontiguousarray(corners.reshape(-1, 3)) + np.float32(0.0)  # -0 becomes 0
    if not len(points):
        return points, np.zeros((0, 3), dtype=np.int64)
    order = np.lexsort(points.T)
    ordered = points[order]
    opens = np.concatenate([[True], (ordered[1:] != ordered[:-1]).any(axis=1)])
    first = order[opens]  # the sort is stable: the earliest of equals
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    index = np.empty(len(points), dtype=np.int64)
    index[order] = rank[np.cumsum(opens) - 1]
    return points[np.sort(first)], index.reshape(-1, 3)


class MeshStlFormat(MeshFormatInterpreter):
    """STL files for `IO`."""

    def __init__(self) -> None:
        self.known_suffixes = (".stl",)

    def read(
        self, path: FileLike, include_textures: bool, device: Device, path_manager: PathManager | None, **kwargs: Any
    ) -> Meshes | None:
        """Read a mesh, corners at exactly equal places as one vertex; None for any other suffix.

        Raises:
            MeshFormatError: the file is malformed or shorter than it says.
            OSError: the path cannot be opened.
        """
        if not endswith(path, self.known_suffixes):
            return None
        verts, faces = parse_stl(read_source(path, path_manager))
        return Meshes([torch.from_numpy(verts).to(device)], [torch.from_numpy(faces).to(device)])

    def save(
        self,
        data: Meshes,
        path: FileLike,
        path_manager: PathManager | None,
        binary: bool | None,
        decimal_places: int | None = None,
        include_textures: bool = True,
        **kwargs: Any,
    ) -> bool:
        """Write the triangles of one mesh, binary unless `binary` is False; vertices without face are lost.

        Raises:
            ValueError: the batch has not exactly one mesh, or a number is not finite in single precision.
            OSError: the file cannot be written; what stood there before is untouched.
        """
        if not endswith(path, self.known_suffixes):
            return False
        check_decimals(decimal_places)
        if include_textures and single_mesh(data).textures is not None:
            kind = type(data.textures).__name__
            warnings.warn(f"STL files hold no colours; this {kind} is not saved", stacklevel=4)
        facets = _facets(single_mesh(data))
        number = "%.9g" if decimal_places is None else f"%.{decimal_places}f"
        write_sink(path, _render_text(facets, number) if binary is False else _render_binary(facets), path_manager)
        return True


def _facets(mesh: Meshes) -> np.ndarray:
    """(F,) records of unit normal (zero for triangles without area) and corners."""
    verts, faces = mesh.get_mesh_verts_faces(0)
    points = single_rows(verts, 3, "verts", "num_verts")
    facets = np.zeros(len(faces), dtype=_FACET)
    facets["corners"] = points[int_rows(faces, len(points), "faces", "num_faces")].reshape(-1, 3, 3)
    corners = facets["corners"].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    facets["normal"] = normals / np.where(lengths > 0.0, lengths, 1.0)
    return facets


def _render_binary(facets: np.ndarray) -> bytes:
    title = b"binary STL written by rendra"  # which must not begin with "solid"
    return title.ljust(80, b" ") + struct.pack("<I", len(facets)) + facets.tobytes()


def _render_text(facets: np.ndarray, number: str) -> bytes:
    vector = " ".join([number] * 3)
    corner = f"      vertex {vector}\n"
    template = f"  facet normal {vector}\n    outer loop\n{corner * 3}    endloop\n  endfacet\n"
    rows = np.concatenate([facets["normal"], facets["corners"].reshape(-1, 9)], axis=1).astype(np.float64)
    return b"solid rendra\n" + format_rows(template, rows) + b"endsolid rendra\n"
