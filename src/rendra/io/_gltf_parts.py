"""The primitives of a glTF scene as arrays, in the frame of the world.

Letters: V verts, F faces (triangles), U texture coordinates, which stay in the file's order and leave here with
their origin at the bottom left.
"""

import warnings
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from rendra.io._bulk_text import Positions
from rendra.io._gltf_asset import BYTE, FLOAT, SHORT, UBYTE, UINT, USHORT, Asset, Floats
from rendra.io._gltf_json import Item
from rendra.io._gltf_materials import Material, read_material
from rendra.io._gltf_scene import Instance, Matrix, instances
from rendra.io.errors import MeshFormatError

EXACT_V = "_RENDRA_V"  # v from the bottom left, where 1 - v has lost its last bits
VERTEX_NUMBER = "_RENDRA_VERTEX"  # which vertex a row is a copy of: two 16-bit halves, the lower first

_POINTS, _TRIANGLES, _STRIP, _FAN = 0, 4, 5, 6
_MOST_PARTS = 1 << 14  # each takes up to 0.2 ms
_FREE_ROWS = 1 << 22  # vertices and corners that any file may show; beyond it, one for each of its bytes


@dataclass(frozen=True)
class Part:
    """One primitive at one place.

    Attributes:
        verts: (V, 3).
        faces: (F, 3) rows of `verts`; none for a primitive of points.
        normals: (V, 3) or None.
        uvs: (U, 2) or None.
        faces_uvs: (F, 3) rows of `uvs`.
        colors: (V, 3) or None.
        material: what it is painted with.
    """

    verts: Floats
    faces: Positions
    normals: Floats | None
    uvs: Floats | None
    faces_uvs: Positions
    colors: Floats | None
    material: Material


def read_parts(asset: Asset) -> list[Part]:
    """All primitives of the scene, in the order of its nodes.

    Lines are passed over, and so are what bends a mesh: skins and morph targets. Both are warned of.

    Raises:
        MeshFormatError: malformed, or so often repeated that the scene outgrows its file beyond all measure.
    """
    return _Reader(asset).read()


class _Reader:
    """Reads primitives; each mesh is read once however often the scene shows it."""

    def __init__(self, asset: Asset) -> None:
        self._asset = asset
        self._rows, self._limit = 0, _FREE_ROWS
        self._parts = 0
        self._meshes: dict[int, list[Part]] = {}
        self._cost: dict[int, tuple[int, int]] = {}
        self._materials: dict[int, Material] = {}
        self._lines = 0
        self._bent: set[str] = set()

    def read(self) -> list[Part]:
        parts = []
        for instance in instances(self._asset):
            self._charge(instance)
            if instance.mesh not in self._meshes:
                self._meshes[instance.mesh] = self._read_mesh(self._asset.meshes[instance.mesh])
            parts += [_placed(part, instance, self._asset.root.file) for part in self._meshes[instance.mesh]]
            if instance.skinned:
                self._bent.add("skins")
        self._warn()
        return parts

    def _charge(self, instance: Instance) -> None:
        """Add up the parts and rows that the scene will have, before any of them is read."""
        if instance.mesh not in self._cost:
            primitives = self._asset.meshes[instance.mesh].items("primitives")
            self._cost[instance.mesh] = len(primitives), sum(map(self._rows_of, primitives))
        parts, rows = self._cost[instance.mesh]
        self._parts += parts
        self._rows += rows
        if self._parts > _MOST_PARTS:
            self._asset.meshes[instance.mesh].fail(
                None,
                "the scene shows too many primitives",
                f"{self._parts:,} up to {instance.node}",
                f"at most {_MOST_PARTS:,}",
            )
        if self._rows > self._limit:
            self._limit = max(_FREE_ROWS, self._asset.size())
        if self._rows > self._limit:
            self._asset.meshes[instance.mesh].fail(
                None,
                "the scene is too large for its file, which lies or shows the same data again and again",
                f"{self._rows:,} vertices and corners up to {instance.node}",
                f"at most {self._limit:,}",
            )

    def _rows_of(self, primitive: Item) -> int:
        attributes = primitive.item("attributes")
        if attributes is None:
            primitive.fail("attributes", "is missing")
        count = len(self._asset.accessors)
        used = (attributes.index("POSITION", count, "accessors"), primitive.index("indices", count, "accessors"))
        return sum(self._asset.rows(index) for index in used if index is not None)

    def _read_mesh(self, mesh: Item) -> list[Part]:
        primitives = mesh.items("primitives")
        if not primitives:
            mesh.fail("primitives", "is missing or empty", expected="at least one primitive")
        attributes = [primitive.item("attributes") for primitive in primitives]
        positions = [None if each is None else each.index("POSITION", 1 << 53, "accessors") for each in attributes]
        uses = Counter(positions)
        parts = []
        for primitive, number in zip(primitives, positions, strict=True):
            part = self._read_primitive(primitive)
            if part is not None:
                parts.append(_compact(part) if uses[number] > 1 else part)
        return parts

    def _read_primitive(self, primitive: Item) -> Part | None:
        """One primitive where its mesh stands; None if it holds nothing that a mesh has."""
        mode = primitive.integer("mode", _TRIANGLES, 0, 6)
        attributes = primitive.item("attributes")
        assert attributes is not None  # the charge asked for it
        if mode not in (_POINTS, _TRIANGLES, _STRIP, _FAN):
            self._lines += 1
            return None
        if "targets" in primitive:
            self._bent.add("morph targets")
        if primitive.extension("KHR_draco_mesh_compression") is not None and "POSITION" not in attributes:
            primitive.fail(None, "Draco compression is not supported", expected="plain accessors")
        return self._read_arrays(primitive, attributes, mode, self._read_material(primitive))

    def _read_material(self, primitive: Item) -> Material:
        number = primitive.index("material", len(self._asset.materials), "materials")
        if number is None:
            return Material(None, None)
        if number not in self._materials:
            self._materials[number] = read_material(self._asset, number)
        return self._materials[number]

    def _read_arrays(self, primitive: Item, attributes: Item, mode: int, material: Material) -> Part | None:
        small = (BYTE, UBYTE, SHORT, USHORT)
        exact = (FLOAT, *small) if self._asset.quantized else (FLOAT,)
        verts = self._floats(attributes, "POSITION", exact, ("VEC3",), None)
        if verts is None:
            primitive.fail("attributes.POSITION", "is missing")
        count = len(verts)
        normals = self._floats(attributes, "NORMAL", (*exact, BYTE, SHORT), ("VEC3",), count)
        colors = self._floats(attributes, "COLOR_0", (FLOAT, UBYTE, USHORT), ("VEC3", "VEC4"), count, scaled=True)
        uvs = self._read_uvs(attributes, material, count)
        corners = self._read_indices(primitive, count)
        faces = np.zeros((0, 3), dtype=np.int64) if mode == _POINTS else _triangles(corners, mode, primitive)
        part = Part(
            verts,
            faces,
            normals,
            uvs,
            faces,
            None if colors is None else np.ascontiguousarray(colors[:, :3]),
            material,
        )
        numbers = self._read_vertex_numbers(attributes, count)
        return part if numbers is None else _rejoined(part, numbers)

    def _floats(
        self,
        attributes: Item,
        name: str,
        components: tuple[int, ...],
        widths: tuple[str, ...],
        count: int | None,
        scaled: bool = False,
    ) -> Floats | None:
        """One attribute as (count, width) numbers; None where the primitive lacks it."""
        index = attributes.index(name, len(self._asset.accessors), "accessors")
        if index is None:
            return None
        rows = self._asset.rows(index)
        if count is not None and rows != count:
            attributes.fail(name, "is not as long as POSITION", f"{rows} elements", f"{count}")
        return self._asset.floats(index, components, widths, scaled)

    def _read_uvs(self, attributes: Item, material: Material, count: int) -> Floats | None:
        """(V, 2) texture coordinates of the material's texture, from the bottom left."""
        wanted = 0 if material.texture is None else material.texture.coordinates
        components = (FLOAT, BYTE, UBYTE, SHORT, USHORT) if self._asset.quantized else (FLOAT, UBYTE, USHORT)
        uvs = self._floats(attributes, f"TEXCOORD_{wanted}", components, ("VEC2",), count, not self._asset.quantized)
        if uvs is None:
            return None
        moved = None if material.texture is None else material.texture.moved
        if moved is not None:
            with np.errstate(over="ignore"):
                uvs = (uvs @ moved[:, :2].T + moved[:, 2]).astype(np.float32)
            if not np.isfinite(uvs).all():
                attributes.fail(f"TEXCOORD_{wanted}", "is not finite where KHR_texture_transform moves it")
        flipped = np.float32(1.0) - uvs[:, 1]
        exact = self._read_exact(attributes, flipped) if moved is None and wanted == 0 else None
        return np.stack([uvs[:, 0], flipped if exact is None else exact], axis=1)

    def _read_exact(self, attributes: Item, flipped: Floats) -> Floats | None:
        """(V,) all bits of v, where this package wrote the file and no other software changed it."""
        exact = self._floats(attributes, EXACT_V, (FLOAT,), ("SCALAR",), len(flipped))
        return exact[:, 0] if exact is not None and np.array_equal(1.0 - (1.0 - exact[:, 0]), flipped) else None

    def _read_indices(self, primitive: Item, count: int) -> Positions:
        """(C,) the vertex of every corner."""
        index = primitive.index("indices", len(self._asset.accessors), "accessors")
        if index is None:
            return np.arange(count, dtype=np.int64)
        corners = self._asset.accessor(index, (UBYTE, USHORT, UINT), ("SCALAR",))[:, 0].astype(np.int64)
        if (largest := int(corners.max())) >= count:
            row, item = int(corners.argmax()), self._asset.accessors[index]
            item.fail(None, f"element {row} is no vertex", largest, f"an index from 0 to {count - 1}")
        return corners

    def _read_vertex_numbers(self, attributes: Item, count: int) -> Positions | None:
        """(V,) which vertex each row is a copy of, where this package wrote the file."""
        index = attributes.index(VERTEX_NUMBER, len(self._asset.accessors), "accessors")
        if index is None or self._asset.rows(index) != count:
            return None
        halves = self._asset.accessor(index, (USHORT,), ("VEC2",)).astype(np.int64)
        return halves[:, 0] + (halves[:, 1] << 16)

    def _warn(self) -> None:
        name = self._asset.root.file
        if self._lines:
            warnings.warn(f"{name}: {self._lines} primitives of lines are not read", stacklevel=6)
        if self._bent:
            bent = " and ".join(sorted(self._bent))
            warnings.warn(f"{name}: {bent} are not applied; the mesh is read as it is at rest", stacklevel=6)


def _triangles(corners: Positions, mode: int, primitive: Item) -> Positions:
    """(F, 3) of a list, a strip or a fan of triangles."""
    count = len(corners)
    if mode == _TRIANGLES:
        if count % 3:
            primitive.fail(None, "the corners do not make whole triangles", count, "a multiple of 3")
        return corners.reshape(-1, 3)
    if count < 3:
        primitive.fail(None, "a strip or fan needs at least three corners", count)
    first = np.arange(count - 2, dtype=np.int64)
    if mode == _FAN:
        return corners[np.stack([first + 1, first + 2, np.zeros_like(first)], axis=1)]
    odd = first % 2  # every other triangle of a strip turns the other way
    return corners[np.stack([first, first + 1 + odd, first + 2 - odd], axis=1)]


def _compact(part: Part) -> Part:
    """A primitive without the vertices that it shares a list with, but does not use."""
    if not len(part.faces):
        return part
    used, faces = np.unique(part.faces, return_inverse=True)
    own, own_uvs = faces.reshape(-1, 3), part.faces_uvs
    uvs = part.uvs
    if uvs is not None and len(uvs) == len(part.verts) and np.array_equal(own_uvs, part.faces):
        uvs, own_uvs = uvs[used], own
    return replace(
        part,
        verts=part.verts[used],
        faces=own,
        normals=None if part.normals is None else part.normals[used],
        uvs=uvs,
        faces_uvs=own_uvs,
        colors=None if part.colors is None else part.colors[used],
    )


def _rejoined(part: Part, numbers: Positions) -> Part:
    """The part with the vertices that it had before it was written, or as it is where other software changed it."""
    first = np.full(len(numbers), -1, dtype=np.int64)
    if numbers.max() >= len(numbers):
        return part
    first[numbers[::-1]] = np.arange(len(numbers))[::-1]
    first = first[: int(numbers.max()) + 1]
    if (first < 0).any():
        return part
    tables = [each for each in (part.verts, part.normals, part.colors) if each is not None]
    if not all(np.array_equal(table[first][numbers], table) for table in tables):
        return part
    return replace(
        part,
        verts=part.verts[first],
        faces=numbers[part.faces],
        normals=None if part.normals is None else part.normals[first],
        colors=None if part.colors is None else part.colors[first],
    )


def _placed(part: Part, instance: Instance, file: str) -> Part:
    """A part in the frame of the world."""
    if instance.to_world is None:
        return part
    linear, shift = instance.to_world[:3, :3], instance.to_world[:3, 3]
    with np.errstate(over="ignore", invalid="ignore"):
        verts = (part.verts @ linear.T + shift).astype(np.float32)
    if not np.isfinite(verts).all():
        raise MeshFormatError(f"{instance.node}: the transform takes vertices out of single precision", file)
    cofactors, determinant = _cofactors(linear)
    normals = None if part.normals is None else _turned(part.normals, cofactors if determinant >= 0.0 else -cofactors)
    if determinant >= 0.0:
        return replace(part, verts=verts, normals=normals)
    flip = [0, 2, 1]  # a mirror turns faces inside out
    return replace(part, verts=verts, normals=normals, faces=part.faces[:, flip], faces_uvs=part.faces_uvs[:, flip])


def _cofactors(linear: Matrix) -> tuple[Matrix, float]:
    """The inverse of (3, 3), transposed, times the determinant; and the determinant."""
    (a, b, c), (d, e, f), (g, h, i) = linear.tolist()
    first = (e * i - f * h, f * g - d * i, d * h - e * g)
    rest = ((c * h - b * i, a * i - c * g, b * g - a * h), (b * f - c * e, c * d - a * f, a * e - b * d))
    return np.array([first, *rest]), a * first[0] + b * first[1] + c * first[2]


def _turned(normals: Floats, cofactors: Matrix) -> Floats:
    """Unit normals under a linear map, by its cofactors."""
    largest = np.abs(cofactors).max()
    turned = normals @ (cofactors / largest if largest else cofactors).T
    lengths = np.linalg.norm(turned, axis=1, keepdims=True)
    return (turned / np.where(lengths > 0.0, lengths, 1.0)).astype(np.float32)
