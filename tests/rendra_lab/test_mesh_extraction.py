"""Meshes of analytic fields: where the surface lies, what it leaves out, its colours and its files."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lightning.pytorch import LightningModule
from PIL import Image
from torch import Tensor

from rendra.io import IO
from rendra.renderer import TexturesUV, TexturesVertex
from rendra.utils import ico_sphere
from rendra_lab import metrics
from rendra_lab.data.ray_views import Scene, SceneViews
from rendra_lab.errors import UserError
from rendra_lab.mesh_export import SurfaceSettings, export_surface
from rendra_lab.mesh_extraction import extract_mesh
from rendra_lab.mesh_quality import components, genus, inward_faces, is_watertight
from rendra_lab.networks.radiance import RadianceScene
from rendra_lab.surface_callback import SurfaceExporter

RESOLUTION = 48
VOXEL = 2.4 / RESOLUTION


@dataclass
class Balls:
    """Balls of one density in a box; a hollow is cut out of all of them."""

    density: float = 20 / VOXEL
    softness: float = 0.0  # world units over which the density rises
    centers: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),)
    radii: tuple[float, ...] = (0.7,)
    hollow: float = 0.0
    haze: float = 0.0
    box: Tensor = field(default_factory=lambda: torch.tensor([[-1.0, -1, -1], [1, 1, 1.4]]))

    def opacity_at(self, points: Tensor, step: float) -> Tensor:
        assert (points >= self.box[0]).all()
        assert (points <= self.box[1]).all()
        distances = [(points - points.new_tensor(c)).norm(dim=1) - r for c, r in zip(self.centers, self.radii)]  # noqa: B905
        depth = -torch.stack(distances).amin(0)
        depth = torch.minimum(depth, points.norm(dim=1) - self.hollow) if self.hollow else depth
        inside = torch.sigmoid(depth / self.softness) if self.softness else (depth > 0).to(points.dtype)
        return -torch.expm1(-(self.density * inside + self.haze) * step)

    def color_at(self, points: Tensor, directions: Tensor) -> Tensor:
        assert torch.allclose(directions.norm(dim=1), torch.ones(len(points)), atol=1e-5)
        return 0.5 - 0.5 * directions  # of the side that is looked at


def off_in_voxels(scene: Balls, **settings: object) -> Tensor:
    mesh = extract_mesh(scene, RESOLUTION, color=None, **settings)  # type: ignore[arg-type]
    return (mesh.verts_packed().norm(dim=1) - 0.7) / VOXEL


def test_the_stand_in_is_a_scene() -> None:
    assert isinstance(Balls(), RadianceScene)


@pytest.mark.parametrize("opacity", [2.0, 20.0, 200.0])
def test_the_density_of_a_body_does_not_move_its_surface(opacity: float) -> None:
    off = off_in_voxels(Balls(density=opacity / VOXEL), level=0.5)
    assert abs(float(off.mean()) + math.log(2) / opacity) < 0.05  # half of the light is gone so deep
    assert float(off.abs().max()) < 0.5


def test_the_level_is_where_a_head_on_ray_has_it() -> None:
    """sigma = s sigmoid(d / w): the depth at d is s w softplus(d / w)."""
    density, softness = 4 / VOXEL, 0.5 * VOXEL
    for level in (0.5, 0.8):
        share = -math.log(1 - level) / (density * softness)
        expected = -softness * math.log(math.expm1(share)) / VOXEL
        off = off_in_voxels(Balls(density, softness), level=level)
        assert abs(float(off.mean()) - expected) < 0.1
        assert float(off.std()) < 0.05


@pytest.mark.parametrize("softness", [0.0, 0.25, 0.5])
def test_a_soft_body_gets_the_outline_that_it_shows(softness: float) -> None:
    """Half of the light of a ray at distance r from the middle is stopped where the depth along it is ln 2."""
    scene = Balls(density=4 / VOXEL, softness=max(softness, 0.01) * VOXEL)
    along = torch.linspace(-1, 1, 2001)
    heights = torch.linspace(0.4, 0.98, 500)
    places = torch.cartesian_prod(heights, along)
    points = torch.stack([places[:, 0], places[:, 1], torch.zeros(len(places))], 1)
    opacity = scene.opacity_at(points, 1e-3).view(500, -1)
    outline = heights[(-torch.log1p(-opacity).sum(1) > math.log(2)).nonzero()[-1]]
    off = off_in_voxels(scene) - (float(outline) - 0.7) / VOXEL
    assert abs(float(off.mean())) < 0.4


@pytest.mark.parametrize("hollow", [0.0, 0.4])
def test_a_body_is_closed_outward_and_has_no_inside(hollow: float) -> None:
    mesh = extract_mesh(Balls(hollow=hollow), RESOLUTION)
    assert is_watertight(mesh)
    assert genus(mesh) == 0
    assert not inward_faces(mesh).any()
    volume = torch.linalg.det(mesh.verts_packed()[mesh.faces_packed()]).sum() / 6
    assert float(volume) == pytest.approx(4 / 3 * math.pi * 0.7**3, rel=0.03)


def test_floaters_go_and_second_bodies_stay() -> None:
    two = Balls(centers=((0, 0, 0), (0, 0, 1.1), (-0.85, -0.85, -0.85)), radii=(0.6, 0.25, 0.08))
    assert int(components(extract_mesh(two, RESOLUTION, keep=0.05)).amax()) == 1
    assert int(components(extract_mesh(two, RESOLUTION, keep=1)).amax()) == 0
    assert int(components(extract_mesh(two, RESOLUTION, keep=0)).amax()) == 2


def test_haze_is_no_surface() -> None:
    hazy = extract_mesh(Balls(haze=0.05), RESOLUTION)
    assert float((hazy.verts_packed().norm(dim=1) - 0.7).abs().max()) < VOXEL


@pytest.mark.parametrize("density", [0.0, 1e-3, math.nan])
def test_a_field_without_a_surface_gives_an_empty_mesh(density: float, tmp_path: Path) -> None:
    written = export_surface(Balls(density=density), SurfaceSettings(16), tmp_path / "mesh")
    assert len(written.mesh.faces_packed()) == 0
    assert "no mesh" in str(written)
    assert not list(tmp_path.iterdir())


def test_a_body_cut_by_the_box_is_closed_there() -> None:
    mesh = extract_mesh(Balls(radii=(1.2,)), 32)
    assert is_watertight(mesh)
    assert float(mesh.verts_packed().abs().amax()) < 1.2 + 2.4 / 32


def test_a_room_is_seen_from_the_viewpoints() -> None:
    room = replace(Balls(radii=(3.0,)), hollow=0.6)
    mesh = extract_mesh(room, RESOLUTION, viewpoints=torch.zeros(1, 3), keep=0)
    assert is_watertight(mesh)
    inner = mesh.verts_packed().norm(dim=1) < 0.8
    assert inner.any()
    assert float((mesh.verts_packed()[inner].norm(dim=1) - 0.6).abs().max()) < VOXEL


def test_vertices_have_the_colour_of_what_looks_straight_at_them() -> None:
    mesh = extract_mesh(Balls(), RESOLUTION)
    assert isinstance(mesh.textures, TexturesVertex)
    outward = torch.nn.functional.normalize(mesh.verts_packed(), dim=1)
    assert float((mesh.textures.verts_features_packed() - (0.5 + 0.5 * outward)).abs().mean()) < 0.03


def test_files_hold_the_mesh_and_its_texture(tmp_path: Path) -> None:
    settings = SurfaceSettings(RESOLUTION, color="texture", num_faces=1500, texture_size=256)
    written = export_surface(Balls(), settings, tmp_path / "new" / "ball", up=(0.0, 0.0, 1.0))
    assert len(written.mesh.faces_packed()) <= 1500
    assert isinstance(written.mesh.textures, TexturesUV)
    names = {path.name for path in (tmp_path / "new").iterdir()}
    assert {"ball.obj", "ball.mtl", "ball.ply", "ball.glb", "ball_views.png"} <= names
    ply = IO().load_mesh(tmp_path / "new" / "ball.ply")
    assert isinstance(ply.textures, TexturesVertex)
    again = IO().load_mesh(tmp_path / "new" / "ball.glb", include_textures=True)
    middle = again.verts_packed()[again.faces_packed()].mean(1)
    texels = again.sample_textures(_Corners(len(middle)))[:, 0, 0, 0]
    wanted = 0.5 + 0.5 * torch.nn.functional.normalize(middle, dim=1)
    assert float((texels - wanted).abs().mean()) < 0.03
    with Image.open(tmp_path / "new" / "ball_views.png") as picture:
        assert np.asarray(picture).std() > 10


class _Corners:
    """Fragments that look at the middle of every face."""

    def __init__(self, count: int) -> None:
        self.pix_to_face = torch.arange(count).view(-1, 1, 1, 1)
        self.bary_coords = torch.full((count, 1, 1, 1, 3), 1 / 3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"resolution": 4}, "8 to 1024, got 4"),
        ({"level": 1.0}, "between 0 and 1"),
        ({"color": "paint"}, "vertex, texture or null"),
        ({"keep": 2}, "share of the largest"),
        ({"num_faces": 3}, "at least 100"),
    ],
)
def test_settings_that_cannot_be(settings: dict, message: str) -> None:
    with pytest.raises(UserError, match=message):
        extract_mesh(Balls(), **{"resolution": 16, **settings})


class Fitted(LightningModule, Balls):  # type: ignore[misc]
    """A field as a task is one."""

    def __init__(self, density: float) -> None:
        LightningModule.__init__(self)
        Balls.__init__(self, density=density)
        self.logged: dict[str, float] = {}

    def log(self, name: str, value: Tensor, **_: object) -> None:  # type: ignore[override]
        self.logged[name] = float(value)


class OneBall(SceneViews):
    """Knows the true mesh."""

    def load(self) -> Scene:
        nothing = SimpleNamespace()
        sphere = ico_sphere(4)
        return Scene(nothing, nothing, nothing, Balls().box, truth=sphere.update_padded(0.7 * sphere.verts_padded()))  # type: ignore[arg-type]


@pytest.mark.parametrize("density", [20 / VOXEL, 0.0])
def test_the_test_of_a_fit_leaves_the_mesh_and_its_distance(
    density: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    views, task = OneBall(), Fitted(density)
    views.setup("test")
    trainer = SimpleNamespace(datamodule=views, is_global_zero=True, loggers=[], global_step=1)
    SurfaceExporter(str(tmp_path), resolution=RESOLUTION).on_test_epoch_end(trainer, task)  # type: ignore[arg-type]
    said = capsys.readouterr().out
    if density == 0:
        assert "no mesh" in said
        assert not task.logged
        return
    assert "closed, 1 piece" in said
    assert task.logged["test/mesh_chamfer_l1"] < 0.004
    assert {path.suffix for path in tmp_path.iterdir()} >= {".obj", ".ply", ".glb", ".png"}


def test_unknown_formats_are_named() -> None:
    with pytest.raises(UserError, match="obj, ply, glb, got doc"):
        SurfaceSettings(formats=("ply", "doc"))


def test_chamfer_of_two_spheres_is_the_difference_of_their_radii() -> None:
    sphere = ico_sphere(4)
    larger = sphere.update_padded(1.1 * sphere.verts_padded())
    diagonal = float((sphere.verts_packed().amax(0) - sphere.verts_packed().amin(0)).norm())
    assert float(metrics.surface_chamfer_l1(larger, sphere)) == pytest.approx(0.1 / diagonal, rel=0.01)
    assert float(metrics.surface_chamfer_l1(sphere, sphere)) < 1e-6
