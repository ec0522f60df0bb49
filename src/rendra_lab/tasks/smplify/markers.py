"""Points that ride on the bones of a body, and how they move as its numbers change.

Letters: N bodies, J joints, M markers, P = 3 J + B + 3 numbers of a body: its pose (rotation vectors), shape, place.
A skeleton's points are linear in its rest positions, and a joint's turn moves all that hangs on it about the joint:
so the derivatives are written down, and cost little more than the points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rendra.body import SMPL
from rendra.transforms import axis_angle_to_matrix
from rendra.transforms.math import sine_defect_ratio, versine_ratio
from rendra.transforms.so3 import hat


@dataclass(frozen=True)
class Marker:
    """A point that a bone carries.

    Attributes:
        bone: the joint whose turn carries it.
        rest: (3,) where it is on the mean body at rest.
        dirs: (3, B) what a beta of 1 adds.
    """

    bone: int
    rest: Tensor
    dirs: Tensor

    @classmethod
    def joint(cls, body: SMPL, index: int) -> Marker:
        """A joint of a body."""
        return cls(index, body.joint_template[index], body.joint_shapedirs[index])

    @classmethod
    def vertex(cls, body: SMPL, index: int) -> Marker:
        """A vertex, which rides on the bone that moves it most."""
        return cls(int(body.weights[index].argmax()), body.v_template[index], body.shapedirs[index])


@dataclass(frozen=True)
class Motion:
    """Markers of posed bodies, and their derivatives.

    Attributes:
        points: (N, M, 3).
        jacobian: (N, M, 3, P); None where nobody asked.
    """

    points: Tensor
    jacobian: Tensor | None


class MarkerSet(torch.nn.Module):
    """The markers of one body model.

    Args:
        parents: of its joints.
        joint_rest: (J, 3) joints of the mean body at rest.
        joint_dirs: (J, 3, B) what betas add to them.
        markers: M of them.
    """

    columns: Tensor  # (J, 3, 1 + B) rest positions and directions of the joints
    marker_columns: Tensor  # (M, 3, 1 + B)
    bones: Tensor  # (M,)
    carries: Tensor  # (M, J) whether a joint's turn moves a marker

    def __init__(self, body: SMPL, markers: Sequence[Marker]) -> None:
        super().__init__()
        self.parents = body.parents
        self.num_betas = body.num_betas
        self.register_buffer("columns", torch.cat([body.joint_template[..., None], body.joint_shapedirs], -1), False)
        rows = [torch.cat([marker.rest[:, None], marker.dirs], dim=1) for marker in markers]
        self.register_buffer("marker_columns", torch.stack(rows), False)
        self.register_buffer("bones", torch.tensor([marker.bone for marker in markers]), False)
        self.register_buffer("carries", _descendants(self.parents)[self.bones], False)

    def forward(self, x: Tensor, derivatives: bool = False) -> Motion:
        """Where the markers of bodies (N, P) are."""
        joints, betas = len(self.parents), self.num_betas
        pose = x[:, : 3 * joints].reshape(-1, joints, 3)
        ones = torch.ones_like(x[:, :1])
        shape = torch.cat([ones, x[:, 3 * joints : 3 * joints + betas]], dim=1)
        turns, places = self._pose(axis_angle_to_matrix(pose))
        offsets = self.marker_columns - self.columns.index_select(0, self.bones)
        carried = turns.index_select(1, self.bones) @ offsets + places.index_select(1, self.bones)  # (N, M, 3, 1 + B)
        points = (carried @ shape[:, None, :, None])[..., 0] + x[:, None, -3:]
        if not derivatives:
            return Motion(points, None)
        centres = (places @ shape[:, None, :, None])[..., 0] + x[:, None, -3:]
        jacobian = x.new_zeros(*points.shape, x.shape[1])
        jacobian[..., : 3 * joints] = self._turning(pose, turns, centres, points)
        jacobian[..., 3 * joints : -3] = carried[..., 1:]
        jacobian[..., -3:] = torch.eye(3, dtype=x.dtype, device=x.device)
        return Motion(points, jacobian)

    def _pose(self, rotations: Tensor) -> tuple[Tensor, Tensor]:
        """Turns (N, J, 3, 3) of the bones, and places (N, J, 3, 1 + B) of the joints, linear in the shape."""
        turns = [rotations[:, 0]]
        places = [self.columns[0].expand(len(rotations), -1, -1)]
        for joint, parent in enumerate(self.parents[1:], 1):
            turns.append(turns[parent] @ rotations[:, joint])
            places.append(places[parent] + turns[parent] @ (self.columns[joint] - self.columns[parent]))
        return torch.stack(turns, 1), torch.stack(places, 1)

    def _turning(self, pose: Tensor, turns: Tensor, centres: Tensor, points: Tensor) -> Tensor:
        """How points move with rotation vectors: (N, M, 3, 3 J)."""
        parents = torch.tensor(self.parents[1:], device=turns.device)
        above = torch.cat([torch.eye(3, dtype=turns.dtype, device=turns.device).expand(len(turns), 1, 3, 3),
                           turns.index_select(1, parents)], 1)  # fmt: skip
        axes = above @ _spins(pose.reshape(-1, 3)).reshape(*pose.shape, 3)  # (N, J, 3, 3) columns: spins
        arms = points[:, :, None] - centres[:, None]  # (N, M, J, 3)
        moved = torch.linalg.cross(axes.transpose(2, 3)[:, None], arms[:, :, :, None], dim=-1)  # (N, M, J, spin, 3)
        moved = moved * self.carries[:, :, None, None]
        return moved.flatten(2, 3).transpose(2, 3)


def _spins(rotation_vectors: Tensor) -> Tensor:
    """The left Jacobian (K, 3, 3) of rotation vectors (K, 3): what turns in space as they change."""
    squared = rotation_vectors.square().sum(-1)[:, None, None]
    cross = hat(rotation_vectors)
    eye = torch.eye(3, dtype=cross.dtype, device=cross.device)
    return eye + versine_ratio(squared) * cross + sine_defect_ratio(squared) * (cross @ cross)


def _descendants(parents: Sequence[int]) -> Tensor:
    """(J, J) bool: whether the joint of the column lies on the way from the root to that of the row, or is it."""
    above = torch.zeros(len(parents), len(parents), dtype=torch.bool)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            above[joint] = above[parent]
        above[joint, joint] = True
    return above
