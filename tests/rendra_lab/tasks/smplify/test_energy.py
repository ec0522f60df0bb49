"""Terms of the objective: closed forms, limits, and written derivatives against autograd's."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from rendra.body import SMPL_JOINTS
from rendra_lab.tasks.smplify.energy import JointLimits, NaturalBends, NaturalPose, Reprojection, UsualShape
from rendra_lab.tasks.smplify.pose_prior import PosePrior
from rendra_lab.tasks.smplify.records import joint_weights
from rendra_lab.terms import LossTerm


def near_one(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def check_derivatives(term: Any, field: Tensor, *others: Tensor, **named: Tensor) -> None:
    changes = near_one(9, *field.shape, 5)
    found = term.row_derivatives(changes, field, *others, **named)
    for row in range(len(field)):
        rest = [other[row : row + 1] for other in others]
        names = {name: value[row : row + 1] for name, value in named.items()}
        slope = torch.autograd.functional.jacobian(
            lambda one, rest=rest, names=names: term.residuals(one[None], *rest, **names)[0], field[row]
        )
        expected = slope.flatten(1) @ changes[row].flatten(0, -2)
        torch.testing.assert_close(found[row], expected, atol=1e-9, rtol=1e-7)


def seen(count: int = 3) -> dict[str, Tensor]:
    confidence = near_one(1, count, 14).abs().clamp_max(1)
    confidence[0, 4] = 0
    weight = near_one(8, count, 14).abs()
    weight[1, 2] = 0
    return {"confidence": confidence, "weight": weight, "enlarge": near_one(2, count).abs() + 0.5}


def test_written_derivatives_are_autograds() -> None:
    check_derivatives(Reprojection(20.0).double(), 30 * near_one(3, 3, 14, 2), 30 * near_one(4, 3, 14, 2), **seen())
    check_derivatives(NaturalPose(PosePrior.built_in()).double(), 0.3 * near_one(5, 3, 72))
    check_derivatives(NaturalBends().double(), near_one(6, 3, 72))
    check_derivatives(JointLimits(), near_one(8, 3, 72))
    check_derivatives(UsualShape(), near_one(7, 3, 10))


def test_small_errors_count_as_they_are_and_large_ones_no_more_than_the_scale() -> None:
    one = torch.ones(1, 14, dtype=torch.float64)
    weight = joint_weights(1, hips_and_neck=0.0).double()
    named = {"confidence": one, "weight": weight, "enlarge": torch.ones(1, dtype=torch.float64)}
    target = torch.zeros(1, 14, 2, dtype=torch.float64)
    term = Reprojection(100.0).double()
    small = term.residuals(target + 0.1, target, **named)
    large = term.residuals(target - 1e6, target, **named)
    counted = [index for index in range(14) if index not in (2, 3, 12)]
    assert small.view(1, 14, 2)[:, counted] == pytest.approx(0.1, rel=1e-5)
    assert large.view(1, 14, 2)[:, counted] == pytest.approx(-100, rel=1e-6)
    for rows in (small, large):
        assert float(rows.view(1, 14, 2)[:, [2, 3, 12]].abs().max()) == 0  # hips and neck, by convention
    at_scale = term.residuals(target + 100, target, **named)
    assert float(at_scale.max()) == pytest.approx(100 / math.sqrt(2))


def test_errors_are_those_of_the_papers_pictures() -> None:
    """A person of half the size counts as one of the full size with twice the error."""
    term, target = Reprojection(), torch.zeros(1, 14, 2)
    sure = {"confidence": torch.ones(1, 14), "weight": torch.ones(1, 14)}
    small = term(target + 2, target, **sure, enlarge=torch.tensor([2.0]))
    large = term(target + 4, target, **sure, enlarge=torch.tensor([1.0]))
    assert float(small) == pytest.approx(float(large))


def test_joints_that_nobody_found_count_nothing_whatever_stands_there() -> None:
    target, joints_px = torch.full((1, 14, 2), torch.nan), torch.zeros(1, 14, 2)
    unseen = {"confidence": torch.zeros(1, 14), "weight": torch.ones(1, 14)}
    value = Reprojection()(joints_px, target, **unseen, enlarge=torch.ones(1))
    assert float(value) == 0


def test_joints_count_as_they_are_told_to() -> None:
    joints_px, weight = torch.ones(1, 14, 2), torch.tensor([[0.0] * 13 + [3.0]])
    known = {"confidence": torch.full((1, 14), 0.5), "weight": weight, "enlarge": torch.ones(1)}
    rows = Reprojection(1e9).residuals(joints_px, 0 * joints_px, **known)
    assert rows[0].tolist() == [0.0] * 26 + [1.5] * 2


def test_the_scale_of_errors_is_positive() -> None:
    with pytest.raises(ValueError, match="scale_px must be positive, got 0"):
        Reprojection(0.0)


def test_bends_cost_what_the_paper_says() -> None:
    pose = torch.zeros(1, 24, 3)
    assert NaturalBends().residuals(pose.flatten(1)).tolist() == [[10.0] * 4]
    pose[0, SMPL_JOINTS.index("left_elbow"), 1] = -1.0  # its numbers 55, 58, 12 and 15
    pose[0, SMPL_JOINTS.index("right_elbow"), 1] = 1.0
    pose[0, SMPL_JOINTS.index("left_knee"), 0] = 1.0
    pose[0, SMPL_JOINTS.index("right_knee"), 0] = -1.0
    flat = pose.flatten(1)
    assert flat[0, [55, 58, 12, 15]].tolist() == [-1.0, 1.0, 1.0, -1.0]
    expected = [10 / math.e, 10 / math.e, 10 / math.e, 10 * math.e]
    assert NaturalBends().residuals(flat)[0].tolist() == pytest.approx(expected)


def test_the_heading_does_not_make_a_pose_unnatural() -> None:
    term, pose = NaturalPose(PosePrior.built_in()), 0.2 * near_one(8, 2, 72).float()
    turned = torch.cat([pose[:, :3] + 1, pose[:, 3:]], dim=1)
    assert torch.equal(term.residuals(pose), term.residuals(turned))


def test_terms_are_sums_of_squares_of_weighted_rows() -> None:
    term = LossTerm(UsualShape(), weight=[[0, 4.0], [10, 4.0], [10, 9.0]], prediction="betas", target=None)
    rows = term.residual_rows({"betas": torch.ones(2, 3)}, {}, step=10)
    assert rows.tolist() == [[3.0] * 3] * 2
    assert float(term({"betas": torch.ones(2, 3)}, {})) == 6
