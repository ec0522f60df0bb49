"""A camera's pose as a learnable module: a base pose and a step from it.

Poses are PyTorch3D's: x_view = x_world @ R + T, R (B, 3, 3), T (B, 3). A pose model says what a step means
(`retract`); both gradient descent, whose parameter is the step, and Gauss-Newton methods, which make small steps
from wherever they stand, use it.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rendra.renderer.cameras import look_at_rotation
from rendra.transforms import so3_exp_map
from rendra_lab.records import TensorRecord


@dataclass(frozen=True)
class PosePrediction(TensorRecord):
    """A mesh as fitted cameras see it."""

    rgb: Float[Tensor, "B H W 3"]
    silhouette: Float[Tensor, "B H W"]
    R: Float[Tensor, "B 3 3"]
    T: Float[Tensor, "B 3"]

    @property
    def position(self) -> Tensor:
        """Where the cameras stand in the world: (B, 3)."""
        return camera_centre(self.R, self.T)


class CameraPose(nn.Module, ABC):
    """One camera: base pose R, T (buffers) and the step `delta` (P,) from it, which is learned."""

    degrees_of_freedom: int
    R: Tensor
    T: Tensor
    is_placed: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.delta = nn.Parameter(torch.zeros(self.degrees_of_freedom))
        self.register_buffer("R", torch.eye(3)[None])
        self.register_buffer("T", torch.tensor([[0.0, 0.0, 1.0]]))
        self.register_buffer("is_placed", torch.tensor(False))

    @abstractmethod
    def retract(self, R: Tensor, T: Tensor, delta: Tensor) -> tuple[Tensor, Tensor]:
        """The poses (B, 3, 3), (B, 3) after steps delta (B, P)."""

    def forward(self) -> tuple[Tensor, Tensor]:
        """The pose now: R (1, 3, 3), T (1, 3)."""
        return self.retract(self.R, self.T, self.delta[None])

    @torch.no_grad()
    def place(self, R: Tensor, T: Tensor) -> None:
        """Start anew from the pose R (1, 3, 3), T (1, 3)."""
        self.R.copy_(R)
        self.T.copy_(T)
        self.delta.zero_()
        self.is_placed.fill_(True)


class LookAtPose(CameraPose):
    """A camera that looks at the origin with +Y up: the step moves its position (3 degrees of freedom)."""

    degrees_of_freedom = 3

    def retract(self, R: Tensor, T: Tensor, delta: Tensor) -> tuple[Tensor, Tensor]:
        """Move the camera's centre C = -T R^T by delta in world units and look at the origin again."""
        return look_at_origin(camera_centre(R, T) + delta)


class SixDofPose(CameraPose):
    """A free camera: the step is a rotation vector in the view frame (rad) and a translation."""

    degrees_of_freedom = 6

    def retract(self, R: Tensor, T: Tensor, delta: Tensor) -> tuple[Tensor, Tensor]:
        """Turn the scene about the world's origin by delta[:3], as the camera sees it, and shift it by delta[3:]."""
        return R @ so3_exp_map(delta[:, :3]), T + delta[:, 3:]


def look_at_origin(position: Tensor) -> tuple[Tensor, Tensor]:
    """The poses of cameras at positions (B, 3) that look at the origin, +Y up."""
    R = look_at_rotation(position, device=position.device)
    return R, -(position[:, None] @ R)[:, 0]


def camera_centre(R: Tensor, T: Tensor) -> Tensor:
    """World positions (B, 3) of cameras."""
    return -(T[:, None] @ R.transpose(1, 2))[:, 0]
