from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from assertions import assert_close
from PIL import Image

from rendra.renderer.lighting import AmbientLights
from rendra.renderer.materials import Materials
from rendra.renderer.mesh.shader import (
    HardDepthShader,
    HardPhongShader,
    SoftPhongShader,
    SoftSilhouetteShader,
)
from rendra.structures.meshes import Meshes
from rendra_lab.data.meshes import load_mesh
from rendra_lab.errors import UserError
from rendra_lab.pictures import (
    FILE_NAMES,
    Headlight,
    OrbitCamera,
    Shading,
    Studio,
    cut_out,
    draw,
    gallery,
    kind_of_picture,
    parse_color,
    point_marks,
    save_image,
    turntable,
)


@pytest.fixture(scope="module")
def cow() -> Meshes:
    return load_mesh(texture_size=128, num_faces=2000)


@pytest.fixture
def studio() -> Studio:
    return Studio(OrbitCamera(), Headlight(), Materials(), Shading(HardPhongShader()), size=(48, 48), antialias=1)


def test_marks_stand_round_their_points_in_their_colours() -> None:
    points, colors = torch.randn(5, 3), torch.rand(5, 3)
    marks = point_marks(points, 0.1, colors)
    corners = marks.verts_packed().view(5, 6, 3)
    assert_close(corners.mean(1), points, atol=1e-6)
    assert_close((corners - points[:, None]).norm(dim=2), torch.full((5, 6), 0.1), atol=1e-6)
    assert_close(marks.textures.verts_features_packed().view(5, 6, 3), colors[:, None].expand(5, 6, 3))
    outwards = marks.faces_normals_packed().view(5, 8, 3) * (
        marks.verts_packed()[marks.faces_packed()].mean(1).view(5, 8, 3) - points[:, None]
    )
    assert (outwards.sum(2) > 0).all()
    assert point_marks(torch.zeros(0, 3), 0.1, (1.0, 0.0, 0.0)).isempty()


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("scale", [1e-2, 1.0, 1e3])
def test_the_whole_mesh_fits_at_any_size_and_place(scale: float, orthographic: bool) -> None:
    ball = load_mesh("ico_sphere", level=3).scale_verts(scale)
    ball = ball.offset_verts(torch.tensor([3.0, -2.0, 1.0]) * scale)
    camera = OrbitCamera(elev=33, azim=77, orthographic=orthographic)
    ndc = camera.cameras(ball).transform_points_ndc(ball.verts_packed())[..., :2]
    widest = ndc.abs().max().item()
    assert (0.8 if orthographic else 0.93) < widest <= 1
    assert_close(ndc.amax(0) + ndc.amin(0), [0.0, 0.0], atol=0.02)


def test_the_view_is_where_the_angles_say(cow: Meshes) -> None:
    camera = OrbitCamera(dist=2.7, elev=0, azim=180, at=(0, 0, 0), fov=60).cameras(cow)
    assert_close(camera.get_camera_center()[0], [0.0, 0.0, -2.7], atol=1e-5)
    head = cow.verts_packed()[cow.verts_packed()[:, 2] < -0.5]
    depth = camera.get_world_to_view_transform().transform_points(head)[..., 2]
    assert (depth < 2.7).all(), "the cow faces the camera"


def test_the_headlight_stands_above_the_viewer_and_follows(cow: Meshes) -> None:
    for azim in (0, 90, 180):
        cameras = OrbitCamera(elev=0, azim=azim).cameras(cow)
        lights = Headlight(right=0, above=1).lights(cameras)
        towards = torch.nn.functional.normalize(cameras.get_camera_center(), dim=-1)
        assert_close(lights.direction, towards + torch.tensor([[0.0, 1.0, 0.0]]), atol=1e-3)


def test_a_picture_shows_the_mesh_before_its_background(studio: Studio, cow: Meshes) -> None:
    image = replace(studio, background=(0.1, 0.2, 0.3)).render(cow)
    assert image.shape == (48, 48, 4)
    assert_close(image[0, 0], [0.1, 0.2, 0.3, 0.0])
    assert 0.2 < image[..., 3].mean() < 0.6
    assert image[..., :3][image[..., 3] == 1].std() > 0.15


def test_width_and_height_are_not_mixed_up(studio: Studio, cow: Meshes) -> None:
    image = replace(studio, size=(24, 60)).render(cow)
    assert image.shape == (24, 60, 4)
    columns = image[..., 3].amax(0)
    assert columns[:10].max() == 0
    assert columns[-10:].max() == 0
    assert columns[30] == 1


def test_antialiasing_averages(studio: Studio, cow: Meshes) -> None:
    fine = replace(studio, size=(96, 96)).render(cow)
    smooth = replace(studio, antialias=2).render(cow)
    assert_close(smooth, fine.reshape(48, 2, 48, 2, 4).mean((1, 3)), atol=1e-6)


def test_a_cut_out_laid_over_its_background_is_the_picture(studio: Studio, cow: Meshes) -> None:
    behind = (0.2, 0.9, 0.4)
    image = replace(studio, background=behind, antialias=2).render(cow)
    cut = cut_out(image, behind)
    assert_close(cut[..., :3] * cut[..., 3:] + (1 - cut[..., 3:]) * torch.tensor(behind), image[..., :3], atol=1e-5)
    assert (cut[..., :3][cut[..., 3] == 0] == 0).all()


@pytest.mark.parametrize(
    ("shading", "background"),
    [
        (Shading(SoftPhongShader(), sigma=1e-5, gamma=4e-3, faces_per_pixel=8), 1.0),
        (Shading(SoftSilhouetteShader(), sigma=1e-4, faces_per_pixel=20, shows="alpha"), 0.0),
        (Shading(HardDepthShader(), shows="depth"), 0.0),
    ],
)
def test_every_kind_of_shading(studio: Studio, cow: Meshes, shading: Shading, background: float) -> None:
    image = replace(studio, shading=shading).render(cow)
    assert torch.isfinite(image).all()
    assert_close(image[0, 0, :3], [background] * 3, atol=1e-4)
    assert (image[20:30, 20:30, :3] - background).abs().mean() > 0.1


def test_depth_is_lighter_where_nearer(studio: Studio) -> None:
    ball = load_mesh("ico_sphere", level=3)
    image = replace(studio, shading=Shading(HardDepthShader(), shows="depth")).render(ball)[..., 0]
    seen = image[24][image[24] > 0]
    middle = len(seen) // 2
    assert seen[middle] == pytest.approx(1, abs=0.02)
    assert seen[0] < 0.5
    assert (seen[: middle - 1].diff() > 0).all()
    assert (seen[middle + 1 :].diff() < 0).all()


def test_the_gallery_holds_six_different_pictures(studio: Studio, cow: Meshes) -> None:
    sheet = gallery(studio, cow)
    pitch = 48 + 6  # a picture and the gap beside it
    rows = np.array_split(sheet, 2)
    cells = [row[-48:, k * pitch : k * pitch + 48].astype(int) for row in rows for k in range(3)]
    assert len({cell.tobytes() for cell in cells}) == 6
    dark, green, red, plain = cells[2:]
    assert (dark.max(-1) == 0).sum() > 100, "without ambient light the cow is black"
    assert (green - plain)[..., 1].max() > 20
    assert np.abs((green - plain)[..., 0]).max() <= 1
    assert (red - plain)[..., 0].max() > 20


def test_the_turntable_goes_once_round(studio: Studio, cow: Meshes) -> None:
    frames = list(turntable(studio, cow, 4))
    assert len(frames) == 4
    assert len({frame.tobytes() for frame in frames}) == 4
    opposite = replace(studio, camera=OrbitCamera(azim=150 + 180)).render(cow)[..., :3]
    assert np.abs(frames[2] / 255 - opposite.numpy()).max() < 0.01
    with pytest.raises(ValueError, match="at least 2 frames, got 1"):
        next(turntable(studio, cow, 1))


@pytest.mark.parametrize("kind", ["picture", "cutout", "gallery", "gif"])
def test_drawing_writes_the_file(studio: Studio, cow: Meshes, tmp_path: Path, kind: str) -> None:
    path = tmp_path / "new" / FILE_NAMES[kind]
    note = draw(kind, studio, cow, path, frames=3)
    assert "2,000 faces" in note
    assert "NOTHING" not in note
    with Image.open(path) as image:
        assert image.mode == {"cutout": "RGBA", "gif": "P"}.get(kind, "RGB")
        assert getattr(image, "n_frames", 1) == (3 if kind == "gif" else 1)
        assert np.asarray(image.convert("RGB")).std() > 10


def test_drawing_says_when_nothing_is_seen(studio: Studio, cow: Meshes, tmp_path: Path) -> None:
    away = replace(studio, camera=OrbitCamera(dist=1, at=(50, 0, 0)))
    assert "NOTHING IS SEEN" in draw("picture", away, cow, tmp_path / "a.png")


def test_an_mp4_without_an_encoder_says_so(
    studio: Studio, cow: Meshes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rendra_lab.pictures.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"rendra\[view\]"):
        draw("mp4", studio, cow, tmp_path / "a.mp4")
    with pytest.raises(ValueError, match=r"writes a \.gif file, but output is"):
        draw("gif", studio, cow, tmp_path / "a.png")


def test_kinds_and_colours_and_their_mistakes() -> None:
    assert kind_of_picture(False, None, False) == "picture"
    assert kind_of_picture(True, None, False) == "gallery"
    assert kind_of_picture(False, "mp4", False) == "mp4"
    assert kind_of_picture(False, None, True) == "cutout"
    with pytest.raises(ValueError, match="exclude each other"):
        kind_of_picture(True, "gif", False)
    with pytest.raises(ValueError, match="null, gif or mp4, got 'avi'"):
        kind_of_picture(False, "avi", False)
    assert parse_color("white") == (1, 1, 1)
    assert parse_color("#ff0080") == (1, 0, 128 / 255)
    assert parse_color([0, 0.5, 1]) == (0, 0.5, 1)
    for wrong in ("blurple", [0, 1], [0, 0, 255]):
        with pytest.raises(ValueError, match=r"color|colour"):
            parse_color(wrong)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: OrbitCamera(fov=180), "camera.fov must lie between 0 and 180"),
        (lambda: OrbitCamera(dist=0), "camera.dist must be positive"),
        (lambda: OrbitCamera(at=(0, 0)), "camera.at must be three numbers"),
        (lambda: Shading(HardPhongShader(), shows="smell"), "shows must be one of color, alpha, depth"),
        (lambda: save_image("a.xyz", torch.zeros(2, 2, 4), False), "output must end in .png"),
        (lambda: save_image("a.jpg", torch.zeros(2, 2, 4), True), r"\.jpg files cannot be transparent"),
    ],
)
def test_mistakes_are_named(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    "change", [{"size": (0, 5)}, {"size": (9000, 5)}, {"size": ("a", 5)}, {"antialias": 0}, {"antialias": "2x"}]
)
def test_impossible_pictures_are_refused(studio: Studio, change: dict) -> None:
    with pytest.raises(ValueError, match="from 1 to"):
        replace(studio, **change)


def test_ambient_light_shows_the_texture_as_it_is(studio: Studio) -> None:
    image = replace(studio, light=AmbientLights()).render(load_mesh("cube"))
    assert_close(image[..., :3], torch.ones(48, 48, 3))


@pytest.mark.parametrize(("scale", "shift", "fits"), [(1.0, 0.0, True), (100.0, 0.0, False), (1.0, 9.0, False)])
def test_the_gallery_says_when_a_mesh_is_out_of_place(
    studio: Studio, tmp_path: Path, scale: float, shift: float, fits: bool
) -> None:
    mesh = load_mesh("cube").scale_verts(scale).offset_verts(torch.tensor([shift, 0.0, 0.0]))
    note = draw("gallery", studio, mesh, tmp_path / "gallery.png")
    assert ("mesh.normalize=extent" in note) is not fits
