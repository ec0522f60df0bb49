"""`IO`: formats are chosen by suffix, and can be added."""

from typing import Any

import pytest
import torch
from assertions import assert_close

from rendra.io import IO
from rendra.io.pluggable_formats import MeshFormatInterpreter, PointcloudFormatInterpreter, endswith
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesUV, TexturesVertex
from rendra.structures import Meshes, Pointclouds
from rendra.utils.ico_sphere import ico_sphere


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".off", ".glb", ".gltf", ".stl", ".OBJ", ".GLB"])
@pytest.mark.parametrize("as_path", [str, lambda path: path])
def test_round_trip_by_suffix(tmp_path, suffix, as_path):
    mesh = ico_sphere(1)
    path = as_path(tmp_path / f"sphere{suffix}")
    IO().save_mesh(mesh, path)
    back = IO().load_mesh(path)
    corners, corners_back = (m.verts_packed()[m.faces_packed()] for m in (mesh, back))
    assert_close(corners_back, corners, atol=1e-6)
    assert len(back.verts_packed()) == len(mesh.verts_packed())
    assert back.textures is None


def textured(textures: Any) -> Meshes:
    return Meshes([torch.eye(3)], [torch.tensor([[0, 1, 2]])], textures)


def test_obj_keeps_uv_textures(tmp_path):
    uv = TexturesUV(torch.rand(1, 8, 8, 3), [torch.tensor([[0, 1, 2]])], [torch.rand(3, 2)])
    IO().save_mesh(textured(uv), tmp_path / "mesh.obj", decimal_places=8)
    back = IO().load_mesh(tmp_path / "mesh.obj").textures
    assert_close(back.maps_padded(), uv.maps_padded(), atol=0.6 / 255)
    assert_close(back.verts_uvs_padded(), uv.verts_uvs_padded(), atol=1e-7)
    IO().save_mesh(textured(uv), tmp_path / "bare.obj", include_textures=False)
    assert not (tmp_path / "bare.mtl").exists()
    assert IO().load_mesh(tmp_path / "mesh.obj", include_textures=False).textures is None
    atlas = IO().load_mesh(tmp_path / "mesh.obj", create_texture_atlas=True, texture_atlas_size=2).textures
    assert atlas.atlas_padded().shape == (1, 1, 2, 2, 3)


def test_obj_keeps_vertex_colours_and_given_normals(tmp_path):
    colors, normals = torch.rand(3, 3), torch.nn.functional.normalize(torch.randn(3, 3), dim=1)
    mesh = Meshes([torch.eye(3)], [torch.tensor([[0, 1, 2]])], TexturesVertex([colors]), verts_normals=[normals])
    IO().save_mesh(mesh, tmp_path / "mesh.obj", decimal_places=8)
    assert_close(IO().load_mesh(tmp_path / "mesh.obj").textures.verts_features_packed(), colors, atol=1e-7)
    assert "f 1//1 2//2 3//3" in (tmp_path / "mesh.obj").read_text()


def test_obj_cannot_hold_an_atlas(tmp_path):
    with pytest.warns(UserWarning, match="cannot hold this TexturesAtlas"):
        IO().save_mesh(textured(TexturesAtlas([torch.rand(1, 2, 2, 3)])), tmp_path / "mesh.obj")


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".off", ".glb", ".xyz"])
def test_a_file_is_read_as_what_it_holds(tmp_path, suffix):
    cloud = Pointclouds([torch.rand(5, 3)], features=[torch.rand(5, 3)])
    IO().save_pointcloud(cloud, tmp_path / f"cloud{suffix}")
    back, plain = (
        IO().load_geometry(tmp_path / f"cloud{suffix}", include_textures=wanted) for wanted in (True, False)
    )
    assert isinstance(back, Pointclouds)
    assert isinstance(plain, Pointclouds)
    assert_close(back.points_packed(), cloud.points_packed(), atol=1e-6)
    assert_close(back.features_packed(), cloud.features_packed(), atol=0.6 / 255)
    assert plain.features_packed() is None
    if suffix != ".xyz":
        IO().save_mesh(ico_sphere(0), tmp_path / f"mesh{suffix}")
        mesh = IO().load_geometry(tmp_path / f"mesh{suffix}")
        assert isinstance(mesh, Meshes)
        assert len(mesh.faces_packed()) == 20


def test_whatever_no_format_reads_is_refused_with_all_that_would_have_worked(tmp_path):
    with pytest.raises(ValueError, match=r"No mesh or point cloud .*notes\.txt.*\.off, \.ply, \.stl, \.xyz\."):
        IO().load_geometry(tmp_path / "notes.txt")


def test_errors_name_the_path_and_what_would_have_worked(tmp_path):
    meshes, clouds = r"\.glb, \.gltf, \.obj, \.off, \.ply, \.stl\.", r"\.glb, \.gltf, \.obj, \.off, \.ply, \.xyz\."
    with pytest.raises(ValueError, match=rf"No mesh interpreter found to read mesh\.xyz\. Registered: {meshes}"):
        IO().load_mesh("mesh.xyz")
    with pytest.raises(ValueError, match=rf"No mesh interpreter found to write to mesh\.xyz\. Registered: {meshes}"):
        IO().save_mesh(ico_sphere(0), "mesh.xyz")
    with pytest.raises(ValueError, match="No format is registered"):
        IO(include_default_formats=False).load_mesh("mesh.obj")
    with pytest.raises(ValueError, match=rf"No point cloud interpreter found to read a\.stl\. Registered: {clouds}"):
        IO().load_pointcloud("a.stl")
    with pytest.raises(
        ValueError, match=rf"No point cloud interpreter found to write to a\.stl\. Registered: {clouds}"
    ):
        IO().save_pointcloud(Pointclouds([torch.zeros(1, 3)]), "a.stl")
    with pytest.raises(ValueError, match="expects a Pointclouds object, got str"):
        IO().save_pointcloud("data", tmp_path / "cloud.ply")
    with pytest.raises(ValueError, match="expects a Meshes object, got int"):
        IO().save_mesh(3, tmp_path / "mesh.ply")
    with pytest.raises(ValueError, match="OBJ is a text format"):
        IO().save_mesh(ico_sphere(0), tmp_path / "mesh.obj", binary=True)
    for suffix in ("glb", "gltf", "obj", "off", "ply", "stl"):
        with pytest.raises(ValueError, match="a file holds one mesh, but the batch has 2"):
            IO().save_mesh(ico_sphere(0).extend(2), tmp_path / f"mesh.{suffix}")
    for suffix in ("glb", "gltf", "obj", "off", "ply", "xyz"):
        with pytest.raises(ValueError, match="a file holds one point cloud, but the batch has 2"):
            IO().save_pointcloud(Pointclouds([torch.zeros(1, 3)] * 2), tmp_path / f"cloud.{suffix}")
    assert list(tmp_path.iterdir()) == []


class _Reverse(MeshFormatInterpreter):
    """Takes OBJ files for itself."""

    known_suffixes = (".obj",)

    def read(self, path, include_textures, device, path_manager, **kwargs):
        return ico_sphere(0) if endswith(path, self.known_suffixes) else None

    def save(self, data, path, path_manager, binary, **kwargs):
        return False


class _Cloud(PointcloudFormatInterpreter):
    def __init__(self) -> None:
        self.saved: list = []

    def read(self, path, device, path_manager, **kwargs):
        return "cloud"

    def save(self, data, path, path_manager, binary, **kwargs):
        self.saved.append(data)
        return True


def test_the_format_registered_last_is_asked_first():
    io = IO()
    io.register_meshes_format(_Reverse())
    assert len(io.load_mesh("no such file.obj").verts_packed()) == 12
    cloud = _Cloud()
    io.register_pointcloud_format(cloud)
    assert io.load_pointcloud("x") == "cloud"
    data = Pointclouds([torch.zeros(1, 3)])
    io.save_pointcloud(data, "x.ply")
    assert cloud.saved == [data]
    for register in (io.register_meshes_format, io.register_pointcloud_format):
        with pytest.raises(ValueError, match="Invalid interpreter"):
            register(object())


def test_interpreters_pass_on_what_is_not_theirs():
    for each in IO().mesh_interpreters:
        assert each.read("a.usd", True, "cpu", None) is None
        assert each.save(ico_sphere(0), "a.usd", None, None) is False
        assert each.read(object(), True, "cpu", None) is None
    for each in IO().pointcloud_interpreters:
        assert each.read("a.las", "cpu", None) is None
        assert each.save(Pointclouds([torch.zeros(1, 3)]), "a.las", None, None) is False
        assert each.read(object(), "cpu", None) is None


def test_endswith():
    assert endswith("a/b.ObJ", (".obj",))
    assert not endswith("a/b.obj2", (".obj",))
    assert not endswith(object(), (".obj",))


class _Storage:
    """A path manager over a dict, counting what was asked."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}

    def open(self, path, mode="r"):
        import io

        if mode == "wb":
            storage = self

            class Writer(io.BytesIO):
                def close(self):
                    storage.files[path] = self.getvalue()
                    super().close()

            return Writer()
        if path not in self.files:
            raise FileNotFoundError(path)
        return io.BytesIO(self.files[path])

    def get_local_path(self, path):
        raise AssertionError("not needed")


def test_a_path_manager_sees_every_path():
    storage = _Storage()
    uv = TexturesUV(torch.rand(1, 4, 4, 3), [torch.tensor([[0, 1, 2]])], [torch.rand(3, 2)])
    io = IO(path_manager=storage)
    io.save_mesh(textured(uv), "s3://bucket/mesh.obj")
    io.save_mesh(textured(uv), "s3://bucket/mesh.glb")
    for suffix in ("ply", "off", "stl"):
        io.save_mesh(textured(None), f"s3://bucket/mesh.{suffix}")
        assert len(io.load_mesh(f"s3://bucket/mesh.{suffix}").verts_packed()) == 3
    assert isinstance(io.load_mesh("s3://bucket/mesh.obj").textures, TexturesUV)
    assert isinstance(io.load_mesh("s3://bucket/mesh.glb").textures, TexturesUV)
    io.save_pointcloud(Pointclouds([torch.eye(3)]), "s3://bucket/cloud.xyz")
    assert len(io.load_pointcloud("s3://bucket/cloud.xyz").points_packed()) == 3
    meshes = {f"s3://bucket/mesh.{suffix}" for suffix in ("obj", "mtl", "png", "ply", "off", "stl", "glb")}
    assert set(storage.files) == meshes | {"s3://bucket/cloud.xyz"}
