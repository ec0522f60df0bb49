from pathlib import Path

import numpy as np
import pytest
import torch
from assertions import assert_close
from PIL import Image

from rendra.io import IO, save_obj, save_ply
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesUV, TexturesVertex
from rendra_lab.data.meshes import bounding_sphere, load_mesh, make_cube

TRIANGLE = torch.tensor([[1.0, 1, 1], [3, 1, 1], [1, 5, 1]])
SMALL_COW = {"texture_size": 128, "num_faces": 2000}


@pytest.fixture
def triangle(tmp_path: Path) -> Path:
    path = tmp_path / "triangle.obj"
    save_obj(path, TRIANGLE, torch.tensor([[0, 1, 2]]))
    return path


def test_the_default_is_the_textured_cow() -> None:
    mesh = load_mesh(**SMALL_COW)
    assert isinstance(mesh.textures, TexturesUV)
    assert len(mesh) == 1
    other = load_mesh(seed=1, breed="grey", build={"horn_length": 0.5}, **SMALL_COW)
    assert not torch.equal(mesh.textures.maps_padded(), other.textures.maps_padded())


def test_a_cow_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    how = {"cache": tmp_path, "texture_size": 128, "num_faces": 2000}
    first = load_mesh("cow", **how)
    load_mesh("cow", **how, seed=1)
    load_mesh("cow", **how, build={"head": 1.1})
    load_mesh("cow", **how, breed="grey")
    assert len(list(tmp_path.iterdir())) == 4
    monkeypatch.setattr("rendra_lab.data.meshes.build_cow", None)
    again, plain = load_mesh("cow", **how), load_mesh("cow", texture_size=128, num_faces=2000)
    for other in (again, plain):
        assert torch.equal(other.verts_packed(), first.verts_packed())
        assert torch.equal(other.faces_packed(), first.faces_packed())
        for part in ("verts_uvs_padded", "faces_uvs_padded", "maps_padded"):
            assert torch.equal(getattr(other.textures, part)(), getattr(first.textures, part)())


@pytest.mark.parametrize(
    ("name", "options", "faces"),
    [
        ("ico_sphere", {"level": 1}, 80),
        ("torus", {"r": 0.1, "R": 0.5, "sides": 5, "rings": 7}, 70),
        ("cube", {}, 12),
    ],
)
def test_own_meshes_are_white(name: str, options: dict, faces: int) -> None:
    mesh = load_mesh(name, **options)
    assert len(mesh.faces_packed()) == faces
    assert isinstance(mesh.textures, TexturesVertex)
    assert (mesh.textures.verts_features_packed() == 1).all()


def test_the_cube_looks_outwards() -> None:
    cube = make_cube()
    corners = cube.verts_packed()[cube.faces_packed()]
    assert ((cube.faces_normals_packed() * corners.mean(1)).sum(1) > 0.5).all()
    assert cube.faces_areas_packed().sum() == pytest.approx(24)
    assert len(cube.verts_packed().unique(dim=0)) == 8


def test_a_file_is_left_where_it_is_and_made_white(triangle: Path) -> None:
    mesh = load_mesh(path=triangle, seed=3)
    assert_close(mesh.verts_packed(), TRIANGLE)
    assert (mesh.textures.verts_features_packed() == 1).all()


def test_a_ply_file_keeps_its_colours(tmp_path: Path) -> None:
    mesh = load_mesh("ico_sphere", level=0)
    mesh.textures = TexturesVertex([torch.rand_like(mesh.verts_packed())])
    IO().save_mesh(mesh, tmp_path / "ball.ply")
    read = load_mesh(path=tmp_path / "ball.ply")
    assert_close(read.textures.verts_features_packed(), mesh.textures.verts_features_packed(), atol=1 / 255, rtol=0)


def test_a_textured_file_keeps_its_texture(shared_data: Path) -> None:
    assert isinstance(load_mesh(path=shared_data / "cow" / "cow.obj").textures, TexturesUV)


def test_normalisations(triangle: Path) -> None:
    centred = load_mesh(path=triangle, normalize="center").verts_packed()
    assert_close(centred, TRIANGLE - torch.tensor([2.0, 3, 1]))
    scaled = load_mesh(path=triangle, normalize="extent", size=1.0).verts_packed()
    assert_close(scaled, centred / 4)
    book = load_mesh(path=triangle, normalize="max_abs").verts_packed()
    assert_close(book.mean(0), [0.0, 0, 0])
    assert book.abs().max() == pytest.approx(1)


def test_bounding_sphere_holds_every_vertex(triangle: Path) -> None:
    centre, radius = bounding_sphere(load_mesh(path=triangle))
    assert_close(centre, [2.0, 3, 1])
    assert radius == pytest.approx(np.sqrt(5))


def test_mistakes_are_named(tmp_path: Path, triangle: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no mesh file .*nowhere.obj"):
        load_mesh(path=tmp_path / "nowhere.obj")
    with pytest.raises(FileNotFoundError, match="it is a folder"):
        load_mesh(path=tmp_path)
    with pytest.raises(ValueError, match="there is no mesh 'horse'; there are cow, ico_sphere, torus, cube"):
        load_mesh("horse")
    with pytest.raises(ValueError, match=r"'torus' cannot be made with.*legs"):
        load_mesh("torus", legs=4)
    with pytest.raises(ValueError, match=r"null or one of center, extent, max_abs, got 'big'"):
        load_mesh(path=triangle, normalize="big")
    with pytest.raises(ValueError, match=r"mesh.size must be positive"):
        load_mesh(path=triangle, normalize="extent", size=0)
    save_ply(tmp_path / "points.ply", TRIANGLE)
    with pytest.raises(ValueError, match="holds no faces"):
        load_mesh(path=tmp_path / "points.ply")
    (tmp_path / "bad.obj").write_text("v 1 2\nf 1 2 3\n")
    with pytest.raises(ValueError, match=r"bad.obj, line 1"):
        load_mesh(path=tmp_path / "bad.obj")
    save_obj(tmp_path / "dot.obj", torch.ones(3, 3), torch.tensor([[0, 1, 2]]))
    with pytest.raises(ValueError, match="single point"):
        load_mesh(path=tmp_path / "dot.obj", normalize="extent")


def write_obj(folder: Path, materials: str, body: str) -> Path:
    (folder / "two.mtl").write_text(materials)
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
    (folder / "two.obj").write_text(f"mtllib two.mtl\n{corners}{body}")
    return folder / "two.obj"


def test_materials_of_plain_colours_are_seen(tmp_path: Path) -> None:
    materials = "newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\nnewmtl unused\nKd 0 1 0\n"
    path = write_obj(tmp_path, materials, "usemtl red\nf 1 2 3\nusemtl blue\nf 2 4 3\n")
    textures = load_mesh(path=path).textures
    assert isinstance(textures, TexturesAtlas)
    assert_close(textures.atlas_packed().mean((1, 2)), [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("second", ["map_Kd blue.png", "Kd 0 0 1"])
def test_an_image_and_another_material_are_both_seen(tmp_path: Path, second: str) -> None:
    for name, colour in {"red": (255, 0, 0), "blue": (0, 0, 255)}.items():
        Image.new("RGB", (4, 4), colour).save(tmp_path / f"{name}.png")
    materials = f"newmtl a\nmap_Kd red.png\nnewmtl b\n{second}\n"
    path = write_obj(tmp_path, materials, "usemtl a\nf 1/1 2/2 3/3\nusemtl b\nf 2/1 4/2 3/3\n")
    textures = load_mesh(path=path).textures
    assert_close(textures.atlas_packed().mean((1, 2)), [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def test_an_unused_material_leaves_the_only_image_as_it_is(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4), (255, 0, 0)).save(tmp_path / "red.png")
    materials = "newmtl a\nmap_Kd red.png\nnewmtl unused\nKd 0 1 0\n"
    path = write_obj(tmp_path, materials, "usemtl a\nf 1/1 2/2 3/3\nf 2/1 4/2 3/3\n")
    assert isinstance(load_mesh(path=path).textures, TexturesUV)
