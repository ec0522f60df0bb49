"""PLY (Stanford polygon) files: ascii and binary of either byte order.

Letters: V verts, F faces (triangles). Vertices that are not finite in single precision are an error, not data.
"""

import sys
import warnings
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rendra.common.datatypes import Device
from rendra.io._bulk_text import Positions, fan_triangles
from rendra.io._mesh_data import Floats, MeshData
from rendra.io._ply_body import Lists, Table, read_tables
from rendra.io._ply_header import parse_header
from rendra.io._rows import check_decimals, float_rows, format_rows, int_rows, number_format
from rendra.io._source import FileLike, PathManager, Source, read_source, write_sink
from rendra.io.errors import MeshFormatError
from rendra.io.pluggable_formats import (
    MeshFormatInterpreter,
    PointcloudFormatInterpreter,
    endswith,
    single_cloud,
    single_mesh,
)
from rendra.renderer.mesh.textures import TexturesBase, TexturesVertex
from rendra.structures import Meshes, Pointclouds

_INDEX_NAMES = ("vertex_indices", "vertex_index")


def load_ply(f: FileLike, *, path_manager: PathManager | None = None) -> tuple[Tensor, Tensor]:
    """Read vertices and faces of a PLY file.

    Polygons become fans of triangles. Other elements and properties are passed over; `IO().load_mesh` reads
    normals and colours too. A file without faces, a point cloud, gives none.

    Args:
        f: path, or open handle (in binary mode, unless the file is ascii).
        path_manager: interprets paths where given.

    Returns:
        (V, 3) float32 vertices and (F, 3) int64 faces, on the CPU.

    Raises:
        MeshFormatError: the file is malformed or shorter than its header says.
        OSError: the path cannot be opened.
    """
    data = parse_ply(read_source(f, path_manager))
    return torch.from_numpy(data.verts), torch.from_numpy(data.faces)


def parse_ply(source: Source) -> MeshData:
    """Read the bytes of a PLY file; errors as in `load_ply`."""
    tables = read_tables(source, parse_header(source))
    if "vertex" not in tables:
        raise MeshFormatError("the file has no vertex element", source.name, expected="element vertex <number>")
    vertex, face = tables["vertex"], tables.get("face")
    verts = _vectors(vertex, "x", "y", "z")
    if verts is None:
        line = vertex.element.line
        raise MeshFormatError("vertices lack x, y or z", source.name, line, expected="one value each, no list")
    _demand_finite(vertex, verts)
    normals, colors = _vectors(vertex, "nx", "ny", "nz"), _colors(vertex)
    if face is None and "tristrips" in tables:
        line = tables["tristrips"].element.line
        raise MeshFormatError("triangle strips are not supported", source.name, line, expected="element face")
    if face is None or not face.element.count:
        return MeshData(verts, np.zeros((0, 3), dtype=np.int64), normals, colors, None)
    faces, polygons = _triangles(face, len(verts))
    faces_colors = _colors(face)
    return MeshData(verts, faces, normals, colors, None if faces_colors is None else faces_colors[polygons])


def _vectors(table: Table, *names: str) -> Floats | None:
    """(n, len(names)) float32 of single-valued columns, or None where one of them is missing."""
    columns = [table.columns.get(name) for name in names]
    if any(column is None or isinstance(column, Lists) for column in columns):
        return None
    with np.errstate(over="ignore"):
        return np.stack([column.astype(np.float32) for column in columns], axis=1)  # type: ignore[union-attr]


def _demand_finite(table: Table, verts: Floats) -> None:
    bad = ~np.isfinite(verts).all(axis=1)
    if bad.any():
        row = int(bad.argmax())
        found = " ".join(str(value) for value in verts[row].tolist())
        table.fail(row, "a coordinate that is not finite in single precision", found)


def _colors(table: Table) -> Floats | None:
    names = ("red", "green", "blue")
    colors = _vectors(table, *names)
    if colors is None:
        return None
    kinds = [table.columns[name].dtype for name in names]  # type: ignore[union-attr]
    scale = [1.0 / np.iinfo(kind).max if kind.kind in "iu" else 1.0 for kind in kinds]
    return colors * np.array(scale, dtype=np.float32)


def _triangles(face: Table, num_verts: int) -> tuple[Positions, Positions]:
    """(F, 3) vertex indices and (F,) the row of each triangle."""
    name = next((each for each in _INDEX_NAMES if each in face.columns), None)
    column = face.columns[name] if name is not None else None
    if not isinstance(column, Lists) or column.values.dtype.kind == "f":
        expected = "property list <integer type> <integer type> vertex_indices"
        raise MeshFormatError("faces lack their vertex indices", face.file, face.element.line, expected=expected)
    if (column.lengths < 3).any():
        row = int((column.lengths < 3).argmax())
        face.fail(row, "a face needs at least three corners", f"{column.lengths[row]}")
    indices = column.values.astype(np.int64)
    bad = (indices < 0) | (indices >= num_verts)
    if bad.any():
        corner = int(bad.argmax())
        row = int(np.searchsorted(np.cumsum(column.lengths), corner, side="right"))
        face.fail(row, "no such vertex", str(indices[corner]), f"an index from 0 to {num_verts - 1}")
    corners, polygons = fan_triangles(column.lengths)
    return indices[corners], polygons


def save_ply(
    f: FileLike,
    verts: Tensor,
    faces: Tensor | None = None,
    verts_normals: Tensor | None = None,
    ascii: bool = False,
    decimal_places: int | None = None,
    path_manager: PathManager | None = None,
) -> None:
    """Write a mesh to a PLY file; colours go through `IO().save_mesh`.

    Args:
        f: path, or open handle (in binary mode, unless `ascii`). A file is replaced only once it is whole.
        verts: (V, 3), or empty; written in single precision.
        faces: (F, 3) indices, or empty or None.
        verts_normals: (V, 3), or empty or None.
        ascii: text instead of the machine's binary.
        decimal_places: digits behind the point of a text; 6 if None. Binary files have no use for it.
        path_manager: interprets paths where given; then files are not replaced atomically.

    Raises:
        ValueError: a shape does not fit, an index points nowhere, a number is not finite.
        OSError: the file cannot be written; what stood there before is untouched.
    """
    content = _Content(verts, faces)
    if verts_normals is not None and verts_normals.numel():
        content.add(("nx", "ny", "nz"), verts_normals, "verts_normals")
    write_sink(f, content.render(ascii, decimal_places), path_manager)


class _Column(NamedTuple):
    """One property of the vertices and its values, (V,)."""

    name: str
    kind: str
    values: np.ndarray


class _Content:
    """A PLY file in the making.

    Args:
        verts: (V, 3).
        faces: (F, 3) or None.
    """

    def __init__(self, verts: Tensor, faces: Tensor | None) -> None:
        self._num_verts = len(verts)
        self._columns: list[_Column] = []
        self.add(("x", "y", "z"), verts, "verts")
        none = torch.zeros(0, 3, dtype=torch.int64)
        self._faces = int_rows(none if faces is None else faces, self._num_verts, "faces", "num_faces")

    def add(self, names: tuple[str, ...], values: Tensor, argument: str, as_uint8: bool = False) -> None:
        """Add (V, 3) values; as_uint8 takes them from [0, 1] to 0..255."""
        rows = float_rows(values, len(names), argument, "num_verts")
        if len(rows) != self._num_verts:
            raise ValueError(f"'{argument}' has {len(rows)} rows, but there are {self._num_verts} verts")
        if as_uint8:
            rows = np.rint(rows.clip(0.0, 1.0) * 255.0)
        kind = "uchar" if as_uint8 else "float"
        self._columns += [_Column(name, kind, rows[:, i]) for i, name in enumerate(names)]

    def render(self, ascii: bool, decimal_places: int | None) -> bytes:
        """The whole file."""
        check_decimals(decimal_places)
        if ascii:
            return self._header("ascii") + self._text(number_format(decimal_places))
        if decimal_places is not None:
            warnings.warn("decimal_places is ignored: a binary PLY file has no decimal places", stacklevel=4)
        return self._header(f"binary_{sys.byteorder}_endian") + self._bytes()

    def _header(self, encoding: str) -> bytes:
        properties = "".join(f"property {column.kind} {column.name}\n" for column in self._columns)
        return (
            f"ply\nformat {encoding} 1.0\nelement vertex {self._num_verts}\n{properties}"
            f"element face {len(self._faces)}\nproperty list uchar int vertex_index\nend_header\n"
        ).encode("ascii")

    def _text(self, number: str) -> bytes:
        row = " ".join("%d" if column.kind == "uchar" else number for column in self._columns)
        values = np.stack([column.values for column in self._columns], axis=1)
        return format_rows(f"{row}\n", values) + format_rows("3 %d %d %d\n", self._faces)

    def _bytes(self) -> bytes:
        kinds = {"float": "f4", "uchar": "u1"}
        vertex = np.zeros(self._num_verts, dtype=[(column.name, kinds[column.kind]) for column in self._columns])
        for column in self._columns:
            vertex[column.name] = column.values
        face = np.zeros(len(self._faces), dtype=[("length", "u1"), ("vertices", "i4", (3,))])
        face["length"], face["vertices"] = 3, self._faces
        return vertex.tobytes() + face.tobytes()


class MeshPlyFormat(MeshFormatInterpreter):
    """PLY files for `IO`."""

    def __init__(self) -> None:
        self.known_suffixes = (".ply",)

    def read(
        self,
        path: FileLike,
        include_textures: bool,
        device: Device,
        path_manager: PathManager | None,
        **kwargs: Any,
    ) -> Meshes | None:
        """Read a mesh with its normals, and its colours as a texture; None for any other suffix.

        Vertex colours become `TexturesVertex`; where there are only face colours, `TexturesAtlas` of one texel.
        """
        if not endswith(path, self.known_suffixes):
            return None
        return parse_ply(read_source(path, path_manager)).meshes(include_textures, device)

    def save(
        self,
        data: Meshes,
        path: FileLike,
        path_manager: PathManager | None,
        binary: bool | None,
        decimal_places: int | None = None,
        colors_as_uint8: bool = False,
        include_textures: bool = True,
        **kwargs: Any,
    ) -> bool:
        """Write one mesh, its normals if it `has_verts_normals`, its vertex colours; binary unless `binary` is False.

        Raises:
            ValueError: the batch has not exactly one mesh.
        """
        if not endswith(path, self.known_suffixes):
            return False
        content = _Content(*single_mesh(data).get_mesh_verts_faces(0))
        if data.has_verts_normals():
            content.add(("nx", "ny", "nz"), data.verts_normals_list()[0], "verts_normals")
        colors = _savable_colors(data.textures) if include_textures else None
        if colors is not None:
            content.add(("red", "green", "blue"), colors, "colors", colors_as_uint8)
        write_sink(path, content.render(binary is False, decimal_places), path_manager)
        return True


def _savable_colors(textures: TexturesBase | None) -> Tensor | None:
    """(V, 3) colours of a vertex texture; anything else is a warning."""
    if textures is None:
        return None
    if isinstance(textures, TexturesVertex) and textures.verts_features_list()[0].shape[-1] == 3:
        return textures.verts_features_list()[0]
    warnings.warn(
        f"Texture will not be saved: PLY files hold RGB vertex colours, not {type(textures).__name__}", stacklevel=5
    )
    return None


class PointcloudPlyFormat(PointcloudFormatInterpreter):
    """PLY files for `IO`, read and written as point clouds."""

    def __init__(self) -> None:
        self.known_suffixes = (".ply",)

    def read(
        self, path: FileLike, device: Device, path_manager: PathManager | None, **kwargs: Any
    ) -> Pointclouds | None:
        """Read the vertices, their normals, and their colours as features; None for any other suffix.

        Faces are checked, but not kept.

        Raises:
            MeshFormatError: the file is malformed or shorter than its header says.
            OSError: the path cannot be opened.
        """
        if not endswith(path, self.known_suffixes):
            return None
        data = parse_ply(read_source(path, path_manager))
        points, normals, colors = (
            None if each is None else [torch.from_numpy(each).to(device)]
            for each in (data.verts, data.normals, data.verts_colors)
        )
        assert points is not None  # a file without vertices was refused
        return Pointclouds(points, normals=normals, features=colors)

    def save(
        self,
        data: Pointclouds,
        path: FileLike,
        path_manager: PathManager | None,
        binary: bool | None,
        decimal_places: int | None = None,
        colors_as_uint8: bool = False,
        **kwargs: Any,
    ) -> bool:
        """Write one cloud, its normals, and its features if they are three, as colours.

        Binary, in the machine's byte order, unless `binary` is False.

        Raises:
            ValueError: the batch has not exactly one cloud, or a number is not finite.
            OSError: the file cannot be written; what stood there before is untouched.
        """
        if not endswith(path, self.known_suffixes):
            return False
        points, normals, features = single_cloud(data).get_cloud(0)
        content = _Content(points, None)
        if normals is not None:
            content.add(("nx", "ny", "nz"), normals, "normals")
        if features is not None and features.shape[-1] == 3:
            content.add(("red", "green", "blue"), features, "features", colors_as_uint8)
        elif features is not None:
            warnings.warn(f"PLY files hold RGB colours, not {features.shape[-1]} features; not saved", stacklevel=4)
        write_sink(path, content.render(binary is False, decimal_places), path_manager)
        return True
