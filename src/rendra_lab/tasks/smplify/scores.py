"""How good fitted bodies are: in the picture, against the truth, and as bodies.

Shapes: B people, K joints of the picture in LSP's order, J joints of the body. Errors are means over all people.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rendra.body import SMPL, SMPL_JOINTS
from rendra_lab.synthesis.joint_limits import beyond_limits, joint_angles
from rendra_lab.tasks.smplify.body_spheres import Balls, limbs_inside_trunk
from rendra_lab.tasks.smplify.records import BodyTruth

_CONFIDENT = 0.5
_TOLERANCE_DEG = 10.0  # people differ
_BACKWARDS = tuple(
    (SMPL_JOINTS.index(name), axis, sign)
    for name, axis, sign in (
        ("left_elbow", 1, 1.0), ("right_elbow", 1, -1.0), ("left_knee", 0, -1.0), ("right_knee", 0, -1.0)
    )
)  # fmt: skip
"""Elbows and knees: the angle that grows, or falls, as they are bent the wrong way."""


def joint_error_px(joints_px: Tensor, target_px: Tensor, *, counted: Tensor) -> Tensor:
    """Mean distance (pixels) of the joints that were found and count (above 0), from where they were found."""
    return _mean_of(joints_px, target_px, counted > 0)


def joint_error_percent(
    joints_px: Tensor, target_px: Tensor, *, counted: Tensor, confidence: Tensor, height_px: Tensor
) -> Tensor:
    """The same in percent of the person's size, of the confident joints alone (confidence of 0.5 and more)."""
    scale = 100 / height_px[:, None, None]
    return _mean_of(joints_px * scale, target_px * scale, (counted > 0) & (confidence >= _CONFIDENT))


def clean_error_px(joints_px: Tensor, truth: BodyTruth) -> Tensor:
    """Mean distance (pixels) of all joints from the true ones."""
    return (joints_px - truth.clean_px).norm(dim=-1).mean()


def mpjpe_mm(joints: Tensor, truth: BodyTruth) -> Tensor:
    """Mean distance of joints (B, J, 3) from the true ones, both about their pelvis, in mm."""
    return 1e3 * (_about_root(joints) - _about_root(truth.joints)).norm(dim=-1).mean()


def pa_mpjpe_mm(joints: Tensor, truth: BodyTruth) -> Tensor:
    """The same after the similarity that aligns each body best (Procrustes); "Protocol 2", in mm."""
    return 1e3 * (aligned(joints, truth.joints) - truth.joints).norm(dim=-1).mean()


def vertex_error_mm(verts: Tensor, truth: BodyTruth) -> Tensor:
    """Mean distance of vertices (B, V, 3) from the true ones after a similarity, in mm; of the same mesh."""
    return 1e3 * (aligned(verts, truth.verts) - truth.verts).norm(dim=-1).mean()


def share_within_limits(pose: Tensor) -> Tensor:
    """The share of poses (B, 3 J) with no joint more than 10 degrees beyond what people usually can."""
    beyond = beyond_limits(pose.reshape(len(pose), -1, 3)[:, :24])[:, 1:]
    return (beyond < math.radians(_TOLERANCE_DEG)).all(1).float().mean()


def share_bends_natural(pose: Tensor) -> Tensor:
    """The share of elbows and knees of poses (B, 3 J) that are not bent backwards by more than 10 degrees."""
    angles = joint_angles(pose.reshape(len(pose), -1, 3)[:, :24])
    backwards = torch.stack([sign * angles[:, joint, axis] for joint, axis, sign in _BACKWARDS], dim=1)
    return (backwards < math.radians(_TOLERANCE_DEG)).float().mean()


def beta_size(betas: Tensor) -> Tensor:
    """The root mean square of betas (B, C); 1 for people as they are."""
    return betas.square().mean().sqrt()


def share_limbs_outside(spheres: Balls) -> Tensor:
    """The share of bodies with neither a forearm nor a hand inside the trunk."""
    return (~limbs_inside_trunk(spheres)).float().mean()


def share_flipped(is_flipped: Tensor) -> Tensor:
    """How often the fit that began from the other side was better."""
    return is_flipped.float().mean()


class ShapeError:
    """Mean distance of the vertices of bodies at rest from those of the true shapes, pelvis on pelvis, in mm.

    Args:
        body: whose betas they are.
    """

    def __init__(self, body: SMPL) -> None:
        self.moves = body.shapedirs - body.joint_shapedirs[0]  # (V, 3, C) about the pelvis, linear in betas

    def __call__(self, betas: Tensor, truth: BodyTruth) -> Tensor:
        """Of betas (B, C)."""
        moves = self.moves.to(betas)
        return 1e3 * torch.stack([(moves @ apart).norm(dim=-1).mean() for apart in betas - truth.betas]).mean()


def aligned(points: Tensor, target: Tensor) -> Tensor:
    """Points (B, M, 3) after the rotation, scale and shift that bring them nearest to others (Umeyama, 1991)."""
    middle, goal = points.mean(1, keepdim=True), target.mean(1, keepdim=True)
    a, b = (points - middle).double(), (target - goal).double()
    u, s, vt = torch.linalg.svd(a.transpose(1, 2) @ b)
    mirror = torch.ones_like(s)
    mirror[:, 2] = torch.linalg.det(u @ vt).sign()
    rotation = u @ torch.diag_embed(mirror) @ vt
    scale = (s * mirror).sum(1) / a.square().sum((1, 2)).clamp_min(1e-12)
    return (scale[:, None, None] * (a @ rotation)).to(points.dtype) + goal


def _about_root(joints: Tensor) -> Tensor:
    return joints - joints[:, :1]


def _mean_of(joints: Tensor, target: Tensor, counted: Tensor) -> Tensor:
    distance = torch.where(counted, (joints - target).norm(dim=-1), 0.0)
    return distance.sum() / counted.sum().clamp_min(1)
