"""The smallest files that use every part of a format, written here byte by byte: no code of ours, no blobs in git."""

import io
import json
import struct
from dataclasses import dataclass
from typing import Any

from PIL import Image

VERTS = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.5), (1.0, 1.0, 0.25), (0.0, -1.5, 2.0), (-0.125, 1e-3, 3.5))
FACES = ((0, 1, 2), (0, 2, 3), (4, 3, 2))
UVS = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.5, 0.25))
COLORS = ((255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255), (10, 20, 30))
_VERTEX_LINE = "vertex {} {} {}\n"


@dataclass(frozen=True)
class Asset:
    """A file and those that it names.

    Attributes:
        name: of the file that one loads.
        files: contents of it and its companions, by name.
    """

    name: str
    files: dict[str, bytes]

    def replaced(self, name: str, data: bytes) -> "Asset":
        """The asset with other content in one file."""
        return Asset(self.name, {**self.files, name: data})


def _rows(template: str, rows: tuple[tuple[float, ...], ...]) -> str:
    return "".join(template.format(*row) for row in rows)


def image_bytes(kind: str = "PNG", size: tuple[int, int] = (4, 2), mode: str = "RGB", **options: Any) -> bytes:
    """A ramp of colours as an image file."""
    image = Image.new("RGB", size)
    image.putdata([(17 * i % 256, 5 * i % 256, 255 - i % 256) for i in range(size[0] * size[1])])
    buffer = io.BytesIO()
    image.convert(mode).save(buffer, kind, **options)
    return buffer.getvalue()


def obj_asset() -> Asset:
    """Every form of a corner, a polygon, negative indices, two materials, a texture, continued lines."""
    text = (
        "# made by a test\nmtllib mesh.mtl\no thing\n"
        + _rows("v {} {} {}\n", VERTS)
        + _rows("vt {} {}\n", UVS)
        + "vn 0 0 1\nvn 0 1 0\ng one\ns off\nf 1 2 3\nusemtl paint\nf 1/1 2/2 3/3\nf 1/1/1 2/2/2 3/3/1 4/4/1\n"
        "usemtl plain\nf -5//1 -4//-1 -3//1\nf 1/1/ 2/2/ 3/3/\nf 1 2 \\\n 3 4 5\nl 1 2\n"
    )
    library = (
        "newmtl paint\nKa 0.5 0.25 1\nKd 1 1 1\nKs 0 0 0\nNs 32\nillum 2\nmap_Kd -s 1 1 1 -clamp on paint.png\n"
        "newmtl plain\nKd 0.25\n"
    )
    return Asset("mesh.obj", {"mesh.obj": text.encode(), "mesh.mtl": library.encode(), "paint.png": image_bytes()})


def colored_obj_asset() -> Asset:
    """Vertex colours, and CRLF line ends."""
    rows = "".join(_rows("v {} {} {}", (v,)) + _rows(" {} {} {}\n", (c,)) for v, c in zip(VERTS, COLORS, strict=True))
    return Asset("mesh.obj", {"mesh.obj": (rows + "f 1 2 3\nf 1 2 3 4 5\n").replace("\n", "\r\n").encode()})


def ply_asset(encoding: str, with_faces: bool = True) -> Asset:
    """Positions, normals, colours, another element, and polygons of several lengths if there are faces."""
    polygons = ((0, 1, 2), (0, 1, 2, 3), (4, 3, 2)) if with_faces else ()
    header = (
        f"ply\nformat {encoding} 1.0\ncomment made by a test\nelement vertex 5\n"
        + "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
        + "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
        + (f"element face {len(polygons)}\nproperty list uchar int vertex_indices\n" if polygons else "")
        + "element extra 2\nproperty list ushort double numbers\nend_header\n"
    )
    order = "<" if "little" in encoding else ">"
    table = [
        *(((*v, 0.0, 0.0, 1.0, *c), "6f3B") for v, c in zip(VERTS, COLORS, strict=True)),
        *(((len(p), *p), f"B{len(p)}i") for p in polygons),
        *(((n, *([0.5] * n)), f"H{n}d") for n in (0, 2)),
    ]
    if encoding == "ascii":
        body = "".join(" ".join(map(str, row)) + "\n" for row, _ in table).encode()
    else:
        body = b"".join(struct.pack(order + code, *row) for row, code in table)
    name = "mesh.ply" if with_faces else "cloud.ply"
    return Asset(name, {name: header.encode() + body})


def off_asset(colored: bool) -> Asset:
    """A comment, a polygon, and colours if wanted."""
    rows = [" ".join(map(str, (*v, *(c if colored else ())))) for v, c in zip(VERTS, COLORS, strict=True)]
    head = f"{'COFF' if colored else 'OFF'}\n# made by a test\n5 3 0\n"
    return Asset("mesh.off", {"mesh.off": (head + "\n".join(rows) + "\n3 0 1 2\n4 0 1 2 3\n3 4 3 2\n").encode()})


def stl_asset(binary: bool) -> Asset:
    """Three facets."""
    triangles = [tuple(VERTS[i] for i in face) for face in FACES]
    if binary:
        facets = [struct.pack("<12fH", 0, 0, 1, *(x for v in t for x in v), 0) for t in triangles]
        return Asset("mesh.stl", {"mesh.stl": b"made by a test".ljust(80) + struct.pack("<I", 3) + b"".join(facets)})
    facets_text = "".join(
        f"facet normal 0 0 1\nouter loop\n{_rows(_VERTEX_LINE, t)}endloop\nendfacet\n" for t in triangles
    )
    return Asset("mesh.stl", {"mesh.stl": f"solid test\n{facets_text}endsolid test\n".encode()})


def xyz_asset(columns: int) -> Asset:
    """Points, with normals or colours behind them where there are six columns."""
    rows = [(*v, *(() if columns == 3 else (0.0, 0.0, 1.0))) for v in VERTS]
    return Asset("cloud.xyz", {"cloud.xyz": "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()})


def pack_glb(document: dict[str, Any] | bytes, body: bytes = b"") -> bytes:
    """The container of glTF 2.0: twelve bytes of header, a JSON chunk, a binary chunk if there is a body."""
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body += b"\0" * (-len(body) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    if body:
        chunks += struct.pack("<II", len(body), 0x004E4942) + body
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def unpack_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Undo `pack_glb`.

    Raises:
        ValueError, struct.error: the data is no such container.
    """
    (length,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + length])
    if not isinstance(document, dict):
        raise ValueError("the document is no object")
    return document, data[28 + length :]


def gltf_parts(textured: bool) -> tuple[dict[str, Any], bytes]:
    """A document of two nodes, one within the other, that show one mesh; and its buffer."""
    blobs = [
        struct.pack("<15f", *(x for v in VERTS for x in v)),
        struct.pack("<9H", *(i for f in FACES for i in f)),
        struct.pack("<10f", *(x for uv in UVS for x in uv))
        if textured
        else struct.pack("<15f", *(x / 255 for c in COLORS for x in c)),
    ]
    if textured:
        blobs.append(image_bytes())
    body, views = b"", []
    for blob in blobs:
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(blob)})
        body += blob + b"\0" * (-len(blob) % 4)
    low, high = ([min(v[i] for v in VERTS) for i in range(3)], [max(v[i] for v in VERTS) for i in range(3)])
    accessors: list[dict[str, Any]] = [
        {"bufferView": 0, "componentType": 5126, "count": 5, "type": "VEC3", "min": low, "max": high},
        {"bufferView": 1, "componentType": 5123, "count": 9, "type": "SCALAR"},
        {"bufferView": 2, "componentType": 5126, "count": 5, "type": "VEC2" if textured else "VEC3"},
    ]
    extra = {"TEXCOORD_0": 2} if textured else {"COLOR_0": 2}
    primitive: dict[str, Any] = {"attributes": {"POSITION": 0, **extra}, "indices": 1, "mode": 4}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "a test"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"children": [1], "translation": [1, 2, 3], "rotation": [0, 0, 0, 1], "scale": [1, 2, 1]},
            {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]},
        ],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    if textured:
        primitive["material"] = 0
        document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 0}}}]
        document["textures"] = [{"source": 0, "sampler": 0}]
        document["samplers"] = [{"wrapS": 10497, "wrapT": 33071}]
        document["images"] = [{"bufferView": 3, "mimeType": "image/png"}]
    return document, body


def glb_asset(textured: bool) -> Asset:
    """One file that holds everything."""
    return Asset("mesh.glb", {"mesh.glb": pack_glb(*gltf_parts(textured))})


def gltf_asset() -> Asset:
    """A document that names its buffer and its image."""
    document, body = gltf_parts(textured=True)
    document["buffers"][0]["uri"] = "mesh.bin"
    document["images"] = [{"uri": "paint.png"}]
    files = {"mesh.gltf": json.dumps(document, indent=1).encode(), "mesh.bin": body, "paint.png": image_bytes()}
    return Asset("mesh.gltf", files)
