"""OFF (Geomview's object file format) in text: OFF, COFF, NOFF, CNOFF, and with ST texture coordinates passed over.

Letters: V verts, F faces (triangles). Vertices that are not finite in single precision are an error, not data.
"""

import re
import warnings
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
from torch import Tensor

from rendra.common.datatypes import Device
from rendra.io._bulk_text import Block, Lines, Positions, fan_triangles, ragged_ranges
from rendra.io._mesh_data import Floats, MeshData
from rendra.io._rows import check_decimals, float_rows, format_rows, int_rows, single_rows
from rendra.io._source import FileLike, PathManager, Source, read_source, write_sink
from rendra.io.pluggable_formats import MeshFormatInterpreter, endswith, single_mesh
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesVertex
from rendra.structures import Meshes

_KEYWORD = re.compile(r"(ST)?(C)?(N)?(4)?(n)?OFF(.*)", re.DOTALL)
_COUNTS = re.compile(r"[0-9]{1,18}")


@dataclass(frozen=True)
class _Header:
    """The first lines.

    Attributes:
        has_colors, has_normals, has_uvs: what the keyword promises of vertices.
        num_verts, num_faces: rows of the two tables.
        row: of the line with the counts.
    """

    has_colors: bool
    has_normals: bool
    has_uvs: bool
    num_verts: int
    num_faces: int
    row: int


def parse_off(source: Source) -> MeshData:
    """Read the bytes of an OFF file.

    Raises:
        MeshFormatError: the file is malformed, binary, four-dimensional, or shorter than its header says.
    """
    lines = Lines(source.name, source.data, continued=False)
    first = lines.chars[lines.firsts]
    rows = np.flatnonzero((first > 32) & (first != ord("#")))
    header, body = _read_header(lines, rows)
    wanted = header.num_verts + header.num_faces
    if wanted > len(body):
        expected = f"{header.num_verts} of vertices and {header.num_faces} of faces"
        why = f"the file is shorter than its header says: {len(body)} lines"
        lines.fail(header.row, why, expected)
    if wanted < len(body):
        lost = lines.number(int(body[wanted]))
        warnings.warn(f"{source.name}: line {lost} and what follows is neither vertex nor face", stacklevel=4)
    verts, normals, colors = _read_verts(lines.block(body[: header.num_verts]), header)
    faces, faces_colors = _read_faces(lines.block(body[header.num_verts : wanted]), header.num_verts)
    return MeshData(verts, faces, normals, colors, faces_colors)


def _read_header(lines: Lines, rows: Positions) -> tuple[_Header, Positions]:
    """The header, and the rows behind it."""
    text = lines.text(int(rows[0])) if len(rows) else ""
    match = _KEYWORD.fullmatch(text.partition("#")[0].strip())
    if match is None:
        lines.fail(int(rows[0]) if len(rows) else 0, "no OFF file", "'OFF' or 'COFF' on the first line")
    uvs, colors, normals, four, many, rest = match.groups()
    row, words, behind = int(rows[0]), rest.split(), rows[1:]
    if four or many:
        lines.fail(row, "points of other than three dimensions are not supported", "OFF, COFF or NOFF")
    if words[:1] == ["BINARY"]:
        lines.fail(row, "binary OFF is not supported", "an OFF file in text")
    if not words:  # the counts have a line of their own; some files have them glued to the keyword
        if not len(behind):
            lines.fail(row, "the file ends behind its keyword", "numbers of vertices, faces and edges")
        row, behind = int(behind[0]), behind[1:]
        words = lines.text(row).partition("#")[0].split()
    if len(words) not in (2, 3) or not all(map(_COUNTS.fullmatch, words)):
        lines.fail(row, "bad counts", "numbers of vertices, faces and edges")
    return _Header(bool(colors), bool(normals), bool(uvs), int(words[0]), int(words[1]), row), behind


def _read_verts(block: Block, header: _Header) -> tuple[Floats, Floats | None, Floats | None]:
    """Positions, normals and colours of the vertices."""
    values = block.floats()
    fixed = 3 + 3 * header.has_normals
    tail = 2 * header.has_uvs
    extra = block.counts - fixed - tail
    allowed = (3, 4) if header.has_colors else (0, 3, 4)
    if len(extra) and not (np.isin(extra, allowed).all() and extra.min() == extra.max()):
        bad = ~np.isin(extra, allowed) | (extra != extra[0])
        sizes = ", ".join(str(fixed + tail + each) for each in allowed)
        i = int(bad.argmax())
        block.fail(i, f"a vertex cannot have {block.counts[i]} numbers here", f"{sizes}, the same in every line")
    starts = block.offsets[:-1, None]
    verts = _finite(block, values, starts + np.arange(3))
    normals = _finite(block, values, starts + np.arange(3, 6)) if header.has_normals else None
    if not len(extra) or extra[0] == 0:
        return verts, normals, None
    tokens = starts + np.arange(fixed, fixed + 3)
    return verts, normals, _colors(block, values, tokens)


def _read_faces(block: Block, num_verts: int) -> tuple[Positions, Floats | None]:
    """Triangles, and the colours of those whose polygons have one."""
    values = block.floats()
    starts = block.offsets[:-1]
    written = values[starts] if len(starts) else values[:0]
    room = block.counts - 1
    for bad, why in (
        (written != np.floor(written), "the number of corners is no whole number"),
        (written < 3, "a face needs at least three corners"),
        (written > room, "the line ends before the corners do"),
    ):
        if bad.any():
            block.fail(int(bad.argmax()), why)
    lengths = written.astype(np.int64)
    tokens = ragged_ranges(starts + 1, lengths)
    corners = values[tokens]
    outside = ~((corners >= 0) & (corners < num_verts) & (corners == np.floor(corners)))
    if outside.any():
        expected = f"an index from 0 to {num_verts - 1}" if num_verts else "no face, as there is no vertex"
        block.fail_token(int(tokens[outside.argmax()]), "no such vertex", expected)
    fans, polygons = fan_triangles(lengths)
    colors = _face_colors(block, values, starts + 1 + lengths, room - lengths)
    return corners.astype(np.int64)[fans], None if colors is None else colors[polygons]


def _face_colors(block: Block, values: np.ndarray, starts: Positions, counts: Positions) -> Floats | None:
    """(faces, 3) of the r g b [a] behind the corners; one number, an index into a map that nobody has, is passed."""
    bad = (counts == 2) | (counts > 4)
    if bad.any():
        i = int(bad.argmax())
        block.fail(i, f"{counts[i]} numbers behind the corners of a face", "none, or a colour: r g b, or r g b a")
    has = counts >= 3
    if not has.any():
        return None
    colors = np.ones((len(counts), 3), dtype=np.float32)
    colors[has] = _colors(block, values, starts[has, None] + np.arange(3))
    return colors


def _colors(block: Block, values: np.ndarray, tokens: Positions) -> Floats:
    """Colours in [0, 1]: whole numbers are out of 255, those with a point are fractions unless one exceeds 1."""
    colors = _finite(block, values, tokens)
    pointed = np.isin(block.chars, np.frombuffer(b".eE", dtype=np.uint8))
    before = np.concatenate([[0], np.cumsum(pointed)])
    ends = np.append(block.begins[1:], len(block.chars))
    fractions = (before[ends[tokens]] > before[block.begins[tokens]]).any()
    return colors if fractions and colors.max() <= 1.0 else colors / np.float32(255.0)


def _finite(block: Block, values: np.ndarray, tokens: Positions) -> Floats:
    """Pick tokens as float32; anything beyond its range is as bad as NaN."""
    with np.errstate(over="ignore"):
        picked = values[tokens].astype(np.float32)
    bad = ~np.isfinite(picked)
    if bad.any():
        _fail_finite(block, int(tokens[bad][0]))
    return picked


def _fail_finite(block: Block, token: int) -> NoReturn:
    block.fail_token(token, "a number that is not finite in single precision")


class MeshOffFormat(MeshFormatInterpreter):
    """OFF files for `IO`."""

    def __init__(self) -> None:
        self.known_suffixes = (".off",)

    def read(
        self, path: FileLike, include_textures: bool, device: Device, path_manager: PathManager | None, **kwargs: Any
    ) -> Meshes | None:
        """Read a mesh, its normals, and its colours as a texture; None for any other suffix.

        Vertex colours become `TexturesVertex`; where there are only face colours, `TexturesAtlas` of one texel.
        Opacity is dropped.

        Raises:
            MeshFormatError: the file is malformed or binary.
            OSError: the path cannot be opened.
        """
        if not endswith(path, self.known_suffixes):
            return None
        return parse_off(read_source(path, path_manager)).meshes(include_textures, device)

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
        """Write one mesh, its normals if it `has_verts_normals`, its vertex colours or its face colours of one texel.

        Args:
            data, path, path_manager: see the base class.
            binary: must not be True.
            decimal_places: digits behind the point; None for as many as single precision needs to come back exactly.
            colors_as_uint8: colours as whole numbers from 0 to 255.
            include_textures: write colours.
            kwargs: ignored.

        Raises:
            ValueError: `binary` is True, the batch has not exactly one mesh, or a number is not finite.
            OSError: the file cannot be written; what stood there before is untouched.
        """
        if not endswith(path, self.known_suffixes):
            return False
        if binary:
            raise ValueError("OFF is written as text: binary must be False or None")
        check_decimals(decimal_places)
        style = _Style("%.9g" if decimal_places is None else f"%.{decimal_places}f", colors_as_uint8)
        write_sink(path, _render(single_mesh(data), include_textures, style), path_manager)
        return True


@dataclass(frozen=True)
class _Style:
    """How numbers are written.

    Attributes:
        number: the % format of a coordinate.
        whole_colors: colours as whole numbers out of 255.
    """

    number: str
    whole_colors: bool

    def color(self) -> str:
        """The % format of a colour; a fraction always has a point, by which readers know it."""
        return "%d" if self.whole_colors else self.number.replace("%", "%#")

    def colors(self, values: Tensor, name: str, count: str) -> np.ndarray:
        """(n, 3) float64 as they are written."""
        rows = float_rows(values, 3, name, count)
        return np.rint(rows.clip(0.0, 1.0) * 255.0) if self.whole_colors else rows


def _render(mesh: Meshes, include_textures: bool, style: _Style) -> bytes:
    """The whole file."""
    verts, faces = mesh.get_mesh_verts_faces(0)
    columns = [single_rows(verts, 3, "verts", "num_verts").astype(np.float64)]
    corners = int_rows(faces, len(verts), "faces", "num_faces")
    keyword, template = "OFF", " ".join([style.number] * 3)
    if mesh.has_verts_normals():
        columns.append(single_rows(mesh.verts_normals_list()[0], 3, "verts_normals", "num_verts").astype(np.float64))
        keyword, template = "NOFF", f"{template} {template}"
    face_template, face_rows = "3 %d %d %d", corners
    textures = mesh.textures if include_textures else None
    color = " ".join([style.color()] * 3)
    if isinstance(textures, TexturesVertex) and textures.verts_features_list()[0].shape[-1] == 3:
        columns.append(style.colors(textures.verts_features_list()[0], "verts_features", "num_verts"))
        keyword, template = f"C{keyword}", f"{template} {color}"
    elif isinstance(textures, TexturesAtlas) and textures.atlas_list()[0].shape[1:] == (1, 1, 3):
        colors = style.colors(textures.atlas_list()[0].reshape(-1, 3), "atlas", "num_faces")
        face_template, face_rows = f"{face_template} {color}", np.concatenate([corners, colors], axis=1)
    elif textures is not None:
        what = f"RGB colours of vertices, or of faces in one texel, not this {type(textures).__name__}"
        warnings.warn(f"OFF files hold {what}; it is not saved", stacklevel=5)
    head = f"{keyword}\n{len(verts)} {len(corners)} 0\n".encode()
    rows = np.concatenate(columns, axis=1)
    return head + format_rows(f"{template}\n", rows) + format_rows(f"{face_template}\n", face_rows)
