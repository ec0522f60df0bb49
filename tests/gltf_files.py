"""glTF files built by hand for the tests: any field can lie."""

import base64
import json
import struct
from typing import Any

import numpy as np

FLOAT, UINT, USHORT, UBYTE = 5126, 5125, 5123, 5121
_TYPES = {FLOAT: "<f4", UINT: "<u4", USHORT: "<u2", UBYTE: "u1", 5122: "<i2", 5120: "i1"}
_SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}

TRIANGLE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]


class Builder:
    """A document with one buffer; change `document` at will before `glb` or `gltf`."""

    def __init__(self) -> None:
        self.binary = b""
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "meshes": [], "nodes": [],
        }  # fmt: skip

    def view(self, data: bytes, **more: Any) -> int:
        """Store bytes."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.document["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data), **more}
        )
        self.binary += data
        return len(self.document["bufferViews"]) - 1

    def accessor(self, rows: Any, component: int = FLOAT, **more: Any) -> int:
        """Store a table."""
        table = np.atleast_2d(np.array(rows, dtype=_TYPES[component]).T).T
        self.document["accessors"].append(
            {
                "bufferView": self.view(table.tobytes()),
                "componentType": component,
                "count": len(table),
                "type": _SHAPES[table.shape[1]],
                **more,
            }
        )
        return len(self.document["accessors"]) - 1

    def mesh(self, *primitives: dict[str, Any]) -> int:
        """A mesh, and a node that shows it."""
        self.document["meshes"].append({"primitives": list(primitives)})
        self.document["nodes"].append({"mesh": len(self.document["meshes"]) - 1})
        return len(self.document["meshes"]) - 1

    def triangle(self, **more: Any) -> dict[str, Any]:
        """A primitive of one triangle."""
        return {"attributes": {"POSITION": self.accessor(TRIANGLE)}, **more}

    def texture(self, image: bytes, **sampler: Any) -> int:
        """A material that shows an image."""
        lists = {name: self.document.setdefault(name, []) for name in ("images", "samplers", "textures", "materials")}
        lists["images"].append({"bufferView": self.view(image), "mimeType": "image/png"})
        lists["samplers"].append(sampler)
        lists["textures"].append({"source": len(lists["images"]) - 1, "sampler": len(lists["samplers"]) - 1})
        base = {"baseColorTexture": {"index": len(lists["textures"]) - 1}}
        lists["materials"].append({"pbrMetallicRoughness": base})
        return len(lists["materials"]) - 1

    def finished(self) -> dict[str, Any]:
        """The document with its buffer declared, and without empty lists."""
        if self.binary and "buffers" not in self.document:
            self.document["buffers"] = [{"byteLength": len(self.binary)}]
        return {key: value for key, value in self.document.items() if value != []}

    def glb(self) -> bytes:
        """All as .glb."""
        return container(json.dumps(self.finished()).encode(), self.binary)

    def gltf(self) -> bytes:
        """All as .gltf with the buffer inside."""
        document = self.finished()
        text = base64.b64encode(self.binary).decode()
        document["buffers"][0].setdefault("uri", f"data:application/octet-stream;base64,{text}")
        return json.dumps(document).encode()


def container(text: bytes, binary: bytes = b"") -> bytes:
    """A .glb of any text and bytes."""
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    if binary:
        body += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
