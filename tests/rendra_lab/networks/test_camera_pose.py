"""Steps of learnable cameras."""

import pytest
import torch
from assertions import assert_close, assert_finite

from rendra.renderer import FoVPerspectiveCameras, look_at_view_transform
from rendra_lab.networks.camera_pose import LookAtPose, SixDofPose, camera_centre, look_at_origin


@pytest.mark.parametrize("make", [LookAtPose, SixDofPose])
def test_no_step_is_no_change(make):
    R, T = look_at_view_transform(2.7, [10.0, 80.0], [30.0, -120.0])
    moved = make().retract(R, T, torch.zeros(2, make.degrees_of_freedom))
    assert_close(moved[0], R, atol=1e-6)
    assert_close(moved[1], T, atol=1e-6)


def test_centre_and_look_at_agree_with_the_cameras():
    R, T = look_at_view_transform(2.7, 30, 40)
    assert_close(camera_centre(R, T), FoVPerspectiveCameras(R=R, T=T).get_camera_center())
    again = look_at_origin(camera_centre(R, T))
    assert_close(again[0], R)
    assert_close(again[1], T)


def test_a_look_at_step_moves_the_position_and_keeps_the_aim():
    pose = LookAtPose()
    pose.place(*look_at_origin(torch.tensor([[0.0, 1.0, 3.0]])))
    with torch.no_grad():
        pose.delta.copy_(torch.tensor([1.0, -0.5, 0.25]))
    R, T = pose()
    assert_close(camera_centre(R, T), [[1.0, 0.5, 3.25]])
    assert_close(T[:, :2], [[0.0, 0.0]], atol=1e-6)


def test_a_free_step_is_a_rotation_and_a_shift():
    R, T = look_at_view_transform(3.0, 20, 50)
    turned, moved = SixDofPose().retract(R, T, torch.tensor([[0.1, -0.2, 0.3, 1.0, 2.0, 3.0]]))
    assert_close(turned @ turned.transpose(1, 2), torch.eye(3)[None])
    angle = torch.arccos(((turned[0] * R[0]).sum() - 1) / 2)
    assert_close(angle, torch.tensor([0.1, -0.2, 0.3]).norm(), atol=1e-4)
    assert_close(moved - T, [[1.0, 2.0, 3.0]])


@pytest.mark.parametrize("make", [LookAtPose, SixDofPose])
def test_gradients_are_finite_at_the_start(make):
    pose = make()
    assert not pose.is_placed
    pose.place(*look_at_origin(torch.tensor([[3.0, 6.9, 2.5]])))
    assert pose.is_placed
    R, T = pose()
    (R.sum() + T.sum()).backward()
    assert_finite(pose.delta.grad)
    assert pose.delta.grad.abs().max() > 0
