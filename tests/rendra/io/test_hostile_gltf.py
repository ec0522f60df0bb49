"""glTF files that lie: each gives a typed error that names the file, the place in it, and what was expected."""

import copy
import io
import json
import os
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from typing import Any

import pytest
from gltf_files import FLOAT, TRIANGLE, UBYTE, UINT, USHORT, Builder, container
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from rendra.io import IO, MeshFormatError
from rendra.io._gltf_asset import Asset
from rendra.io._gltf_parts import read_parts
from rendra.io._source import Source


def parse(data: bytes, name: str = "bad.glb") -> list:
    return read_parts(Asset(Source(name, data, "."), None, False))


def refused(data: bytes, *messages: str) -> MeshFormatError:
    with pytest.raises(MeshFormatError) as caught:
        parse(data)
    assert str(caught.value).startswith("bad.glb")
    assert len(str(caught.value)) < 500
    for message in messages:
        assert message in str(caught.value)
    return caught.value


GOOD = Builder()
GOOD.mesh(GOOD.triangle())
TEXT = json.dumps(GOOD.finished()).encode()

CONTAINERS = [
    (b"", "no glTF file"),
    (b"glTF", "byte 4: the file ends within its header"),
    (b"PNG", "no glTF file; found 'PNG'; expected 'glTF', or a JSON object"),
    (struct.pack("<4sII", b"glTF", 1, 12), "byte 4: the container's version is not supported; found '1'"),
    (struct.pack("<4sII", b"glTF", 2, 0xFFFFFFFF), "byte 8: the length in the header is not the file's"),
    (struct.pack("<4sII", b"glTF", 2, 3), "byte 8: the length"),
    (struct.pack("<4sII", b"glTF", 2, 12), "byte 12: the file ends before its JSON chunk"),
    (struct.pack("<4sII", b"glTF", 2, 16) + b"1234", "byte 12: the file ends within a chunk's header"),
    (
        struct.pack("<4sIII4s", b"glTF", 2, 20, 0xFFFFFFF0, b"JSON"),
        "byte 12: a chunk runs past the end; found '4294967280 bytes'; expected at most 0",
    ),
    (struct.pack("<4sIII4s", b"glTF", 2, 20, 0, b"BIN\0"), "byte 16: the first chunk is not JSON"),
    (container(b""), "the JSON chunk is malformed at byte 20"),
    (container(b"[]"), "the JSON chunk is no object"),
    (container(b'{"asset" 1}'), "malformed at byte 29 (Expecting ':' delimiter); found '1}"),
    (container(b'{"a": "\xff"}'), "is not UTF-8 at byte 27"),
    (container(b'{"a": 1, "a": 2}'), "the key 'a' comes twice"),
    (container(b'{"a": NaN}'), "NaN is no JSON number"),
    (container(b'{"a": -Infinity}'), "-Infinity is no JSON number"),
    (container(b'{"a": ' + b"[" * 200_000), "nested too deeply"),
    (container(b'{"a":' * 200_000), "nested too deeply"),
    (container(b'{"a": ' + b"9" * 100_000 + b"}"), "malformed"),
    (container(b"{}"), "asset: is missing"),
    (container(b'{"asset": {"version": "1.0"}}'), "asset.version: is not supported; found '1.0'"),
    (container(b'{"asset": {"version": 2}}'), "asset.version: is no text"),
    (container(TEXT), "buffers[0].uri: is missing, and there is no binary chunk"),
    (container(TEXT, b"12345678"), "buffers[0].byteLength: the data is shorter than its declaration; found '36'"),
]  # fmt: skip


@pytest.mark.parametrize(("data", "message"), CONTAINERS, ids=range(len(CONTAINERS)))
def test_malformed_containers(data, message):
    refused(data, message)


def test_errors_of_gltf_text_name_the_line():
    error = refused(b'{"asset": {"version": "2.0"},\n\n "meshes": [}\n')
    assert error.line == 3
    assert "bad.glb, line 3: the JSON is malformed" in str(error)


def change(path: str, value: Any) -> Callable[[dict], None]:
    """Set one field of the document; `...` removes it."""

    def apply(document: dict) -> None:
        *way, last = [int(key) if key.isdigit() else key for key in path.split("/")]
        at: Any = document
        for key in way:
            at = at[key]
        if value is ...:
            del at[last]
        elif isinstance(last, int) or last not in ("+",):
            at[last] = value

    return apply


FIELDS = [
    ("accessors", 3, "accessors: is no list; found '3'"),
    ("accessors/0", 3, "accessors[0]: is no object"),
    ("accessors/0/count", ..., "accessors[0].count: is missing; expected a whole number from 1"),
    ("accessors/0/count", 0, "accessors[0].count: is out of range; found '0'"),
    ("accessors/0/count", -3, "out of range"),
    ("accessors/0/count", 2.5, "accessors[0].count: is no whole number; found '2.5'"),
    ("accessors/0/count", "3", "is no whole number"),
    ("accessors/0/count", True, "is no whole number"),
    ("accessors/0/count", 1e300, "out of range"),
    ("accessors/0/count", 10**30, "out of range"),
    ("accessors/0/count", 4, "the accessor runs past the end of its bufferView; found '4 elements, 12 bytes apart"),
    ("accessors/0/count", 4_000_000, "runs past the end"),
    ("accessors/0/count", 5_000_000, "meshes[0]: the scene is too large for its file"),
    ("accessors/0/byteOffset", -4, "accessors[0].byteOffset: is out of range; found '-4'"),
    ("accessors/0/byteOffset", 4, "runs past the end"),
    ("accessors/0/byteOffset", 1 << 60, "out of range"),
    ("accessors/0/componentType", 5124, "componentType: is not allowed here; found '5124'; expected 5126"),
    ("accessors/0/componentType", USHORT, "is not allowed here"),
    ("accessors/0/type", "VEC2", "accessors[0].type: is not allowed here; found 'VEC2'; expected VEC3"),
    ("accessors/0/type", "MAT4", "is not allowed here"),
    ("accessors/0/type", 3, "accessors[0].type: is no text"),
    ("accessors/0/sparse", {}, "accessors[0].sparse: sparse accessors are not supported"),
    ("accessors/0/bufferView", ..., "accessors[0].bufferView: is missing, and zeros or compressed data"),
    ("accessors/0/bufferView", 7, "accessors[0].bufferView: there is no such one among the bufferViews; found '7'"),
    ("accessors/0/bufferView", -1, "out of range"),
    ("accessors/1/componentType", FLOAT, "accessors[1].componentType: is not allowed here"),
    ("accessors/1/type", "VEC3", "accessors[1].type: is not allowed here"),
    ("bufferViews/0/buffer", 1, "bufferViews[0].buffer: there is no such one among the buffers"),
    ("bufferViews/0/buffer", ..., "bufferViews[0].buffer: is missing"),
    ("bufferViews/0/byteOffset", -1, "out of range"),
    ("bufferViews/0/byteOffset", 1000, "bufferViews[0]: lies outside of its buffer; found 'bytes 1000 to 1036'"),
    ("bufferViews/0/byteLength", 1 << 40, "lies outside of its buffer"),
    ("bufferViews/0/byteLength", 35, "runs past the end"),
    ("bufferViews/0/byteStride", 8, "bufferViews[0].byteStride: is less than one element of accessors[0]; found '8'"),
    ("bufferViews/0/byteStride", 0, "out of range"),
    ("bufferViews/0/byteStride", -12, "out of range"),
    ("bufferViews/0/byteStride", 256, "out of range"),
    ("bufferViews/0/byteStride", 16, "runs past the end"),
    ("buffers/0/byteLength", 1 << 40, "shorter than its declaration"),
    ("buffers/0/uri", "data:application/octet-stream;base64", "the data URI has no comma"),
    ("buffers/0/uri", "data:;base64,A", "the data URI is no base64"),
    ("buffers/0/uri", "data:;base64,AAAA", "shorter than its declaration"),
    ("buffers/0/uri", "missing.bin", "buffers[0].uri: there is no such file; found 'missing.bin'"),
    ("meshes/0/primitives", [], "meshes[0].primitives: is missing or empty"),
    ("meshes/0/primitives/0/attributes", ..., "meshes[0].primitives[0].attributes: is missing"),
    ("meshes/0/primitives/0/attributes", {}, "attributes.POSITION: is missing"),
    ("meshes/0/primitives/0/attributes/POSITION", 9, "no such one among the accessors"),
    ("meshes/0/primitives/0/attributes/NORMAL", 1, "NORMAL: is not as long as POSITION; found '6 elements'"),
    ("meshes/0/primitives/0/indices", 9, "no such one among the accessors"),
    ("meshes/0/primitives/0/mode", 7, "mode: is out of range; found '7'; expected a whole number from 0 to 6"),
    ("meshes/0/primitives/0/material", 0, "material: there is no such one among the materials"),
    ("nodes/0/mesh", 1, "nodes[0].mesh: there is no such one among the meshes"),
    ("nodes/0/children", [0], "nodes[0]: every node is the child of another"),
    ("nodes/0/children", [4], "no such one among the nodes"),
    ("nodes/0/matrix", [1] * 15, "nodes[0].matrix: is no list of this length"),
    ("nodes/0/matrix", [1] * 16, "nodes[0].matrix: is no affine transform"),
    ("nodes/0/matrix", ["1"] * 16, "nodes[0].matrix[0]: is no number"),
    ("nodes/0/rotation", [0, 0, 0, 0], "nodes[0].rotation: is a quaternion of length 0"),
    ("nodes/0/scale", [1, 1, 10**400], "nodes[0].scale[2]: is not finite"),
    ("nodes/0/scale", [1, 1, 1e300], None),
    ("nodes/0/translation", [1e39, 0, 0], "nodes[0]: the transform takes vertices out of single precision"),
    ("scenes", [{"nodes": [0, 0]}], "nodes[0]: the node has two parents, or is its own ancestor"),
    ("scenes", [{"nodes": [0]}, {"nodes": 3}], None),
    ("scene", 5, None),
    ("extensionsRequired", ["KHR_draco_mesh_compression"], "not supported; save the file without compression"),
    ("extensionsRequired", ["EXT_meshopt_compression"], "without compression; found 'EXT_meshopt_compression'"),
    ("extensionsRequired", ["MY_own"], "the file needs an extension that is not supported; found 'MY_own'"),
    ("extensionsRequired", [3], "extensionsRequired[0]: is no text"),
]  # fmt: skip


@pytest.mark.parametrize(("path", "value", "message"), FIELDS, ids=[f"{i} {row[0]}" for i, row in enumerate(FIELDS)])
def test_fields_that_lie(path, value, message):
    builder = Builder()
    primitive = builder.triangle()
    builder.mesh({**primitive, "indices": builder.accessor([0, 1, 2, 2, 1, 0], UBYTE)})
    document = json.loads(json.dumps(builder.finished()))
    change(path, value)(document)
    data = container(json.dumps(document).encode(), builder.binary)
    if message is None:
        assert len(parse(data)[0].verts) == 3
    else:
        refused(data, message)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([[0, 0, 0], [float("nan"), 0, 0], [0, 1, 0]], "accessors[0]: element 1 is not finite"),
        ([[0, 0, 0], [0, float("inf"), 0], [0, 1, 0]], "element 1 is not finite"),
        (TRIANGLE[:2], "the corners do not make whole triangles; found '2'"),
    ],
)
def test_positions_that_lie(rows, message):
    builder = Builder()
    builder.mesh({"attributes": {"POSITION": builder.accessor(rows)}})
    refused(builder.glb(), message)


@pytest.mark.parametrize("component", [UBYTE, USHORT, UINT])
def test_indices_that_lie(component):
    builder = Builder()
    builder.mesh({**builder.triangle(), "indices": builder.accessor([0, 1, 3], component)})
    refused(builder.glb(), "accessors[1]: element 2 is no vertex; found '3'; expected an index from 0 to 2")


def test_nodes_in_a_circle():
    builder = Builder()
    builder.document["nodes"] = [{"children": [1]}, {"children": [2]}, {"children": [1]}]
    refused(builder.glb(), "nodes[1]: the node has two parents, or is its own ancestor")
    builder.document["nodes"] = [{"children": [i + 1]} for i in range(5_000)] + [{}]
    assert parse(builder.glb()) == []  # deep, but a tree


@pytest.mark.parametrize("material", [
    {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1]}},
    {"pbrMetallicRoughness": {"baseColorTexture": {}}},
    {"pbrMetallicRoughness": {"baseColorTexture": {"index": 1}}},
    {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": -1}}},
    {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": {"KHR_texture_transform": 2}}}},
    {"pbrMetallicRoughness": []},
])  # fmt: skip
def test_materials_that_lie(material):
    builder = Builder()
    builder.texture(b"x")
    builder.document["materials"] = [material]
    builder.mesh(builder.triangle(material=0))
    refused(builder.glb(), "materials[0].pbrMetallicRoughness")


def peak(work: Callable[[], Any]) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_a_lying_header_allocates_nothing():
    builder = Builder()
    builder.mesh(builder.triangle())
    builder.document["accessors"][0]["count"] = 1 << 50
    builder.document["buffers"] = [{"byteLength": 1 << 50}]
    data = builder.glb()
    assert peak(lambda: refused(data)) < 2_000_000


def test_a_small_file_cannot_grow_without_bound():
    """Thousands of nodes show one mesh, whose thousands of primitives read one accessor."""
    builder = Builder()
    positions = builder.accessor(TRIANGLE * 300)
    builder.mesh(*({"attributes": {"POSITION": positions}} for _ in range(200)))
    builder.document["nodes"] = [{"mesh": 0}] * 2000
    data = builder.glb()
    assert peak(lambda: refused(data, "the scene is too large for its file", "at most 4,194,304")) < 60_000_000


def test_broken_and_huge_images(tmp_path):
    for image, message in (
        (b"\x89PNG\r\n\x1a\n", r"m\.glb, images\[0\]: cannot decode the image"),
        (_png_of(100_000, 100_000), r"images\[0\]: the image is too large"),
    ):
        builder = Builder()
        primitive = builder.triangle(material=builder.texture(image))
        primitive["attributes"]["TEXCOORD_0"] = builder.accessor([[0, 0]] * 3)
        builder.mesh(primitive)
        (tmp_path / "m.glb").write_bytes(builder.glb())
        with pytest.raises(MeshFormatError, match=message):
            IO().load_mesh(tmp_path / "m.glb")
        assert IO().load_mesh(tmp_path / "m.glb", include_textures=False).textures is None


def test_many_tints_of_one_image_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr("rendra.io._gltf_paint.MAX_TEXTURE_PIXELS", 400)
    buffer = io.BytesIO()
    Image.new("L", (10, 10)).save(buffer, format="PNG")
    builder = Builder()
    builder.texture(buffer.getvalue())
    (base,) = builder.document["materials"]
    uvs = builder.accessor([[0, 0]] * 3)
    builder.document["materials"] = [
        {"pbrMetallicRoughness": {**base["pbrMetallicRoughness"], "baseColorFactor": [i / 8, 1, 1, 1]}}
        for i in range(5)
    ]
    for material in range(5):
        primitive = builder.triangle(material=material)
        primitive["attributes"]["TEXCOORD_0"] = uvs
        builder.mesh(primitive)
    (tmp_path / "m.glb").write_bytes(builder.glb())
    with pytest.raises(MeshFormatError, match=r"in all their tints, are too large; found '500'"):
        IO().load_mesh(tmp_path / "m.glb")


def _png_of(width: int, height: int) -> bytes:
    """Only the header of a picture."""
    body = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + body + struct.pack(">I", zlib.crc32(body))
    return head + struct.pack(">I4sI", 0, b"IDAT", zlib.crc32(b"IDAT"))


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("../secret.bin", "leaves the folder"),
        ("%2e%2e/secret.bin", "leaves the folder"),
        ("..%5Csecret.bin", "leaves the folder"),
        ("/etc/passwd", "is absolute"),
        ("C:\\secret.bin", "is absolute"),
        ("file:///etc/passwd", "is a URL"),
        ("https://example.org/b.bin", "is a URL"),
        ("link.bin", "through a link"),
        ("a%00b", "NUL"),
    ],
)
@pytest.mark.parametrize("kind", ["buffers", "images"])
def test_no_path_leaves_the_folder(tmp_path, uri, message, kind):
    (tmp_path / "asset").mkdir()
    (tmp_path / "secret.bin").write_bytes(b"\0" * 100)
    os.symlink(tmp_path / "secret.bin", tmp_path / "asset" / "link.bin")
    builder = Builder()
    primitive = builder.triangle(material=builder.texture(b"image"))
    primitive["attributes"]["TEXCOORD_0"] = builder.accessor([[0, 0]] * 3)
    builder.mesh(primitive)
    text = builder.gltf()
    document = json.loads(text)
    document[kind][0] = {"uri": uri, "byteLength": 100}
    path = tmp_path / "asset" / "m.gltf"
    path.write_text(json.dumps(document))
    with pytest.raises(MeshFormatError, match=message) as caught:
        IO().load_mesh(path)
    assert f"m.gltf, {kind}[0]" in str(caught.value)
    if kind == "buffers" and uri == "../secret.bin":
        assert len(IO().load_mesh(path, allow_outside=True, include_textures=False).verts_packed()) == 3


def test_a_large_buffer_beside_the_file_may_hold_a_large_scene(tmp_path):
    builder = Builder()
    builder.mesh({"attributes": {"POSITION": builder.accessor(TRIANGLE * 500_000)}})
    builder.document["nodes"] *= 3
    builder.document["buffers"] = [{"byteLength": len(builder.binary), "uri": "b.bin"}]
    (tmp_path / "b.bin").write_bytes(builder.binary)
    (tmp_path / "m.gltf").write_text(json.dumps(builder.finished()))
    assert len(IO().load_mesh(tmp_path / "m.gltf").verts_packed()) == 4_500_000


def test_bytes_behind_the_end_are_said():
    with pytest.warns(UserWarning, match="5 bytes behind the end are ignored"):
        assert len(parse(GOOD.glb() + b"extra")) == 1


# Any value in any place: a result or a MeshFormatError, nothing else


def _places(value: Any, path: tuple = ()) -> list[tuple]:
    keys: Any = value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    return [path] * bool(path) + [place for key in keys for place in _places(value[key], (*path, key))]


def _rich() -> Builder:
    builder = Builder()
    primitive = builder.triangle(material=builder.texture(b"image"))
    primitive["attributes"] |= {
        "NORMAL": builder.accessor(TRIANGLE), "COLOR_0": builder.accessor([[1, 2, 3, 4]] * 3, UBYTE),
        "TEXCOORD_0": builder.accessor([[0.5, 2.0]] * 3), "_RENDRA_VERTEX": builder.accessor([[0, 0]] * 3, USHORT),
        "_RENDRA_V": builder.accessor([0.1, 0.2, 0.3]),
    }  # fmt: skip
    builder.mesh({**primitive, "indices": builder.accessor([0, 1, 2], USHORT)})
    builder.document["nodes"] += [{"children": [0], "matrix": [2.0, *[0] * 4, 1, *[0] * 4, 1, *[0] * 4, 1]}]
    builder.document["nodes"] += [{"mesh": 0, "rotation": [0, 0, 0, 2], "translation": [1, 2, 3]}]
    builder.document["scenes"] = [{"nodes": [1, 2]}]
    info = builder.document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    info["extensions"] = {"KHR_texture_transform": {"scale": [1, 2], "texCoord": 0}}
    return builder


RICH = _rich()
PLACES = _places(RICH.finished())
junk = st.one_of(
    st.none(), st.booleans(), st.integers(-3, 10), st.integers(), st.floats(allow_nan=False, allow_infinity=False),
    st.text(max_size=5), st.just([]), st.just({}), st.just([0]), st.just([[]]), st.sampled_from([5120, 5123, 5126]),
)  # fmt: skip


def test_fuzzed_documents():
    fuzz_documents(60)


@pytest.mark.slow
def test_many_fuzzed_documents():
    fuzz_documents(10_000)


def fuzz_documents(examples: int) -> None:
    @settings(
        max_examples=examples, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True, database=None
    )
    @given(st.lists(st.tuples(st.sampled_from(PLACES), junk), min_size=1, max_size=2), st.booleans())
    def judge(changes, cut):
        try:
            parts = parse(_changed(changes)[: -40 if cut else None])
        except MeshFormatError:
            return
        assert all(
            not part.faces.size or 0 <= part.faces.min() <= part.faces.max() < len(part.verts) for part in parts
        )

    judge()


def _changed(changes: list[tuple[tuple, Any]]) -> bytes:
    """The rich file with other values in some places."""
    document = json.loads(json.dumps(RICH.finished()))
    for (*way, last), value in changes:
        at: Any = document
        try:
            for key in way:
                at = at[key]
            at[last] = copy.deepcopy(value)
        except (KeyError, IndexError, TypeError):
            continue  # an earlier change took this place away
    return container(json.dumps(document).encode(), RICH.binary)
