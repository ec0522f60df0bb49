"""glTF: what is written comes back to the bit, and others read it; what others write is read as they mean it."""

import io
import json
import math
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from assertions import assert_close
from gltf_files import FLOAT, TRIANGLE, UBYTE, UINT, USHORT, Builder
from PIL import Image

from rendra.io import IO
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesUV, TexturesVertex
from rendra.structures import Meshes, Pointclouds
from rendra.utils.ico_sphere import ico_sphere


def load(tmp_path, data: bytes, suffix: str = "glb", **options: Any) -> Meshes:
    path = tmp_path / f"file.{suffix}"
    path.write_bytes(data)
    return IO().load_mesh(path, **options)


def png(*rows: list[tuple[int, int, int]]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.array(rows, dtype=np.uint8)).save(buffer, format="PNG")
    return buffer.getvalue()


def corner_uvs(textures: TexturesUV) -> torch.Tensor:
    return textures.verts_uvs_list()[0][textures.faces_uvs_list()[0]]


def corner_colors(mesh: Meshes) -> torch.Tensor:
    return mesh.textures.faces_verts_textures_packed(mesh.faces_packed())


def image_of(height: int, width: int) -> torch.Tensor:
    return torch.randint(0, 256, (1, height, width, 3)).float() / 255.0


# Writing and reading


@pytest.mark.parametrize("suffix", ["glb", "gltf"])
@pytest.mark.parametrize("rows", [162, 300], ids=["as many as vertices", "seams"])
def test_a_textured_mesh_comes_back_to_the_bit(tmp_path, suffix, rows):
    sphere = ico_sphere(2)
    faces_uvs = torch.randint(0, rows, (320, 3)) if rows == 300 else sphere.faces_packed()
    uvs = torch.rand(rows, 2, dtype=torch.float64).pow(3).float()  # many small ones, for which 1 - v is not exact
    textures = TexturesUV(image_of(7, 5), [faces_uvs], [uvs])
    mesh = Meshes(sphere.verts_list(), sphere.faces_list(), textures, verts_normals=sphere.verts_normals_list())
    IO().save_mesh(mesh, tmp_path / f"m.{suffix}")
    back = IO().load_mesh(tmp_path / f"m.{suffix}")
    assert torch.equal(back.verts_packed(), mesh.verts_packed())
    assert torch.equal(back.faces_packed(), mesh.faces_packed())
    assert torch.equal(back.verts_normals_packed(), mesh.verts_normals_packed())
    assert torch.equal(back.textures.maps_padded(), textures.maps_padded())
    assert torch.equal(corner_uvs(back.textures), corner_uvs(textures))
    assert (back.textures.padding_mode, back.textures.align_corners) == ("border", True)


def test_the_cow_comes_back_to_the_bit(shared_data, tmp_path):
    cow = IO().load_mesh(shared_data / "cow" / "cow.obj")
    IO().save_mesh(cow, tmp_path / "cow.glb")
    back = IO().load_mesh(tmp_path / "cow.glb")
    assert torch.equal(back.verts_packed(), cow.verts_packed())
    assert torch.equal(back.faces_packed(), cow.faces_packed())
    assert torch.equal(back.textures.maps_padded(), cow.textures.maps_padded())
    assert torch.equal(back.textures.verts_uvs_padded(), cow.textures.verts_uvs_padded())
    assert torch.equal(back.textures.faces_uvs_padded(), cow.textures.faces_uvs_padded())


def test_vertices_without_face_stay_where_they_are(tmp_path):
    faces = torch.tensor([[4, 1, 3]])
    textures = TexturesUV(image_of(2, 2), [torch.tensor([[0, 1, 1]])], [torch.rand(2, 2)])
    mesh = Meshes([torch.randn(6, 3)], [faces], textures)
    IO().save_mesh(mesh, tmp_path / "m.glb")
    back = IO().load_mesh(tmp_path / "m.glb")
    assert torch.equal(back.verts_packed(), mesh.verts_packed())
    assert torch.equal(back.faces_packed(), faces)
    assert torch.equal(corner_uvs(back.textures), corner_uvs(textures))


def test_vertex_colours_come_back_to_the_bit(tmp_path):
    colors = torch.rand(12, 3)
    sphere = ico_sphere(0)
    sphere.textures = TexturesVertex([colors])
    IO().save_mesh(sphere, tmp_path / "m.glb")
    back = IO().load_mesh(tmp_path / "m.glb")
    assert torch.equal(back.textures.verts_features_packed(), colors)
    assert IO().load_mesh(tmp_path / "m.glb", include_textures=False).textures is None
    IO().save_mesh(sphere, tmp_path / "bare.glb", include_textures=False)
    assert IO().load_mesh(tmp_path / "bare.glb").textures is None


@pytest.mark.parametrize("verts", [0, 1, 5])
def test_meshes_without_faces(tmp_path, verts):
    mesh = Meshes([torch.randn(verts, 3)], [torch.zeros(0, 3, dtype=torch.int64)])
    for suffix in ("glb", "gltf"):
        IO().save_mesh(mesh, tmp_path / f"m.{suffix}")
        back = IO().load_mesh(tmp_path / f"m.{suffix}")
        assert torch.equal(back.verts_packed(), mesh.verts_packed())
        assert back.faces_packed().shape == (0, 3)


def test_how_a_texture_is_read_comes_back(tmp_path):
    textures = TexturesUV(
        image_of(3, 3), [torch.tensor([[0, 1, 2]])], [torch.tensor([[-0.5, 2.0], [1.5, 0.0], [0.0, 1.0]])],
        padding_mode="reflection", sampling_mode="nearest",
    )  # fmt: skip
    IO().save_mesh(Meshes([torch.eye(3)], [torch.tensor([[0, 1, 2]])], textures), tmp_path / "m.glb")
    back = IO().load_mesh(tmp_path / "m.glb").textures
    assert (back.padding_mode, back.sampling_mode) == ("reflection", "nearest")
    assert torch.equal(corner_uvs(back), corner_uvs(textures))


def test_more_than_65535_vertices(tmp_path):
    mesh = Meshes([torch.randn(70_000, 3)], [torch.randint(0, 70_000, (500, 3))])
    IO().save_mesh(mesh, tmp_path / "m.glb")
    assert torch.equal(IO().load_mesh(tmp_path / "m.glb").faces_packed(), mesh.faces_packed())


def test_what_gltf_cannot_hold(tmp_path):
    atlas = Meshes([torch.eye(3)], [torch.tensor([[0, 1, 2]])], TexturesAtlas([torch.rand(1, 2, 2, 3)]))
    with pytest.warns(UserWarning, match="not this TexturesAtlas: it is not saved"):
        IO().save_mesh(atlas, tmp_path / "m.glb")
    assert IO().load_mesh(tmp_path / "m.glb").textures is None
    before = (tmp_path / "m.glb").read_bytes()
    for value, why in ((math.nan, "not finite"), (1e39, "not finite in single precision")):
        bad = Meshes([torch.full((3, 3), value, dtype=torch.float64)], [torch.tensor([[0, 1, 2]])])
        with pytest.raises(ValueError, match=why):
            IO().save_mesh(bad, tmp_path / "m.glb")
    with pytest.raises(ValueError, match=r"binary=False, but \.glb is binary"):
        IO().save_mesh(ico_sphere(0), tmp_path / "m.glb", binary=False)
    with pytest.raises(ValueError, match=r"binary=True, but .* \.gltf is text"):
        IO().save_mesh(ico_sphere(0), tmp_path / "m.gltf", binary=True)
    assert (tmp_path / "m.glb").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("options", "why"),
    [({"padding_mode": "zeros"}, "cannot say padding_mode"), ({"align_corners": False}, "not saved")],
)
def test_ways_to_read_a_texture_that_are_lost_are_said(tmp_path, options, why):
    textures = TexturesUV(image_of(2, 2), [torch.tensor([[0, 1, 2]])], [torch.rand(3, 2)], **options)
    with pytest.warns(UserWarning, match=why):
        IO().save_mesh(Meshes([torch.eye(3)], [torch.tensor([[0, 1, 2]])], textures), tmp_path / "m.glb")


def test_an_attribute_that_contradicts_the_file_is_ignored(tmp_path):
    """Other programs may move vertices and pass on attributes that they do not know."""
    builder = Builder()
    primitive = builder.triangle()
    primitive["attributes"] |= {
        "_RENDRA_VERTEX": builder.accessor([[0, 0], [0, 0], [1, 0]], USHORT),
        "_RENDRA_V": builder.accessor([0.1, 0.2, 0.3]),
        "TEXCOORD_0": builder.accessor([[0.0, 0.0]] * 3),
    }
    primitive["material"] = builder.texture(png([(9, 9, 9)]))
    builder.mesh(primitive)
    mesh = load(tmp_path, builder.glb())
    assert mesh.verts_packed().tolist() == TRIANGLE
    assert corner_uvs(mesh.textures)[..., 1].tolist() == [[1.0, 1.0, 1.0]]


# Against an independent program


def test_trimesh_reads_what_is_written(tmp_path):
    sphere = ico_sphere(1)
    uvs = torch.rand(42, 2)
    textured = Meshes(
        sphere.verts_list(), sphere.faces_list(), TexturesUV(image_of(4, 6), sphere.faces_list(), [uvs])
    )
    colored = Meshes(sphere.verts_list(), sphere.faces_list(), TexturesVertex([torch.rand(42, 3)]))
    for suffix in ("glb", "gltf"):
        IO().save_mesh(textured, tmp_path / f"t.{suffix}")
        found = trimesh.load(tmp_path / f"t.{suffix}", process=False, force="mesh")
        assert_close(torch.tensor(np.array(found.vertices)), sphere.verts_packed().tolist(), atol=0)
        assert np.array_equal(found.faces, sphere.faces_packed())
        assert_close(torch.tensor(np.array(found.visual.uv)), uvs.tolist(), atol=1e-7)
        image = torch.tensor(np.array(found.visual.material.baseColorTexture.convert("RGB")))
        assert torch.equal(image / 255.0, textured.textures.maps_padded()[0])
    IO().save_mesh(colored, tmp_path / "c.glb")
    (found,) = trimesh.load(tmp_path / "c.glb", process=False).geometry.values()
    seen = found.visual.vertex_attributes["color"]  # not vertex_colors, as there is a material: no metal
    assert_close(torch.tensor(np.array(seen)), colored.textures.verts_features_packed(), atol=0)


def test_what_trimesh_writes_is_read(tmp_path):
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    turn = trimesh.transformations.rotation_matrix(0.7, [1.0, 2.0, 3.0], [0.1, 0.2, 0.3])
    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.visual.vertex_colors = np.random.default_rng(0).integers(0, 256, (42, 4), dtype=np.uint8)
    scene = trimesh.Scene()
    scene.add_geometry(ball, transform=turn)
    scene.add_geometry(box)
    (tmp_path / "s.glb").write_bytes(scene.export(file_type="glb"))
    mesh = IO().load_mesh(tmp_path / "s.glb")
    corners = np.concatenate([ball.copy().apply_transform(turn).triangles, box.triangles])
    mine = mesh.verts_packed()[mesh.faces_packed()]
    order, expected = np.argsort(mine.sum((1, 2)).numpy()), corners[np.argsort(corners.sum((1, 2)))]
    assert_close(mine[order], expected.tolist(), atol=1e-5)
    assert len(mesh.verts_packed()) == 42 + len(box.vertices)
    assert_close(mesh.textures.verts_features_packed()[:42], (ball.visual.vertex_colors[:, :3] / 255.0).tolist())


def test_a_textured_mesh_of_trimesh_is_read(tmp_path):
    ball, uvs = trimesh.creation.icosphere(subdivisions=1), np.random.default_rng(0).random((42, 2))
    image = Image.fromarray(np.random.default_rng(1).integers(0, 256, (5, 4, 3), dtype=np.uint8))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    ball.visual = trimesh.visual.TextureVisuals(uv=uvs, material=material)
    (tmp_path / "m.glb").write_bytes(ball.export(file_type="glb"))
    mesh = IO().load_mesh(tmp_path / "m.glb")
    assert_close(corner_uvs(mesh.textures), uvs[ball.faces].tolist(), atol=1e-6)
    assert torch.equal(mesh.textures.maps_padded()[0], torch.tensor(np.array(image)) / 255.0)


# What the format means


def test_nodes_move_meshes(tmp_path):
    builder = Builder()
    builder.mesh(builder.triangle())
    builder.document["nodes"] = [
        {"children": [1, 2], "translation": [0, 0, 10]},
        {"mesh": 0, "rotation": [0, 0, math.sqrt(0.5), math.sqrt(0.5)], "scale": [2, 3, 4]},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]},
        {"mesh": 0, "name": "not in the scene"},
    ]
    builder.document["scenes"] = [{"nodes": [3]}, {"nodes": [0]}]
    builder.document["scene"] = 1
    verts = load(tmp_path, builder.glb()).verts_packed()
    assert_close(verts, [[0, 0, 10], [0, 2, 10], [-3, 0, 10], [5, 6, 17], [6, 6, 17], [5, 7, 17]])


def test_a_mirror_keeps_faces_outside_out(tmp_path):
    builder = Builder()
    primitive = builder.triangle()
    primitive["attributes"]["NORMAL"] = builder.accessor([[0, 0, 1.0]] * 3)
    builder.mesh(primitive)
    builder.document["nodes"] = [{"mesh": 0, "scale": [1, 2, -3]}]
    mesh = load(tmp_path, builder.glb())
    assert_close(mesh.faces_normals_packed(), [[0, 0, -1]])
    assert_close(mesh.verts_normals_packed(), [[0, 0, -1]] * 3)


def test_normals_stay_normal_to_a_sheared_surface(tmp_path):
    builder = Builder()
    slope = [[0.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 0.0]]
    normals = [[-math.sqrt(0.5), 0.0, math.sqrt(0.5)]] * 3
    builder.mesh({"attributes": {"POSITION": builder.accessor(slope), "NORMAL": builder.accessor(normals)}})
    builder.document["nodes"] = [{"mesh": 0, "scale": [3, 1, 0.5]}]
    mesh = load(tmp_path, builder.glb())
    assert_close(mesh.verts_normals_packed(), mesh.faces_normals_packed().expand(3, 3))


@pytest.mark.parametrize(
    ("mode", "indices", "faces"),
    [
        (None, [0, 1, 2, 2, 1, 3], [[0, 1, 2], [2, 1, 3]]),
        (5, [0, 1, 2, 3, 4], [[0, 1, 2], [1, 3, 2], [2, 3, 4]]),
        (6, [0, 1, 2, 3], [[1, 2, 0], [2, 3, 0]]),
        (0, [0, 1], []),
    ],
)
@pytest.mark.parametrize("component", [UBYTE, USHORT, UINT])
def test_lists_strips_and_fans(tmp_path, mode, indices, faces, component):
    builder = Builder()
    primitive: dict = {"attributes": {"POSITION": builder.accessor(torch.rand(5, 3).numpy())}}
    primitive["indices"] = builder.accessor(indices, component)
    builder.mesh(primitive if mode is None else {**primitive, "mode": mode})
    assert load(tmp_path, builder.glb()).faces_packed().tolist() == faces


def test_interleaved_attributes_without_indices(tmp_path):
    rows = torch.rand(6, 5).numpy()
    builder = Builder()
    view = builder.view(rows.tobytes(), byteStride=20)
    for offset, shape in ((0, "VEC3"), (12, "VEC2")):
        builder.document["accessors"].append(
            {"bufferView": view, "byteOffset": offset, "componentType": FLOAT, "count": 6, "type": shape}
        )
    material = builder.texture(png([(1, 2, 3)]))
    builder.mesh({"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": material})
    mesh = load(tmp_path, builder.glb())
    assert_close(mesh.verts_packed(), rows[:, :3].tolist(), atol=0)
    assert mesh.faces_packed().tolist() == [[0, 1, 2], [3, 4, 5]]
    assert_close(mesh.textures.verts_uvs_padded()[0], [[u, 1 - v] for u, v in rows[:, 3:].tolist()], atol=1e-7)


def test_quantized_positions_and_normalized_colours(tmp_path):
    builder = Builder()
    positions = builder.accessor([[0, 0, 0, 0], [127, 0, 0, 0], [0, -128, 0, 0]], 5120)
    builder.document["accessors"][0] |= {"type": "VEC3", "normalized": True}
    builder.document["bufferViews"][0]["byteStride"] = 4
    colors = builder.accessor([[0, 51, 255, 9]] * 3, UBYTE, normalized=True)
    builder.document["extensionsUsed"] = builder.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    builder.mesh({"attributes": {"POSITION": positions, "COLOR_0": colors}})
    mesh = load(tmp_path, builder.glb())
    assert mesh.verts_packed().tolist() == [[0, 0, 0], [1, 0, 0], [0, -1, 0]]
    assert_close(mesh.textures.verts_features_packed(), [[0.0, 0.2, 1.0]] * 3)


def test_plain_colours_respect_factors(tmp_path):
    builder = Builder()
    builder.document["materials"] = [
        {"pbrMetallicRoughness": {"baseColorFactor": [0.25, 0.5, 1, 0.1]}, "extensions": {"KHR_materials_unlit": {}}},
        {"extensions": {"KHR_materials_pbrSpecularGlossiness": {"diffuseFactor": [0, 0, 1, 1]}}},
        {"name": "nothing"},
    ]
    builder.document["extensionsRequired"] = ["KHR_materials_unlit"]
    colored = builder.triangle(material=0)
    colored["attributes"]["COLOR_0"] = builder.accessor([[1.0, 0.5, 0.25]] * 3)
    builder.mesh(builder.triangle(material=0), colored, builder.triangle(material=1), builder.triangle(material=2))
    expected = [[0.25, 0.5, 1], [0.25, 0.25, 0.25], [0, 0, 1], [1, 1, 1]]
    assert_close(load(tmp_path, builder.glb()).textures.verts_features_packed()[::3], expected)


def test_several_images_share_one(tmp_path):
    """Each part keeps its colours, also a plain one; the second image is tinted."""
    builder = Builder()
    uvs = builder.accessor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    images = [
        png([(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (9, 9, 9)]),
        png([(255, 255, 255), (100, 0, 0), (0, 50, 0)]),
    ]
    for material in [builder.texture(image, wrapS=33071, wrapT=33071) for image in images]:
        primitive = builder.triangle(material=material)
        primitive["attributes"]["TEXCOORD_0"] = uvs
        builder.mesh(primitive)
    builder.document["materials"][1]["pbrMetallicRoughness"]["baseColorFactor"] = [0.5, 1, 1, 1]
    builder.document["materials"].append({"pbrMetallicRoughness": {"baseColorFactor": [0.1, 0.2, 0.3, 1]}})
    builder.mesh(builder.triangle(material=2))
    mesh = load(tmp_path, builder.glb())
    expected = [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[0.5, 1, 1], [0, 50 / 255, 0], [0.5, 1, 1]],
        [[0.1, 0.2, 0.3]] * 3,
    ]
    assert_close(corner_colors(mesh), expected, atol=1e-4)


def test_a_shared_list_of_vertices_is_not_copied_for_each_part(tmp_path):
    builder = Builder()
    positions = builder.accessor(torch.rand(6, 3).numpy())
    parts = [builder.accessor(part, UINT) for part in ([0, 1, 2], [3, 4, 5])]
    builder.mesh(*({"attributes": {"POSITION": positions}, "indices": part} for part in parts))
    mesh = load(tmp_path, builder.glb())
    assert len(mesh.verts_packed()) == 6
    assert mesh.faces_packed().tolist() == [[0, 1, 2], [3, 4, 5]]


def textured_triangle(uvs: list, **sampler: int) -> Builder:
    builder = Builder()
    primitive = builder.triangle(material=builder.texture(png([(0, 0, 0), (255, 255, 255)]), **sampler))
    primitive["attributes"]["TEXCOORD_0"] = builder.accessor(uvs)
    builder.mesh(primitive)
    return builder


def test_repeated_images_are_unrolled(tmp_path):
    inside = [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75]]
    shifted = [[u + 3, v - 2] for u, v in inside]
    found = load(tmp_path, textured_triangle(shifted).glb()).textures
    assert_close(corner_uvs(found)[0], [[u, 1 - v] for u, v in inside])
    clamped = load(tmp_path, textured_triangle(shifted, wrapS=33071, wrapT=33071).glb()).textures
    assert_close(corner_uvs(clamped)[0], [[u, 1 - v] for u, v in shifted])
    with pytest.warns(UserWarning, match="1 faces cross the border of a repeated texture"):
        load(tmp_path, textured_triangle([[0.5, 0.5], [1.5, 0.5], [0.5, 0.75]]).glb())


def test_texture_transforms(tmp_path):
    builder = textured_triangle([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    info = builder.document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    info["extensions"] = {
        "KHR_texture_transform": {"offset": [0.25, 0.75], "scale": [0.5, 0.25], "rotation": math.pi / 2}
    }
    found = corner_uvs(load(tmp_path, builder.glb()).textures)[0]
    # a quarter turn counter-clockwise takes +u upwards, which is -v in the file, and +v to +u
    assert_close(found, [[0.25, 0.25], [0.25, 0.75], [0.5, 0.25]])


def test_files_beside_a_gltf(tmp_path):
    builder = textured_triangle([[0.5, 0.5]] * 3)
    (tmp_path / "my data").mkdir()
    (tmp_path / "my data" / "b.bin").write_bytes(builder.binary)
    Image.new("RGB", (2, 2), (255, 0, 51)).save(tmp_path / "p.png")
    builder.document["buffers"] = [{"byteLength": len(builder.binary), "uri": "my%20data/b.bin"}]
    builder.document["images"] = [{"uri": "p.png"}]
    mesh = load(tmp_path, builder.gltf(), "gltf")
    assert_close(corner_colors(mesh), [[[1, 0, 0.2]] * 3])
    (tmp_path / "p.png").unlink()
    with pytest.warns(UserWarning, match="the file of image 0 does not exist"):
        assert load(tmp_path, builder.gltf(), "gltf").textures is None


def test_what_is_passed_over_is_said(tmp_path):
    builder = Builder()
    builder.mesh(builder.triangle(mode=1), builder.triangle(targets=[{}]))
    builder.document["nodes"][0]["skin"] = 0
    with pytest.warns(UserWarning, match="not read|not applied") as caught:
        mesh = load(tmp_path, builder.glb())
    assert len(mesh.verts_packed()) == 3
    messages = sorted(str(each.message).split(": ", 1)[1] for each in caught)
    assert messages == [
        "1 primitives of lines are not read",
        "morph targets and skins are not applied; the mesh is read as it is at rest",
    ]


def test_clouds(tmp_path):
    cloud = Pointclouds([torch.randn(9, 3)], normals=[torch.randn(9, 3)], features=[torch.rand(9, 3)])
    for suffix in ("glb", "gltf"):
        IO().save_pointcloud(cloud, tmp_path / f"c.{suffix}")
        back = IO().load_pointcloud(tmp_path / f"c.{suffix}")
        for found, expected in zip(back.get_cloud(0), cloud.get_cloud(0), strict=True):
            assert torch.equal(found, expected)


def test_the_written_json_is_plain(tmp_path):
    IO().save_mesh(ico_sphere(0), tmp_path / "m.gltf")
    document = json.loads((tmp_path / "m.gltf").read_text())
    positions = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    assert np.float32(positions["max"]).tolist() == ico_sphere(0).verts_packed().amax(0).tolist()
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])
