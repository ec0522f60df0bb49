"""The statements of a Wavefront OBJ file as arrays.

Read: v (x y z, with w or r g b [a] behind), vt, vn, f, usemtl, mtllib. Groups, objects, smoothing, lines,
points and free-form surfaces are passed over. Indices leave here counted from 0, with -1 for "none".
"""

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendra.io._bulk_text import Block, Lines, Positions, fan_triangles, parse_numbers
from rendra.io._source import Source
from rendra.io.errors import MeshFormatError

Floats = npt.NDArray[np.float32]

_OTHER, _VERTEX, _UV, _NORMAL, _FACE = range(5)
_SLASH = ord("/")
MOST_LIBRARIES = 1000  # each is looked for on disk
_CORNER = re.compile(rb"[+-]?\d+(/([+-]?\d+)?){0,2}")
_FORMS = "v, v/vt, v//vn or v/vt/vn, whole numbers counted from 1 or negative from the end"
# fmt: off
_PASSED_OVER = frozenset((
    "vp", "p", "l", "g", "s", "mg", "o", "cstype", "deg", "bmat", "step", "curv", "curv2", "surf",
    "parm", "trim", "hole", "scrv", "sp", "end", "con", "bevel", "c_interp", "d_interp", "lod",
    "usemtl", "mtllib", "shadow_obj", "trace_obj", "ctech", "stech", "maplib", "usemap", "call",
    "csh", "fo", "bzp", "bsp", "cdc", "cdp", "res",
))
# fmt: on


@dataclass(frozen=True)
class ObjData:
    """What an OBJ file says, polygons already cut into triangles.

    Attributes:
        verts: (V, 3) positions.
        colors: (V, 3) vertex colours in [0, 1], or None; white where only some vertices have one.
        uvs: (U, 2) texture coordinates, origin bottom left.
        normals: (N, 3), as written.
        faces, faces_uvs, faces_normals: (F, 3) indices into verts, uvs, normals; the last two -1 where absent.
        faces_materials: (F,) indices into material_names; -1 before the first usemtl.
        material_names: in the order of their first use.
        libraries: (line, text) of every mtllib statement, repetitions left out.
    """

    verts: Floats
    colors: Floats | None
    uvs: Floats
    normals: Floats
    faces: Positions
    faces_uvs: Positions
    faces_normals: Positions
    faces_materials: Positions
    material_names: list[str]
    libraries: list[tuple[int, str]]


def parse_obj(source: Source) -> ObjData:
    """Read the bytes of an OBJ file.

    Raises:
        MeshFormatError: malformed statement, index out of range, coordinate that is not finite, or no OBJ at all.
    """
    nul = source.data.find(b"\0")
    if nul >= 0:
        line = source.data.count(b"\n", 0, nul) + 1
        raise MeshFormatError("a NUL byte, so this is no OBJ text", source.name, line, expected="plain text")
    lines = Lines(source.name, source.data)
    kinds = _classify(lines)
    rows = {kind: np.flatnonzero(kinds == kind) for kind in (_VERTEX, _UV, _NORMAL, _FACE)}
    others = _other_rows(lines, kinds)
    if not len(rows[_VERTEX]) and not len(rows[_FACE]):
        _demand_known_words(lines, others)
    verts, colors = _read_vertices(lines.block(rows[_VERTEX], 1))
    uvs = _read_vectors(lines.block(rows[_UV], 2), 2, (2, 3), "a texture coordinate needs u v, or u v w")
    normals = _read_vectors(lines.block(rows[_NORMAL], 2), 3, (3,), "a normal needs three numbers")
    corners = _read_corners(lines.block(rows[_FACE], 1))
    references = [
        _resolve(corners, slot, rows[kind], noun)
        for slot, kind, noun in ((0, _VERTEX, "vertex"), (1, _UV, "texture coordinate"), (2, _NORMAL, "normal"))
    ]
    triangles, polygons = fan_triangles(corners.block.counts)
    materials, names, libraries = _read_names(lines, others, rows[_FACE])
    return ObjData(
        verts, colors, uvs, normals,
        references[0][triangles], references[1][triangles], references[2][triangles],
        materials[polygons], names, libraries,
    )  # fmt: skip


def _classify(lines: Lines) -> npt.NDArray[np.int8]:
    """The kind of each line, from its first three characters."""
    first, second, third = (lines.chars[lines.firsts + i] for i in range(3))
    kinds = np.full(len(first), _OTHER, dtype=np.int8)
    is_v = first == ord("v")
    kinds[is_v & (second <= 32)] = _VERTEX
    kinds[is_v & (second == ord("t")) & (third <= 32)] = _UV
    kinds[is_v & (second == ord("n")) & (third <= 32)] = _NORMAL
    kinds[(first == ord("f")) & (second <= 32)] = _FACE
    return kinds


def _other_rows(lines: Lines, kinds: npt.NDArray[np.int8]) -> Positions:
    """Lines that hold some other statement: neither empty nor comments."""
    first = lines.chars[lines.firsts]
    return np.flatnonzero((kinds == _OTHER) & (first > 32) & (first != ord("#")))


def _demand_known_words(lines: Lines, others: Positions) -> None:
    """A file without vertices and faces must at least speak OBJ: not a web page, not a JSON."""
    for row in others.tolist():
        if lines.text(row).split()[0] not in _PASSED_OVER:
            lines.fail(row, "neither vertices nor faces, and a statement unknown to OBJ", "lines such as 'v 0 0 1'")


def _read_vertices(block: Block) -> tuple[Floats, Floats | None]:
    expected = "x y z, optionally with w, or with r g b and a"
    values = _read_table(block, (3, 4, 6, 7), f"a vertex cannot have {{}} numbers: it needs {expected}")
    starts = block.offsets[:-1, None]
    verts = _finite(block, values, starts + np.arange(3))
    colored = block.counts >= 6
    if not colored.any():
        return verts, None
    colors = np.ones_like(verts)
    colors[colored] = _finite(block, values, starts[colored] + np.arange(3, 6))
    return verts, colors / 255.0 if colors.max() > 1.0 else colors


def _read_vectors(block: Block, width: int, allowed: tuple[int, ...], why: str) -> Floats:
    values = _read_table(block, allowed, why)
    return _finite(block, values, block.offsets[:-1, None] + np.arange(width))


def _read_table(block: Block, allowed: tuple[int, ...], why: str) -> npt.NDArray[np.float64]:
    bad = ~np.isin(block.counts, allowed)
    if bad.any():
        row = int(bad.argmax())
        block.fail(row, why.format(block.counts[row]))
    return block.floats()


def _finite(block: Block, values: npt.NDArray[np.float64], tokens: Positions) -> Floats:
    """Pick tokens as float32; anything beyond its range is as bad as NaN."""
    with np.errstate(over="ignore"):
        picked = values[tokens].astype(np.float32)
    bad = ~np.isfinite(picked)
    if bad.any():
        block.fail_token(int(tokens[bad][0]), "a coordinate that is not finite in single precision")
    return picked


@dataclass(frozen=True)
class _Corners:
    """Corners of all faces, C of them, as written: (C, 3) for v, vt, vn, and which of them are written at all."""

    block: Block
    numbers: Positions
    present: npt.NDArray[np.bool_]


def _read_corners(block: Block) -> _Corners:
    """Turn 'a/b/c' into numbers."""
    short = block.counts < 3
    if short.any():
        block.fail(int(short.argmax()), "a face needs at least three corners")
    begins = block.begins
    slashes = np.flatnonzero(block.chars == _SLASH)
    per_corner = np.diff(np.append(np.searchsorted(slashes, begins), len(slashes)))
    _demand_slots(block, per_corner)
    values, empty = _parse_slots(block, slashes)
    numbers = np.zeros((len(begins), 3), dtype=np.int64)
    present = np.zeros((len(begins), 3), dtype=np.bool_)
    firsts = np.cumsum(per_corner + 1) - per_corner - 1
    for slot in range(3):
        has = per_corner >= slot
        where = slice(None) if has.all() else has
        numbers[where, slot] = values[firsts[where] + slot] if has.any() else 0
        present[where, slot] = ~empty[firsts[where] + slot] if has.any() else False
    _demand_one_form(block, present)
    return _Corners(block, numbers, present)


def _demand_slots(block: Block, per_corner: Positions) -> None:
    if len(per_corner) and per_corner.max() > 2:
        block.fail_token(int(per_corner.argmax()), "a face corner with more than three indices", _FORMS)


def _parse_slots(block: Block, slashes: Positions) -> tuple[Positions, npt.NDArray[np.bool_]]:
    """(corners + slashes,) the numbers between the slashes, 0 for an empty place, and which places are empty."""
    chars = block.chars
    signs = np.flatnonzero((chars == ord("-")) | (chars == ord("+")))
    after = chars[slashes + 1]  # a block ends with a line feed
    gaps = np.flatnonzero((after == _SLASH) | (after <= 32))
    count = len(block.begins) + len(slashes)
    empty = np.zeros(count, dtype=np.bool_)
    if len(gaps):
        corner = np.searchsorted(block.begins, slashes[gaps], side="right") - 1
        empty[corner + gaps + 1] = True
        chars = np.insert(chars, slashes[gaps] + 1, ord("0"))
    values = parse_numbers(chars.tobytes().replace(b"/", b" "), np.int64)
    if values is None or len(values) != count or not _signs_lead(block.chars, signs):
        block.blame(_CORNER.fullmatch, _FORMS)
    zero = (values == 0) & ~empty
    if zero.any():
        _fail_slot(block, slashes, int(zero.argmax()), "a face index is 0, but OBJ counts from 1")
    return values, empty  # type: ignore[return-value]


def _signs_lead(chars: npt.NDArray[np.uint8], signs: Positions) -> bool:
    """Whether a digit follows every sign, and a blank or a slash comes before it."""
    digit = (chars[signs + 1] >= ord("0")) & (chars[signs + 1] <= ord("9"))
    opened = (chars[signs - 1] <= 32) | (chars[signs - 1] == _SLASH)
    return bool(np.all(digit & opened))


def _fail_slot(block: Block, slashes: Positions, slot: int, why: str) -> None:
    """Raise for the slot-th number of a face block."""
    places = np.sort(np.concatenate([block.begins, slashes]))
    block.fail_token(int(np.searchsorted(block.begins, places[slot], side="right")) - 1, why, _FORMS)


def _demand_one_form(block: Block, present: npt.NDArray[np.bool_]) -> None:
    """All corners of a face have the same form."""
    form = present @ np.array([1, 2, 4])
    if len(form) and form.min() != form.max():
        mixed = form != np.repeat(form[block.offsets[:-1]], block.counts)
        if mixed.any():
            block.fail_token(int(mixed.argmax()), "the corners of a face have different forms", "one form per face")


def _resolve(corners: _Corners, slot: int, defined_rows: Positions, noun: str) -> Positions:
    """(C,) indices from 0; -1 where the corner has none.

    A negative index counts back from the last element defined above the face.
    """
    raw, present, total = corners.numbers[:, slot], corners.present[:, slot], len(defined_rows)
    index = raw - 1
    negative = raw < 0
    if negative.any():
        above = np.repeat(np.searchsorted(defined_rows, corners.block.rows), corners.block.counts)
        index[negative] = above[negative] + raw[negative]
    bad = present & ((index < 0) | (index >= total))
    if bad.any():
        corner = int(bad.argmax())
        reach = f"an index from 1 to {total}, or negative within what stands above" if total else f"no {noun} index"
        written = corners.block.token(corner).decode("latin-1").split("/")[slot]
        why = f"a face names {noun} {written[:24]}, but the file has {total}"
        corners.block.fail_token(corner, why, reach)
    return index  # absent ones were read as 0, so they are -1 already


def _read_names(
    lines: Lines, others: Positions, face_rows: Positions
) -> tuple[Positions, list[str], list[tuple[int, str]]]:
    """(F,) material of each face, the material names, and the mtllib statements."""
    first = lines.chars[lines.firsts[others]]
    names: dict[str, int] = {}
    uses: list[tuple[int, int]] = [(-1, -1)]  # row, material
    libraries: dict[str, int] = {}
    for row in others[(first == ord("u")) | (first == ord("m"))].tolist():
        word, _, rest = lines.text(row).replace("\t", " ").partition(" ")
        if word == "usemtl" and rest.strip():
            uses.append((row, names.setdefault(rest.strip(), len(names))))
        elif word == "mtllib" and rest.strip():
            libraries.setdefault(rest.strip(), lines.number(row))
            if len(libraries) > MOST_LIBRARIES:
                lines.fail(row, "too many material libraries", f"at most {MOST_LIBRARIES:,}")
        elif word in ("usemtl", "mtllib"):
            lines.fail(row, f"{word} without a name")
    at, material = np.array(uses, dtype=np.int64).T
    return (
        material[np.searchsorted(at, face_rows) - 1],
        list(names),
        [(line, text) for text, line in libraries.items()],
    )
