"""Natural poses: within the limits, nothing through anything, varied, and the limits themselves."""

import math

import pytest
import torch
from torch import Tensor

from rendra.body import SMPL, SMPL_JOINTS
from rendra.transforms import axis_angle_to_matrix, matrix_to_axis_angle
from rendra_lab.synthesis.joint_limits import beyond_limits, joint_angles, joint_limits, within_limits
from rendra_lab.synthesis.pose_families import ANGLES, FAMILIES
from rendra_lab.synthesis.poses import FAMILY_NAMES, NaturalPoses, draw_poses, limbs_apart


@pytest.fixture(scope="module")
def poses() -> NaturalPoses:
    return draw_poses(3000, seed=5)


def turned(**degrees: tuple[float, float, float]) -> Tensor:
    """A pose at rest but for some joints."""
    pose = torch.zeros(1, 24, 3)
    for name, angles in degrees.items():
        pose[0, SMPL_JOINTS.index(name)] = torch.tensor(angles) * (math.pi / 180)
    return pose


def mirrored(pose: Tensor) -> Tensor:
    other = {"left": "right", "right": "left"}
    swap = [SMPL_JOINTS.index("_".join(other.get(part, part) for part in name.split("_"))) for name in SMPL_JOINTS]
    return pose[:, swap] * torch.tensor([1.0, -1.0, -1.0])


def test_every_pose_keeps_the_limits_and_its_limbs_apart(poses: NaturalPoses) -> None:
    assert float(beyond_limits(poses.joints).max()) < 1e-5
    assert bool(limbs_apart(poses.joints).all())
    assert torch.equal(poses.joints[:, 0], torch.zeros(3000, 3))


def test_elbows_and_knees_only_flex(poses: NaturalPoses) -> None:
    angles = joint_angles(poses.joints)
    for name, axis, sign in (("left_knee", 0, 1), ("right_knee", 0, 1), ("left_elbow", 1, -1), ("right_elbow", 1, 1)):
        flexion = sign * angles[:, SMPL_JOINTS.index(name), axis]
        assert float(flexion.min()) > -1e-5
        assert float(flexion.max()) > math.radians(110)  # and far


def test_all_families_come_in_their_shares_and_in_any_order(poses: NaturalPoses) -> None:
    shares = torch.bincount(poses.family, minlength=len(FAMILY_NAMES)) / 3000
    wanted = torch.tensor([family.share for family in FAMILIES.values()])
    torch.testing.assert_close(shares[:-1], wanted / wanted.sum() * 0.94, atol=0.025, rtol=0)
    assert len(poses.family[:40].unique()) > 10


def test_the_same_seed_draws_the_same_poses_and_another_one_others() -> None:
    first, again, other = draw_poses(40, seed=1), draw_poses(40, seed=1), draw_poses(40, seed=2)
    assert torch.equal(first.joints, again.joints)
    assert torch.equal(first.trunk, again.trunk)
    assert not torch.equal(first.joints, other.joints)


def test_trunks_are_rotations_and_some_are_upside_down(poses: NaturalPoses) -> None:
    torch.testing.assert_close(poses.trunk @ poses.trunk.transpose(1, 2), torch.eye(3).expand(3000, 3, 3))
    upright = poses.trunk[:, 1, 1]  # of the pelvis' y along the world's
    assert 0.6 < float((upright > 0.8).float().mean()) < 0.95
    assert float((upright < -0.7).float().mean()) > 0.01


def test_left_and_right_are_alike(poses: NaturalPoses) -> None:
    """Half of the poses are mirrored, so that no side is favoured."""
    torch.testing.assert_close(poses.joints.mean(0), mirrored(poses.joints).mean(0), atol=0.06, rtol=0)


def test_opposite_arm_and_leg_swing_together_in_running(poses: NaturalPoses) -> None:
    running = joint_angles(poses.joints[poses.family == FAMILY_NAMES.index("running")])
    hips = running[:, SMPL_JOINTS.index("left_hip"), 0] - running[:, SMPL_JOINTS.index("right_hip"), 0]
    arms = running[:, SMPL_JOINTS.index("left_shoulder"), 1] + running[:, SMPL_JOINTS.index("right_shoulder"), 1]
    assert float(torch.corrcoef(torch.stack([hips, arms]))[0, 1]) < -0.5


def test_the_spine_bends_over_three_joints_and_a_raised_arm_over_two(poses: NaturalPoses) -> None:
    angles = joint_angles(poses.joints)
    bent = angles[:, [SMPL_JOINTS.index(f"spine{part}") for part in (1, 2, 3)], 0]
    far = bent.sum(1) > math.radians(40)
    assert bool((bent[far] > math.radians(5)).all(1).float().mean() > 0.9)
    collar, shoulder = (angles[:, SMPL_JOINTS.index(f"left_{name}"), 2] for name in ("collar", "shoulder"))
    assert float(collar[shoulder > math.radians(60)].mean()) > math.radians(15)


@pytest.mark.parametrize("count", [0, 1])
def test_few_poses_and_none(count: int) -> None:
    drawn = draw_poses(count)
    assert drawn.joints.shape == (count, 24, 3)
    assert drawn.trunk.shape == (count, 3, 3)


@pytest.mark.parametrize("arguments", [{"count": -1}, {"count": 1, "random_share": 2.0}, {"count": 1, "noise": -1.0}])
def test_impossible_arguments_are_refused(arguments: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="at least 0"):
        draw_poses(**arguments)  # type: ignore[arg-type]


def test_random_poses_are_more_spread_than_those_of_families() -> None:
    wild, tame = draw_poses(400, random_share=1.0), draw_poses(400, random_share=0.0, noise=0.3)
    spine = SMPL_JOINTS.index("spine2")
    assert float(wild.joints[:, spine].std(0)[1]) > float(tame.joints[:, spine].std(0)[1])
    assert bool((wild.family == len(FAMILIES)).all())


def test_keys_name_angles_that_exist() -> None:
    for family in FAMILIES.values():
        assert family.share > 0
        for pose in family.keys:
            assert set(pose) == set(ANGLES)


# limits


def test_limits_are_of_every_joint_and_mirror_each_other() -> None:
    lower, upper = joint_limits()
    assert lower.shape == upper.shape == (24, 3)
    assert bool((lower <= 0).all())
    assert bool((upper >= 0).all())
    swapped_lower, swapped_upper = mirrored(lower[None])[0], mirrored(upper[None])[0]
    torch.testing.assert_close(torch.minimum(swapped_lower, swapped_upper), lower)
    torch.testing.assert_close(torch.maximum(swapped_lower, swapped_upper), upper)


def test_twist_and_swing_make_the_rotation_again() -> None:
    pose = torch.randn(50, 24, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    angles = joint_angles(pose)
    arm = torch.tensor([any(part in name for part in ("collar", "shoulder", "elbow", "wrist", "hand"))
                        for name in SMPL_JOINTS])  # fmt: skip
    along = torch.where(arm[:, None], torch.eye(3)[0], torch.eye(3)[1]).double()
    swing, twist = angles * (1 - along), angles * along
    torch.testing.assert_close(
        axis_angle_to_matrix(swing) @ axis_angle_to_matrix(twist), axis_angle_to_matrix(pose), atol=1e-9, rtol=0
    )


def test_a_twist_does_not_change_the_swing() -> None:
    swing = turned(left_shoulder=(0, -50, 30))[:, 16]
    twist = turned(left_shoulder=(40, 0, 0))[:, 16]
    whole = torch.zeros(1, 24, 3)
    whole[:, 16] = matrix_to_axis_angle(axis_angle_to_matrix(swing) @ axis_angle_to_matrix(twist))
    torch.testing.assert_close(joint_angles(whole)[:, 16], swing + twist, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("joint", "angles", "beyond"),
    [
        ("left_knee", (30, 0, 0), 0.0),
        ("left_knee", (-20, 0, 0), 20.0),
        ("right_elbow", (0, 90, 0), 0.0),
        ("right_elbow", (0, -15, 0), 15.0),
        ("left_elbow", (0, -165, 0), 10.0),
        ("left_shoulder", (0, 0, 100), 0.0),
        ("left_shoulder", (0, 0, 130), 30.0),
        ("right_hip", (-150, 0, 0), 20.0),
        ("pelvis", (170, 0, 0), 0.0),
    ],
)
def test_how_far_a_joint_is_beyond_its_limits(joint: str, angles: tuple[float, float, float], beyond: float) -> None:
    found = beyond_limits(turned(**{joint: angles}))[0]
    assert float(found[SMPL_JOINTS.index(joint)]) == pytest.approx(math.radians(beyond), abs=1e-5)
    assert float(found.sum()) == pytest.approx(math.radians(beyond), abs=1e-5)


def test_a_hip_does_not_flex_and_spread_in_full_at_once() -> None:
    assert float(beyond_limits(turned(left_hip=(-90, 0, 40))).max()) == 0
    assert float(beyond_limits(turned(left_hip=(-115, 0, 60))).max()) > math.radians(10)


def test_what_is_brought_within_the_limits_keeps_them_and_what_does_stays() -> None:
    pose = 1.2 * torch.randn(200, 24, 3, generator=torch.Generator().manual_seed(3))
    brought = within_limits(pose)
    assert float(beyond_limits(brought).max()) < 1e-5
    assert float(beyond_limits(pose).max()) > 0.5
    torch.testing.assert_close(
        axis_angle_to_matrix(within_limits(brought)), axis_angle_to_matrix(brought), atol=1e-5, rtol=0
    )


# limbs


@pytest.mark.parametrize(
    ("pose", "is_apart"),
    [
        ({}, True),
        ({"left_shoulder": (0, 0, -75), "right_shoulder": (0, 0, 75)}, True),
        ({"left_shoulder": (0, 0, -75), "left_elbow": (75, -95, 0)}, False),  # a forearm through the belly
        ({"left_hip": (0, 0, -30)}, False),  # a leg through the other one
        ({"right_shoulder": (0, 120, 0)}, True),  # reaches across, before the chest
        ({"right_shoulder": (0, 150, 70)}, False),
        ({"left_hip": (-100, 0, 10), "right_hip": (-100, 0, -10)}, True),
    ],
)
def test_limbs_that_go_through_something_are_found(
    pose: dict[str, tuple[float, float, float]], is_apart: bool
) -> None:
    assert bool(limbs_apart(turned(**pose))[0]) == is_apart


def test_the_spheres_that_are_tested_lie_within_the_body() -> None:
    """Poses whose limbs are apart must not be refused: at rest every sphere is inside the free body's box."""
    from rendra_lab.synthesis import poses as module

    body = SMPL.free(low=True)
    rest = body.joint_template[None]
    eye = torch.eye(3).expand(1, 24, 3, 3)
    least, most = body.v_template.amin(0) - 0.02, body.v_template.amax(0) + 0.02
    for name, rows in module._SPHERES.items():
        middles, radii = module._spheres(rest, eye, rows)
        assert bool((middles[0] - 0.5 * radii[:, None] > least).all()), name
        assert bool((middles[0] + 0.5 * radii[:, None] < most).all()), name
