"""`scripts/convert.py`: every format to every other, what is kept, what is refused."""

import importlib.util
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from assertions import assert_close
from small_files import (
    COLORS,
    FACES,
    UVS,
    VERTS,
    colored_obj_asset,
    glb_asset,
    image_bytes,
    obj_asset,
    off_asset,
    ply_asset,
    stl_asset,
    xyz_asset,
)

from rendra.io import IO, load_objs_as_meshes
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesUV, TexturesVertex
from rendra.structures import Meshes, Pointclouds

ROOT = Path(__file__).parents[2]
_spec = importlib.util.spec_from_file_location("convert", ROOT / "scripts" / "convert.py")
program = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(program)

MESHES = (".obj", ".ply", ".glb", ".gltf", ".off", ".stl")
CLOUDS = (".xyz", ".ply", ".obj", ".off", ".glb")


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def put(asset) -> str:
    for name, data in asset.files.items():
        Path(name).write_bytes(data)
    return asset.name


def run(*arguments: str) -> None:
    program.main([str(each) for each in arguments])


def refused(capsys, *arguments: str) -> str:
    """The line with which the program ends."""
    with pytest.raises(SystemExit) as caught:
        run(*arguments)
    assert caught.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    return printed.err


def triangles(path: str) -> torch.Tensor:
    """(F, 3, 3) corners."""
    mesh = IO().load_mesh(path, include_textures=False)
    return mesh.verts_packed()[mesh.faces_packed()]


def centroid_colors(mesh: Meshes) -> torch.Tensor:
    """(F, 3) what the texture shows in the middle of every face."""
    faces = torch.arange(len(mesh.faces_packed())).reshape(1, -1, 1, 1)
    middles = torch.full((1, faces.numel(), 1, 1, 3), 1 / 3)
    return mesh.sample_textures(SimpleNamespace(pix_to_face=faces, bary_coords=middles))[0, :, 0, 0]


def square(textures=None, normals=None) -> Meshes:
    verts = torch.tensor([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 4]])
    return Meshes([verts], [torch.tensor([[0, 1, 2], [0, 2, 3]])], textures, verts_normals=normals)


def uv_texture() -> TexturesUV:
    colors = torch.tensor([[[1.0, 0, 0], [0, 1, 0]], [[0, 0, 1], [1, 1, 1]]])
    corners = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    return TexturesUV(colors[None], [torch.tensor([[0, 1, 2], [0, 2, 3]])], [corners])


CORNER_COLORS = [[0.0, 0, 1], [1, 1, 1], [0, 1, 0], [1, 0, 0]]


@pytest.mark.parametrize("source", MESHES)
@pytest.mark.parametrize("target", MESHES)
def test_every_mesh_format_to_every_other(here, capsys, source, target):
    IO().save_mesh(square(), f"in{source}")
    before = Path(f"in{source}").read_bytes()
    run(f"in{source}", f"out{target}")
    assert_close(triangles(f"out{target}"), triangles(f"in{source}"), atol=1e-6)
    printed = capsys.readouterr()
    assert printed.out == f"out{target}: 4 vertices, 2 faces\n"
    assert printed.err == ""
    assert Path(f"in{source}").read_bytes() == before


@pytest.mark.parametrize("source", CLOUDS)
@pytest.mark.parametrize("target", CLOUDS)
def test_every_cloud_format_to_every_other(here, capsys, source, target):
    points, colors = torch.tensor(VERTS), torch.tensor(COLORS) / 255
    IO().save_pointcloud(Pointclouds([points], features=[colors]), f"in{source}")
    run(f"in{source}", f"out{target}")
    back = IO().load_pointcloud(f"out{target}")
    assert_close(back.points_packed(), points, atol=1e-6)
    assert_close(back.features_packed(), colors, atol=1e-3)
    assert capsys.readouterr().out == f"out{target}: 5 points\n"


@pytest.mark.parametrize(
    "asset",
    [obj_asset(), colored_obj_asset(), ply_asset("binary_big_endian"), off_asset(True), stl_asset(True),
     glb_asset(True), glb_asset(False)],
    ids=lambda asset: asset.name,
)  # fmt: skip
@pytest.mark.parametrize("target", [*MESHES, ".xyz"])
def test_files_of_other_programs(here, asset, target):
    name = put(asset)
    run(name, f"out{target}")
    if target == ".xyz":
        return
    assert_close(triangles(f"out{target}"), triangles(name), atol=1e-6)


# Colours


@pytest.mark.parametrize("source", [".obj", ".glb"])
@pytest.mark.parametrize("target", [".obj", ".glb", ".gltf"])
def test_images_are_kept(here, capsys, source, target):
    IO().save_mesh(square(uv_texture()), f"in{source}")
    run(f"in{source}", f"out{target}")
    assert capsys.readouterr().err == ""
    textures = IO().load_mesh(f"out{target}").textures
    assert_close(textures.maps_padded(), uv_texture().maps_padded(), atol=1e-6)
    uvs = textures.verts_uvs_packed() if hasattr(textures, "verts_uvs_packed") else textures.verts_uvs_list()[0]
    expected = uv_texture().verts_uvs_list()[0][uv_texture().faces_uvs_list()[0]]
    assert_close(uvs[textures.faces_uvs_list()[0]], expected, atol=1e-6)


@pytest.mark.parametrize("target", [".ply", ".off"])
def test_images_go_to_the_vertices_where_there_is_no_other_place(here, capsys, target):
    IO().save_mesh(square(uv_texture()), "in.obj")
    run("in.obj", f"out{target}")
    assert_close(IO().load_mesh(f"out{target}").textures.verts_features_packed(), CORNER_COLORS, atol=1e-6)
    expected = (
        f"convert.py: warning: {target} files hold no image: vertices take the colours, what lies between is lost\n"
    )
    assert capsys.readouterr().err == expected


@pytest.mark.parametrize("source", [".obj", ".ply", ".glb", ".off"])
@pytest.mark.parametrize("target", [".obj", ".ply", ".glb", ".off"])
def test_vertex_colours_are_kept(here, capsys, source, target):
    IO().save_mesh(square(TexturesVertex([torch.tensor(CORNER_COLORS)])), f"in{source}")
    run(f"in{source}", f"out{target}")
    assert capsys.readouterr().err == ""
    assert_close(IO().load_mesh(f"out{target}").textures.verts_features_packed(), CORNER_COLORS, atol=1e-6)


@pytest.mark.parametrize("target", [".obj", ".glb"])
def test_face_colours_become_an_image_and_stay_exact(here, capsys, target):
    colors = torch.tensor([[1.0, 0.2, 0], [0, 0.4, 1]])
    IO().save_mesh(square(TexturesAtlas([colors[:, None, None]])), "in.off")
    run("in.off", f"out{target}")
    assert capsys.readouterr().err == ""
    assert_close(centroid_colors(IO().load_mesh(f"out{target}")), colors, atol=1e-3)


def test_face_colours_at_the_vertices_are_means(here, capsys):
    IO().save_mesh(square(TexturesAtlas([torch.tensor([[1.0, 0, 0], [0, 0, 1]])[:, None, None]])), "in.off")
    run("in.off", "out.ply")
    assert "hold no face colours" in capsys.readouterr().err
    expected = [[0.5, 0, 0.5], [1, 0, 0], [0.5, 0, 0.5], [0, 0, 1]]
    assert_close(IO().load_mesh("out.ply").textures.verts_features_packed(), expected, atol=0.003)


@pytest.mark.parametrize("target", [".obj", ".glb"])
def test_all_materials_of_an_obj_are_kept(here, capsys, target):
    for name, mode in (("a.png", "L"), ("b.png", "RGB")):
        Path(name).write_bytes(image_bytes(mode=mode, size=(8, 8)))
    Path("m.mtl").write_text("newmtl a\nmap_Kd a.png\nnewmtl b\nmap_Kd b.png\nnewmtl c\nKd 0.2 0.4 0.6\n")
    rows = "".join(f"v {i} {j} {k}\n" for k in range(4) for i, j in ((0, 0), (1, 0), (0, 1)))
    faces = "f 1/1 2/2 3/3\nusemtl a\nf 4/1 5/2 6/3\nusemtl b\nf 7/4 8/5 9/6\nusemtl c\nf 10 11 12\n"
    uvs = "vt 0 0\nvt 1 0\nvt 0 1\nvt 3.25 -2\nvt 3.75 -2\nvt 3.5 -1.5\n"
    Path("in.obj").write_text("mtllib m.mtl\n" + rows + uvs + faces)
    run("in.obj", f"out{target}")
    seen = centroid_colors(IO().load_mesh(f"out{target}"))
    atlas = load_objs_as_meshes(["in.obj"], create_texture_atlas=True, texture_atlas_size=1).textures.atlas_packed()
    assert_close(seen, atlas[:, 0, 0], atol=0.003)
    assert_close(seen[[0, 3]], [[1.0, 1, 1], [0.2, 0.4, 0.6]], atol=0.001)
    assert capsys.readouterr().err == ""


def test_faces_without_material_are_white_and_vertex_colours_win(here):
    Path("a.png").write_bytes(image_bytes())
    Path("m.mtl").write_text("newmtl a\nmap_Kd a.png\n")
    corners = "v 0 0 0{0}\nv 1 0 0{0}\nv 0 1 0{0}\n"
    Path("in.obj").write_text(f"mtllib m.mtl\n{corners.format('')}vt 0 0\nusemtl a\nf 1/1 2/1 3/1\nf 1 3 2\n")
    run("in.obj", "out.glb")
    assert_close(centroid_colors(IO().load_mesh("out.glb"))[1], [1.0, 1, 1], atol=0.002)
    Path("m.mtl").write_text("newmtl a\nKd 1 0 0\n")
    Path("in.obj").write_text(f"mtllib m.mtl\n{corners.format(' 0 0 1')}usemtl a\nf 1 2 3\n")
    run("in.obj", "blue.ply")
    assert_close(IO().load_mesh("blue.ply").textures.verts_features_packed(), [[0.0, 0, 1]] * 3, atol=0.002)


def test_what_an_stl_cannot_hold_is_named(here, capsys):
    IO().save_mesh(square(uv_texture(), [torch.eye(4)[:, :3] + 0.1]), "in.obj")
    run("in.obj", "out.stl")
    assert capsys.readouterr().err == (
        "convert.py: warning: .stl files hold no colours: they are dropped\n"
        "convert.py: warning: .stl files hold no normals of vertices: they are dropped\n"
    )
    run("in.obj", "bare.stl", "--no-textures")
    assert "colours" not in capsys.readouterr().err


@pytest.mark.parametrize("target", [".ply", ".glb"])
def test_normals_of_an_obj_are_kept(here, capsys, target):
    normals = torch.nn.functional.normalize(torch.arange(12.0).reshape(4, 3) + 1, dim=1)
    IO().save_mesh(square(None, [normals]), "in.obj", decimal_places=8)
    run("in.obj", f"out{target}")
    assert_close(IO().load_mesh(f"out{target}").verts_normals_packed(), normals, atol=1e-6)
    Path("two.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nvn 0 1 0\nf 1//1 2//1 3//1\nf 1//2 2//2 3//2\n")
    run("two.obj", f"two{target}")
    assert capsys.readouterr().err == (
        "convert.py: warning: normals are not kept: some vertices have several, or none\n"
    )


# Points from meshes


def test_a_mesh_becomes_the_cloud_of_its_vertices(here, capsys):
    IO().save_mesh(square(uv_texture()), "in.obj")
    run("in.obj", "out.xyz")
    run("in.obj", "out.ply", "--vertices")
    assert capsys.readouterr().out == "out.xyz: 4 points\nout.ply: 4 points\n"
    for name in ("out.xyz", "out.ply"):
        cloud = IO().load_pointcloud(name)
        assert_close(cloud.points_packed(), square().verts_packed())
        assert_close(cloud.features_packed(), CORNER_COLORS, atol=1e-6)


@pytest.mark.parametrize("target", [".ply", ".xyz"])
def test_points_are_drawn_from_the_surface(here, target):
    flat = Meshes([square().verts_packed() * torch.tensor([1.0, 1, 0])], square().faces_list(), uv_texture())
    IO().save_mesh(flat, "in.obj")
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        run("in.obj", f"{name}{target}", "--sample", "500", "--seed", str(seed))
    clouds = [IO().load_pointcloud(f"{name}{target}") for name in "abc"]
    points = clouds[0].points_packed()
    assert points.shape == (500, 3)
    assert torch.equal(points, clouds[1].points_packed())
    assert not torch.equal(points, clouds[2].points_packed())
    assert (points[:, 2] == 0).all()
    assert_close(points.mean(0), [1.0, 0.5, 0.0], atol=0.1)
    assert_close(clouds[0].normals_packed(), torch.tensor([0.0, 0, 1]).expand(500, 3))
    u, v = points[:, 0] / 2, points[:, 1]
    assert_close(clouds[0].features_packed()[:, 2], (1 - v), atol=0.51)
    assert_close(clouds[0].features_packed()[:, 1], u, atol=0.01)


# Where things are


def test_turn_shift_and_scale(here):
    IO().save_mesh(square(None, [torch.eye(3).repeat(2, 1)[:4]]), "in.ply")
    run("in.ply", "up.ply", "--up", "z-to-y")
    turned = IO().load_mesh("up.ply")
    assert_close(turned.verts_packed()[3], [0.0, 4.0, -1.0])  # what was up, +z, is +y, and nothing is mirrored
    assert_close(turned.verts_normals_packed()[2], [0.0, 1.0, 0.0])
    run("up.ply", "back.ply", "--up", "y-to-z")
    assert_close(IO().load_mesh("back.ply").verts_packed(), square().verts_packed())
    run("in.ply", "scaled.ply", "--scale", "0.5", "--center")
    assert_close(IO().load_mesh("scaled.ply").verts_packed()[3], [-0.5, 0.25, 1.0])
    run("in.ply", "fit.ply", "--fit", "8")
    assert_close(IO().load_mesh("fit.ply").verts_packed(), 2 * square().verts_packed())


def test_text_and_digits(here):
    IO().save_mesh(square(), "in.obj")
    run("in.obj", "text.ply", "--ascii", "--decimals", "2")
    assert b"2.00 1.00 0.00\n" in Path("text.ply").read_bytes()
    run("text.ply", "binary.ply", "--binary")
    assert b"format binary" in Path("binary.ply").read_bytes()
    run("in.obj", "text.stl", "--ascii")
    assert Path("text.stl").read_bytes().startswith(b"solid")


# What is refused


def test_mistakes_are_one_line(here, capsys):
    IO().save_mesh(square(), "in.obj")
    Path("bad.obj").write_text("v 0 0\n")
    Path("points.ply").write_bytes(ply_asset("ascii", with_faces=False).files["cloud.ply"])
    Path("folder.obj").mkdir()
    Path("one.xyz").write_text("1 2 3\n")
    for arguments, message in [
        (("lost.obj", "out.ply"), "convert.py: there is no file lost.obj\n"),
        (("folder.obj", "out.ply"), "convert.py: there is no file folder.obj (it is a folder)\n"),
        (("in.obj", "folder.obj"), "convert.py: folder.obj is a folder\n"),
        (
            ("in.obj", "out.doc"),
            "convert.py: out.doc: no format has the suffix '.doc'; there are .glb, .gltf, .obj, ",
        ),
        (("in.obj", "out"), "convert.py: out: no format has the suffix ''; there are"),
        (("bad.obj", "out.ply"), "convert.py: bad.obj, line 1: a vertex cannot have 2 numbers"),
        (("in.obj", "in.obj"), "convert.py: in.obj is the input itself\n"),
        (("in.obj", "in.obj", "--force"), "convert.py: in.obj is the input itself\n"),
        (("in.obj", "points.ply"), "convert.py: points.ply exists; --force replaces it\n"),
        (("points.ply", "out.stl"), "convert.py: .stl files hold faces, not points alone\n"),
        (("points.ply", "out.xyz", "--sample", "5"), "convert.py: points.ply holds points without faces"),
        (("in.obj", "out.stl", "--vertices"), "convert.py: .stl files hold faces, not points alone\n"),
        (("in.obj", "out.ply", "--scale", "-1"), "convert.py: scale is -1.0; expected a positive number\n"),
        (("in.obj", "out.ply", "--fit", "nan"), "convert.py: fit is nan; expected a positive number\n"),
        (("in.obj", "out.ply", "--sample", "0"), "convert.py: sample is 0; expected 1 point or more\n"),
        (("in.obj", "out.ply", "--ascii", "--decimals", "99"), "convert.py: decimal_places is 99"),
        (("in.obj", "out.obj", "--binary"), "convert.py: OBJ is a text format"),
        (("one.xyz", "out.xyz", "--fit", "1"), "convert.py: all points coincide"),
        (("in.obj", "no/such/out.ply"), "convert.py: [Errno 2] No such file or directory: 'no/such/out.ply'\n"),
    ]:
        assert refused(capsys, *arguments).startswith(message), arguments
    assert not [each.name for each in here.iterdir() if each.name.startswith("out")]


def test_options_that_exclude_each_other(here, capsys):
    for pair in (("--scale", "1", "--fit", "1"), ("--sample", "1", "--vertices"), ("--ascii", "--binary")):
        with pytest.raises(SystemExit) as caught:
            run("in.obj", "out.ply", *pair)
        assert caught.value.code == 2
        assert "not allowed with" in capsys.readouterr().err


def test_the_input_survives_its_other_names(here, capsys):
    IO().save_mesh(square(), "in.obj")
    os.symlink("in.obj", "link.obj")
    os.link("in.obj", "twin.obj")
    for name in ("link.obj", "twin.obj", "../" + here.name + "/in.obj"):
        assert "is the input itself" in refused(capsys, "in.obj", name, "--force")


def test_nothing_beside_an_obj_is_replaced(here, capsys):
    IO().save_mesh(square(uv_texture()), "in.glb")
    Path("out.png").write_bytes(b"mine")
    assert refused(capsys, "in.glb", "out.obj") == "convert.py: out.png exists; --force replaces it\n"
    assert Path("out.png").read_bytes() == b"mine"
    run("in.glb", "out.obj", "--force")
    assert Path("out.png").read_bytes() != b"mine"
    capsys.readouterr()
    textured = Path("out.obj").rename("renamed.obj")
    assert "may belong to the input renamed.obj" in refused(capsys, textured, "out.obj", "--force")
    assert sorted(each.name for each in here.iterdir()) == ["in.glb", "out.mtl", "out.png", "renamed.obj"]


def test_help_names_every_format(capsys):
    with pytest.raises(SystemExit) as caught:
        run("--help")
    assert caught.value.code == 0
    printed = capsys.readouterr().out
    assert all(suffix in printed for suffix in (".obj", ".ply", ".glb", ".gltf", ".off", ".stl", ".xyz"))


def test_the_small_files_are_what_they_say(here):
    for asset in (ply_asset("ascii"), off_asset(False), stl_asset(False)):
        corners = triangles(put(asset))
        assert_close(corners[0], torch.tensor([VERTS[i] for i in FACES[0]]))
    assert len(IO().load_pointcloud(put(xyz_asset(6))).points_packed()) == len(UVS)
