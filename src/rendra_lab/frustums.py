"""The frame in which shapes are rebuilt: the part of a camera's view behind a box of its picture.

A frustum is bounded by a box of the picture and two depths. Its frame is the cube [-1, 1]^3: x' and y' go from the
box's left and upper edges to its right and lower ones, z' from the nearest depth to the farthest, linear in 1 / z.
So projective a map keeps straight lines straight and plane faces plane. With the whole picture as its box it is the
frame of "VoxMesh" and its Blender depths, with regions of interest that of Pix3D's heads
(Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739).

Letters: N frustums. Axes, pixels and boxes: as of `rendra_lab.detection.records`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rendra_lab.records import TensorRecord
from rendra_lab.shape_records import Shapes

_LEAST_DEPTH = 1e-4  # what lies nearer, or behind the camera, is taken to be here


@dataclass(frozen=True)
class Frustums(TensorRecord):
    """N frustums of cameras without skew."""

    boxes: Float[Tensor, "N 4"]
    depth_range: Float[Tensor, "N 2"]  # nearest and farthest z, both above 0
    intrinsics: Float[Tensor, "N 3 3"]

    def from_camera(self, points: Float[Tensor, "N P 3"]) -> Float[Tensor, "N P 3"]:
        """Points in the camera's axes to the frustum's frame; depths below 0.0001 count as that."""
        z = points[..., 2].clamp_min(_LEAST_DEPTH)
        focal, center = self._lens()
        pixels = focal * points[..., :2] / z[..., None] + center
        low, size = self._corner_and_size()
        near, far = self.depth_range.unsqueeze(1).unbind(-1)
        depth = 2 * (1 / near - 1 / z) / (1 / near - 1 / far) - 1
        return torch.cat([2 * (pixels - low) / size - 1, depth[..., None]], dim=-1)

    def to_camera(self, points: Float[Tensor, "N P 3"]) -> Float[Tensor, "N P 3"]:
        """The inverse of `from_camera`."""
        near, far = self.depth_range.unsqueeze(1).unbind(-1)
        z = 1 / (1 / near - (points[..., 2] + 1) / 2 * (1 / near - 1 / far))
        low, size = self._corner_and_size()
        focal, center = self._lens()
        pixels = low + (points[..., :2] + 1) / 2 * size
        return torch.cat([(pixels - center) / focal * z[..., None], z[..., None]], dim=-1)

    def turned_from_camera(
        self, points: Float[Tensor, "N P 3"], normals: Float[Tensor, "N P 3"]
    ) -> Float[Tensor, "N P 3"]:
        """Normals of a surface through points in the camera's axes, as they are in the frustum's frame.

        Normals are covectors: the inverse transposed Jacobian turns them. Of length 1.
        """
        z = points[..., 2].clamp_min(_LEAST_DEPTH)
        focal, _ = self._lens()
        _, size = self._corner_and_size()
        near, far = self.depth_range.unsqueeze(1).unbind(-1)
        across = z[..., None] * size / (2 * focal) * normals[..., :2]  # along x' and y' at constant z'
        along = (points * normals).sum(-1) * z * (1 / near - 1 / far) / 2  # dz = z^2 (1 / near - 1 / far) / 2 dz'
        turned = torch.cat([across, along[..., None]], dim=-1)
        return torch.nn.functional.normalize(turned, dim=-1, eps=1e-12)

    def voxels_of(self, shapes: Shapes, side: int, samples: int = 2) -> Bool[Tensor, "N side side side"]:
        """The grid over each frustum, [z, y, x]: filled where any of samples^3 places of a cell is in the object."""
        full = [
            _filled(matrix, voxels, side * samples)
            for matrix, voxels in zip(self._to_own_axes(shapes.voxels_to_camera), shapes.voxels, strict=True)
        ]
        if not full:
            return torch.zeros(0, side, side, side, dtype=torch.bool, device=self.boxes.device)
        cells = torch.stack(full).reshape(-1, side, samples, side, samples, side, samples)
        return cells.any(6).any(4).any(2)

    def _to_own_axes(self, voxels_to_camera: Tensor) -> Tensor:
        """Columns: a point (x', y', z', 1) of each frame to a multiple of (x, y, z, 1) in its object's cube.

        A point of the camera's axes over its depth, (x / z, y / z, 1, 1 / z), is linear in the frame.
        """
        low, size = (part[:, 0].double() for part in self._corner_and_size())
        focal, center = (part[:, 0].double() for part in self._lens())
        near, far = self.depth_range.double().unbind(-1)
        matrix = low.new_zeros(len(low), 4, 4)
        matrix[:, [0, 1], [0, 1]] = size / 2 / focal
        matrix[:, :2, 3] = (low + size / 2 - center) / focal
        matrix[:, 2, 3] = 1
        matrix[:, 3, 2] = (1 / far - 1 / near) / 2
        matrix[:, 3, 3] = (1 / near + 1 / far) / 2
        return (torch.linalg.inv(voxels_to_camera.double()) @ matrix).to(self.boxes)

    def _corner_and_size(self) -> tuple[Tensor, Tensor]:
        low, high = self.boxes[:, None, :2], self.boxes[:, None, 2:]
        return low, high - low

    def _lens(self) -> tuple[Tensor, Tensor]:
        focal = torch.stack([self.intrinsics[:, 0, 0], self.intrinsics[:, 1, 1]], dim=-1)
        return focal[:, None], self.intrinsics[:, None, :2, 2]


def _filled(matrix: Tensor, voxels: Tensor, side: int) -> Tensor:
    """Which of side^3 places of a frame lie in filled voxels (V, V, V) of one object: (side, side, side)."""
    ticks = (torch.arange(side, device=matrix.device) + 0.5).to(matrix) * (2 / side) - 1
    x, y, z = ticks, ticks[:, None], ticks[:, None, None]
    count = voxels.shape[0]
    to_cells = (count / 2) / (matrix[3, 2] * z + matrix[3, 3])  # below the line is 1 / depth
    within = torch.ones((side, side, side), dtype=torch.bool, device=matrix.device)
    index = matrix.new_zeros(side, side, side)
    for row in (matrix[2], matrix[1], matrix[0]):  # z, y, x
        rest = (row[1] * y + (row[2] * z + row[3])) * to_cells + count / 2  # small: without x
        cell = (row[0] * to_cells * x + rest).floor()
        within &= (cell >= 0) & (cell < count)
        index = index * count + cell
    return within & voxels.reshape(-1)[torch.where(within, index, 0.0).long()]
