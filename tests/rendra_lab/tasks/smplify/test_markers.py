"""Points that ride on bones: those of the body, and derivatives against autograd's."""

import pytest
import torch
from torch import Tensor

from rendra.body import SMPL
from rendra_lab.tasks.smplify.markers import Marker, MarkerSet
from rendra_lab.tasks.smplify.records import LSP_JOINTS
from rendra_lab.tasks.smplify.task import picture_markers, project, project_changes


@pytest.fixture(scope="module")
def body() -> SMPL:
    return SMPL.free(low=True)


@pytest.fixture(scope="module")
def markers(body: SMPL) -> MarkerSet:
    return MarkerSet(body, picture_markers(body)).double()


def numbers(seed: int, count: int = 2) -> Tensor:
    return 0.5 * torch.randn(count, 85, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_joints_are_those_of_the_body(body: SMPL) -> None:
    every = MarkerSet(body, [Marker.joint(body, joint) for joint in range(24)])
    x = numbers(0).float()
    expected = body(x[:, 72:82], x[:, :72], x[:, 82:]).joints
    torch.testing.assert_close(every(x).points, expected, atol=1e-5, rtol=0)


def test_the_top_of_the_head_is_the_bodys_where_one_bone_moves_it(body: SMPL, markers: MarkerSet) -> None:
    x = numbers(1)
    x[:, 3:72] = 0  # at rest, but turned as a whole
    verts = body(x[:, 72:82].float(), x[:, :72].float(), x[:, 82:].float()).verts
    head = markers(x).points[:, LSP_JOINTS.index("head_top")]
    torch.testing.assert_close(head.float(), verts[:, body.head_top], atol=1e-5, rtol=0)


@pytest.mark.parametrize("scale", [1.0, 0.0, 1e-9])
def test_written_derivatives_are_autograds(markers: MarkerSet, scale: float) -> None:
    x = scale * numbers(2)
    motion = markers(x, derivatives=True)
    assert motion.jacobian is not None
    for row in range(len(x)):
        expected = torch.autograd.functional.jacobian(lambda one: markers(one[None]).points[0], x[row])
        torch.testing.assert_close(motion.jacobian[row], expected, atol=1e-9, rtol=0)
    assert torch.equal(motion.points, markers(x).points)
    assert markers(x).jacobian is None


def test_derivatives_of_pixels_are_autograds(markers: MarkerSet) -> None:
    x, focal, center = numbers(3, 1), torch.tensor([300.0]).double(), torch.tensor([[128.0, 100.0]]).double()
    x[:, 84] = 4.0
    motion = markers(x, derivatives=True)
    assert motion.jacobian is not None

    def pixels(one: Tensor) -> Tensor:
        return project(markers(one[None]).points, focal, center)[0]

    expected = torch.autograd.functional.jacobian(pixels, x[0])
    found = project_changes(motion.points, motion.jacobian, focal)[0]
    torch.testing.assert_close(found, expected, atol=1e-8, rtol=1e-9)


def test_points_behind_the_camera_stay_finite() -> None:
    points = torch.tensor([[[1.0, 2.0, -3.0], [1.0, 2.0, 0.0]]])
    changes = torch.ones(1, 2, 3, 5)
    focal, center = torch.tensor([100.0]), torch.zeros(1, 2)
    assert bool(project(points, focal, center).isfinite().all())
    assert bool(project_changes(points, changes, focal).isfinite().all())


def test_nobody_has_no_points(markers: MarkerSet) -> None:
    motion = markers(torch.zeros(0, 85, dtype=torch.float64), derivatives=True)
    assert motion.jacobian is not None
    assert motion.points.shape == (0, 14, 3)
    assert motion.jacobian.shape == (0, 14, 3, 85)
