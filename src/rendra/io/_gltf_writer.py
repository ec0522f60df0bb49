"""One mesh as a glTF 2.0 file, everything inside it.

Letters: V verts, F faces, U texture coordinates, P pairs of a vertex and a texture coordinate, the vertices of the
file.
"""

import base64
import json
import struct
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from rendra.io._gltf_asset import FLOAT, UINT, USHORT
from rendra.io._gltf_materials import CLAMP, MIRROR, NEAREST
from rendra.io._gltf_parts import EXACT_V, VERTEX_NUMBER
from rendra.io._images import encode_image
from rendra.io._rows import int_rows, single_rows
from rendra.renderer.mesh.textures import TexturesBase, TexturesUV, TexturesVertex
from rendra.structures import Meshes

_VERTEX_TARGET, _INDEX_TARGET = 34962, 34963
_LARGEST = (1 << 32) - 1  # what the container's 32-bit lengths can say


def render_glb(mesh: Meshes, include_textures: bool) -> bytes:
    """The whole .glb file of a batch of one mesh.

    Raises:
        ValueError: a number is not finite in single precision, or the file would exceed 4 GiB.
    """
    document, binary = _Document(mesh, include_textures).render()
    chunks = [(b"JSON", _padded(_json(document), b" "))]
    if binary:
        chunks.append((b"BIN\0", binary))
    body = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
    if len(body) + 12 > _LARGEST:
        raise ValueError(f"the mesh takes {len(body):,} bytes, but a .glb file holds at most {_LARGEST:,}")
    return struct.pack("<4sII", b"glTF", 2, len(body) + 12) + body


def render_gltf(mesh: Meshes, include_textures: bool) -> bytes:
    """The whole .gltf file of a batch of one mesh, its buffer as a data URI; errors as `render_glb`."""
    document, binary = _Document(mesh, include_textures).render()
    if binary:
        text = base64.b64encode(binary).decode("ascii")
        document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{text}"
    return _json(document) + b"\n"


def _json(document: dict[str, Any]) -> bytes:
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")


def _padded(data: bytes, filler: bytes) -> bytes:
    return data + filler * (-len(data) % 4)


@dataclass(frozen=True)
class _Tables:
    """The vertices of the file, and its triangles.

    Attributes:
        verts: (P,) which vertex of the mesh each of the file's is.
        uvs: (P, 2) texture coordinates, origin bottom left; None without texture.
        faces: (F, 3) rows of the two above.
        split: whether some vertex comes more than once, or elsewhere than in the mesh.
    """

    verts: np.ndarray
    uvs: np.ndarray | None
    faces: np.ndarray
    split: bool


class _Document:
    """The JSON and the binary part in the making.

    Args:
        mesh: a batch of one.
        include_textures: write its texture.
    """

    def __init__(self, mesh: Meshes, include_textures: bool) -> None:
        self._mesh = mesh
        verts, faces = mesh.get_mesh_verts_faces(0)
        self._verts = single_rows(verts, 3, "verts", "num_verts")
        self._faces = int_rows(faces, len(self._verts), "faces", "num_faces")
        self._textures = _savable(mesh.textures) if include_textures else None
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._binary = bytearray()

    def render(self) -> tuple[dict[str, Any], bytes]:
        """The document, and the bytes of its one buffer."""
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "rendra"},
            "scene": 0,
            "scenes": [{"name": "scene"}],
        }
        if not len(self._verts):
            return document, b""  # glTF knows no empty mesh
        primitive = self._primitive()
        document["scenes"][0]["nodes"] = [0]
        document["nodes"] = [{"mesh": 0}]
        document["meshes"] = [{"primitives": [primitive]}]
        document["materials"] = [self._material(document)]
        document["accessors"], document["bufferViews"] = self._accessors, self._views
        binary = _padded(bytes(self._binary), b"\0")
        document["buffers"] = [{"byteLength": len(binary)}]
        return document, binary

    def _primitive(self) -> dict[str, Any]:
        tables = self._tables()
        verts = self._verts[tables.verts]
        attributes = {"POSITION": self._add(verts, "VEC3", FLOAT, bounds=True)}
        if self._mesh.has_verts_normals():
            normals = single_rows(self._mesh.verts_normals_list()[0], 3, "verts_normals", "num_verts")
            attributes["NORMAL"] = self._add(normals[tables.verts], "VEC3", FLOAT)
        if tables.uvs is not None:
            flipped = np.float32(1.0) - tables.uvs[:, 1]
            attributes["TEXCOORD_0"] = self._add(np.stack([tables.uvs[:, 0], flipped], axis=1), "VEC2", FLOAT)
            if (np.float32(1.0) - flipped != tables.uvs[:, 1]).any():
                attributes[EXACT_V] = self._add(tables.uvs[:, 1:], "SCALAR", FLOAT)
        if isinstance(self._textures, TexturesVertex):
            colors = single_rows(self._textures.verts_features_list()[0], 3, "verts_features", "num_verts")
            attributes["COLOR_0"] = self._add(colors[tables.verts], "VEC3", FLOAT)
        if tables.split:
            halves = tables.verts.astype("<u4").view("<u2").reshape(-1, 2)
            attributes[VERTEX_NUMBER] = self._add(halves, "VEC2", USHORT)
        primitive: dict[str, Any] = {"attributes": attributes, "material": 0, "mode": 4 if len(tables.faces) else 0}
        if len(tables.faces):
            kind, component = ("<u2", USHORT) if len(verts) < 0xFFFF else ("<u4", UINT)
            corners = tables.faces.reshape(-1, 1).astype(kind)
            primitive["indices"] = self._add(corners, "SCALAR", component, _INDEX_TARGET)
        return primitive

    def _tables(self) -> _Tables:
        """Vertices as they are, or split where one has several texture coordinates."""
        count = len(self._verts)
        whole = np.arange(count, dtype=np.int64)
        if not isinstance(self._textures, TexturesUV) or not len(self._faces):
            return _Tables(whole, None, self._faces, False)
        uvs = single_rows(self._textures.verts_uvs_list()[0], 2, "verts_uvs", "num_verts")
        corners = int_rows(self._textures.faces_uvs_list()[0].clamp_min(0), len(uvs), "faces_uvs", "num_faces")
        keys, faces = np.unique(corners * count + self._faces, return_inverse=True)
        rows, owners = np.divmod(keys, count)
        faces = faces.reshape(-1, 3)
        unused = np.setdiff1d(whole, owners)
        owners = np.concatenate([owners, unused])
        table = np.concatenate([uvs[rows], np.zeros((len(unused), 2), dtype=np.float32)])
        if len(owners) > count:
            return _Tables(owners, table, faces, True)
        order = np.argsort(owners)  # one coordinate a vertex: in the order of the vertices
        return _Tables(whole, table[order], owners[faces], False)

    def _material(self, document: dict[str, Any]) -> dict[str, Any]:
        """A material that is no metal and has no back; the texture, if any, goes into the document."""
        surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
        if isinstance(self._textures, TexturesUV) and len(self._faces):
            image = encode_image(self._textures.maps_list()[0], "png")
            document["images"] = [{"bufferView": self._add_bytes(image), "mimeType": "image/png"}]
            wrap = MIRROR if self._textures.padding_mode == "reflection" else CLAMP
            sampler = {"wrapS": wrap, "wrapT": wrap}
            if self._textures.sampling_mode == "nearest":
                sampler |= {"magFilter": NEAREST, "minFilter": NEAREST}
            document["samplers"] = [sampler]
            document["textures"] = [{"source": 0, "sampler": 0}]
            surface["baseColorTexture"] = {"index": 0}
        return {"pbrMetallicRoughness": surface, "doubleSided": True}

    def _add(
        self, rows: np.ndarray, shape: str, component: int, target: int = _VERTEX_TARGET, bounds: bool = False
    ) -> int:
        """Store a table; return the number of its accessor."""
        little = rows.astype(rows.dtype.newbyteorder("<"))
        accessor = {
            "bufferView": self._add_bytes(little.tobytes(), target),
            "componentType": component,
            "count": len(rows),
            "type": shape,
        }
        if bounds:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def _add_bytes(self, data: bytes, target: int | None = None) -> int:
        """Store bytes; return the number of their view."""
        self._binary += b"\0" * (-len(self._binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self._binary), "byteLength": len(data)}
        self._views.append(view if target is None else view | {"target": target})
        self._binary += data
        return len(self._views) - 1


def _savable(textures: TexturesBase | None) -> TexturesUV | TexturesVertex | None:
    """A texture that glTF can hold; anything else is a warning."""
    if isinstance(textures, TexturesVertex) and textures.verts_features_list()[0].shape[-1] == 3:
        return textures
    if isinstance(textures, TexturesUV) and not textures.multi_map:
        image = textures.maps_list()[0]
        if image.dim() == 3 and image.shape[-1] == 3 and image.numel():
            _warn_of_sampling(textures)
            return textures
    if textures is not None:
        what = f"this {type(textures).__name__}: it is not saved"
        warnings.warn(
            f"glTF files hold one RGB image with coordinates, or RGB vertex colours, not {what}", stacklevel=7
        )
    return None


def _warn_of_sampling(textures: TexturesUV) -> None:
    """Say what `read` will not know."""
    if textures.padding_mode == "zeros":
        warnings.warn('glTF cannot say padding_mode="zeros": the image is read with "border"', stacklevel=8)
    if not textures.align_corners:
        warnings.warn("align_corners=False is not saved: this package reads glTF with True", stacklevel=8)
