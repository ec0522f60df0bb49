"""Natural poses of people, drawn at random: what they do, in how many ways, and nothing that a body cannot.

Every pose lies between key poses of one family (`pose_families`), some are anything within the limits of the joints
(`joint_limits`). Angles of the trunk are shared by the joints of the spine and the neck, and an arm's rise by collar
and shoulder (a third of it, as Inman, Saunders and Abbott, "Observations on the function of the shoulder joint",
1944, found). Poses whose limbs go through the trunk or each other are drawn again.

The poses are made here, and none is recorded: no motion capture data were used.
Axes at rest: y up, the body looks along +z, its left arm along +x. Letters: N poses, A named angles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from rendra.body import SMPL, SMPL_JOINTS, SMPL_PARENTS, pose_skeleton
from rendra.transforms import axis_angle_to_matrix, matrix_to_axis_angle
from rendra_lab.synthesis.joint_limits import beyond_limits, joint_angles, joint_limits, within_limits
from rendra_lab.synthesis.pose_families import ANGLES, ARM, ARMS, FAMILIES, LIMB, SPREAD, Family, Key

__all__ = [
    "FAMILY_NAMES",
    "NaturalPoses",
    "beyond_limits",
    "draw_poses",
    "joint_angles",
    "joint_limits",
    "limbs_apart",
    "within_limits",
]

FAMILY_NAMES = (*FAMILIES, "random")
_ROUNDS = 60  # of drawing again what was not possible; each is possible more often than not
_NEAR = 0.35  # of the way to the next key, where what lies between two keys is neither
_SPINE = {"spine1": (0.4, 0.25, 0.4), "spine2": (0.35, 0.35, 0.35), "spine3": (0.25, 0.4, 0.25)}  # flex, turn, side
_NECK = {"neck": (0.55, 0.5, 0.55), "head": (0.45, 0.5, 0.45)}


@dataclass(frozen=True)
class NaturalPoses:
    """N poses.

    Attributes:
        joints: (N, 24, 3) rotation vectors against the parents; those of the first joint are 0.
        trunk: (N, 3, 3) how the pelvis lies in a world whose y is up, before anybody chooses a heading about y.
        family: (N,) which of FAMILY_NAMES.
    """

    joints: Tensor
    trunk: Tensor
    family: Tensor

    def select(self, rows: Tensor) -> NaturalPoses:
        """Some of them, by numbers or a mask."""
        return NaturalPoses(self.joints[rows], self.trunk[rows], self.family[rows])


def draw_poses(count: int, seed: int = 0, random_share: float = 0.06, noise: float = 1.0) -> NaturalPoses:
    """Poses of all families, in random order; the same for the same arguments.

    Args:
        count: N.
        seed: of all choices.
        random_share: of the poses are anything within the limits of the joints.
        noise: scales the spread of each angle about the keys.

    Raises:
        ValueError: a negative count or noise, or a share outside [0, 1].
    """
    if count < 0 or not 0 <= random_share <= 1 or not noise >= 0:
        raise ValueError(
            f"count and noise must be at least 0 and random_share in [0, 1], got {count}, {noise} and {random_share}"
        )
    generator = torch.Generator().manual_seed(seed)
    shares = torch.tensor([family.share for family in FAMILIES.values()])
    shares = torch.cat([shares / shares.sum() * (1 - random_share), torch.tensor([random_share])])
    wanted = torch.multinomial(shares, max(count, 1), replacement=True, generator=generator)[:count]
    poses = _of_families(wanted, noise, generator)
    bad = (~limbs_apart(poses.joints)).nonzero()[:, 0]
    for _ in range(_ROUNDS):
        if not len(bad):
            break
        again = _of_families(wanted[bad], noise, generator)
        poses.joints[bad], poses.trunk[bad] = again.joints, again.trunk
        bad = bad[~limbs_apart(again.joints)]
    poses.joints[bad] = _as_pose(_neutral(1))[0]  # whoever is so stubborn stands at ease
    return poses


def _of_families(family: Tensor, noise: float, generator: torch.Generator) -> NaturalPoses:
    """One pose for each number of a family."""
    angles = _neutral(len(family))
    for number, kind in enumerate(FAMILIES.values()):
        rows = (family == number).nonzero()[:, 0]
        angles[rows] = _between_keys(kind, len(rows), noise, generator)
    joints, trunk = _as_pose(angles)
    rows = (family == len(FAMILIES)).nonzero()[:, 0]
    joints[rows] = _anything(len(rows), generator)
    upright = math.radians(20) * torch.randn(len(rows), 3, generator=generator) * torch.tensor([1.0, 0.0, 1.0])
    trunk[rows] = axis_angle_to_matrix(upright)
    return NaturalPoses(joints, trunk, family)


def _between_keys(family: Family, count: int, noise: float, generator: torch.Generator) -> Tensor:
    """Angles (count, A) in degrees."""
    keys = _table(family.keys)
    stops = len(keys) if family.is_cyclic else len(keys) - 1
    time = torch.rand(count, generator=generator) * stops
    first = time.long().clamp_max(max(stops - 1, 0))
    share = (time - first)[:, None]
    here, there = keys[first], keys[(first + 1) % len(keys)]
    angles = torch.lerp(here, there, share * (_NEAR if family.is_apart else 1))
    strength = 0.8 + 0.4 * torch.rand(count, 1, generator=generator)  # small and large motions
    angles = _neutral(1) + strength * (angles - _neutral(1))
    stance = [ANGLES.index("pitch"), ANGLES.index("roll")]
    angles[:, stance] = here[:, stance] if family.is_apart else torch.lerp(here, there, share)[:, stance]
    angles = _with_free_arms(angles, family.free_arms, generator)
    spread = torch.tensor([SPREAD[_part(name)] for name in ANGLES]) * noise
    calm = 0.5 + torch.rand(count, 1, generator=generator)
    return _mirrored_half(angles + calm * spread * torch.randn(angles.shape, generator=generator), generator)


def _with_free_arms(angles: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Some of the poses with other arms: both sides alike, or each its own."""
    count, keys = len(angles), _table(ARMS)
    chosen = torch.randint(len(ARMS), (count, 2), generator=generator)
    alike = torch.rand(count, generator=generator) < 0.5
    chosen[:, 1] = torch.where(alike, chosen[:, 0], chosen[:, 1])
    free = torch.rand(count, generator=generator) < share
    angles = angles.clone()
    for side, name in enumerate(("left_", "right_")):
        columns = [ANGLES.index(name + part) for part in ARM]
        angles[:, columns] = torch.where(free[:, None], keys[chosen[:, side]][:, columns], angles[:, columns])
    return angles


def _mirrored_half(angles: Tensor, generator: torch.Generator) -> Tensor:
    """Left and right exchanged in half of the poses."""
    swap = torch.tensor([ANGLES.index(_other_side(name)) for name in ANGLES])
    signs = torch.tensor([-1.0 if name in ("side", "turn", "tilt", "look", "roll") else 1.0 for name in ANGLES])
    mirrored = angles[:, swap] * signs
    return torch.where(torch.rand(len(angles), 1, generator=generator) < 0.5, mirrored, angles)


def _anything(count: int, generator: torch.Generator) -> Tensor:
    """Rotation vectors (count, 24, 3) anywhere within the limits, more often about the middle of the ranges."""
    lower, upper = joint_limits()
    shares = torch.rand(3, count, *lower.shape, generator=generator).mean(0)  # a bell
    ease, _ = _as_pose(_neutral(1))
    low, high = (lower - joint_angles(ease)) * 1.1, (upper - joint_angles(ease)) * 1.1
    angles = joint_angles(ease) + torch.where(shares < 0.5, (1 - 2 * shares) * low, (2 * shares - 1) * high)
    pose = within_limits(angles)
    pose[:, 0] = 0
    return pose


def _as_pose(angles: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation vectors (N, 24, 3) within the limits and turns of the trunk (N, 3, 3) of angles (N, A) in degrees."""
    angles = angles * (math.pi / 180)
    named = dict(zip(ANGLES, angles.unbind(1), strict=True))
    zero = torch.zeros_like(angles[:, 0])
    turns = {name: torch.eye(3).expand(len(angles), 3, 3) for name in SMPL_JOINTS}
    for shares, names in ((_SPINE, ("flex", "turn", "side")), (_NECK, ("nod", "look", "tilt"))):
        flex, turn, side = (named[name] for name in names)
        for joint, (forth, round_, left) in shares.items():
            turns[joint] = _turn(forth * flex, round_ * turn, -left * side)
    for side_name, sign in (("left", 1.0), ("right", -1.0)):
        limb = {part: named[f"{side_name}_{part}"] for part in LIMB}
        for joint, (x, y, z) in _leg(limb).items():
            turns[f"{side_name}_{joint}"] = _turn(x, sign * y, sign * z)
        for joint, turned in _arm(limb, sign).items():
            turns[f"{side_name}_{joint}"] = turned
    pose = matrix_to_axis_angle(torch.stack([turns[name] for name in SMPL_JOINTS], dim=1))
    trunk = _turn(zero, zero, -named["roll"]) @ _turn(named["pitch"], zero, zero)
    return within_limits(pose), trunk


def _leg(limb: dict[str, Tensor]) -> dict[str, tuple[Tensor, Tensor, Tensor]]:
    """Rotations about x, y, z of the joints of a left leg."""
    zero = torch.zeros_like(limb["hip"])
    return {
        "hip": (-limb["hip"], limb["out"], limb["abd"]),
        "knee": (limb["knee"].clamp_min(0), zero, zero),
        "ankle": (limb["ankle"], 0.3 * limb["out"], -0.4 * limb["abd"]),  # soles seek the floor
        "foot": (-limb["toe"], zero, zero),
    }


def _arm(limb: dict[str, Tensor], sign: float) -> dict[str, Tensor]:
    """Rotations (N, 3, 3) of the joints of an arm; sign -1 for the right one."""
    raised, plane = limb["raise_"], limb["plane"]
    zero = torch.zeros_like(raised)
    forth = raised.sin() * plane.sin()
    direction = torch.stack([raised.sin() * plane.cos(), -raised.cos(), forth], dim=1)
    whole = _swing_from_x(direction, sign) @ _turn(-limb["spin"], zero, zero)
    lift = math.radians(36) * (raised / math.pi).clamp(0, 1) ** 1.5 - math.radians(5) + limb["shrug"]
    reach = torch.where(forth > 0, math.radians(18) * forth, math.radians(12) * forth)
    collar = _turn(zero, sign * -reach, sign * lift)
    bent = _turn(zero, sign * -limb["elbow"].clamp_min(0), zero)
    return {
        "collar": collar,
        "shoulder": collar.transpose(1, 2) @ whole,
        "elbow": bent @ _turn(limb["palm"] / 2, zero, zero),
        "wrist": _turn(zero, zero, -sign * limb["wrist"]) @ _turn(limb["palm"] / 2, zero, zero),
        "hand": _turn(zero, zero, -sign * limb["grip"]),
    }


def _turn(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Rotations (N, 3, 3): a twist about y, then a swing about x and z."""
    zero = torch.zeros_like(x)
    swing = axis_angle_to_matrix(torch.stack([x, zero, z], dim=1))
    return swing @ axis_angle_to_matrix(torch.stack([zero, y, zero], dim=1))


def _swing_from_x(direction: Tensor, sign: float) -> Tensor:
    """The shortest rotations (N, 3, 3) from an arm at rest, left for sign 1, to a direction (N, 3) of a left arm."""
    x, y, z = direction.unbind(1)
    axis = torch.stack([torch.zeros_like(x), -sign * z, sign * y], dim=1)  # of the cross product
    sine = axis.norm(dim=1, keepdim=True)
    return axis_angle_to_matrix(axis / sine.clamp_min(1e-9) * torch.atan2(sine, x[:, None]))


@cache
def _skeleton() -> Tensor:
    """Joints (24, 3) of the mean free body at rest."""
    return SMPL.free(low=True).joint_template


def limbs_apart(pose: Tensor) -> Tensor:
    """Whether (N,) no limb goes through the trunk, the head or another limb, of rotation vectors (N, 24, 3).

    Spheres along the bones of the mean free body, a little thinner than the flesh, which may touch.
    """
    rest = _skeleton()
    skeleton = pose_skeleton(axis_angle_to_matrix(pose), rest.expand(len(pose), -1, -1), SMPL_PARENTS)
    spheres = {name: _spheres(skeleton.joints, skeleton.rotations, rows) for name, rows in _SPHERES.items()}
    apart = torch.ones(len(pose), dtype=torch.bool)
    for one, other, squeeze in _PAIRS:
        (a, r), (b, s) = spheres[one], spheres[other]
        apart &= (torch.cdist(a, b) > squeeze * (r[:, None] + s)).flatten(1).all(1)
    return apart


# of each group of spheres: bone, offset from its joint at rest in metres, radius
_Sphere = tuple[str, tuple[float, float, float], float]
_TRUNK_SPHERES: list[_Sphere] = [
    (bone, (x, up, forth), 0.105)
    for bone, up, forth in (
        ("pelvis", 0.0, 0.02), ("spine1", 0.05, 0.055), ("spine2", 0.06, 0.045), ("spine3", 0.07, 0.03)
    )
    for x in (-0.055, 0.055)
]  # fmt: skip


def _along(bone: str, vector: tuple[float, float, float], shares: tuple[float, ...], radius: float) -> list[_Sphere]:
    return [(bone, (share * vector[0], share * vector[1], share * vector[2]), radius) for share in shares]


_SPHERES: dict[str, list[_Sphere]] = {"trunk": _TRUNK_SPHERES, "head": [("head", (0.0, 0.04, 0.015), 0.1)]}
for _side, _sign in (("left", 1.0), ("right", -1.0)):
    _SPHERES[f"{_side}_upper_arm"] = _along(f"{_side}_shoulder", (_sign * 0.253, 0.0, 0.0), (0.65, 1.0), 0.045)
    _SPHERES[f"{_side}_forearm"] = _along(f"{_side}_elbow", (_sign * 0.227, 0.0, 0.0), (0.3, 0.65, 1.0), 0.038)
    _SPHERES[f"{_side}_hand"] = _along(f"{_side}_wrist", (_sign * 0.1, -0.005, 0.0), (0.5, 1.0, 1.5), 0.035)
    _SPHERES[f"{_side}_thigh"] = _along(f"{_side}_hip", (_sign * 0.019, -0.365, 0.0), (0.35, 0.55, 0.75, 1.0), 0.068)
    _SPHERES[f"{_side}_calf"] = _along(f"{_side}_knee", (_sign * 0.021, -0.429, 0.0), (0.2, 0.4, 0.6, 0.8, 1.0), 0.05)
    _SPHERES[f"{_side}_foot"] = _along(f"{_side}_ankle", (_sign * 0.01, -0.04, 0.13), (0.4, 1.0), 0.04)

_PAIRS: list[tuple[str, str, float]] = [
    *((f"{side}_upper_arm", "trunk", 0.85) for side in ("left", "right")),
    *((f"{side}_{part}", "trunk", 0.95) for side in ("left", "right") for part in ("forearm", "hand")),
    *((f"{side}_{part}", "head", 0.9) for side in ("left", "right") for part in ("upper_arm", "forearm", "hand")),
    *((f"{side}_{part}", "trunk", 0.9) for side in ("left", "right") for part in ("calf", "foot")),
    *((f"{side}_{part}", f"{other}_thigh", 0.85) for side in ("left", "right") for other in ("left", "right")
      for part in ("forearm", "hand")),
    *((f"{side}_{part}", f"{other}_calf", 0.85) for side in ("left", "right") for other in ("left", "right")
      for part in ("forearm", "hand")),
    *((f"left_{one}", f"right_{two}", 0.85) for one in ("thigh", "calf", "foot") for two in ("thigh", "calf", "foot")
      if (one, two) != ("thigh", "thigh")),
    *((f"left_{one}", f"right_{two}", 0.8) for one in ("upper_arm", "forearm", "hand") for two in
      ("upper_arm", "forearm", "hand")),
]  # fmt: skip


def _spheres(joints: Tensor, rotations: Tensor, rows: list[_Sphere]) -> tuple[Tensor, Tensor]:
    """Middles (N, S, 3) and radii (S,)."""
    bones = torch.tensor([SMPL_JOINTS.index(bone) for bone, _, _ in rows])
    offsets = torch.tensor([offset for _, offset, _ in rows])
    middles = joints[:, bones] + (rotations[:, bones] @ offsets[:, :, None])[..., 0]
    return middles, torch.tensor([radius for _, _, radius in rows])


def _neutral(count: int) -> Tensor:
    """Angles (count, A) in degrees of standing at ease."""
    return _table(FAMILIES["standing"].keys[:1]).repeat(count, 1)


def _table(keys: tuple[Key, ...]) -> Tensor:
    return torch.tensor([[pose[name] for name in ANGLES] for pose in keys])


def _part(name: str) -> str:
    return name.removeprefix("left_").removeprefix("right_")


def _other_side(name: str) -> str:
    if name.startswith("left_"):
        return "right_" + _part(name)
    return "left_" + _part(name) if name.startswith("right_") else name
