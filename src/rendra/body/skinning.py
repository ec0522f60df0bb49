"""Linear blend skinning: a skeleton turns, and the surface about it follows.

Letters: B bodies, J joints, V vertices. Rotations act on column vectors, x' = R x, as those of SMPL do.
Loper et al., "SMPL: A Skinned Multi-Person Linear Model", 2015, Eq. 2-4.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import chain, pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from rendra.kernels.skinning import SkinWeights, reference, skin
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

    Joints equally far from the root are turned at once.

    Args:
        rotations: (B, J, 3, 3), each joint's against its parent's; the first one turns everything.
        rest: (B, J, 3) places of the joints at rest. The root stays where it is.
        parents: (J,), -1 first; see `check_parents`.

    Raises:
        ValueError: shapes that do not fit each other, or parents that are no tree.
    """
    parents = tuple(parents)
    if rotations.shape[1:] != (len(parents), 3, 3) or rest.shape[1:] != (len(parents), 3):
        raise ValueError(
            f"rotations and rest of {len(parents)} joints are (B, {len(parents)}, 3, 3) and (B, {len(parents)}, 3), "
            f"got {tuple(rotations.shape)} and {tuple(rest.shape)}"
        )
    order = _order(parents)
    apart = torch.cat([rest[:, :1], rest[:, 1:] - _select(rest, order.above)], dim=1)
    moves = torch.cat([rotations, apart[..., None]], dim=-1)  # (B, J, 3, 4), each against its parent's
    levels = _select(moves, order.joints).split(order.sizes, dim=1)
    chained = [levels[0]]
    for level, slots in zip(levels[1:], order.slots, strict=True):
        parent = _select(chained[-1], slots)
        moved = parent[..., :3] @ level
        chained.append(torch.cat([moved[..., :3], moved[..., 3:] + parent[..., 3:]], dim=-1))
    posed = _select(torch.cat(chained, dim=1), order.places)
    return PosedSkeleton(posed[..., 3], posed[..., :3])


def _select(rows: Tensor, index: list[int]) -> Tensor:
    return rows.index_select(1, torch.tensor(index, dtype=torch.long, device=rows.device))


class _Order(NamedTuple):
    """The joints of a skeleton by their distance from the root."""

    above: list[int]  # parents of all joints but the root
    joints: list[int]  # level after level
    sizes: list[int]  # of the levels
    slots: list[list[int]]  # for each level but the first, where in the level before the parents are
    places: list[int]  # where in `joints` each joint is


@lru_cache
def _order(parents: tuple[int, ...]) -> _Order:
    check_parents(parents)
    depths = [0]
    for parent in parents[1:]:
        depths.append(depths[parent] + 1)
    levels = [[j for j, depth in enumerate(depths) if depth == level] for level in range(max(depths) + 1)]
    slots = [[before.index(parents[j]) for j in level] for before, level in pairwise(levels)]
    joints = list(chain.from_iterable(levels))
    return _Order(list(parents[1:]), joints, [len(level) for level in levels], slots,
                  sorted(range(len(joints)), key=joints.__getitem__))  # fmt: skip


def linear_blend_skinning(
    verts: Tensor, skeleton: PosedSkeleton, rest: Tensor, weights: Tensor | SkinWeights
) -> Tensor:
    """Vertices (B, V, 3) that follow a skeleton: each the weighted mean of where its joints would take it.

    Args:
        verts: (B, V, 3) at rest.
        skeleton: posed.
        rest: (B, J, 3) joints at rest.
        weights: of sum 1: a matrix (V, J), which gets a gradient; or those that are not zero
            (`rendra.kernels.skinning.skin_weights`), which take a tenth of the time and get none.
    """
    shifts = skeleton.joints - (skeleton.rotations * rest[..., None, :]).sum(-1)
    moves = torch.cat([skeleton.rotations, shifts[..., None]], dim=-1)
    if isinstance(weights, Tensor):
        return reference.skin_dense(verts, moves, weights)
    return skin(verts, moves, weights)


def pose_features(rotations: Tensor) -> Tensor:
    """What poses change shapes by: R - I of all joints but the first, row by row, (B, 9 (J - 1)).

    Zero at rest (Loper et al., 2015, Eq. 9).
    """
    return (rotations[:, 1:] - torch.eye(3, dtype=rotations.dtype, device=rotations.device)).flatten(1)
