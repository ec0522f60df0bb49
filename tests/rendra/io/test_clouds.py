"""Point clouds in files: XYZ, and what PLY and the mesh formats say of points."""

import struct

import pytest
import torch
import trimesh
from assertions import assert_close
from far_device import far  # noqa: F401

from rendra.io import IO, MeshFormatError
from rendra.io._source import Source
from rendra.io.xyz_io import parse_xyz
from rendra.renderer.mesh.textures import TexturesUV, TexturesVertex
from rendra.structures import Meshes, Pointclouds
from rendra.utils.ico_sphere import ico_sphere

UNIT = torch.nn.functional.normalize(torch.tensor([[1.0, 2, 3], [-1, 0.5, 2]]), dim=1)
POINTS, COLORS = torch.tensor([[0.1, 0.2, 0.3], [1e-7, -5, 1e6]]), torch.tensor([[1.0, 0, 0], [0, 0, 1]])
CLOUDS = {
    "bare": Pointclouds([POINTS]),
    "normals": Pointclouds([POINTS], normals=[UNIT]),
    "positive normals": Pointclouds([POINTS], normals=[UNIT.abs()]),
    "colours": Pointclouds([POINTS], features=[COLORS]),
    "dark colours": Pointclouds([POINTS], features=[COLORS * 1e-3]),
    "both": Pointclouds([POINTS], normals=[UNIT], features=[COLORS]),
    "empty": Pointclouds([torch.zeros(0, 3)]),
    "empty with colours": Pointclouds([torch.zeros(0, 3)], features=[torch.zeros(0, 3)]),
}


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("form", ["xyz", "ply", "ascii ply"])
def test_clouds_come_back(tmp_path, name, form):
    path = tmp_path / f"c.{form.split()[-1]}"
    options = {"binary": False, "decimal_places": 12} if form == "ascii ply" else {}
    IO().save_pointcloud(CLOUDS[name], path, **options)
    back = IO().load_pointcloud(path)
    for found, expected in zip(back.get_cloud(0), CLOUDS[name].get_cloud(0), strict=True):
        assert (found is None) == (expected is None)
        if expected is not None:
            assert torch.equal(found, expected)


@pytest.mark.parametrize("suffix", ["glb", "off", "obj"])
def test_mesh_formats_hold_clouds(tmp_path, suffix):
    IO().save_pointcloud(CLOUDS["colours"], tmp_path / f"c.{suffix}")
    back = IO().load_pointcloud(tmp_path / f"c.{suffix}")
    assert_close(back.points_packed(), POINTS, atol=1e-6)
    assert_close(back.features_packed(), COLORS)
    assert back.normals_packed() is None


def test_the_vertices_of_meshes_are_clouds(tmp_path):
    sphere = ico_sphere(1)
    for suffix in ("glb", "gltf", "obj", "off", "ply"):
        IO().save_mesh(sphere, tmp_path / f"m.{suffix}")
        back = IO().load_pointcloud(tmp_path / f"m.{suffix}")
        assert_close(back.points_packed(), sphere.verts_packed(), atol=1e-6)


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply_of_either_order(tmp_path, order):
    name = {"<": "little", ">": "big"}[order]
    head = f"ply\nformat binary_{name}_endian 1.0\nelement vertex 1\n"
    head += "".join(f"property float {c}\n" for c in ("x", "y", "z", "nx", "ny", "nz"))
    head += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    (tmp_path / "c.ply").write_bytes(head.encode() + struct.pack(f"{order}6f3B", 1, 2, 3, 4, 5, 6, 255, 0, 51))
    points, normals, features = IO().load_pointcloud(tmp_path / "c.ply").get_cloud(0)
    assert (points.tolist(), normals.tolist()) == ([[1, 2, 3]], [[4, 5, 6]])
    assert_close(features, [[1, 0, 0.2]])
    assert len(IO().load_mesh(tmp_path / "c.ply").verts_packed()) == 1  # as before: a mesh without faces


def test_ply_colours_as_bytes(tmp_path):
    IO().save_pointcloud(CLOUDS["colours"], tmp_path / "c.ply", colors_as_uint8=True)
    assert b"property uchar red" in (tmp_path / "c.ply").read_bytes()
    assert torch.equal(IO().load_pointcloud(tmp_path / "c.ply").features_packed(), COLORS)


def test_the_pedestrian(shared_data, tmp_path):
    cloud = IO().load_pointcloud(shared_data / "pedestrian.ply")
    assert torch.equal(cloud.points_packed(), IO().load_mesh(shared_data / "pedestrian.ply").verts_packed())
    IO().save_pointcloud(cloud, tmp_path / "p.xyz")
    assert torch.equal(IO().load_pointcloud(tmp_path / "p.xyz").points_packed(), cloud.points_packed())


@pytest.mark.parametrize(
    ("text", "normals", "colors"),
    [
        ("1 2 3\n", None, None),
        ("# x y z\n\n  1\t2 3 # there\r\n", None, None),
        ("1 2 3 0 -1 0\n", [0, -1, 0], None),
        ("1 2 3 0 1 0\n", None, [0, 1, 0]),
        ("# x y z nx ny nz\n1 2 3 0 1 0\n", [0, 1, 0], None),
        ("# x y z r g b\n1 2 3 0 -1 0\n", None, [0, -1, 0]),
        ("1 2 3 255 0 51\n", None, [1, 0, 0.2]),
        ("1 2 3 0 0 1 .5 .5 .5\n", [0, 0, 1], [0.5, 0.5, 0.5]),
    ],
)
def test_what_the_columns_mean(text, normals, colors):
    found = parse_xyz(Source("a.xyz", text.encode(), "."))
    assert found["points"].tolist() == [[1, 2, 3]]
    assert ("normals" in found, "colors" in found) == (normals is not None, colors is not None)
    if normals is not None:
        assert found["normals"].tolist() == [normals]
    if colors is not None:
        assert_close(torch.from_numpy(found["colors"]), [colors])


def test_the_caller_may_name_the_columns(tmp_path):
    (tmp_path / "c.xyz").write_text("1 2 3 0 1 0\n")
    cloud = IO().load_pointcloud(tmp_path / "c.xyz", columns=("x", "y", "z", "nx", "ny", "nz"))
    assert cloud.normals_packed().tolist() == [[0, 1, 0]]
    with pytest.raises(ValueError, match="columns is 'x z y'; expected 'x y z' or"):
        IO().load_pointcloud(tmp_path / "c.xyz", columns=("x", "z", "y"))


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("1 2\n", 1, "2 columns; found '1 2'; expected 3, 6 or 9"),
        ("5\nwater\nO 0 0 0\n", 1, "1 columns"),
        ("1 2 3\n# so\n1 2 3 4\n", 3, "4 columns, where the lines above have 3"),
        ("1 2 3\n1 2 x\n", 2, "cannot read 'x'"),
        ("1,0 2 3\n", 1, "cannot read '1,0'"),
        ("1 2 3\n1 nan 3\n", 2, "not finite in single precision"),
        ("1 2 3\n1 1e39 3\n", 2, "not finite in single precision"),
        ("# x y z r g b\n1 2 3\n", 2, "3 columns; found '1 2 3'; expected 6: x y z r g b"),
        ("1 2 3\0\n1 2 \0\n", 2, "2 columns"),
    ],
)
def test_malformed_xyz(text, line, message):
    with pytest.raises(MeshFormatError) as caught:
        parse_xyz(Source("bad.xyz", text.encode(), "."))
    assert str(caught.value).startswith(f"bad.xyz, line {line}: ")
    assert message in str(caught.value)


def test_what_cannot_be_written(tmp_path):
    five = Pointclouds([POINTS], features=[torch.rand(2, 5)])
    for suffix in ("xyz", "ply", "off", "glb", "obj"):
        with pytest.warns(UserWarning, match="not saved|cannot hold"):
            IO().save_pointcloud(five, tmp_path / f"c.{suffix}")
        assert IO().load_pointcloud(tmp_path / f"c.{suffix}").features_packed() is None
    before = (tmp_path / "c.xyz").read_bytes()
    with pytest.raises(ValueError, match="XYZ is a text format"):
        IO().save_pointcloud(CLOUDS["bare"], tmp_path / "c.xyz", binary=True)
    with pytest.raises(ValueError, match=r"XYZ colours lie in \[0, 1\]; 'features' has 0 to 2"):
        IO().save_pointcloud(Pointclouds([POINTS], features=[COLORS * 2]), tmp_path / "c.xyz")
    for suffix in ("xyz", "ply"):
        with pytest.raises(ValueError, match=r"'(points|verts)' is not finite"):
            IO().save_pointcloud(Pointclouds([POINTS * torch.nan]), tmp_path / f"c.{suffix}")
    assert (tmp_path / "c.xyz").read_bytes() == before


def test_another_device(tmp_path, far):  # noqa: F811
    """What lies there is written, and what is read goes there."""
    sphere = ico_sphere(1)
    uvs = TexturesUV(torch.rand(1, 4, 4, 3), sphere.faces_list(), [torch.rand(42, 2)])
    mesh = Meshes(sphere.verts_list(), sphere.faces_list(), uvs).to(far)
    colored = Meshes(mesh.verts_list(), mesh.faces_list(), TexturesVertex([mesh.verts_packed() * 0.1 + 0.5]))
    for suffix, each in (("glb", mesh), ("gltf", mesh), ("glb", colored), ("off", colored)):
        IO().save_mesh(each, tmp_path / f"m.{suffix}")
        back = IO().load_mesh(tmp_path / f"m.{suffix}", device=far)
        assert back.device == back.textures.device == far
        assert back.verts_packed().tolist() == mesh.verts_packed().tolist()
    IO().save_mesh(mesh, tmp_path / "m.stl", include_textures=False)
    assert IO().load_mesh(tmp_path / "m.stl", device=far).device == far
    cloud = CLOUDS["both"].to(far)
    for suffix in ("xyz", "ply", "glb", "off"):
        IO().save_pointcloud(cloud, tmp_path / f"c.{suffix}")
        assert IO().load_pointcloud(tmp_path / f"c.{suffix}", device=far).device == far


def test_trimesh_reads_what_is_written(tmp_path):
    for name in ("bare", "colours"):
        for suffix in ("xyz", "ply"):
            IO().save_pointcloud(CLOUDS[name], tmp_path / f"c.{suffix}")
            found = trimesh.load(tmp_path / f"c.{suffix}")
            assert_close(torch.tensor(found.vertices), POINTS.tolist())
