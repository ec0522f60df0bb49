"""Photographs of meshes against closed forms."""

import pytest
import torch
from torch import Tensor

from rendra.renderer import AmbientLights, TexturesVertex
from rendra.structures import Meshes
from rendra.utils import ico_sphere
from rendra_lab.data import mesh_photographs
from rendra_lab.data.camera_rigs import look_at_origin, rig
from rendra_lab.data.mesh_photographs import MeshPhotographer, Shots
from rendra_lab.data.posed_images import PosedImages
from rendra_lab.errors import UserError

LENS = (-0.2, 0.05, 0.004, -0.003)


def ball(level: int = 4, radius: float = 1.0, at: tuple[float, ...] = (0.0, 0.0, 0.0), grey: float = 1.0) -> Meshes:
    sphere = ico_sphere(level)
    verts = sphere.verts_packed() * radius + torch.tensor(at)
    return Meshes([verts], [sphere.faces_packed()], TexturesVertex([torch.full_like(verts, grey)]))


def shots(count: int, size: tuple[int, int], fov: float = 60.0, distortion: tuple[float, ...] = ()) -> Shots:
    R, T = look_at_origin(rig("sphere", (count, 0, 0), 2.7)[0])
    return Shots.alike([f"view {i}" for i in range(count)], R, T, size, fov, distortion)


def taken(mesh: Meshes, wanted: Shots, antialias: int = 4) -> PosedImages:
    images = list(MeshPhotographer(mesh, AmbientLights(), antialias).take(wanted))
    return PosedImages.gather(wanted.labels, images, wanted.intrinsics, wanted.R, wanted.T, wanted.distortion)


def distance_to_rays(images: PosedImages, index: int, xy: Tensor, point: Tensor) -> Tensor:
    origins, directions = images.rays(torch.full((len(xy),), index), xy)
    return torch.linalg.cross(point - origins, directions, dim=-1).norm(dim=1)


def centres(height: int, width: int) -> Tensor:
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2)


@pytest.mark.parametrize("distortion", [(), LENS])
@pytest.mark.parametrize("size", [(48, 48), (40, 64), (64, 40)])
def test_the_ray_through_what_a_pixel_shows_meets_it(size: tuple[int, int], distortion: tuple[float, ...]) -> None:
    place = (0.5, 0.3, -0.4)
    wanted = shots(6, size, distortion=distortion)
    off_centre = torch.tensor([0.0, 0.0, 3.25, -2.5])
    wanted = Shots(wanted.labels, wanted.sizes, wanted.intrinsics + off_centre, wanted.distortion, wanted.R, wanted.T)
    images = taken(ball(2, 0.06, place), wanted, antialias=8)
    for index in range(len(images)):
        alpha = images.image(index)[..., 3].reshape(-1, 1)
        xy = (centres(*size) * alpha).sum(0) / alpha.sum()
        depth = float((torch.tensor(place) - images.positions[index]).norm())
        pixel = depth / float(images.intrinsics[index, 0])
        assert distance_to_rays(images, index, xy[None], torch.tensor(place)) < 0.08 * pixel


@pytest.mark.parametrize("distortion", [(), LENS])
def test_the_silhouette_of_a_ball_is_the_balls(distortion: tuple[float, ...]) -> None:
    images = taken(ball(), shots(4, (50, 70), 70.0, distortion))
    one_pixel = 0.75 * 2.7 / float(images.intrinsics[0, 0])
    for index in range(len(images)):
        alpha = images.image(index)[..., 3].flatten()
        miss = distance_to_rays(images, index, centres(50, 70), torch.zeros(3))
        assert bool((alpha[miss < 0.997 - one_pixel] == 1).all())
        assert bool((alpha[miss > 1 + one_pixel] == 0).all())


def test_coverage_adds_up_to_the_area() -> None:
    images = taken(ball(), shots(2, (64, 64)))
    focal = float(images.intrinsics[0, 0])
    area = torch.pi * focal**2 / (2.7**2 - 1)
    for index in range(2):
        assert abs(float(images.image(index)[..., 3].sum()) / area - 1) < 0.01


def test_edges_keep_their_colour() -> None:
    rgba = taken(ball(), shots(1, (32, 32))).image(0)
    assert bool(((rgba[..., 3] > 0) & (rgba[..., 3] < 1)).any())
    assert bool((rgba[rgba[..., 3] > 0] >= torch.tensor([1.0, 1.0, 1.0, 0.0])).all())
    assert bool((rgba[rgba[..., 3] == 0] == 0).all())


@pytest.mark.parametrize("distortion", [(), LENS])
def test_pictures_do_not_depend_on_how_they_are_divided(
    monkeypatch: pytest.MonkeyPatch, distortion: tuple[float, ...]
) -> None:
    wanted = shots(2, (24, 40), distortion=distortion)
    whole = taken(ball(2), wanted).pixels.int()
    monkeypatch.setattr(mesh_photographs, "_SAMPLES_AT_ONCE", 2000)
    parts = taken(ball(2), wanted).pixels.int()
    assert int(((whole - parts).abs() > 1).any(1).sum()) <= 4  # samples that an edge meets to within rounding


def test_a_lens_that_hardly_distorts_changes_hardly_anything() -> None:
    plain, bent = (taken(ball(2), shots(2, (32, 32), distortion=lens)).pixels.int() for lens in ((), (1e-7,)))
    assert (plain[:, 3] - bent[:, 3]).abs().max() <= 20  # a sample is a sixteenth


def test_only_what_stands_before_the_camera_is_seen() -> None:
    R, T = torch.eye(3)[None], torch.tensor([[0.0, 0.0, -2.0]])  # the ball lies behind
    images = taken(ball(2), Shots.alike(["behind"], R, T, (16, 16), 60.0))
    assert not bool(images.pixels.any())
    inside = taken(ball(2), Shots.alike(["inside"], R, torch.zeros(1, 3), (16, 16), 60.0))
    assert bool((inside.pixels[:, 3] == 255).all())


def test_what_lies_outside_the_picture_leaves_it_empty() -> None:
    R, T = torch.eye(3)[None], torch.tensor([[30.0, 0.0, 3.0]])
    images = taken(ball(2), Shots.alike(["aside"], R, T, (16, 16), 60.0))
    assert not bool(images.pixels.any())


def test_what_cannot_be_is_said() -> None:
    with pytest.raises(UserError, match=r"data\.fov_deg must lie between 0 and 180"):
        shots(1, (8, 8), fov=180.0)
    with pytest.raises(UserError, match="at most 8 coefficients, got 9"):
        shots(1, (8, 8), distortion=(0.0,) * 9)
    with pytest.raises(UserError, match=r"data\.antialias must be a whole number from 1 to 16, got 0"):
        MeshPhotographer(ball(0), AmbientLights(), 0)
    with pytest.raises(ValueError, match="got a batch of 2"):
        MeshPhotographer(ball(0).extend(2), AmbientLights())
