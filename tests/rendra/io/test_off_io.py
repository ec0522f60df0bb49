"""OFF files."""

import pytest
import torch
import trimesh
from assertions import assert_close

from rendra.io import IO, MeshFormatError
from rendra.io._source import Source
from rendra.io.off_io import parse_off
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesUV, TexturesVertex
from rendra.structures import Meshes, Pointclouds
from rendra.utils.ico_sphere import ico_sphere

VERTS = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"


def load(tmp_path, text: str) -> Meshes:
    (tmp_path / "m.off").write_text(text, newline="")
    return IO().load_mesh(tmp_path / "m.off")


def test_a_mesh_comes_back_to_the_bit(tmp_path):
    sphere = ico_sphere(1)
    verts, faces, features = sphere.verts_packed() * 1e-3, sphere.faces_packed(), torch.rand(42, 3)
    features[0], features[1] = 1.0, 0.0
    mesh = Meshes([verts], [faces], TexturesVertex([features]), verts_normals=[torch.randn(42, 3)])
    IO().save_mesh(mesh, tmp_path / "m.off")
    assert (tmp_path / "m.off").read_text().startswith("CNOFF\n42 80 0\n")
    back = IO().load_mesh(tmp_path / "m.off")
    assert torch.equal(back.verts_packed(), verts)
    assert torch.equal(back.faces_packed(), faces)
    assert torch.equal(back.verts_normals_packed(), mesh.verts_normals_packed())
    assert torch.equal(back.textures.verts_features_packed(), features)
    assert IO().load_mesh(tmp_path / "m.off", include_textures=False).textures is None


def test_black_and_white_come_back(tmp_path):
    for value in (0.0, 1.0):
        mesh = Meshes([torch.eye(3)], [torch.tensor([[0, 1, 2]])], TexturesVertex([torch.full((3, 3), value)]))
        for options in ({}, {"colors_as_uint8": True}):
            IO().save_mesh(mesh, tmp_path / "m.off", **options)
            assert (IO().load_mesh(tmp_path / "m.off").textures.verts_features_packed() == value).all()


def test_face_colours_are_an_atlas(tmp_path):
    atlas = torch.rand(80, 1, 1, 3)
    sphere = ico_sphere(1)
    sphere.textures = TexturesAtlas([atlas])
    IO().save_mesh(sphere, tmp_path / "m.off")
    assert torch.equal(IO().load_mesh(tmp_path / "m.off").textures.atlas_packed(), atlas)
    mesh = load(tmp_path, f"OFF\n4 2 0\n{VERTS}4 0 1 2 3 255 0 51\n3 0 1 2\n")
    assert_close(mesh.textures.atlas_packed()[:, 0, 0], [[1, 0, 0.2], [1, 0, 0.2], [1, 1, 1]])


@pytest.mark.parametrize(
    "text",
    [
        f"OFF\n4 2 6\n{VERTS}3 0 1 2\n3 0 2 3\n",
        f"# made by hand\n\nOFF # really\n# counts\n4 2 6 # and edges\n\n{VERTS}# faces\n3 0 1 2 # one\n\n3 0 2 3",
        f"OFF 4 2 6\n{VERTS}3 0 1 2\n3 0 2 3\n",
        f"OFF4 2 6\n{VERTS}3 0 1 2\n3 0 2 3\n",  # as many files of ModelNet40 have it
        f"OFF\n4 2\n{VERTS}4 0 1 2 3\n3 0 2 3 7\n".replace("4 0 1 2 3", "3  0\t1 2  "),
        f"OFF\r\n4 2 6\r\n{VERTS}3 0 1 2\r\n3 0 2 3\r\n".replace("\r\n", "\n").replace("\n", "\r\n"),
        f"OFF\n4 1 6\n{VERTS}4 0 1 2 3\n",
        "\ufeffOFF\n4 1 6\n" + VERTS + "4 0 1 2 3\n",
    ],
)
def test_forms_of_the_same_mesh(tmp_path, text):
    mesh = load(tmp_path, text)
    assert mesh.verts_packed().tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    assert mesh.faces_packed().tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.textures is None


@pytest.mark.parametrize(
    ("keyword", "row", "color", "normal"),
    [
        ("COFF", "0 0 0 255 0 51", [1, 0, 0.2], None),
        ("COFF", "0 0 0 255 0 51 9", [1, 0, 0.2], None),
        ("COFF", "0 0 0 1. 0 .2 1", [1, 0, 0.2], None),
        ("COFF", "0 0 0 1 0 0", [1 / 255, 0, 0], None),
        ("OFF", "0 0 0 1 0 5e-1", [1, 0, 0.5], None),
        ("NOFF", "0 0 0 0 -1 0", None, [0, -1, 0]),
        ("STCNOFF", "0 0 0 0 -1 0 255 0 51 255 .5 .5", [1, 0, 0.2], [0, -1, 0]),
        ("STOFF", "0 0 0 .5 .5", None, None),
    ],
)
def test_what_vertices_carry(tmp_path, keyword, row, color, normal):
    mesh = load(tmp_path, f"{keyword}\n2 0 0\n{row}\n{row}\n")
    assert mesh.verts_packed().tolist() == [[0, 0, 0]] * 2
    if color is not None:
        assert_close(mesh.textures.verts_features_packed(), [color] * 2)
    assert (mesh.textures is None) == (color is None)
    assert mesh.has_verts_normals() == (normal is not None)
    if normal is not None:
        assert mesh.verts_normals_packed().tolist() == [normal] * 2


MALFORMED = [
    ("", 1, "no OFF file"),
    ("ply\n", 1, "no OFF file; found 'ply'; expected 'OFF'"),
    ("OFF\n", 1, "the file ends behind its keyword"),
    ("OFF BINARY\n\0\0", 1, "binary OFF is not supported"),
    ("4OFF\n1 0 0\n", 1, "other than three dimensions"),
    ("OFF\n1\n", 2, "bad counts"),
    ("OFF\n-1 0 0\n", 2, "bad counts"),
    ("OFF\n1e9 0 0\n", 2, "bad counts"),
    ("OFF\n" + "9" * 5000 + " 0 0\n", 2, "bad counts"),
    ("OFF\n1000000000 1000000000 0\n0 0 0\n", 2, "shorter than its header says: 1 lines"),
    ("OFF\n1 0 0\n0 0\n", 3, "a vertex cannot have 2 numbers here; found '0 0'; expected 3, 6, 7"),
    ("OFF\n2 0 0\n0 0 0\n0 0 0 1 1 1\n", 4, "the same in every line"),
    ("COFF\n1 0 0\n0 0 0\n", 3, "a vertex cannot have 3 numbers here"),
    ("OFF\n1 0 0\n0 x 0\n", 3, "cannot read 'x'"),
    ("OFF\n1 0 0\n0 nan 0\n", 3, "not finite in single precision"),
    ("OFF\n1 0 0\n0 1e39 0\n", 3, "not finite in single precision"),
    (f"OFF\n4 1 0\n{VERTS}2 0 1\n", 7, "at least three corners"),
    (f"OFF\n4 1 0\n{VERTS}-3 0 1\n", 7, "at least three corners"),
    (f"OFF\n4 1 0\n{VERTS}3.5 0 1 2 3\n", 7, "no whole number"),
    (f"OFF\n4 1 0\n{VERTS}nan 0 1 2 3\n", 7, "no whole number"),
    (f"OFF\n4 1 0\n{VERTS}1e18 0 1 2\n", 7, "the line ends before the corners do"),
    (f"OFF\n4 1 0\n{VERTS}3 0 1\n", 7, "the line ends before the corners do"),
    (f"OFF\n4 1 0\n{VERTS}3 0 1 4\n", 7, "no such vertex; found '3 0 1 4'; expected an index from 0 to 3"),
    (f"OFF\n4 1 0\n{VERTS}3 0 1 -1\n", 7, "no such vertex"),
    (f"OFF\n4 1 0\n{VERTS}3 0 1 nan\n", 7, "no such vertex"),
    (f"OFF\n4 1 0\n{VERTS}3 0 1 .5\n", 7, "no such vertex"),
    (f"OFF\n4 1 0\n{VERTS}3 0 1 2 9 9\n", 7, "2 numbers behind the corners"),
    (f"OFF\n4 1 0\n{VERTS}3 0 1 2 nan 0 0\n", 7, "not finite"),
    ("OFF\n0 1 0\n3 0 0 0\n", 3, "as there is no vertex"),
]


@pytest.mark.parametrize(("text", "line", "message"), MALFORMED)
def test_malformed_off(text, line, message):
    with pytest.raises(MeshFormatError) as caught:
        parse_off(Source("bad.off", text.encode(), "."))
    assert str(caught.value).startswith(f"bad.off, line {line}: ")
    assert message in str(caught.value)
    assert len(str(caught.value)) < 400


def test_what_follows_is_said(tmp_path):
    with pytest.warns(UserWarning, match="line 7 and what follows is neither vertex nor face"):
        load(tmp_path, f"OFF\n4 0 0\n{VERTS}3 0 1 2\n")


def test_empty_meshes_and_clouds(tmp_path):
    mesh = Meshes([torch.zeros(0, 3)], [torch.zeros(0, 3, dtype=torch.int64)])
    IO().save_mesh(mesh, tmp_path / "m.off")
    assert len(IO().load_mesh(tmp_path / "m.off").verts_packed()) == 0
    cloud = Pointclouds([torch.randn(5, 3)], features=[torch.rand(5, 3)])
    IO().save_pointcloud(cloud, tmp_path / "c.off")
    back = IO().load_pointcloud(tmp_path / "c.off")
    assert torch.equal(back.points_packed(), cloud.points_packed())
    assert torch.equal(back.features_packed(), cloud.features_packed())


def test_what_off_cannot_hold(tmp_path):
    uv = TexturesUV(torch.rand(1, 4, 4, 3), [torch.tensor([[0, 1, 2]])], [torch.rand(3, 2)])
    with pytest.warns(UserWarning, match="not this TexturesUV; it is not saved"):
        IO().save_mesh(Meshes([torch.eye(3)], [torch.tensor([[0, 1, 2]])], uv), tmp_path / "m.off")
    before = (tmp_path / "m.off").read_bytes()
    with pytest.raises(ValueError, match="OFF is written as text"):
        IO().save_mesh(ico_sphere(0), tmp_path / "m.off", binary=True)
    with pytest.raises(ValueError, match="decimal_places is -1"):
        IO().save_mesh(ico_sphere(0), tmp_path / "m.off", decimal_places=-1)
    bad = Meshes([torch.full((3, 3), torch.nan)], [torch.tensor([[0, 1, 2]])])
    with pytest.raises(ValueError, match="not finite"):
        IO().save_mesh(bad, tmp_path / "m.off")
    assert (tmp_path / "m.off").read_bytes() == before


def test_trimesh_and_this_package_understand_each_other(tmp_path):
    IO().save_mesh(ico_sphere(1), tmp_path / "m.off")
    found = trimesh.load(tmp_path / "m.off", process=False)
    assert_close(torch.tensor(found.vertices), ico_sphere(1).verts_packed().tolist(), atol=0)
    (tmp_path / "t.off").write_text(found.export(file_type="off"))
    back = IO().load_mesh(tmp_path / "t.off")
    assert_close(back.verts_packed(), ico_sphere(1).verts_packed(), atol=1e-6)
    assert torch.equal(back.faces_packed(), ico_sphere(1).faces_packed())
