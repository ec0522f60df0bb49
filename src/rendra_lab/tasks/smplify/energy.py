"""The terms of SMPLify's objective, each a sum of squares.

Bogo et al., "Keep it SMPL: Automatic Estimation of 3D Human Pose and Shape from a Single Image", ECCV 2016.
Letters: N fits, K joints of the picture, J joints of the body, B betas. Angles are radians; lengths in the picture
are pixels of one in which the person is as large as in the paper's (`PeopleBatch.enlarge`).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from rendra.body import SMPL_JOINTS
from rendra_lab.tasks.smplify.pose_prior import PosePrior


class SumOfSquares(nn.Module):
    """A term: `residuals` are its rows, one a fit, and the term is their squared length."""

    def forward(self, *arguments: Tensor, **named: Tensor) -> Tensor:
        """The sum of the squares of all fits."""
        return self.residuals(*arguments, **named).square().sum()

    residuals: Callable[..., Tensor]  # rows (N, R)


class Reprojection(SumOfSquares):
    """How far the projected joints are from those of the picture, by the robust measure of Geman and McClure.

    Residual e s / sqrt(s^2 + e^2): an error e far above s counts no more than s.

    Args:
        scale_px: s.
        joint_weights: of each joint of the picture; the hips of two skeletons differ by convention, the neck too.
    """

    weights: Tensor

    def __init__(self, scale_px: float = 100.0, joint_weights: tuple[float, ...] | None = None) -> None:
        super().__init__()
        if not scale_px > 0:
            raise ValueError(f"scale_px must be positive, got {scale_px}")
        self.scale_px = scale_px
        usual = [1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 1.0]
        self.register_buffer("weights", torch.tensor(usual if joint_weights is None else joint_weights), False)

    def residuals(self, joints_px: Tensor, target_px: Tensor, *, confidence: Tensor, enlarge: Tensor) -> Tensor:
        """Rows (N, 2 K).

        Args:
            joints_px: (N, K, 2) projected.
            target_px: (N, K, 2) of the picture.
            confidence: (N, K) in [0, 1]; 0 for a joint that was not found.
            enlarge: (N,) pixels of the paper's picture in one of this.
        """
        error = (joints_px - target_px) * enlarge[:, None, None]
        robust = error * self.scale_px / (self.scale_px**2 + error.square()).sqrt()
        return (robust * (self.weights * confidence)[..., None]).flatten(1)


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


class UsualShape(SumOfSquares):
    """Betas of variance 1 are small."""

    def residuals(self, betas: Tensor) -> Tensor:
        """Betas (N, B) themselves."""
        return betas
