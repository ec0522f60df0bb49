"""What `convert` promises beyond its program: its arguments, and colours that change their form."""

from types import SimpleNamespace

import pytest
import torch
from assertions import assert_close

from rendra.io import IO, save_obj
from rendra.io import _carried_colors as carried
from rendra.io.conversion import Conversion, convert
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesUV, TexturesVertex
from rendra.structures import Meshes

VERTS = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]])
FACES = torch.tensor([[0, 1, 2]])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"up": "x-to-y"}, "up is 'x-to-y'; expected z-to-y or y-to-z"),
        ({"scale": 0.0}, "scale is 0.0; expected a positive number"),
        ({"fit": float("inf")}, "fit is inf"),
        ({"sample": -1}, "sample is -1"),
        ({"sample": 3_000_000_000}, "sample is 3000000000; expected at most 50,000,000 points"),
        ({"seed": 2**70}, "seed is 1180591620717411303424; expected a whole number of 64 bits"),
        ({"scale": 1.0, "fit": 1.0}, "scale and fit exclude each other"),
        ({"sample": 1, "vertices": True}, "sample and vertices exclude each other"),
    ],
)
def test_options_that_cannot_be(given, message):
    with pytest.raises(ValueError, match=message):
        Conversion(**given)


def test_what_was_written_is_returned(tmp_path):
    save_obj(tmp_path / "in.obj", VERTS, FACES)
    done = convert(str(tmp_path / "in.obj"), tmp_path / "out.ply")
    assert (done.path, done.num_verts, done.num_faces) == (tmp_path / "out.ply", 4, 1)
    done = convert(tmp_path / "in.obj", tmp_path / "out.xyz", Conversion(sample=7))
    assert (done.num_verts, done.num_faces) == (7, 0)


def test_files_of_nothing(tmp_path):
    save_obj(tmp_path / "in.obj", torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64))
    for suffix in (".ply", ".off", ".xyz", ".glb"):
        done = convert(tmp_path / "in.obj", tmp_path / f"out{suffix}", Conversion(center=True, fit=2.0))
        assert done.num_verts == 0
        assert len(IO().load_pointcloud(done.path).points_packed()) == 0


def test_a_failure_writes_nothing(tmp_path):
    save_obj(tmp_path / "in.obj", VERTS * 1e37, FACES)
    with pytest.raises(ValueError, match="not finite"):
        convert(tmp_path / "in.obj", tmp_path / "out.ply", Conversion(scale=1e10))
    with pytest.raises(ValueError, match="all points coincide once scaled"):
        convert(tmp_path / "in.obj", tmp_path / "out.ply", Conversion(scale=1e-90))
    assert [each.name for each in tmp_path.iterdir()] == ["in.obj"]


def test_a_place_that_cannot_be_written_is_named_as_it_was_given(tmp_path):
    save_obj(tmp_path / "in.obj", VERTS, FACES)
    with pytest.raises(FileNotFoundError) as caught:
        convert(tmp_path / "in.obj", tmp_path / "no" / "out.ply")
    assert caught.value.filename == str(tmp_path / "no" / "out.ply")


def test_unseen_vertices_are_white():
    red = TexturesAtlas([torch.tensor([1.0, 0, 0]).reshape(1, 1, 1, 3)])
    colors = carried.colors_at_verts(Meshes([VERTS], [FACES], red)).verts_features_packed()
    assert_close(colors, [[1.0, 0, 0]] * 3 + [[1.0, 1, 1]])


def test_colours_at_vertices_are_those_of_a_vertex_texture():
    given = torch.rand(4, 3)
    mesh = Meshes([VERTS], [torch.tensor([[0, 1, 2], [2, 1, 3]])], TexturesVertex([given]))
    assert_close(carried.colors_at_verts(mesh).verts_features_packed(), given)


@pytest.mark.parametrize("num_faces", [1, 2, 3, 4, 5, 17])
def test_an_image_of_face_colours_shows_them_anywhere_on_a_face(num_faces):
    atlas = torch.rand(num_faces, 1, 1, 3)
    texture = carried.atlas_as_image(atlas)
    mesh = Meshes([VERTS], [FACES.expand(num_faces, 3)], texture)
    anywhere = torch.distributions.Dirichlet(torch.ones(3)).sample((1, num_faces, 1, 1))
    fragments = SimpleNamespace(pix_to_face=torch.arange(num_faces).reshape(1, -1, 1, 1), bary_coords=anywhere)
    assert_close(mesh.sample_textures(fragments)[0, :, 0, 0], atlas[:, 0, 0], atol=1e-4)


def test_squares_of_several_texels_are_averaged():
    atlas = torch.rand(2, 4, 4, 3)
    assert_close(carried.atlas_as_image(atlas).maps_padded()[0].reshape(-1, 3)[:2], atlas.mean(dim=(1, 2)))


def test_too_many_face_colours_are_refused(monkeypatch):
    monkeypatch.setattr(carried, "MAX_TEXTURE_PIXELS", 3)
    with pytest.raises(ValueError, match="4 face colours do not fit into an image of 3 texels"):
        carried.atlas_as_image(torch.rand(4, 1, 1, 3))


def test_an_image_goes_round_through_every_format_that_holds_it(tmp_path):
    uv = TexturesUV(torch.rand(1, 4, 4, 3), [FACES], [torch.tensor([[0.1, 0.2], [0.9, 0.3], [0.4, 1.0]])])
    IO().save_mesh(Meshes([VERTS[:3]], [FACES], uv), tmp_path / "a.obj", decimal_places=8)
    for source, target in (("a.obj", "b.glb"), ("b.glb", "c.gltf"), ("c.gltf", "d.obj")):
        convert(tmp_path / source, tmp_path / target, Conversion(decimals=8))
    first, last = (IO().load_mesh(tmp_path / name).textures for name in ("a.obj", "d.obj"))
    assert torch.equal(first.maps_padded(), last.maps_padded())
    corners = [each.verts_uvs_list()[0][each.faces_uvs_list()[0]] for each in (first, last)]
    assert_close(corners[0], corners[1], atol=1e-7)
