"""OBJ files: what is read, what is written, and that the two agree."""

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from assertions import assert_close
from PIL import Image

from rendra.io import load_obj, load_objs_as_meshes, save_obj
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesUV, TexturesVertex

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def read(text: str) -> tuple:
    return load_obj(io.StringIO(text))


def faces_of(text: str) -> list:
    return read(text)[1].verts_idx.tolist()


# Real files


@pytest.mark.parametrize(
    ("name", "num_verts", "num_faces", "num_uvs", "num_normals"),
    [
        ("cow/cow.obj", 2930, 5856, 3225, 0),
        ("teapot.obj", 1292, 2464, 0, 1289),
        ("cube/cube_texture.obj", 8, 12, 14, 6),
    ],
)
def test_real_files_have_the_sizes_that_their_lines_say(
    shared_data, name, num_verts, num_faces, num_uvs, num_normals
):
    verts, faces, properties = load_obj(shared_data / name)
    assert verts.shape == (num_verts, 3)
    assert verts.dtype == torch.float32
    assert faces.verts_idx.shape == (num_faces, 3)
    assert faces.verts_idx.dtype == torch.int64
    assert (0 if properties.verts_uvs is None else len(properties.verts_uvs)) == num_uvs
    assert (0 if properties.normals is None else len(properties.normals)) == num_normals


def test_cow_agrees_with_a_reader_of_three_lines(shared_data):
    path = shared_data / "cow" / "cow.obj"
    lines = [line.split() for line in path.read_text().splitlines()]
    expected_verts = torch.tensor([[float(x) for x in line[1:]] for line in lines if line[:1] == ["v"]])
    expected_faces = [[int(c.split("/")[0]) - 1 for c in line[1:]] for line in lines if line[:1] == ["f"]]
    verts, faces, properties = load_obj(path)
    assert torch.equal(verts, expected_verts)
    assert faces.verts_idx.tolist() == expected_faces
    assert (faces.normals_idx == -1).all()
    assert (faces.materials_idx == 0).all()
    assert properties.texture_images["material_1"].shape == (1024, 1024, 3)
    assert_close(properties.material_colors["material_1"]["shininess"], [10.0])
    assert_close(properties.material_colors["material_1"]["specular_color"], [0.0, 0.0, 0.0])


def test_cow_becomes_a_textured_mesh(shared_data):
    cow = shared_data / "cow" / "cow.obj"
    mesh = load_objs_as_meshes([cow])
    assert isinstance(mesh.textures, TexturesUV)
    assert mesh.textures.maps_padded().shape == (1, 1024, 1024, 3)
    assert len(load_objs_as_meshes([str(cow), cow], load_textures=False)) == 2
    assert load_objs_as_meshes([cow], load_textures=False).textures is None


# The statements


def test_every_form_of_a_corner():
    text = SQUARE + "vt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 1\nvn 0 1 0\nvn 1 0 0\n"
    text += "f 1 2 3\nf 1/1 2/2 3/3\nf 1//1 2//2 3//3\nf 1/3/1 2/2/2 3/1/3\nf 1/1/ 2/2/ 3/3/\n"
    _, faces, _ = read(text)
    assert faces.verts_idx.tolist() == [[0, 1, 2]] * 5
    none, run, back = [-1] * 3, [0, 1, 2], [2, 1, 0]
    assert faces.textures_idx.tolist() == [none, run, none, back, run]
    assert faces.normals_idx.tolist() == [none, none, run, run, none]
    assert faces.materials_idx.tolist() == [-1] * 5


def test_negative_indices_count_from_what_stands_above_them():
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 5 5 5\nf -3 -2 -1\nf -4 +2 3\n"
    assert faces_of(text) == [[0, 1, 2], [1, 2, 3], [0, 1, 2]]


def test_positive_indices_may_name_what_stands_below_them():
    assert faces_of("f 1 2 3\n" + SQUARE) == [[0, 1, 2]]


def test_polygons_become_fans_and_keep_their_materials():
    text = SQUARE + "v 2 2 2\nusemtl a\nf 1 2 3 4\nusemtl b\nf 1 2 3\nf 1 2 3 4 5\n"
    with pytest.warns(UserWarning, match="No mtl file provided"):
        _, faces, properties = read(text)
    assert faces.verts_idx.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 3, 4]]
    assert faces.materials_idx.tolist() == [0, 0, 1, 1, 1, 1]
    assert properties.material_colors is None
    assert properties.texture_images is None


@pytest.mark.parametrize(
    "text",
    [
        SQUARE.replace("\n", "\r\n") + "f 1 2 3\r\n",
        SQUARE.replace("\n", "\r") + "f 1 2 3\r",
        "\ufeff" + SQUARE + "f 1 2 3",
        "# head\n\n" + SQUARE.replace(" ", "\t") + "\tf  1\t2 3   \n",
        SQUARE.replace("\n", " # a corner, not 7 8 9\n") + "f 1 2 3#end\n",
        "\n".join("  " + line for line in SQUARE.splitlines()) + "\nf 1 \\\n 2 \\\r\n3\n",
        "# a path C:\\temp\\\n" + SQUARE + "o thing\ng one two\ns off\nf 1 2 3\nl 1 2\np 1\n",
        SQUARE.replace(" 0\n", " 0 1.0\n") + "f 1 2 3\n",
    ],
    ids=["crlf", "cr", "mark", "tabs", "comments", "continued", "passed over", "w"],
)
def test_spellings_of_the_same_mesh(text):
    verts, faces, _ = read(text)
    assert verts.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert faces.verts_idx.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("text", ["", "\n\n", "# nothing\n", "o empty\ng g\n", "v 1 2 3\n"])
def test_files_without_faces(text):
    verts, faces, properties = read(text)
    assert verts.shape == (text.count("v "), 3)
    assert faces.verts_idx.shape == faces.normals_idx.shape == faces.textures_idx.shape == (0, 3)
    assert faces.materials_idx.shape == (0,)
    assert properties == (None, None, None, None, None)


def test_interleaved_statements_keep_their_order():
    rows = [f"v {i} 0 0\nvn 0 0 {i}\nvt {i} 1\n" for i in range(50)]
    faces = [f"f {i}/{i}/{i} {i + 1}/{i + 1}/{i + 1} {i + 2}/{i + 2}/{i + 2}\n" for i in range(1, 49)]
    verts, read_faces, properties = read("".join(a + b for a, b in zip(rows, [*faces, "", ""], strict=True)))
    assert verts[:, 0].tolist() == properties.normals[:, 2].tolist() == properties.verts_uvs[:, 0].tolist()
    assert read_faces.verts_idx.tolist() == [[i, i + 1, i + 2] for i in range(48)]


def test_handles_of_both_kinds_and_paths_agree(tmp_path):
    path = tmp_path / "square.obj"
    path.write_text(SQUARE + "f 1 2 3 4\n")
    with path.open() as text, path.open("rb") as binary:
        read_all = [load_obj(f) for f in (path, str(path), text, binary)]
    for verts, faces, _ in read_all[1:]:
        assert torch.equal(verts, read_all[0][0])
        assert torch.equal(faces.verts_idx, read_all[0][1].verts_idx)


def test_what_is_no_file():
    with pytest.raises(TypeError, match="expected a path or an open file, got int"):
        load_obj(3)
    with pytest.raises(FileNotFoundError):
        load_obj("no/such.obj")
    with pytest.raises(TypeError, match="expected a list of paths"):
        load_objs_as_meshes("one.obj")
    with pytest.raises(ValueError, match="files is empty"):
        load_objs_as_meshes([])


# Colours, textures, atlas


def test_vertex_colours_become_a_texture_where_nothing_else_is():
    text = "v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1 0\nf 1 2 3\n"
    mesh = load_objs_as_meshes([io.StringIO(text)])
    assert isinstance(mesh.textures, TexturesVertex)
    assert mesh.textures.verts_features_packed().tolist() == [[1, 0, 0], [0, 1, 0], [1, 1, 1]]
    of_255 = load_objs_as_meshes([io.StringIO(text.replace("1 0 0\n", "255 0 51\n", 1))])
    assert_close(of_255.textures.verts_features_packed()[0], [1.0, 0.0, 0.2])
    plain = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    assert load_objs_as_meshes([io.StringIO(text), io.StringIO(plain)]).textures is None


def write_textured(folder: Path, image: np.ndarray, material: str = "map_Kd image.png\n") -> Path:
    folder.mkdir(exist_ok=True)
    Image.fromarray(image).save(folder / "image.png")
    (folder / "mesh.mtl").write_text("newmtl paint\nKd 0.5 0.25 1\n" + material)
    obj = folder / "mesh.obj"
    obj.write_text(f"mtllib mesh.mtl\n{SQUARE}vt 0 0\nvt 1 0\nvt 1 1\nusemtl paint\nf 1/1 2/2 3/3\nf 1 3 4\n")
    return obj


CHECKER = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], dtype=np.uint8)


def test_texture_image_and_colours_arrive(tmp_path):
    _, faces, properties = load_obj(write_textured(tmp_path, CHECKER))
    assert_close(properties.texture_images["paint"], torch.from_numpy(CHECKER / 255.0))
    assert set(properties.material_colors["paint"]) == {"diffuse_color"}
    assert faces.textures_idx.tolist() == [[0, 1, 2], [-1, -1, -1]]
    _, _, bare = load_obj(write_textured(tmp_path, CHECKER), load_textures=False)
    assert bare.material_colors is None
    assert bare.texture_images is None


def test_atlas_takes_image_or_diffuse_colour(tmp_path):
    obj = write_textured(tmp_path, np.full((4, 4, 3), 51, dtype=np.uint8))
    _, _, properties = load_obj(obj, create_texture_atlas=True, texture_atlas_size=3)
    assert properties.texture_atlas.shape == (2, 3, 3, 3)
    assert_close(properties.texture_atlas[0], torch.full((3, 3, 3), 0.2))
    assert_close(properties.texture_atlas[1], torch.tensor([0.5, 0.25, 1.0]).expand(3, 3, 3))
    mesh = load_objs_as_meshes([obj], create_texture_atlas=True)
    assert isinstance(mesh.textures, TexturesAtlas)


def test_faces_without_coordinates_are_named_in_a_warning(tmp_path):
    with pytest.warns(UserWarning, match="no texture coordinates"):
        mesh = load_objs_as_meshes([write_textured(tmp_path, CHECKER)])
    assert mesh.textures.faces_uvs_list()[0].tolist() == [[0, 1, 2], [0, 0, 0]]


def test_what_is_missing_is_a_warning(tmp_path):
    obj = write_textured(tmp_path, CHECKER, "map_Kd lost.png\n")
    with pytest.warns(UserWarning, match=r"Texture file does not exist: .*lost\.png"):
        assert load_obj(obj)[2].texture_images == {}
    (tmp_path / "mesh.mtl").write_text("newmtl other\n")
    with pytest.warns(UserWarning, match=r"'paint' is used, but .*mesh\.mtl does not define it"):
        load_obj(obj)
    (tmp_path / "mesh.mtl").unlink()
    with pytest.warns(UserWarning, match=r"Mtl file does not exist: .*mesh\.mtl"):
        assert load_obj(obj)[2].material_colors is None


def test_several_textures_use_the_first_and_say_so(tmp_path):
    obj = write_textured(tmp_path, CHECKER)
    Image.new("RGB", (3, 5)).save(tmp_path / "second one.png")
    (tmp_path / "more things.mtl").write_text("newmtl second\nmap_Kd -o 0 0 -clamp on second one.png\n")
    text = obj.read_text().replace("f 1 3 4", "usemtl second\nf 1/1 3/3 4/2")
    obj.write_text(text + "mtllib more things.mtl\n")
    _, faces, properties = load_obj(obj)
    assert faces.materials_idx.tolist() == [0, 1]
    assert {name: tuple(image.shape) for name, image in properties.texture_images.items()} == {
        "paint": (2, 2, 3),
        "second": (5, 3, 3),
    }
    with pytest.warns(UserWarning, match="has 2 texture images, and only that of 'paint'"):
        mesh = load_objs_as_meshes([obj])
    assert mesh.textures.maps_padded().shape == (1, 2, 2, 3)


# Writing


def mesh_tensors(seed: int = 0) -> dict:
    generator = torch.Generator().manual_seed(seed)
    return {
        "verts": torch.randn(7, 3, generator=generator),
        "faces": torch.randint(7, (11, 3), generator=generator),
        "normals": torch.randn(5, 3, generator=generator),
        "faces_normals_idx": torch.randint(5, (11, 3), generator=generator),
        "verts_uvs": torch.rand(6, 2, generator=generator),
        "faces_uvs": torch.randint(6, (11, 3), generator=generator),
    }


@pytest.mark.parametrize("with_normals", [False, True])
@pytest.mark.parametrize("with_uvs", [False, True])
@pytest.mark.parametrize("to_path", [False, True])
def test_what_is_written_is_read(tmp_path, with_normals, with_uvs, to_path):
    given = mesh_tensors()
    options = {k: v for k, v in given.items() if ("normals" in k and with_normals) or ("uvs" in k and with_uvs)}
    sink = tmp_path / "mesh.obj" if to_path else io.StringIO()
    save_obj(sink, given["verts"], given["faces"], 8, **options)
    verts, faces, properties = load_obj(sink if to_path else io.StringIO(sink.getvalue()))
    assert_close(verts, given["verts"], atol=1e-8, rtol=1e-6)
    assert torch.equal(faces.verts_idx, given["faces"])
    assert (properties.normals is not None) == with_normals
    assert (properties.verts_uvs is not None) == with_uvs
    if with_normals:
        assert_close(properties.normals, given["normals"], atol=1e-8, rtol=1e-6)
        assert torch.equal(faces.normals_idx, given["faces_normals_idx"])
    if with_uvs:
        assert_close(properties.verts_uvs, given["verts_uvs"], atol=1e-8, rtol=1e-6)
        assert torch.equal(faces.textures_idx, given["faces_uvs"])


def test_text_of_a_small_file():
    sink = io.StringIO()
    save_obj(sink, torch.tensor([[0.125, -1.0, 2.0]]), torch.tensor([[0, 0, 0]]), decimal_places=2)
    assert sink.getvalue() == "v 0.12 -1.00 2.00\nf 1 1 1\n"
    binary = io.BytesIO()
    save_obj(binary, torch.zeros(1, 3), torch.zeros(0, 3, dtype=torch.int64))
    assert binary.getvalue() == b"v 0.000000 0.000000 0.000000\n"


@pytest.mark.parametrize("image_format", ["png", "jpeg"])
def test_texture_round_trip(tmp_path, image_format):
    given = mesh_tensors()
    ramp = torch.linspace(0, 1, 16 * 16 * 3).reshape(16, 16, 3)
    path = tmp_path / "a model.obj"
    save_obj(path, **given, texture_map=ramp, image_format=image_format, image_quality=95)
    _, _, properties = load_obj(path)
    assert_close(properties.texture_images["mesh"], ramp, atol=0.5 / 255 + 1e-6 if image_format == "png" else 0.02)
    suffix = {"png": "png", "jpeg": "jpg"}[image_format]
    assert {each.name for each in tmp_path.iterdir()} == {f"a model.{end}" for end in ("mtl", "obj", suffix)}


def test_normals_without_indices_are_those_of_the_vertices():
    given, sink = mesh_tensors(), io.StringIO()
    save_obj(sink, given["verts"], given["faces"], normals=given["verts"])
    _, faces, _ = read(sink.getvalue())
    assert torch.equal(faces.normals_idx, given["faces"])


def test_empty_meshes_can_be_written():
    sink = io.StringIO()
    save_obj(sink, torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64))
    assert sink.getvalue() == ""
    save_obj(sink, torch.tensor([]), torch.tensor([]))
    assert sink.getvalue() == ""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"verts": torch.zeros(4, 2)}, r"'verts' should either be empty or of shape \(num_verts, 3\); got \(4, 2\)"),
        (
            {"faces": torch.zeros(4, dtype=torch.int64)},
            r"'faces' should either be empty or of shape \(num_faces, 3\)",
        ),
        ({"faces": torch.zeros(4, 3)}, "'faces' should hold integers"),
        ({"faces": torch.full((11, 3), 7)}, r"Faces have invalid indices: row 0 of 'faces' is \[7, 7, 7\], limit 7"),
        ({"verts": torch.full((7, 3), torch.nan)}, "'verts' is not finite in row 0"),
        ({"verts_uvs": None}, "go together"),
        ({"faces_uvs": torch.zeros(3, 3, dtype=torch.int64)}, "faces_uvs has 3 rows, but faces has 11"),
        ({"normals": None}, "without normals"),
        ({"faces_normals_idx": None}, "has 5 rows, but verts has 7"),
        ({"decimal_places": 1.5}, "decimal_places is 1.5"),
        ({"decimal_places": -1}, "decimal_places is -1"),
        ({"texture_map": torch.zeros(4, 4)}, r"should be of shape \(H, W, 3\); got \(4, 4\)"),
        ({"texture_map": torch.zeros(4, 4, 3), "image_format": "bmp"}, "image_format is 'bmp'"),
        ({"texture_map": torch.zeros(4, 4, 3), "verts_uvs": None, "faces_uvs": None}, "without verts_uvs"),
        ({"verts_colors": torch.zeros(3, 3)}, "verts_colors has 3 rows, but verts has 7"),
    ],
)
def test_what_cannot_be_written_is_refused_before_anything_is(tmp_path, change, message):
    path = tmp_path / "mesh.obj"
    with pytest.raises(ValueError, match=message):
        save_obj(path, **(mesh_tensors() | change))
    assert list(tmp_path.iterdir()) == []


def test_a_texture_needs_a_path():
    with pytest.raises(ValueError, match="f must be a path"):
        save_obj(io.StringIO(), **mesh_tensors(), texture_map=torch.zeros(2, 2, 3))


def test_a_failing_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "mesh.obj"
    path.write_text("old")

    def full_disk(*_: object) -> None:
        raise OSError(28, "no space left")

    monkeypatch.setattr("rendra.io._source.os.replace", full_disk)
    with pytest.raises(OSError, match="no space left"):
        save_obj(path, torch.zeros(1, 3), torch.zeros(0, 3, dtype=torch.int64))
    assert path.read_text() == "old"
    assert [each.name for each in tmp_path.iterdir()] == ["mesh.obj"]


def test_gradients_do_not_stand_in_the_way():
    sink = io.StringIO()
    save_obj(sink, torch.zeros(1, 3, dtype=torch.float64, requires_grad=True), torch.zeros(0, 3, dtype=torch.int32))
    assert sink.getvalue().startswith("v 0.0")
