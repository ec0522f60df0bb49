"""Packed faces that are awkward to draw."""

import math

import torch
from torch import Tensor

BLUR = math.log(1 / 1e-4 - 1) * 1e-4


def soup(num_faces: int, seed: int = 0, reach: float = 0.4) -> Tensor:
    """Random triangles (F, 3, 3) in and around the image, between depths 1 and 4."""
    generator = torch.Generator().manual_seed(seed)
    centre = torch.rand(num_faces, 1, 2, generator=generator) * 2.6 - 1.3
    xy = centre + (torch.rand(num_faces, 3, 2, generator=generator) - 0.5) * 2 * reach
    z = 1 + 3 * torch.rand(num_faces, 3, 1, generator=generator)
    return torch.cat([xy, z], dim=-1)


def with_monsters(faces: Tensor) -> Tensor:
    """The faces and, among them: a point, a needle, an edge-on one, ones behind the camera, NaN and infinity."""
    nan, inf = float("nan"), float("inf")
    monsters = torch.tensor(
        [
            [[0.1, 0.1, 2.0], [0.1, 0.1, 2.0], [0.1, 0.1, 2.0]],
            [[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0], [0.0, 0.0, 3.0]],
            [[0.0, 0.0, -1.0], [0.5, 0.0, 2.0], [0.0, 0.5, 2.0]],
            [[0.0, 0.0, -1.0], [0.5, 0.0, -2.0], [0.0, 0.5, -2.0]],
            [[0.0, 0.0, 0.0], [0.5, 0.0, 2.0], [0.0, 0.5, 2.0]],
            [[nan, 0.0, 1.0], [0.5, 0.0, 2.0], [0.0, 0.5, 2.0]],
            [[0.0, 0.0, nan], [0.5, 0.0, 2.0], [0.0, 0.5, 2.0]],
            [[0.0, 0.0, 2.0], [0.5, 0.0, nan], [0.0, 0.5, 2.0]],
            [[0.0, 0.0, 2.0], [0.5, 0.0, 2.0], [0.0, 0.5, nan]],
            [[inf, 0.0, 1.0], [0.5, 0.0, 2.0], [0.0, 0.5, 2.0]],
            [[-1e9, -1e9, 9.0], [1e9, -1e9, 9.0], [0.0, 1e9, 9.0]],
        ]
    )
    return torch.cat([faces[:1], monsters, faces[1:]])


def packed(*counts: int) -> tuple[Tensor, Tensor]:
    """First face and number of faces of images with these many faces."""
    num = torch.tensor(counts, dtype=torch.int64)
    return num.cumsum(0) - num, num
