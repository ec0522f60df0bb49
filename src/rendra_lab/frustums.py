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
        ticks = (torch.arange(side * samples, device=self.boxes.device) + 0.5) * (2 / (side * samples)) - 1
        z, y, x = torch.meshgrid(ticks, ticks, ticks, indexing="ij")
        places = torch.stack([x, y, z], dim=-1).reshape(1, -1, 3).to(self.boxes)
        full = torch.stack([
            _is_inside(self._one(index).to_camera(places)[0], shapes.voxels[index], shapes.voxels_to_camera[index])
            for index in range(len(self.boxes))
        ]) if len(self.boxes) else self.boxes.new_zeros((0, places.shape[1]), dtype=torch.bool)  # fmt: skip
        cells = full.reshape(-1, side, samples, side, samples, side, samples)
        return cells.any(6).any(4).any(2)

    def _one(self, index: int) -> Frustums:
        return Frustums(*(values[index : index + 1] for values in (self.boxes, self.depth_range, self.intrinsics)))

    def _corner_and_size(self) -> tuple[Tensor, Tensor]:
        low, high = self.boxes[:, None, :2], self.boxes[:, None, 2:]
        return low, high - low

    def _lens(self) -> tuple[Tensor, Tensor]:
        focal = torch.stack([self.intrinsics[:, 0, 0], self.intrinsics[:, 1, 1]], dim=-1)
        return focal[:, None], self.intrinsics[:, None, :2, 2]


def _is_inside(points: Tensor, voxels: Tensor, voxels_to_camera: Tensor) -> Tensor:
    """Whether points (P, 3) in the camera's axes lie in filled voxels (V, V, V) of one object."""
    inverse = torch.linalg.inv(voxels_to_camera.double()).to(points)
    own = points @ inverse[:3, :3].T + inverse[:3, 3]
    side = voxels.shape[0]
    cell = ((own + 1) * (side / 2)).floor().long()
    is_within = ((cell >= 0) & (cell < side)).all(-1)
    x, y, z = cell.clamp(0, side - 1).unbind(-1)
    return is_within & voxels.reshape(-1)[(z * side + y) * side + x]
