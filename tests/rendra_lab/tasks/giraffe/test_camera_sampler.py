"""Cameras on a sphere, and their rays."""

import math

import pytest
import torch
from assertions import assert_close

from rendra_lab.errors import UserError
from rendra_lab.tasks.giraffe.camera_sampler import CameraSampler


def drawn(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_cameras_look_at_the_middle_upright() -> None:
    cameras = CameraSampler(30.0, (2.0, 3.0), (0.0, 1.0), (0.0, 0.5)).sample(200, drawn())
    R, eye = cameras.camera_to_world[:, :3, :3], cameras.camera_to_world[:, :3, 3]
    assert_close(R.mT @ R, torch.eye(3).expand(200, 3, 3))
    assert_close(torch.linalg.det(R), torch.ones(200))
    assert_close(R[:, :, 2] * eye.norm(dim=1, keepdim=True), eye)  # looks along -z
    assert_close(R[:, 2, 0], torch.zeros(200))  # x is level
    assert float(R[:, 2, 1].min()) >= 0  # y is up
    assert 2 <= float(eye.norm(dim=1).min()) < 2.05 < 2.95 < float(eye.norm(dim=1).max()) <= 3
    assert_close(cameras.camera_to_world[:, 3], torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(200, 4))


def test_places_are_uniform_on_the_sphere_and_poles_are_no_exception() -> None:
    sampler = CameraSampler(polar=(0.0, 1.0), radius=(1.0, 1.0))
    z = sampler.sample(4000, drawn()).camera_to_world[:, 2, 3]
    assert_close(z.sort().values, torch.linspace(1, -1, 4000).flip(0), atol=0.06)  # Archimedes
    zero = torch.zeros(2)
    above = sampler.at(zero, torch.tensor([0.0, 1.0]), zero + 1, zero).camera_to_world[:, :3, :3]
    assert_close(above.mT @ above, torch.eye(3).expand(2, 3, 3))


def test_rays_fill_the_field_of_view() -> None:
    sampler = CameraSampler(40.0, polar=(0.3, 0.3))
    cameras = sampler.sample(2, drawn())
    rays = sampler.rays(cameras, 4)
    assert rays.directions.shape == (2, 16, 3)
    own = rays.directions @ cameras.camera_to_world[:, :3, :3]  # in the camera's axes
    assert_close(own[..., 2], -torch.ones(2, 16))
    half = math.tan(math.radians(20))
    assert_close(own[0, :4, 0], torch.tensor([-0.75, -0.25, 0.25, 0.75]) * half)
    assert_close(own[0, ::4, 1], torch.tensor([0.75, 0.25, -0.25, -0.75]) * half)  # the first row is the upper
    assert float(rays.directions[0, 0, 2]) > float(rays.directions[0, 12, 2])
    ends = CameraSampler(40.0, polar=(0.3, 0.3), end_points_included=True).rays(cameras, 4).directions
    assert_close((ends @ cameras.camera_to_world[:, :3, :3])[0, :4, 0], torch.tensor([-1, -1 / 3, 1 / 3, 1]) * half)
    assert CameraSampler(end_points_included=True).rays(cameras, 1).directions.isfinite().all()


def test_published_quirks_are_what_they_are_said_to_be() -> None:
    quirky = CameraSampler(polar=(0.05, 0.5), batch_normalized_look_at=True)
    R = quirky.sample(50, drawn()).camera_to_world[:, :3, :3]
    sines = R[:, :2, 2].norm(dim=1)
    assert_close(R.norm(dim=1)[:, 0], sines / sines.max())
    assert_close(R.norm(dim=1)[:, 1], sines / sines.max())
    assert_close(R.norm(dim=1)[:, 2], torch.ones(50))
    assert quirky.sample(0, drawn()).camera_to_world.shape == (0, 4, 4)
    turns = [
        CameraSampler(background_turns=(0.0, 0.25), one_background_turn=one).sample(9, drawn()).background_turn
        for one in (False, True)
    ]
    assert 0 < float(turns[0].min()) < float(turns[0].max()) < math.pi / 2
    assert float(turns[1].min()) == float(turns[1].max()) == float(turns[0][0])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"fov_deg": 180.0}, "fov_deg must be above 0 and below 180, got 180"),
        ({"radius": (3.0, 2.0)}, "the least first"),
        ({"polar": (0.2, 1.5)}, "cameras.polar"),
    ],
)
def test_settings_that_cannot_be(settings: dict, message: str) -> None:
    with pytest.raises(UserError, match=message):
        CameraSampler(**settings)
