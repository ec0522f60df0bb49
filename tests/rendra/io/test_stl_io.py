"""STL files."""

import struct

import pytest
import torch
import trimesh
from assertions import assert_close

from rendra.io import IO, MeshFormatError
from rendra.io._source import Source
from rendra.io.stl_io import parse_stl
from rendra.renderer.mesh.textures import TexturesVertex
from rendra.structures import Meshes
from rendra.utils.ico_sphere import ico_sphere

FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
TEXT = f"solid name\n{FACET}endsolid name\n"


def parse(data: bytes | str) -> tuple:
    return parse_stl(Source("bad.stl", data.encode() if isinstance(data, str) else data, "."))


@pytest.mark.parametrize("binary", [None, True, False])
def test_triangles_come_back_to_the_bit(tmp_path, binary):
    sphere = ico_sphere(2)
    IO().save_mesh(sphere, tmp_path / "m.stl", binary=binary)
    assert ((tmp_path / "m.stl").read_bytes()[:5] == b"solid") == (binary is False)
    back = IO().load_mesh(tmp_path / "m.stl")
    assert len(back.verts_packed()) == 162
    assert torch.equal(back.verts_packed()[back.faces_packed()], sphere.verts_packed()[sphere.faces_packed()])
    assert torch.equal(back.faces_packed().unique(), torch.arange(162))


def test_vertices_are_merged_where_exactly_equal_in_the_order_of_first_use():
    rows = ([5, 0, 0, 1, -0.0, 0, 0, 1, 0], [1, 0, 0, 5, 0, 0, 0, 1, 1e-30])
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *corners, 7) for corners in rows)
    verts, faces = parse(b"x" * 80 + struct.pack("<I", 2) + body)
    assert verts.tolist() == [[5, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, pytest.approx(1e-30)]]
    assert faces.tolist() == [[0, 1, 2], [1, 0, 3]]


def test_a_binary_file_may_begin_with_solid():
    data = b"solid but binary".ljust(80) + struct.pack("<I", 1) + struct.pack("<12fH", *range(12), 0)
    assert parse(data)[0].tolist() == [[3, 4, 5], [6, 7, 8], [9, 10, 11]]


@pytest.mark.parametrize(
    "text",
    [TEXT, TEXT.upper(), TEXT.replace("\n", "\r\n"), TEXT.replace("\n", "\n\n  \t"), f"  {TEXT}solid b\nendsolid"],
)
def test_forms_of_text(text):
    verts, faces = parse(text)
    assert verts.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("data", ["solid\nendsolid\n", b"\0" * 84])
def test_no_triangles(data):
    verts, faces = parse(data)
    assert (verts.shape, faces.shape) == ((0, 3), (0, 3))


def test_empty_and_degenerate_meshes(tmp_path):
    for verts, faces in ((torch.zeros(0, 3), torch.zeros(0, 3)), (torch.zeros(3, 3), torch.tensor([[0, 1, 2]]))):
        mesh = Meshes([verts], [faces.long()])
        for binary in (True, False):
            IO().save_mesh(mesh, tmp_path / "m.stl", binary=binary)
            assert len(IO().load_mesh(tmp_path / "m.stl").faces_packed()) == len(faces)


MALFORMED = [
    (b"", None, "the file ends within its header; found '0 bytes'; expected 84"),
    (b"x" * 83, None, "the file ends within its header"),
    (b"x" * 80 + b"\xff" * 4, None, "byte 80: the file is too short for its 4294967295 triangles; found '84 bytes'"),
    (
        b"x" * 80 + struct.pack("<I12fH", 1, 0, 0, 0, *[torch.nan] * 9, 0),
        None,
        "triangle 0: a coordinate that is not",
    ),
    ("solid\nhello\n", 2, "a statement unknown to STL; found 'hello'"),
    ("solid\nvertexes 1 2 3\n", 2, "a statement unknown to STL"),
    (TEXT.replace("outer loop\n", ""), 3, "a statement out of order; found 'vertex 0 0 0'; expected 'outer'"),
    (TEXT.replace("vertex 1 0 0\n", ""), 6, "a statement out of order"),
    (TEXT.replace("endloop\n", "vertex 1 1 1\nendloop\n"), 7, "a statement out of order"),
    (TEXT.replace("endfacet\n", ""), 7, "the file ends within a triangle"),
    (TEXT.replace("1 0 0", "1 0"), 5, "a corner needs three numbers"),
    (TEXT.replace("1 0 0", "1 0 0 0"), 5, "a corner needs three numbers"),
    (TEXT.replace("1 0 0", "1 x 0"), 5, "cannot read 'x'"),
    (TEXT.replace("1 0 0", "1 inf 0"), 5, "not finite in single precision"),
    (TEXT.replace("1 0 0", "1 1e40 0"), 5, "not finite in single precision"),
]


@pytest.mark.parametrize(("data", "line", "message"), MALFORMED)
def test_malformed_stl(data, line, message):
    with pytest.raises(MeshFormatError) as caught:
        parse(data)
    assert str(caught.value).startswith("bad.stl" + (f", line {line}: " if line else ": "))
    assert message in str(caught.value)


def test_bytes_behind_the_end_are_said():
    with pytest.warns(UserWarning, match="3 bytes behind the last triangle are ignored"):
        parse(b"\0" * 87)


def test_what_stl_cannot_hold(tmp_path):
    sphere = ico_sphere(0)
    sphere.textures = TexturesVertex([torch.rand(12, 3)])
    with pytest.warns(UserWarning, match="STL files hold no colours; this TexturesVertex is not saved"):
        IO().save_mesh(sphere, tmp_path / "m.stl")
    IO().save_mesh(sphere, tmp_path / "m.stl", include_textures=False)
    before = (tmp_path / "m.stl").read_bytes()
    bad = Meshes([torch.full((3, 3), 1e39, dtype=torch.float64)], [torch.tensor([[0, 1, 2]])])
    with pytest.raises(ValueError, match="not finite in single precision in row 0"):
        IO().save_mesh(bad, tmp_path / "m.stl")
    assert (tmp_path / "m.stl").read_bytes() == before


def test_trimesh_and_this_package_understand_each_other(tmp_path):
    sphere = ico_sphere(1)
    corners = sphere.verts_packed()[sphere.faces_packed()]
    for binary in (True, False):
        IO().save_mesh(sphere, tmp_path / "m.stl", binary=binary)
        found = trimesh.load(tmp_path / "m.stl")
        assert_close(torch.tensor(found.triangles.copy()), corners.double().tolist(), atol=0)
        assert_close(torch.tensor(found.face_normals), sphere.faces_normals_packed().tolist(), atol=1e-5)
    for kind in ("stl", "stl_ascii"):
        data = found.export(file_type=kind)
        (tmp_path / "t.stl").write_bytes(data if isinstance(data, bytes) else data.encode())
        back = IO().load_mesh(tmp_path / "t.stl")
        assert_close(back.verts_packed()[back.faces_packed()], corners, atol=1e-6)
        assert len(back.verts_packed()) == 42
