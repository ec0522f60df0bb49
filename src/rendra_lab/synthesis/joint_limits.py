"""How far the 24 joints of SMPL's skeleton turn.

A rotation is parted into a twist about the bone and a swing of the bone, R = swing twist: where an arm points is then
bounded apart from how it turns about itself, which Euler angles and the components of a rotation vector mix. Bones
lie along y (legs, trunk, head) or x (arms) at rest.
Axes at rest: y up, the body looks along +z, its left arm along +x. Turns of a right joint mirror those of the left
one: (x, y, z) becomes (x, -y, -z).

Ranges: American Academy of Orthopaedic Surgeons, "Joint Motion: Method of Measuring and Recording", 1965, and Boone
and Azen, "Normal range of motion of joints in male subjects", J. Bone Joint Surg. 61-A, 1979. Widened where athletes
reach further (hips), and divided where several of SMPL's joints share what is measured as one: the 80 degrees of the
back between three, those of the neck between two, the 180 of a raised arm between collar and shoulder, the 80 and 80
of the forearm's turn between elbow and wrist.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rendra.body import SMPL_JOINTS
from rendra.transforms import (
    axis_angle_to_quaternion,
    quaternion_invert,
    quaternion_multiply,
    quaternion_to_axis_angle,
)

_Range = tuple[float, float]
# degrees about x, y, z, of the trunk and of the left side; the comment says what the first and last number are
_RANGES: dict[str, tuple[_Range, _Range, _Range]] = {
    "pelvis": ((-180, 180), (-180, 180), (-180, 180)),  # the heading
    "hip": ((-130, 35), (-50, 60), (-35, 75)),  # flexion, extension; inwards, outwards; adduction, abduction
    "knee": ((0, 155), (-20, 20), (-10, 10)),  # straight, flexion
    "ankle": ((-35, 55), (-30, 30), (-30, 30)),  # dorsiflexion, plantar flexion
    "foot": ((-65, 40), (-15, 15), (-15, 15)),  # toes up, toes down
    "spine1": ((-20, 40), (-18, 18), (-20, 20)),  # extension, flexion; turns; to either side
    "spine2": ((-18, 35), (-22, 22), (-20, 20)),
    "spine3": ((-18, 30), (-25, 25), (-18, 18)),
    "neck": ((-32, 32), (-42, 42), (-28, 28)),
    "head": ((-28, 28), (-38, 38), (-20, 20)),
    "collar": ((-20, 20), (-30, 25), (-18, 42)),  # protraction, retraction; depression, elevation
    "shoulder": ((-105, 95), (-142, 70), (-102, 100)),  # outwards, inwards; across, backwards; down, up
    "elbow": ((-60, 60), (-155, 0), (-10, 10)),  # supination, pronation; flexion, straight
    "wrist": ((-50, 50), (-28, 38), (-82, 75)),  # the rest of the turn; radial, ulnar; flexion, extension
    "hand": ((-15, 15), (-20, 20), (-95, 35)),  # of the knuckles
}
_BALLS = ("hip", "shoulder")  # whose swings are bounded by an ellipse through the ranges, not by a box
_ARM = ("collar", "shoulder", "elbow", "wrist", "hand")


def joint_limits() -> tuple[Tensor, Tensor]:
    """The least and the greatest angles (24, 3), radians, of `joint_angles`."""
    bounds = torch.tensor([_bounds(name) for name in SMPL_JOINTS]) * (math.pi / 180)
    return bounds[..., 0], bounds[..., 1]


def joint_angles(pose: Tensor) -> Tensor:
    """Twists about the bones and swings of them (N, 24, 3), radians in (-pi, pi], of rotation vectors (N, 24, 3).

    The twist stands at the bone's axis; the other two are the components of the swing's rotation vector.
    """
    quaternions = axis_angle_to_quaternion(pose)
    quaternions = torch.where(quaternions[..., :1] < 0, -quaternions, quaternions)
    along = _bone_axes(pose)
    part = (quaternions[..., 1:] * along).sum(-1)
    twist_angle = 2 * torch.atan2(part, quaternions[..., 0])
    half = twist_angle[..., None] / 2
    twist = torch.cat([half.cos(), half.sin() * along], dim=-1)
    swing = quaternion_to_axis_angle(quaternion_multiply(quaternions, quaternion_invert(twist)))
    return swing * (1 - along) + twist_angle[..., None] * along


def beyond_limits(pose: Tensor) -> Tensor:
    """How far (N, 24) each joint of rotation vectors (N, 24, 3) is beyond its limits, radians; 0 within them.

    Hips and shoulders swing within an elliptic cone through their ranges, so that not both are taken at once in full.
    """
    angles = joint_angles(pose)
    lower, upper = (bound.to(angles) for bound in joint_limits())
    boxed = torch.maximum(lower - angles, angles - upper).clamp_min(0)
    balls, along = _balls(angles), _bone_axes(angles)
    swing = angles * (1 - along)
    reach = _reach(swing, lower, upper)
    outside = swing.norm(dim=-1) * (1 - 1 / reach.clamp_min(1))
    twisted = (boxed * along).amax(-1)
    return torch.where(balls, torch.maximum(outside, twisted), boxed.amax(-1))


def within_limits(pose: Tensor) -> Tensor:
    """The rotation vectors (N, 24, 3) nearest to given ones, angle by angle, that keep the limits."""
    angles = joint_angles(pose)
    lower, upper = (bound.to(angles) for bound in joint_limits())
    along = _bone_axes(angles)
    swing = angles * (1 - along)
    shrunk = swing / _reach(swing, lower, upper).clamp_min(1)[..., None]
    swing = torch.where(_balls(angles)[:, None], shrunk, swing.clamp(lower, upper) * (1 - along))
    twist = angles.clamp(lower, upper) * along
    turned = quaternion_multiply(axis_angle_to_quaternion(swing), axis_angle_to_quaternion(twist))
    return quaternion_to_axis_angle(turned)


def _bounds(name: str) -> list[_Range]:
    part = name.removeprefix("left_").removeprefix("right_")
    x, y, z = _RANGES[part]
    return [x, (-y[1], -y[0]), (-z[1], -z[0])] if name.startswith("right_") else [x, y, z]


def _bone_axes(like: Tensor) -> Tensor:
    """(24, 3), ones where bones lie along an axis at rest."""
    axes = torch.zeros(len(SMPL_JOINTS), 3)
    for joint, name in enumerate(SMPL_JOINTS):
        axes[joint, 0 if name.split("_")[-1] in _ARM else 1] = 1
    return axes.to(like)


def _balls(like: Tensor) -> Tensor:
    """(24,) bool: hips and shoulders."""
    return torch.tensor([name.split("_")[-1] in _BALLS for name in SMPL_JOINTS], device=like.device)


def _reach(swing: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """How far (N, 24) swings are on their way to the ellipse, 1 on it; its quarters have axes of their own."""
    axes = torch.where(swing < 0, -lower, upper).clamp_min(1e-3)
    return (swing / axes).norm(dim=-1)
