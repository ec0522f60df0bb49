"""Joining cameras, reading back eye, target and up, and turning on the spot."""

import math

import pytest
import torch
from assertions import assert_close

from rendra.renderer.camera_utils import camera_to_eye_at_up, join_cameras_as_batch, rotate_on_spot
from rendra.renderer.cameras import (
    FoVPerspectiveCameras,
    PerspectiveCameras,
    get_world_to_view_transform,
    look_at_view_transform,
)
from rendra.renderer.fisheyecameras import FishEyeCameras
from rendra.transforms import axis_angle_to_matrix, random_rotations


def test_joining_keeps_every_camera() -> None:
    points = torch.randn(6, 3)
    singles = [FoVPerspectiveCameras(fov=40.0 + i, R=random_rotations(1), T=torch.randn(1, 3)) for i in range(2)]
    pair = FoVPerspectiveCameras(fov=torch.tensor([30.0, 35]), R=random_rotations(2), T=torch.randn(2, 3))
    joined = join_cameras_as_batch([singles[0], pair, singles[1]])
    assert len(joined) == 4
    expected = [singles[0].transform_points(points)[None], pair.transform_points(points)]
    assert_close(joined.transform_points(points)[:3], torch.cat(expected))
    assert_close(joined[3].transform_points(points), singles[1].transform_points(points))
    px = [PerspectiveCameras(50.0 + i, in_ndc=False, image_size=((4, 5 + i),)) for i in range(2)]
    assert_close(join_cameras_as_batch(px).image_size, [[4, 5], [4, 6]])
    assert len(join_cameras_as_batch([FishEyeCameras(), FishEyeCameras()])) == 2


def test_joining_refuses() -> None:
    one, other = PerspectiveCameras(), FoVPerspectiveCameras()
    px = PerspectiveCameras(50.0, in_ndc=False, image_size=((4, 5),))
    sized = PerspectiveCameras(image_size=((4, 5),))
    for cameras, message in (
        ([], "one or more"),
        ([one, 3], "must inherit"),
        ([one, other], "same type.*FoVPerspective"),
        ([one, px], "_in_ndc is not constant"),
        ([one, sized], "image_size is given for some"),
        ([one, PerspectiveCameras(device="meta")], "same device"),
    ):
        with pytest.raises(ValueError, match=message):
            join_cameras_as_batch(cameras)


def test_eye_at_up_describe_the_camera() -> None:
    R, T = random_rotations(5, dtype=torch.float64), torch.randn(5, 3, dtype=torch.float64)
    eye, at, up = camera_to_eye_at_up(get_world_to_view_transform(R, T))
    R2, T2 = look_at_view_transform(eye=eye, at=at, up=up)
    assert_close(R2, R, atol=1e-12)
    assert_close(T2, T, atol=1e-12)
    assert_close(up.norm(dim=-1), torch.ones(5))


def test_turning_on_the_spot_keeps_the_centre() -> None:
    R, T = random_rotations(4, dtype=torch.float64), torch.randn(4, 3, dtype=torch.float64)
    turn = random_rotations(4, dtype=torch.float64)
    R2, T2 = rotate_on_spot(R, T, turn)
    before, after = PerspectiveCameras(R=R, T=T), PerspectiveCameras(R=R2, T=T2)
    assert_close(after.get_camera_center(), before.get_camera_center())
    points = torch.randn(4, 6, 3, dtype=torch.float64)
    seen = before.get_world_to_view_transform().transform_points(points)
    assert_close(after.get_world_to_view_transform().transform_points(points), seen @ turn.mT)
    single = rotate_on_spot(R[0], T[0], turn[0])
    assert_close(single[0], R2[:1])
    assert_close(single[1], T2[:1])


def test_turning_about_y_pans() -> None:
    turn = axis_angle_to_matrix(torch.tensor([0.0, math.pi / 2, 0]))
    R, T = rotate_on_spot(torch.eye(3), torch.zeros(3), turn)
    ahead = get_world_to_view_transform(R, T).transform_points(torch.tensor([[0.0, 0, 1]]))
    assert_close(ahead, [[1.0, 0, 0]], atol=1e-6)  # what was ahead is now on the left (+X)


def test_turning_refuses_wrong_shapes() -> None:
    with pytest.raises(ValueError, match=r"Invalid T.*\(1, 2\)"):
        rotate_on_spot(torch.eye(3), torch.zeros(2), torch.eye(3))
    with pytest.raises(ValueError, match="Invalid rotation"):
        rotate_on_spot(torch.eye(3), torch.zeros(3), torch.eye(4))
