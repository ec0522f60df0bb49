"""Pictures of boxes as batches of single objects, with everything known in closed form."""

from __future__ import annotations

import torch

from rendra.ops import cubify, sample_points_from_meshes
from rendra.structures import Meshes
from rendra_lab.shape_records import ShapeBatch, Shapes

SIDE = 33
GRID = 8


def box_pictures(sizes: list[tuple[float, float, float]], dtype: torch.dtype = torch.float32) -> ShapeBatch:
    """One box each, of the given half lengths, two metres in front of the camera; wide ones are class 0, else 1.

    Boxes fill the inner half of their grids; pictures are white where a box is, seen as flat as its middle.
    """
    halves = torch.tensor(sizes, dtype=dtype).reshape(-1, 3)
    count = len(halves)
    filled = torch.zeros(count, GRID, GRID, GRID, dtype=torch.bool)
    filled[:, 2:6, 2:6, 2:6] = True
    matrix = torch.zeros(count, 4, 4, dtype=dtype)
    matrix[:, [0, 1, 2], [0, 1, 2]] = 2 * halves
    matrix[:, 2, 3], matrix[:, 3, 3] = 2, 1
    own = cubify(filled.to(dtype), 0.5, align="corner")
    camera = own.update_padded(own.verts_padded() @ matrix[:, :3, :3].mT + matrix[:, None, :3, 3])
    points, normals = _sampled(camera, dtype)
    focal = 1.5 * SIDE
    lens = torch.tensor([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]], dtype=dtype).repeat(count, 1, 1)
    ticks = (torch.arange(SIDE, dtype=dtype) + 0.5 - SIDE / 2).abs() / focal * 2
    inside = (ticks[None, :, None] < halves[:, 1, None, None]) & (ticks[None, None, :] < halves[:, 0, None, None])
    shapes = Shapes(points, normals, filled, matrix, tuple(camera.verts_list()), tuple(camera.faces_list()))
    return ShapeBatch(
        rgb=inside[:, None].to(dtype).expand(-1, 3, -1, -1).contiguous(),
        intrinsics=lens,
        depth_range=torch.tensor([[1.0, 4.0]], dtype=dtype).repeat(count, 1),
        labels=(halves[:, 0] < halves[:, 1]).long(),
        shapes=shapes,
        shape_ids=[f"box {each}" for each in sizes],
    )


def _sampled(meshes: Meshes, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    if not len(meshes):
        return torch.zeros(0, 300, 3, dtype=dtype), torch.zeros(0, 300, 3, dtype=dtype)
    points, normals = sample_points_from_meshes(meshes, 300, return_normals=True)
    return points, normals
