"""Scores of fitted bodies: closed forms, what alignment undoes, millimetres."""

import math

import pytest
import torch

from rendra.body import SMPL, SMPL_JOINTS
from rendra.transforms import axis_angle_to_matrix
from rendra_lab.tasks.smplify import scores
from rendra_lab.tasks.smplify.records import BodyTruth, joint_weights


@pytest.fixture(scope="module")
def body() -> SMPL:
    return SMPL.free(low=True)


def cloud(seed: int = 0) -> torch.Tensor:
    return torch.randn(4, 24, 3, generator=torch.Generator().manual_seed(seed))


def truth(joints: torch.Tensor, betas: torch.Tensor | None = None) -> BodyTruth:
    count = len(joints)
    betas = torch.zeros(count, 10) if betas is None else betas
    return BodyTruth(torch.zeros(count, 72), betas, torch.zeros(count, 3), joints, joints, torch.zeros(count, 14, 2))


def turned_and_grown(joints: torch.Tensor) -> torch.Tensor:
    turns = axis_angle_to_matrix(torch.randn(len(joints), 3, generator=torch.Generator().manual_seed(1)))
    scale = torch.tensor([0.5, 1.0, 2.0, 3.0])[: len(joints), None, None]
    return scale * joints @ turns + torch.tensor([3.0, -2.0, 5.0])


def test_alignment_undoes_a_similarity() -> None:
    goal = cloud()
    torch.testing.assert_close(scores.aligned(turned_and_grown(goal), goal), goal, atol=1e-5, rtol=0)
    assert float(scores.pa_mpjpe_mm(turned_and_grown(goal), truth(goal))) < 0.01
    assert float(scores.vertex_error_mm(turned_and_grown(goal), truth(goal))) < 0.01


def test_alignment_does_not_mirror() -> None:
    goal = cloud()
    mirrored = goal * torch.tensor([-1.0, 1.0, 1.0])
    assert float((scores.aligned(mirrored, goal) - goal).norm(dim=-1).mean()) > 0.3


def test_no_similarity_is_better_than_the_aligned() -> None:
    points, goal = cloud(2), cloud(3)
    best = (scores.aligned(points, goal) - goal).square().sum((1, 2))
    for step in range(20):
        generator = torch.Generator().manual_seed(step)
        turn = axis_angle_to_matrix(0.05 * torch.randn(4, 3, generator=generator))
        near = scores.aligned(points, goal) @ turn * (1 + 0.05 * torch.randn(4, 1, 1, generator=generator))
        assert bool(((near - goal).square().sum((1, 2)) >= best - 1e-4).all())


def test_points_that_all_lie_in_one_place_stay_finite() -> None:
    assert bool(scores.aligned(torch.ones(2, 5, 3), cloud()[:2, :5]).isfinite().all())
    assert scores.aligned(torch.zeros(0, 24, 3), torch.zeros(0, 24, 3)).shape == (0, 24, 3)


def test_errors_of_joints_are_millimetres_about_the_pelvis() -> None:
    goal = cloud()
    off = goal + torch.tensor([1.0, 2.0, 3.0])  # the place does not count
    assert float(scores.mpjpe_mm(off, truth(goal))) == pytest.approx(0, abs=1e-3)
    off[:, 1:, 0] += 0.024  # 24 mm in all joints but the pelvis
    assert float(scores.mpjpe_mm(off, truth(goal))) == pytest.approx(23.0, abs=1e-2)


def test_errors_in_the_picture_are_of_joints_that_count_and_were_found() -> None:
    target, confidence = torch.zeros(2, 14, 2), torch.ones(2, 14)
    fitted = torch.full((2, 14, 2), 3.0) * torch.tensor([1.0, 0.0])  # 3 pixels to the right
    fitted[:, [2, 3, 12]] = 1000.0  # hips and neck differ by convention
    fitted[0, 0] = 500.0
    confidence[0, 0] = 0.0
    confidence[1, 1] = 0.4
    fitted[1, 1] = torch.tensor([25.0, 0.0])
    counted = joint_weights(2, hips_and_neck=0.0) * (confidence > 0)
    found = scores.joint_error_px(fitted, target, counted=counted)
    assert float(found) == pytest.approx((20 * 3 + 25) / 21)
    percent = scores.joint_error_percent(
        fitted, target, counted=counted, confidence=confidence, height_px=torch.tensor([100.0, 200.0])
    )
    assert float(percent) == pytest.approx((10 * 3 + 10 * 1.5) / 20)
    assert float(scores.joint_error_px(fitted, target, counted=0 * counted)) == 0


def test_shapes_are_compared_at_rest_pelvis_on_pelvis(body: SMPL) -> None:
    betas, zero = torch.tensor([[1.5, -1.0] + [0.0] * 8]), torch.zeros(1, 10)
    apart = []
    for shape in (betas, zero):
        posed = body(shape, torch.zeros(1, 72))
        apart.append(posed.verts - posed.joints[:, :1])
    expected = 1e3 * (apart[0] - apart[1]).norm(dim=-1).mean()
    measure = scores.ShapeError(body)
    assert float(measure(betas, truth(cloud()[:1]))) == pytest.approx(float(expected), rel=1e-4)
    assert float(measure(zero, truth(cloud()[:1]))) == 0
    assert float(scores.beta_size(torch.full((3, 10), -2.0))) == 2


@pytest.mark.parametrize(
    ("joint", "forwards"),
    [
        ("left_elbow", [0.0, -1.0, 0.0]),
        ("right_elbow", [0.0, 1.0, 0.0]),
        ("left_knee", [1.0, 0.0, 0.0]),
        ("right_knee", [1.0, 0.0, 0.0]),
    ],
)
def test_elbows_and_knees_bend_one_way(joint: str, forwards: list[float]) -> None:
    pose = torch.zeros(1, 24, 3)
    pose[0, SMPL_JOINTS.index(joint)] = torch.tensor(forwards)
    assert float(scores.share_bends_natural(pose.flatten(1))) == 1
    assert float(scores.share_within_limits(pose.flatten(1))) == 1
    assert float(scores.share_bends_natural(-pose.flatten(1))) == 0.75
    assert float(scores.share_within_limits(-pose.flatten(1))) == 0
    assert float(scores.share_bends_natural(-math.radians(8) * pose.flatten(1))) == 1  # people differ


def test_flips_are_counted() -> None:
    assert float(scores.share_flipped(torch.tensor([True, False, False, False]))) == 0.25
