"""PLY files: every encoding, extra elements, polygons, colours."""

import io
import struct

import numpy as np
import pytest
import torch
from assertions import assert_close

from rendra.io import IO, load_ply, save_ply
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesVertex
from rendra.structures import Meshes

XYZ = "property float x\nproperty float y\nproperty float z\n"
FACE = "property list uchar int vertex_indices\n"
ORDERS = {"<": "binary_little_endian", ">": "binary_big_endian"}
VERTS = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5], [1.0, 1.0, 0.25], [0.0, -1.5, 2.0]])


def header(encoding: str, *elements: str) -> str:
    return f"ply\nformat {encoding} 1.0\ncomment made by a test\n{''.join(elements)}end_header\n"


def ascii_ply(elements: str, body: str) -> io.StringIO:
    return io.StringIO(header("ascii", elements) + body)


def test_pedestrian_is_a_point_cloud(shared_data):
    verts, faces = load_ply(shared_data / "pedestrian.ply")
    lines = (shared_data / "pedestrian.ply").read_text().splitlines()
    expected = torch.tensor([[float(x) for x in line.split()] for line in lines[8:]])
    assert verts.shape == (239, 3)
    assert torch.equal(verts, expected)
    assert faces.shape == (0, 3)
    assert faces.dtype == torch.int64


@pytest.mark.parametrize("ascii", [False, True])
@pytest.mark.parametrize("to_path", [False, True])
@pytest.mark.parametrize("with_normals", [False, True])
def test_what_is_written_is_read(tmp_path, ascii, to_path, with_normals):
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    sink = tmp_path / "mesh.ply" if to_path else io.BytesIO()
    save_ply(sink, VERTS, faces, VERTS if with_normals else None, ascii=ascii)
    verts, read_faces = load_ply(sink if to_path else io.BytesIO(sink.getvalue()))
    assert_close(verts, VERTS, atol=1e-6)
    assert torch.equal(read_faces, faces)


def test_text_of_a_small_file():
    sink = io.StringIO()
    save_ply(sink, VERTS[:1], torch.tensor([[0, 0, 0]]), VERTS[1:2], ascii=True, decimal_places=1)
    normals = "property float nx\nproperty float ny\nproperty float nz\n"
    start = f"ply\nformat ascii 1.0\nelement vertex 1\n{XYZ}{normals}element face 1\n"
    assert sink.getvalue() == (
        start + "property list uchar int vertex_index\nend_header\n0.0 0.0 0.0 1.0 0.0 0.5\n3 0 0 0\n"
    )


@pytest.mark.parametrize("ascii", [False, True])
@pytest.mark.parametrize("faces", [None, torch.zeros(0, 3, dtype=torch.int64), torch.tensor([])])
@pytest.mark.parametrize("verts", [VERTS, torch.zeros(0, 3), torch.tensor([])])
def test_empty_parts(ascii, faces, verts):
    sink = io.BytesIO()
    save_ply(sink, verts, faces, ascii=ascii)
    read_verts, read_faces = load_ply(io.BytesIO(sink.getvalue()))
    assert read_verts.shape == (len(verts), 3)
    assert read_faces.shape == (0, 3)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("lengths", [(3, 3), (4, 4), (3, 5, 4), (5, 3)])
@pytest.mark.parametrize(
    "kinds", [("uchar", "int", "B", "i"), ("int", "uchar", "i", "B"), ("ushort", "uint", "H", "I")]
)
def test_binary_faces_of_any_length_and_type(order, lengths, kinds):
    length_name, index_name, length_code, index_code = kinds
    elements = (
        f"element vertex 5\nproperty uchar flag\n{XYZ}",
        f"element face {len(lengths)}\nproperty short before\n"
        f"property list {length_name} {index_name} vertex_index\nproperty double after\n",
        "element extra 2\nproperty list uchar float numbers\n",
    )
    body = b"".join(struct.pack(f"{order}B3f", 7, i, 2 * i, 3 * i) for i in range(5))
    for n in lengths:
        body += struct.pack(f"{order}h{length_code}{n}{index_code}d", -1, n, *range(n), 0.5)
    body += struct.pack(f"{order}BBf", 0, 1, 0.5)
    verts, faces = load_ply(io.BytesIO(header(ORDERS[order], *elements).encode() + body))
    assert_close(verts, [[i, 2.0 * i, 3.0 * i] for i in range(5)])
    assert faces.tolist() == [[0, i, i + 1] for n in lengths for i in range(1, n - 1)]


def test_binary_and_text_agree_on_several_lists_in_a_row():
    elements = (
        f"element face 3\nproperty list uchar int first\nproperty char gap\n{FACE}property char tail\n",
        f"element vertex 4\n{XYZ}",
    )
    rows = [([9], 1, [0, 1, 2], 2), ([], 3, [0, 1, 2, 3], 4), ([8, 7], 5, [3, 2, 1], 6)]
    binary, text = b"", ""
    for first, gap, indices, tail in rows:
        code = f"<B{len(first)}ibB{len(indices)}ib"
        binary += struct.pack(code, len(first), *first, gap, len(indices), *indices, tail)
        text += " ".join(map(str, [len(first), *first, gap, len(indices), *indices, tail])) + "\n"
    binary += VERTS.numpy().tobytes()
    text += "".join(" ".join(map(str, row)) + "\n" for row in VERTS.tolist())
    from_binary = load_ply(io.BytesIO(header(ORDERS["<"], *elements).encode() + binary))
    from_text = load_ply(io.StringIO(header("ascii", *elements) + text))
    for verts, faces in (from_binary, from_text):
        assert torch.equal(verts, VERTS)
        assert faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3], [3, 2, 1]]


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: "\ufeff" + text,
        lambda text: text.replace("end_header\n", "end_header\n\n\n"),
        lambda text: text.rstrip("\n"),
        lambda text: text.replace("format ascii 1.0", "comment x\nformat ascii 1.0 \nobj_info y"),
    ],
    ids=["crlf", "cr", "mark", "blank lines", "no last line end", "comments"],
)
def test_spellings_of_the_same_mesh(damage):
    text = header("ascii", f"element vertex 3\n{XYZ}", f"element face 1\n{FACE}") + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    verts, faces = load_ply(io.BytesIO(damage(text).encode()))
    assert verts.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert faces.tolist() == [[0, 1, 2]]


def test_what_follows_the_last_element_is_a_warning():
    with pytest.warns(UserWarning, match="line 10 and what follows"):
        load_ply(ascii_ply(f"element vertex 1\n{XYZ}", "0 0 0\n1 1 1\n"))
    with pytest.warns(UserWarning, match="3 bytes behind the last element"):
        load_ply(io.BytesIO(header(ORDERS["<"], f"element vertex 0\n{XYZ}").encode() + b"abc"))


def test_decimal_places_of_a_binary_file_are_a_warning():
    with pytest.warns(UserWarning, match="decimal_places is ignored"):
        save_ply(io.BytesIO(), VERTS, decimal_places=3)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"verts": torch.zeros(3)}, ValueError, "'verts' should either be empty or of shape"),
        ({"faces": torch.tensor([[0, 1, 4]])}, ValueError, "Faces have invalid indices: row 0 of 'faces'"),
        ({"faces": torch.tensor([[0, 1, -1]])}, ValueError, "Faces have invalid indices"),
        ({"verts_normals": VERTS[:2]}, ValueError, "'verts_normals' has 2 rows, but there are 4 verts"),
        ({"decimal_places": "3"}, ValueError, "decimal_places is '3'"),
        ({"f": io.StringIO()}, TypeError, "opened as text"),
        ({"f": 5}, TypeError, "expected a path or an open file, got int"),
    ],
)
def test_what_cannot_be_written_is_refused(arguments, error, message):
    given = {"f": io.BytesIO(), "verts": VERTS + 0.1} | arguments
    with pytest.raises(error, match=message):
        save_ply(**given)


# Through IO: normals and colours


@pytest.mark.parametrize("binary", [True, False, None])
@pytest.mark.parametrize("colors_as_uint8", [False, True])
def test_colours_and_normals_round_trip(tmp_path, binary, colors_as_uint8):
    colors = torch.tensor([[0.0, 0.2, 1.0], [0.4, 0.6, 0.8], [1.0, 0.0, 0.0], [0.2, 0.2, 0.2]])
    normals = torch.nn.functional.normalize(VERTS + 1, dim=1)
    mesh = Meshes([VERTS], [torch.tensor([[0, 1, 2]])], TexturesVertex([colors]), verts_normals=[normals])
    path = tmp_path / "mesh.ply"
    IO().save_mesh(mesh, path, binary=binary, colors_as_uint8=colors_as_uint8)
    content = path.read_bytes()
    assert (b"property uchar red" in content) == colors_as_uint8
    assert (b"format ascii" in content) == (binary is False)
    back = IO().load_mesh(path)
    assert_close(back.textures.verts_features_packed(), colors, atol=1e-6)
    assert back.has_verts_normals()
    assert_close(back.verts_normals_packed(), normals, atol=1e-6)
    assert IO().load_mesh(path, include_textures=False).textures is None


def test_face_colours_become_an_atlas_and_follow_their_polygon(tmp_path):
    face = f"element face 2\n{FACE}property uchar red\nproperty uchar green\nproperty uchar blue\n"
    path = tmp_path / "mesh.ply"
    text = header("ascii", f"element vertex 4\n{XYZ}", face)
    path.write_text(text + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3 255 0 0\n3 0 1 2 0 0 51\n")
    textures = IO().load_mesh(path).textures
    assert isinstance(textures, TexturesAtlas)
    assert_close(textures.atlas_packed().reshape(3, 3), [[1.0, 0, 0], [1, 0, 0], [0, 0, 0.2]])


def test_a_texture_that_ply_cannot_hold_is_a_warning(tmp_path):
    mesh = Meshes([VERTS], [torch.tensor([[0, 1, 2]])], TexturesVertex([torch.zeros(4, 5)]))
    with pytest.warns(UserWarning, match="Texture will not be saved"):
        IO().save_mesh(mesh, tmp_path / "mesh.ply")


def test_doubles_and_odd_orders_of_properties():
    elements = "element vertex 2\nproperty double z\nproperty uchar quality\nproperty double y\nproperty double x\n"
    rows = np.array(
        [(3.0, 1, 2.0, 1.0), (6.0, 1, 5.0, 4.0)], dtype=[("z", ">f8"), ("q", "u1"), ("y", ">f8"), ("x", ">f8")]
    )
    verts, _ = load_ply(io.BytesIO(header(ORDERS[">"], elements).encode() + rows.tobytes()))
    assert verts.tolist() == [[1, 2, 3], [4, 5, 6]]
