"""Linear blend skinning: a skeleton turns, and the surface about it follows.

Letters: B bodies, J joints, V vertices. Rotations act on column vectors, x' = R x, as those of SMPL do.
Loper et al., "SMPL: A Skinned Multi-Person Linear Model", 2015, Eq. 2-4.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from rendra.transforms import axis_angle_to_matrix, rotation_6d_to_matrix


class PosedSkeleton(NamedTuple):
    """Where a posed skeleton is.

    Attributes:
        joints: (B, J, 3) places of the joints.
        rotations: (B, J, 3, 3) of each joint's bone, from rest to the world: the product along its chain.
    """

    joints: Tensor
    rotations: Tensor


def check_parents(parents: Sequence[int]) -> tuple[int, ...]:
    """The parents of J joints, as a tuple.

    Raises:
        ValueError: the first one is not the root (-1), or another one does not come after its parent.
    """
    if not parents or parents[0] != -1:
        raise ValueError(f"the first joint must be the root, with parent -1; got {list(parents)}")
    for joint, parent in enumerate(parents[1:], 1):
        if not 0 <= parent < joint:
            raise ValueError(f"the parent of joint {joint} must be one of the joints before it, got {parent}")
    return tuple(int(parent) for parent in parents)


def pose_to_matrices(pose: Tensor, num_joints: int) -> Tensor:
    """Rotations (B, J, 3, 3) of each joint against its parent.

    Args:
        pose: rotation vectors (B, J, 3) or (B, 3 J), radians; rotation matrices (B, J, 3, 3); or six numbers a joint
            (B, J, 6), the first two rows of a matrix (Zhou et al., "On the continuity of rotation representations",
            2019).
        num_joints: J.

    Raises:
        ValueError: another shape.
    """
    shape = tuple(pose.shape[1:])
    if shape == (3 * num_joints,):
        return axis_angle_to_matrix(pose.reshape(-1, num_joints, 3))
    if shape == (num_joints, 3):
        return axis_angle_to_matrix(pose)
    if shape == (num_joints, 6):
        return rotation_6d_to_matrix(pose)
    if shape == (num_joints, 3, 3):
        return pose
    raise ValueError(
        f"a pose of {num_joints} joints is (B, {num_joints}, 3), (B, {3 * num_joints}), (B, {num_joints}, 3, 3) or "
        f"(B, {num_joints}, 6), got {tuple(pose.shape)}"
    )


def pose_skeleton(rotations: Tensor, rest: Tensor, parents: Sequence[int]) -> PosedSkeleton:
    """Turns each joint of a skeleton against its parent.

    Args:
        rotations: (B, J, 3, 3), each joint's against its parent's; the first one turns everything.
        rest: (B, J, 3) places of the joints at rest. The root stays where it is.
        parents: (J,), -1 first; see `check_parents`.
    """
    turned: list[Tensor] = [rotations[:, 0]]
    placed: list[Tensor] = [rest[:, 0]]
    for joint in range(1, len(parents)):
        parent = parents[joint]
        turned.append(turned[parent] @ rotations[:, joint])
        apart = (rest[:, joint] - rest[:, parent])[..., None]
        placed.append(placed[parent] + (turned[parent] @ apart)[..., 0])
    return PosedSkeleton(torch.stack(placed, dim=1), torch.stack(turned, dim=1))


def linear_blend_skinning(verts: Tensor, skeleton: PosedSkeleton, rest: Tensor, weights: Tensor) -> Tensor:
    """Vertices (B, V, 3) that follow a skeleton: each the weighted mean of where its joints would take it.

    Args:
        verts: (B, V, 3) at rest.
        skeleton: posed.
        rest: (B, J, 3) joints at rest.
        weights: (V, J), not negative, of sum 1.
    """
    num_bodies, num_joints = rest.shape[:2]
    shifts = skeleton.joints - (skeleton.rotations @ rest[..., None])[..., 0]
    moves = torch.cat([skeleton.rotations, shifts[..., None]], dim=-1).reshape(num_bodies, num_joints, 12)
    blended = (weights @ moves).reshape(num_bodies, -1, 3, 4)
    return (blended[..., :3] @ verts[..., None])[..., 0] + blended[..., 3]
