"""Fisheye cameras: the published formula by hand, round trips, gradients, the axis and the back."""

import math

import pytest
import torch
from assertions import assert_close, assert_finite

from rendra.renderer.cameras import try_get_projection_transform
from rendra.renderer.fisheyecameras import FishEyeCameras
from rendra.transforms import random_rotations

# a real lens's size of distortion
LENS = {
    "focal_length": torch.tensor([[0.9], [1.1]], dtype=torch.float64),
    "principal_point": torch.tensor([[0.02, -0.03], [0.0, 0.1]], dtype=torch.float64),
    "radial_params": torch.tensor([[-0.02, 0.08, -0.06, 0.015, 0.002, -0.0009]], dtype=torch.float64),
    "tangential_params": torch.tensor([[4e-4, -7e-4]], dtype=torch.float64),
    "thin_prism_params": torch.tensor([[1e-3, -2e-4, 3e-4, 5e-5]], dtype=torch.float64),
}


def some_points(p: int = 12) -> torch.Tensor:
    """View points up to 60 degrees off the axis, and one on it."""
    slopes = 2 * torch.rand(2, p, 2, dtype=torch.float64) - 1
    z = 1 + torch.rand(2, p, 1, dtype=torch.float64)
    slopes[:, 0] = 0
    slopes[:, 1] *= 1e-5
    return torch.cat((1.2 * slopes * z, z), dim=-1)


def test_the_formula_by_hand() -> None:
    camera = FishEyeCameras(**LENS)
    x, y, z = 0.3, -0.5, 1.1
    radius = math.hypot(x, y)
    theta = math.atan(radius / z)
    k = LENS["radial_params"][0].tolist()
    p0, p1 = LENS["tangential_params"][0].tolist()
    s = LENS["thin_prism_params"][0].tolist()
    d = theta * (1 + sum(c * theta ** (2 * i + 2) for i, c in enumerate(k)))
    a, b = d * x / radius, d * y / radius
    r2 = a * a + b * b
    u = a + (2 * a * a + r2) * p0 + 2 * a * b * p1 + s[0] * r2 + s[1] * r2**2
    v = b + (2 * b * b + r2) * p1 + 2 * a * b * p0 + s[2] * r2 + s[3] * r2**2
    out = camera.transform_points(torch.tensor([[x, y, z]], dtype=torch.float64))
    assert_close(out[0], [[0.9 * u + 0.02, 0.9 * v - 0.03, z]], atol=1e-12)
    assert_close(out[1], [[1.1 * u, 1.1 * v + 0.1, z]], atol=1e-12)


def test_without_distortion_it_is_equidistant() -> None:
    camera = FishEyeCameras(focal_length=((2.0,),))
    angle = torch.tensor([0.0, 1e-4, 0.5, 1.2, 2.0, 3.0])  # beyond 90 degrees too
    points = torch.stack((angle.sin(), torch.zeros(6), angle.cos()), dim=-1)
    out = camera.transform_points(points)
    assert_close(out[:, 0], 2 * angle)
    assert_close(out[:, 1], torch.zeros(6))


@pytest.mark.parametrize("off", [None, "use_radial", "use_tangential", "use_thin_prism"])
def test_unprojecting_undoes_projecting(off: str | None) -> None:
    camera = FishEyeCameras(**LENS, **({off: False} if off else {}))
    points = some_points()
    assert_close(camera.unproject_points(camera.transform_points(points)), points, atol=1e-12)


def test_behind_the_image_plane_it_still_comes_back() -> None:
    camera = FishEyeCameras(radial_params=((-0.01, 0, 0, 0, 0, 0),))
    points = torch.tensor([[1.0, 2, -0.3], [-2, 0.5, -1]])
    assert_close(camera.unproject_points(camera.transform_points(points)), points, atol=1e-4)


def test_a_switched_off_term_is_a_zero_term() -> None:
    points = some_points()
    for switch, name in (
        ("use_radial", "radial_params"),
        ("use_tangential", "tangential_params"),
        ("use_thin_prism", "thin_prism_params"),
    ):
        off = FishEyeCameras(**LENS, **{switch: False}).transform_points(points)
        zero = FishEyeCameras(**{**LENS, name: 0 * LENS[name]}).transform_points(points)
        assert_close(off, zero)
        assert not torch.allclose(off, FishEyeCameras(**LENS).transform_points(points), atol=1e-6)


def test_world_points_go_through_the_pose() -> None:
    R, T = random_rotations(2, dtype=torch.float64), torch.randn(2, 3, dtype=torch.float64)
    seen, view = FishEyeCameras(**LENS, R=R, T=T, world_coordinates=True), FishEyeCameras(**LENS)
    points = some_points()
    world = seen.get_world_to_view_transform().inverse().transform_points(points)
    projected = seen.transform_points(world)
    assert_close(projected, view.transform_points(points))
    assert_close(seen.unproject_points(projected), world, atol=1e-10)
    assert_close(seen.unproject_points(projected, world_coordinates=False), points, atol=1e-10)


def test_gradients_of_projecting_and_unprojecting() -> None:
    names = list(LENS)
    values = [value.clone().requires_grad_() for value in LENS.values()]
    points = some_points(4).requires_grad_()

    def project(points, *values):
        return FishEyeCameras(**dict(zip(names, values, strict=True))).transform_points(points)

    def unproject(points, *values):
        return FishEyeCameras(**dict(zip(names, values, strict=True))).unproject_points(points)

    assert torch.autograd.gradcheck(project, (points, *values))
    xy_depth = project(points, *values).detach().requires_grad_()
    assert torch.autograd.gradcheck(unproject, (xy_depth, *values))


def test_on_the_axis_everything_is_finite() -> None:
    points = torch.tensor([[0.0, 0, 2], [0, 0, 1e-3], [0, 0, -1], [0, 0, 0]], requires_grad=True)
    out = FishEyeCameras().transform_points(points)
    out.sum().backward()
    assert_finite(out)
    assert_finite(points.grad)


def test_shapes_indexing_and_screen() -> None:
    camera = FishEyeCameras(**LENS, image_size=((100, 200),))
    points = some_points()
    assert camera.transform_points(points[0]).shape == (2, 12, 3)
    assert camera[1].transform_points(points[1]).shape == (12, 3)
    assert camera[0].transform_points(torch.zeros(0, 3)).shape == (0, 3)
    assert_close(camera[1].transform_points(points[1]), camera.transform_points(points)[1])
    ndc, screen = camera.transform_points_ndc(points), camera.transform_points_screen(points)
    assert_close(screen[..., 0], 100 - 50 * ndc[..., 0])
    assert_close(camera.clone().transform_points(points), camera.transform_points(points))
    assert try_get_projection_transform(camera, {}) is None
    assert camera.in_ndc()
    assert not camera.is_perspective()


def test_wrong_input_is_refused() -> None:
    with pytest.raises(ValueError, match=r"radial_params of shape \(N, 6\); got \(1, 4\)"):
        FishEyeCameras(radial_params=torch.zeros(1, 4))
    with pytest.raises(ValueError, match="scaled_depth_input"):
        FishEyeCameras().unproject_points(torch.zeros(1, 3), scaled_depth_input=True)
