"""The terms of SMPLify's objective, each a sum of squares.

Bogo et al., "Keep it SMPL: Automatic Estimation of 3D Human Pose and Shape from a Single Image", ECCV 2016.
Letters: N fits, K joints of the picture, J joints of the body, B betas. Angles are radians; lengths in the picture
are pixels of one in which the person is as large as in the paper's (`PeopleBatch.enlarge`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from rendra.body import SMPL_JOINTS
from rendra_lab.synthesis.joint_limits import beyond_limits
from rendra_lab.tasks.smplify.pose_prior import PosePrior


class SumOfSquares(nn.Module):
    """A term: `residuals` are its rows, one a fit, and the term is their squared length."""

    def forward(self, *arguments: Any, **named: Tensor) -> Tensor:
        """The sum of the squares of all fits."""
        return self.residuals(*arguments, **named).square().sum()

    residuals: Callable[..., Tensor]  # rows (N, R)


class Reprojection(SumOfSquares):
    """How far the projected joints are from those of the picture, by the robust measure of Geman and McClure.

    Residual e s / sqrt(s^2 + e^2): an error e far above s counts no more than s.

    Args:
        scale_px: s.
    """

    def __init__(self, scale_px: float = 100.0) -> None:
        super().__init__()
        if not scale_px > 0:
            raise ValueError(f"scale_px must be positive, got {scale_px}")
        self.scale_px = scale_px

    def residuals(
        self, joints_px: Tensor, target_px: Tensor, *, confidence: Tensor, weight: Tensor, enlarge: Tensor
    ) -> Tensor:
        """Rows (N, 2 K).

        Args:
            joints_px: (N, K, 2) projected.
            target_px: (N, K, 2) of the picture.
            confidence: (N, K) in [0, 1]; 0 for a joint that was not found.
            weight: (N, K) that multiplies it.
            enlarge: (N,) pixels of the paper's picture in one of this.
        """
        error = (joints_px - target_px) * enlarge[:, None, None]
        robust = error * self.scale_px / (self.scale_px**2 + error.square()).sqrt()
        return _weighted(robust, weight * confidence).flatten(1)

    def row_derivatives(
        self,
        changes: Tensor,
        joints_px: Tensor,
        target_px: Tensor,
        *,
        confidence: Tensor,
        weight: Tensor,
        enlarge: Tensor,
    ) -> Tensor:
        """How the rows change with joints_px: (N, 2 K, P) of changes (N, K, 2, P)."""
        error = (joints_px - target_px) * enlarge[:, None, None]
        slope = self.scale_px**3 / (self.scale_px**2 + error.square()).pow(1.5) * enlarge[:, None, None]
        return (_weighted(slope, weight * confidence)[..., None] * changes).flatten(1, 2)


def _weighted(rows: Tensor, weight: Tensor) -> Tensor:
    """Joints (N, K, 2) by weights (N, K); those that nobody found count nothing, whatever stands there."""
    return torch.where(weight[..., None] > 0, weight[..., None] * rows, 0.0)


class NaturalPose(SumOfSquares):
    """How unlikely a pose is: the most favourable of a mixture of Gaussians.

    Args:
        prior: the mixture.
    """

    def __init__(self, prior: PosePrior) -> None:
        super().__init__()
        self.prior = prior

    def residuals(self, pose: Tensor) -> Tensor:
        """Rows (N, 3 J - 2) of poses (N, 3 J) whose first three numbers, the heading, do not count."""
        return self.prior.residuals(pose[:, 3:])

    def row_derivatives(self, changes: Tensor, pose: Tensor) -> Tensor:
        """How the rows change with the pose: (N, 3 J - 2, P) of changes (N, 3 J, P); the component stays."""
        return self.prior.row_derivatives(changes[:, 3:], pose[:, 3:])


class NaturalBends(SumOfSquares):
    """Elbows and knees bend one way: exp(angle the other way)."""

    columns: Tensor
    signs: Tensor

    def __init__(self, steepness: float = 1.0) -> None:
        super().__init__()
        self.steepness = steepness
        bends = {"left_elbow": (1, 1.0), "right_elbow": (1, -1.0), "left_knee": (0, -1.0), "right_knee": (0, -1.0)}
        columns = [3 * SMPL_JOINTS.index(name) + axis for name, (axis, _) in bends.items()]
        self.register_buffer("columns", torch.tensor(columns), False)
        self.register_buffer("signs", torch.tensor([sign for _, sign in bends.values()]), False)

    def residuals(self, pose: Tensor) -> Tensor:
        """Rows (N, 4) of poses (N, 3 J)."""
        return 10 * (self.steepness * self.signs * pose.index_select(1, self.columns)).exp()

    def row_derivatives(self, changes: Tensor, pose: Tensor) -> Tensor:
        """How the rows change with the pose: (N, 4, P) of changes (N, 3 J, P)."""
        slope = self.steepness * self.signs * self.residuals(pose)
        return slope[..., None] * changes.index_select(1, self.columns)


class JointLimits(SumOfSquares):
    """No joint turns further than joints do: see `rendra_lab.synthesis.joint_limits`. Not of the paper."""

    def residuals(self, pose: Tensor) -> Tensor:
        """Rows (N, 23), radians beyond its limits, of the joints of poses (N, 3 J) but the root."""
        return beyond_limits(pose.reshape(len(pose), -1, 3)[:, : len(SMPL_JOINTS)])[:, 1:]

    def row_derivatives(self, changes: Tensor, pose: Tensor) -> Tensor:
        """How the rows change with the pose: (N, 23, P) of changes (N, 3 J, P); each moves with its own joint."""
        with torch.enable_grad():
            turns = pose.detach().reshape(len(pose), -1, 3)[:, : len(SMPL_JOINTS)].requires_grad_()
            (slope,) = torch.autograd.grad(beyond_limits(turns).sum(), turns)
        of_joints = changes.unflatten(1, (-1, 3))[:, 1 : len(SMPL_JOINTS)]
        return (slope[:, 1:, :, None] * of_joints).sum(2)


class UsualShape(SumOfSquares):
    """Betas of variance 1 are small."""

    def residuals(self, betas: Tensor) -> Tensor:
        """Betas (N, B) themselves."""
        return betas

    def row_derivatives(self, changes: Tensor, betas: Tensor) -> Tensor:
        """Those of the betas: (N, B, P)."""
        return changes
