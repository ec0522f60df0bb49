"""Files of a few megabytes that would take hours or gigabytes if any step were worse than linear."""

import io
import struct

import numpy as np
import pytest
from file_limits import within_limits
from PIL import Image
from small_files import gltf_parts, image_bytes, pack_glb

from rendra.io import IO, MeshFormatError, load_obj, load_ply
from rendra.io._images import decode_image
from rendra.io.mtl_io import load_mtl

M = 1_000_000
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY = "ply\nformat ascii 1.0\n"
BINARY_PLY = "ply\nformat binary_little_endian 1.0\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"


def glb_of_nodes(nodes: list[dict]) -> bytes:
    """The small GLB file with these nodes and one more that shows its mesh."""
    document, body = gltf_parts(textured=False)
    return pack_glb({**document, "nodes": [*nodes, {"mesh": 0}]}, body)


def glb_of_parts(primitives: int, nodes: int, materials: int, images: int) -> bytes:
    """Textured triangles: so many a mesh, which every node shows elsewhere, each with a tint and an image of its own.

    Materials and images begin again at their first when they run out.
    """
    document, body = gltf_parts(textured=True)
    (primitive,) = document["meshes"][0]["primitives"]
    info = {"extensions": {"KHR_texture_transform": {"rotation": 1, "scale": [2, 3]}}}
    document |= {
        "meshes": [{"primitives": [{**primitive, "material": i % materials} for i in range(primitives)]}],
        "nodes": [{"mesh": 0, "translation": [i, 2, 3], "scale": [1, -1, 2]} for i in range(nodes)],
        "scenes": [{"nodes": list(range(nodes))}],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorFactor": [i / materials, 1, 0, 1],
                    "baseColorTexture": {"index": i % images, **info},
                }
            }
            for i in range(materials)
        ],
        "textures": [{"source": i} for i in range(images)],
        "images": document["images"] * images,
    }
    return pack_glb(document, body)


def glb_of_images(*sizes: tuple[int, int]) -> bytes:
    """One textured triangle for each image, all black."""
    document, body = gltf_parts(textured=True)
    (primitive,) = document["meshes"][0]["primitives"]
    document["meshes"][0]["primitives"] = [{**primitive, "material": i} for i in range(len(sizes))]
    document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": i}}} for i in range(len(sizes))]
    document["textures"] = [{"source": i} for i in range(len(sizes))]
    document["images"] = []
    for size in sizes:
        buffer = io.BytesIO()
        Image.new("1", size).save(buffer, "PNG")
        document["images"].append({"bufferView": len(document["bufferViews"]), "mimeType": "image/png"})
        view = {"buffer": 0, "byteOffset": len(body), "byteLength": len(buffer.getvalue())}
        document["bufferViews"].append(view)
        body += buffer.getvalue()
    document["buffers"] = [{"byteLength": len(body)}]
    return pack_glb(document, body)


OBJ_TEXTS = {
    "a number that is none": ("v 0 0 " + "9" * 2 * M + "x\n", "cannot read '9999"),
    "a number of ten megabytes": ("v 0 0 0." + "9" * 10 * M + "\n", None),
    "a number beyond all bounds": ("v 0 0 " + "9" * 10 * M + "\n", "not finite"),
    "a comment of ten megabytes": (TRIANGLE + "#" + "x" * 10 * M + "\nf 1 2 3\n", None),
    "a word of ten megabytes": ("x" * 10 * M, "unknown to OBJ"),
    "a line of blanks": (TRIANGLE + "v 0 0 0 " + " " * 10 * M, None),
    "a polygon of 300,000 corners": (TRIANGLE + "f " + "1 2 3 " * (M // 9) + "\n", None),
    "a vertex of two million numbers": ("v " + "1 " * 2 * M + "\n", "a vertex cannot have 2000000 numbers"),
    "an index of ten megabytes": (TRIANGLE + "f 1 2 " + "3" * 10 * M + "\n", "names vertex 3333"),
    "an index of signs": (TRIANGLE + "f 1 2 " + "-" * 2 * M + "\n", "cannot read '-----"),
    "a corner of slashes": (TRIANGLE + "f 1 2 " + "3/" * 2 * M + "\n", "more than three indices"),
    "one line, continued": (TRIANGLE + "f 1 2 3 " + "\\\n" * (M // 4) + "\n", None),
    "blank lines": ("\n" * M, None),
    "indented lines": ("  v 0 0 0\n" * (M // 5), None),
    "as many materials as lines": (TRIANGLE + "".join(f"usemtl {i}\n" for i in range(M // 10)), None),
    "one library, again and again": (TRIANGLE + "usemtl a\n" + "mtllib lost.mtl\n" * (M // 5), None),
    "libraries without end": (
        TRIANGLE + "usemtl a\n" + "".join(f"mtllib {i}\n" for i in range(M // 5)), "too many material libraries",
    ),
    "libraries on one line": (
        TRIANGLE + "usemtl a\nmtllib " + " ".join(map(str, range(M))) + "\n", "too many material libraries",
    ),
}  # fmt: skip
MTL_TEXTS = {
    "a number that is none": ("newmtl a\nNs " + "9" * 2 * M + "x\n", "bad material value"),
    "a number of ten megabytes": ("newmtl a\nNs 0." + "9" * 10 * M + "\n", None),
    "options without end": ("newmtl a\nmap_Kd " + "-bm 1 " * (M // 30) + "lost.png\n", None),
    "a name of ten megabytes": ("newmtl a\nmap_Kd " + "x" * 10 * M + "\n", None),
    "materials without end": ("".join(f"newmtl {i}\nKd 1\n" for i in range(M // 50)), None),
}
PLY_TEXTS = {
    "a number that is none": (f"{PLY}element vertex 1\n{XYZ}end_header\n0 0 {'9' * 2 * M}x\n", "cannot read '9999"),
    "properties without end": (
        f"{PLY}element vertex 0\n" + "".join(f"property char {i}\n" for i in range(M // 5)), "too many",
    ),
    "elements without end": (PLY + "".join(f"element {i} 0\n" for i in range(M // 5)), "too many"),
    "a comment of ten megabytes": (f"{PLY}comment {'x' * 10 * M}\nelement vertex 0\n{XYZ}end_header\n", None),
    "a statement of ten megabytes": (f"{PLY}{'x' * 10 * M}\n", "unknown header statement"),
    "comments without end": (f"{PLY}{'comment' + chr(10) * (M // 5)}end_header\n", "no vertex element"),
    "rows of one byte": (
        f"{BINARY_PLY}element vertex 0\n{XYZ}element x {M // 2}\nproperty list char char y\nend_header\n"
        + "\0" * (M // 2 - 1) + "\1\0", None,
    ),
    "a list of every length": (
        f"{BINARY_PLY}element vertex 0\n{XYZ}element x 2\nproperty list uint char y\nend_header\n"
        + "\0\0\0\0" + struct.pack("<I", 2**31 - 1).decode("latin-1") + "x" * 1000, "a list of 2147483647",
    ),
}  # fmt: skip


def judge(load, text: str, message: str | None) -> None:
    source = io.BytesIO(text.encode("latin-1"))
    with within_limits():
        if message is None:
            load(source)
            return
        with pytest.raises(MeshFormatError) as caught:
            load(source)
    assert message in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("name", OBJ_TEXTS)
def test_huge_obj(name):
    judge(load_obj, *OBJ_TEXTS[name])


@pytest.mark.parametrize("name", MTL_TEXTS)
def test_huge_mtl(name, tmp_path):
    judge(lambda source: load_mtl(source, material_names=["a"], data_dir=str(tmp_path)), *MTL_TEXTS[name])


@pytest.mark.parametrize("name", PLY_TEXTS)
def test_huge_ply(name):
    judge(load_ply, *PLY_TEXTS[name])


MESH_BYTES = {
    "off, a number that is none": ("off", f"OFF\n1 0 0\n0 0 {'9' * 2 * M}x\n".encode(), "cannot read '9999"),
    "off, counts of ten megabytes": ("off", b"OFF\n" + b"9" * 10 * M + b" 0 0\n", "bad counts"),
    "off, counts that lie": ("off", b"OFF\n1000000000 1000000000 0\n0 0 0\n", "shorter than its header says"),
    "off, comments without end": ("off", b"OFF\n" + b"#\n" * M + b"0 0 0\n", None),
    "off, one polygon": ("off", b"OFF\n1 1 0\n0 0 0\n500000 " + b"0 " * (M // 2) + b"\n", None),
    "off, a polygon that lies": ("off", b"OFF\n1 1 0\n0 0 0\n2000000000 0 0 0\n", "ends before the corners do"),
    "stl, a count that lies": ("stl", b"\0" * 80 + struct.pack("<I", 2**32 - 1) + b"\0" * 5000, "too short"),
    "stl, a word of ten megabytes": ("stl", b"solid" + b"x" * 10 * M, "unknown to STL"),
    "stl, solids without end": ("stl", b"solid\n" * (M // 5), None),
    "glb, nested lists": ("glb", pack_glb(b"[" * M), "nested too deeply"),
    "glb, nested objects": ("glb", pack_glb(b'{"a":' * M), "nested too deeply"),
    "glb, an endless number": ("glb", pack_glb(b'{"asset":' + b"9" * M + b"}"), "malformed"),
    "glb, doubled at each node": ("glb", glb_of_nodes([{"children": [i + 1] * 2} for i in range(50)]), "two parents"),
    "glb, a ring of nodes": ("glb", glb_of_nodes([{"children": [1]}, {"children": [0]}]), "its own ancestor"),
    "glb, lists without end": ("glb", pack_glb(b'{"asset":{"version":"2.0"},"x":[' + b"[0]," * M + b"0]}"), None),
    "glb, nodes without end": ("glb", glb_of_nodes([{}] * 70_000), "nodes: is too long; found '70,001 entries'"),
    "glb, children without end": ("glb", glb_of_nodes([{"children": [1] * M}, {}]), "two parents"),
    "glb, empty materials without end": (
        "glb", pack_glb(b'{"asset":{"version":"2.0"},"materials":[' + b"{}," * M + b"{}]}"), "materials: is too long",
    ),
    "glb, primitives without end": ("glb", glb_of_parts(17_000, 1, 1, 1), "too many primitives; found '17,000"),
    "glb, a mesh at every node": ("glb", glb_of_parts(130, 200, 1, 1), "too many primitives; found '16,510 up to n"),
    "glb, parts, tints and images": ("glb", glb_of_parts(500, 2, 500, 100), None),
    "glb, images that do not fit": ("glb", glb_of_images((9000, 2), (2, 9000)), "side by side are too large"),
}  # fmt: skip


@pytest.mark.parametrize("name", MESH_BYTES)
def test_huge_mesh(name, tmp_path):
    suffix, data, message = MESH_BYTES[name]
    path = tmp_path / f"mesh.{suffix}"
    path.write_bytes(data)
    with within_limits():
        if message is None:
            IO().load_mesh(path)
            return
        with pytest.raises(MeshFormatError) as caught:
            IO().load_mesh(path)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (f"0 0 {'9' * 2 * M}x\n".encode(), "cannot read '9999"),
        (b"0 " * 2 * M, "2000000 columns"),
        (b"# x y z\n" * (M // 5) + b"0 0 0\n", None),
        (b"# " + b"x y z " * (M // 5) + b"\n0 0 0\n", None),
    ],
    ids=["a number that is none", "columns without end", "comments without end", "a comment of a megabyte"],
)
def test_huge_xyz(data, message, tmp_path):
    path = tmp_path / "cloud.xyz"
    path.write_bytes(data)
    with within_limits():
        if message is None:
            assert len(IO().load_pointcloud(path).points_packed()) == 1
            return
        with pytest.raises(MeshFormatError, match=message):
            IO().load_pointcloud(path)


# Images that are small on disk and large in memory

BOMB = (12_000, 9_000)  # below the limit of Pillow, above ours


def claimed(kind: str) -> bytes:
    """An image file that claims the size of BOMB and holds a few pixels."""
    data, size = bytearray(image_bytes(kind, (4, 2))), BOMB
    if kind == "BMP":
        struct.pack_into("<ii", data, 18, *size)
    elif kind == "TGA":
        struct.pack_into("<HH", data, 12, *size)
    elif kind == "GIF":
        struct.pack_into("<HH", data, 6, *size)
    elif kind == "PPM":
        return bytes(data).replace(b"4 2", b"%d %d" % size)
    elif kind == "JPEG":
        at = data.index(b"\xff\xc0") + 5
        struct.pack_into(">HH", data, at, *size)
    return bytes(data)


@pytest.mark.parametrize("kind", ["BMP", "TGA", "GIF", "PPM", "JPEG"])
def test_images_that_claim_too_much(kind):
    with within_limits(), pytest.raises(MeshFormatError, match=r"^bomb: the image is too large.*at most 67,108,864"):
        decode_image(claimed(kind), "bomb")


def test_a_bomb_that_keeps_its_promise():
    buffer = io.BytesIO()
    Image.new("1", BOMB).save(buffer, "PNG")
    assert len(buffer.getvalue()) < 100_000
    with within_limits(), pytest.raises(MeshFormatError, match="found '12000 x 9000'"):
        decode_image(buffer.getvalue(), "bomb")


def test_text_that_unpacks_to_gigabytes_is_not_unpacked():
    from PIL import PngImagePlugin

    info = PngImagePlugin.PngInfo()
    info.add_text("comment", "x" * 20 * M, zip=True)
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((2, 2, 3), dtype=np.uint8)).save(buffer, "PNG", pnginfo=info)
    with within_limits(), pytest.raises(MeshFormatError, match="cannot decode the image"):
        decode_image(buffer.getvalue(), "bomb")
