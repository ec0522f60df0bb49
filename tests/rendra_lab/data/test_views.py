"""Views of a known mesh, rendered or photographed."""

import numpy as np
import pytest
import torch
from assertions import assert_close
from PIL import Image

from rendra_lab.camera_starts import GivenStart
from rendra_lab.data.meshes import load_mesh
from rendra_lab.data.view_sequences import FrameByFrame, RenderedSequence
from rendra_lab.data.views import PhotoView, RenderedView, read_photo
from rendra_lab.errors import UserError
from rendra_lab.networks.mesh_view import MeshView


@pytest.fixture
def scene():
    return MeshView(load_mesh("ico_sphere", level=2), image_size=(32, 48))


def test_a_rendered_view_has_an_exact_silhouette(scene):
    data = RenderedView(scene, distance=3.0, elevation_deg=20.0, azimuth_deg=30.0)
    data.setup("fit")
    target = next(iter(data.train_dataloader()))
    assert target.rgb.shape == (1, 32, 48, 3)
    assert set(target.silhouette.unique().tolist()) == {0.0, 1.0}
    # a ball of radius 1 at distance 3 seen with 60 degrees: a disc of radius tan(asin(1/3)) / tan(30 deg)
    radius = np.tan(np.arcsin(1 / 3)) / np.tan(np.radians(30)) * 16
    assert_close(target.silhouette.sum(), np.pi * radius**2, rtol=0.06)
    assert_close(target.position.norm(), 3.0)


def test_shrunk_views_keep_their_mean(scene):
    data = RenderedView(scene)
    data.setup("fit")
    small = data.target.resized((8, 12))
    assert small.rgb.shape == (1, 8, 12, 3)
    assert_close(small.silhouette.mean(), data.target.silhouette.mean())
    assert_close(small.rgb.mean(), data.target.rgb.mean())


def test_a_photograph_is_fitted_into_the_image(scene, tmp_path):
    rgba = np.zeros((100, 100, 4), np.uint8)
    rgba[25:75, 25:75] = [255, 0, 0, 255]
    Image.fromarray(rgba).save(tmp_path / "photo.png")
    data = PhotoView(scene, tmp_path / "photo.png")
    data.setup("fit")
    assert data.target.rgb.shape == (1, 32, 48, 3)
    assert_close(data.target.silhouette.sum(), 16 * 16, rtol=0.02)
    assert_close(data.target.rgb[0, 16, 24], [1.0, 0.0, 0.0], atol=1e-3)
    assert_close(data.target.rgb[0, 0, 0], [1.0, 1.0, 1.0], atol=1e-3)
    assert data.target.R.isnan().all()


def test_a_mask_may_lie_beside_a_photograph(tmp_path):
    Image.fromarray(np.full((10, 20, 3), 128, np.uint8)).save(tmp_path / "photo.jpg")
    mask = np.zeros((10, 20), np.uint8)
    mask[2:5, 3:9] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    colours, covered = read_photo(tmp_path / "photo.jpg", tmp_path / "mask.png")
    assert colours.shape == (10, 20, 3)
    assert covered.sum() == 18


@pytest.mark.parametrize(
    ("photo", "mask", "message"),
    [
        ("absent.png", None, "no image"),
        ("opaque.png", None, "no alpha channel"),
        ("opaque.png", "small.png", "pixels large"),
        ("opaque.png", "black.png", "empty"),
        ("broken.png", None, "not an image"),
    ],
)
def test_a_photograph_that_does_not_fit_is_named(tmp_path, photo, mask, message):
    Image.fromarray(np.full((10, 20, 3), 128, np.uint8)).save(tmp_path / "opaque.png")
    Image.fromarray(np.full((5, 5), 255, np.uint8)).save(tmp_path / "small.png")
    Image.fromarray(np.zeros((10, 20), np.uint8)).save(tmp_path / "black.png")
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n nonsense")
    with pytest.raises(UserError, match=message):
        read_photo(tmp_path / photo, None if mask is None else tmp_path / mask)


def test_a_sequence_is_walked_frame_by_frame(scene):
    data = RenderedSequence(scene, frames=3, steps_per_frame=2, distance=(3.0, 2.0))
    data.setup("fit")
    assert [int(batch.frame) for batch in data.train_dataloader()] == [0, 0, 1, 1, 2, 2]
    assert [int(batch.frame) for batch in data.test_dataloader()] == [0, 1, 2]
    assert_close(torch.stack([view.position.norm() for view in data.views]), [3.0, 2.5, 2.0])


def test_a_resumed_sequence_goes_on_where_it_was(scene):
    data = RenderedSequence(scene, frames=3, steps_per_frame=2)
    data.setup("fit")
    resumed = FrameByFrame(data.views, 2)
    resumed.load_state_dict({"given": 3})
    assert [int(batch.frame) for batch in resumed] == [1, 2, 2, 0, 0, 1]


def empty_views(scene):
    """Everything that looks for a mesh which is not there."""
    target = RenderedView(MeshView(load_mesh("cube"), image_size=16))
    target.setup("fit")
    return {
        "data.distance": lambda: RenderedView(scene).setup("fit"),
        "a frame": lambda: RenderedSequence(scene, frames=2).setup("fit"),
        "init.position": lambda: GivenStart()(scene, None, target.target, None),
    }


@pytest.mark.parametrize("what", ["data.distance", "a frame", "init.position"])
@pytest.mark.parametrize(("scale", "shift"), [(1.0, 500.0), (1e-4, 0.0)])
def test_a_view_without_the_mesh_is_refused_with_a_way_out(what, scale, shift):
    mesh = load_mesh("cube").scale_verts(scale).offset_verts(torch.tensor([shift, 0.0, 0.0]))
    scene = MeshView(mesh, image_size=16)
    with pytest.raises(UserError, match=f"nothing of the mesh is seen.*{what}.*mesh.normalize=extent"):
        empty_views(scene)[what]()


def test_a_view_full_of_the_mesh_is_warned_of(caplog):
    RenderedView(MeshView(load_mesh("cube").scale_verts(100.0), image_size=16)).setup("fit")
    assert "no outline to fit" in caplog.text
    caplog.clear()
    RenderedView(MeshView(load_mesh("cube"), image_size=16)).setup("fit")
    assert not caplog.text


def test_grey_pictures_of_16_bits_keep_their_shades(tmp_path):
    ramp = np.linspace(0, 65535, 200).astype(np.uint16).reshape(10, 20)
    Image.fromarray(ramp).save(tmp_path / "grey.png")
    colours, covered = read_photo(tmp_path / "grey.png", tmp_path / "grey.png")
    assert_close(covered, torch.from_numpy(ramp / np.float32(65535)), atol=0.003)
    assert_close(colours, covered[..., None].expand(-1, -1, 3))


def test_a_mask_of_zeros_and_ones_is_told_its_range(tmp_path):
    Image.fromarray(np.ones((4, 4), np.uint8)).save(tmp_path / "mask.png")
    with pytest.raises(UserError, match="brightest pixel is 1 of 255"):
        read_photo(tmp_path / "mask.png", tmp_path / "mask.png")


@pytest.mark.parametrize("make", [RenderedView, lambda scene: RenderedSequence(scene, frames=2)])
def test_views_are_rendered_once_for_fit_and_test(scene, make):
    data = make(scene)
    data.setup("fit")
    first = data.target
    data.setup("test")
    assert data.target is first
