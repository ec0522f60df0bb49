"""Where a camera fit begins."""

import math

import pytest
import torch
from assertions import assert_close
from torch.optim import Adam

from rendra.renderer import look_at_view_transform
from rendra.transforms import euler_angles_to_matrix
from rendra_lab.camera_starts import GivenStart, MultiStart, sphere_directions
from rendra_lab.data.meshes import load_mesh
from rendra_lab.data.views import render_views
from rendra_lab.losses import SummedSquaredError
from rendra_lab.metrics import position_error_percent, rotation_error_deg
from rendra_lab.networks.camera_pose import LookAtPose, SixDofPose, camera_centre, look_at_origin
from rendra_lab.networks.mesh_view import MeshView
from rendra_lab.tasks.pose.task import Pose
from rendra_lab.terms import LossTerm


def make_task(scene, pose):
    losses = {
        "silhouette": LossTerm(SummedSquaredError(), 1.0, "silhouette", "silhouette"),
        "texture": LossTerm(SummedSquaredError(), 0.1, "rgb", "rgb"),
    }
    return Pose(scene=scene, pose=pose, start=GivenStart(), losses=losses, optimizer=Adam)


def random_view(scene, generator, free=False):
    direction = torch.randn(1, 3, generator=generator)
    distance = 2.2 + 1.8 * torch.rand(1, generator=generator)
    R, T = look_at_origin(direction / direction.norm() * distance)
    if free:
        roll = torch.tensor([[0.0, 0.0, 2 * math.pi]]) * torch.rand(1, generator=generator)
        shift = torch.tensor([[0.5, 0.5, 0.0]]) * (torch.rand(1, 3, generator=generator) - 0.5)
        R, T = R @ euler_angles_to_matrix(roll, "XYZ"), T + shift
    return render_views(scene, R, T)


def found(search, scene, pose, target):
    """Rotation error in degrees and distance error in percent."""
    R, T = search(scene, pose, target, make_task(scene, pose).residuals_of)
    distance = 100 * (T.norm() / target.T.norm() - 1).abs()
    return float(rotation_error_deg(R, target.R)), float(distance)


def test_directions_are_even():
    directions = sphere_directions(256)
    assert_close(directions.norm(dim=1), torch.ones(256))
    assert directions.mean(0).norm() < 0.01
    nearest = (directions @ directions.T - 2 * torch.eye(256)).amax(1).clamp(-1, 1).arccos()
    assert torch.rad2deg(nearest).min() > 8
    assert torch.rad2deg(nearest).max() < 16


def test_a_given_start_looks_at_the_origin():
    scene = MeshView(load_mesh("ico_sphere", level=0), image_size=8)
    target = render_views(scene, *look_at_view_transform(3.0))
    R, T = GivenStart([3.0, 6.9, 2.5])(scene, LookAtPose(), target, None)
    assert_close(camera_centre(R, T), [[3.0, 6.9, 2.5]])
    with pytest.raises(ValueError, match="three coordinates"):
        GivenStart([0.0, 0.0, 0.0])


@pytest.mark.parametrize("pose", [LookAtPose, SixDofPose])
def test_a_small_search_finds_the_cow(pose):
    scene = MeshView(load_mesh(num_faces=2000, texture_size=128), image_size=96, sigma=2e-5)
    R, T = look_at_view_transform(2.6, 25.0, 140.0)
    levels = ((32, 16, 8, 4), (96, 32, 2, 6))
    search = MultiStart(directions=64, rolls=4, levels=levels)
    rotation_deg, distance_percent = found(search, scene, pose(), render_views(scene, R, T))
    assert rotation_deg < 2
    assert distance_percent < 2


def test_nothing_to_find_is_an_error():
    scene = MeshView(load_mesh("ico_sphere", level=1), image_size=32)
    away = render_views(scene, torch.eye(3)[None], torch.tensor([[50.0, 0.0, 2.0]]))
    with pytest.raises(ValueError, match="silhouette is empty"):
        MultiStart(directions=4)(scene, LookAtPose(), away, None)


@pytest.mark.slow
@pytest.mark.parametrize(("pose", "views", "needed"), [(LookAtPose, 100, 95), (SixDofPose, 40, 38)])
def test_random_views_of_the_real_cow_are_found(shared_data, pose, views, needed):
    """Under 2 degrees and 2 % of the distance, with the defaults."""
    scene = MeshView(load_mesh(path=shared_data / "cow" / "cow.obj"), sigma=3e-6)
    generator, search, good = torch.Generator().manual_seed(0), MultiStart(), 0
    for view in range(views):
        target = random_view(scene, generator, free=pose is SixDofPose)
        rotation_deg, distance_percent = found(search, scene, pose(), target)
        success = rotation_deg < 2 and distance_percent < 2
        good += success
        if not success:
            print(
                f"view {view}: {rotation_deg:.2f} degrees, {distance_percent:.2f} %, from {target.position.tolist()}"
            )
    print(f"{pose.__name__}: {good} of {views}")
    assert good >= needed


def test_errors_are_measured_as_they_are_called():
    R, T = look_at_view_transform(3.0, 10.0, 20.0)
    turned, _ = look_at_view_transform(3.0, 11.0, 20.0)
    assert_close(rotation_error_deg(turned, R), 1.0, atol=1e-3)
    assert_close(position_error_percent(torch.tensor([[3.0, 0.03, 0.0]]), torch.tensor([[3.0, 0.0, 0.0]])), 1.0)
