"""Where to begin: how far away a person stands, and which way they are turned, from the torso alone.

Bogo et al., "Keep it SMPL", ECCV 2016, Sec. 3.3: depth by similar triangles; who shows narrow shoulders is also begun
from behind.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rendra.transforms import axis_angle_to_matrix, matrix_to_axis_angle
from rendra_lab.tasks.smplify.records import LSP_JOINTS, PeopleBatch

_TORSO = tuple(LSP_JOINTS.index(name) for name in ("right_hip", "left_hip", "right_shoulder", "left_shoulder"))
_SIDES = ((0, 2), (1, 3))  # hip and shoulder of one side, within the torso


@dataclass(frozen=True)
class CameraStart:
    """How a fit begins.

    Args:
        narrow_px: shoulders closer than this, in a picture of the paper's size, leave open which way a person looks:
            both are tried.
    """

    narrow_px: float = 25.0

    def __call__(self, batch: PeopleBatch, rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Headings and places of bodies at rest.

        Args:
            batch: B people.
            rest: (14, 3) the joints of the picture, of a body at rest that looks along +z.

        Returns:
            Rotation vectors (B, 3) into the camera's axes, places (B, 3) in metres, and whether each may as well
            look the other way (B,) bool.
        """
        torso, seen = batch.joints_px[:, _TORSO], batch.confidence[:, _TORSO] > 0
        heading = self._heading(torso, seen)
        depth = self._depth(batch, torso, seen, rest)
        turns = axis_angle_to_matrix(heading)
        middle = self._middle(batch)
        joints = rest @ turns.transpose(1, 2)  # (B, 14, 3)
        weight = (batch.confidence > 0).to(rest.dtype)
        centre = (joints * weight[..., None]).sum(1) / weight.sum(1, keepdim=True).clamp_min(1.0)
        ray = torch.cat([(middle - batch.center_px) / batch.focal_px[:, None], torch.ones_like(depth)[:, None]], 1)
        place = ray * depth[:, None] - centre
        shoulders = (torso[:, 2] - torso[:, 3]).norm(dim=1) * batch.enlarge
        return heading, place, (shoulders < self.narrow_px) | ~seen[:, 2:].all(1)

    @staticmethod
    def flipped(heading: Tensor) -> Tensor:
        """Headings (B, 3) of the same bodies looking the other way."""
        half = axis_angle_to_matrix(heading.new_tensor([0.0, math.pi, 0.0]))
        return matrix_to_axis_angle(axis_angle_to_matrix(heading) @ half)

    @staticmethod
    def _heading(torso: Tensor, seen: Tensor) -> Tensor:
        """Upright along the spine of the picture; looking at the camera if the left side is to the right there."""
        hips, shoulders = torso[:, :2].mean(1), torso[:, 2:].mean(1)
        up = torch.where(seen.all(1)[:, None], hips - shoulders, hips.new_tensor([0.0, 1.0]))  # pixels point down
        roll = torch.atan2(-up[:, 0], up[:, 1])
        right = torch.stack([roll.cos(), roll.sin()], 1)
        across = (torso[:, 1] - torso[:, 0]) * (seen[:, 1] & seen[:, 0])[:, None]
        across = across + (torso[:, 3] - torso[:, 2]) * (seen[:, 3] & seen[:, 2])[:, None]
        looks_at_us = (across * right).sum(1) >= 0
        zero = torch.zeros_like(roll)
        stand = axis_angle_to_matrix(roll.new_tensor([math.pi, 0.0, 0.0]))
        turn = axis_angle_to_matrix(torch.stack([zero, torch.where(looks_at_us, 0.0, math.pi), zero], 1))
        return matrix_to_axis_angle(axis_angle_to_matrix(torch.stack([zero, zero, roll], 1)) @ stand @ turn)

    @staticmethod
    def _depth(batch: PeopleBatch, torso: Tensor, seen: Tensor, rest: Tensor) -> Tensor:
        """Focal length times length over pixels, of the sides of the torso; or of the whole person."""
        body = rest[list(_TORSO)]
        lengths = torch.stack([(body[a] - body[b]).norm() for a, b in _SIDES])
        pixels = torch.stack([(torso[:, a] - torso[:, b]).norm(dim=1) for a, b in _SIDES], 1)
        whole = torch.stack([seen[:, a] & seen[:, b] for a, b in _SIDES], 1)
        length, pixel = (lengths * whole).sum(1), (pixels * whole).sum(1)
        stature = rest[:, 1].max() - rest[:, 1].min()
        by_torso, by_height = length / pixel.clamp_min(1e-6), stature / batch.height_px
        trusted = whole.any(1) & (pixel / whole.sum(1).clamp_min(1) > 0.1 * batch.height_px)  # not seen end on
        return batch.focal_px * torch.where(trusted, by_torso, by_height)

    @staticmethod
    def _middle(batch: PeopleBatch) -> Tensor:
        weight = (batch.confidence > 0).to(batch.joints_px.dtype)[..., None]
        return (batch.joints_px.nan_to_num() * weight).sum(1) / weight.sum(1).clamp_min(1.0)
