"""Crossing pairs of triangles, the specification: plain torch, any device, all pairs, in float64.

Triangles a and b with unit normals n_a, n_b cross if, with every signed distance of at most the tolerance set to zero
and that of a corner which the other triangle has too (the same coordinates),
1. a has corners strictly on both sides of the plane of b, and b of that of a;
2. on the line of both planes, along n_a x n_b, the pieces inside a and inside b overlap by more than the tolerance
   (Moeller, "A fast triangle-triangle intersection test", 1997).
A triangle whose height is within the tolerance, or that is not finite, crosses nothing.
"""

import torch
from torch import Tensor

_PAIRS_AT_ONCE = 2**22


def crossing_pairs(tris: Tensor, tolerance: float) -> Tensor:
    """Pairs (K, 2); see the package's `crossing_pairs`."""
    corners = tris.double()
    low, high = corners.amin(1), corners.amax(1)
    rows = max(1, _PAIRS_AT_ONCE // max(1, len(tris)))
    found = [torch.empty((0, 2), dtype=torch.int64, device=tris.device)]
    for begin in range(0, len(tris), rows):
        part = slice(begin, begin + rows)
        meet = ((low[part, None] <= high) & (high[part, None] >= low)).all(-1)
        i, j = meet.nonzero().unbind(1)
        i = i + begin
        i, j = i[i < j], j[i < j]
        crosses = _cross_each_other(corners[i], corners[j], tolerance)
        found.append(torch.stack([i[crosses], j[crosses]], 1))
    return torch.cat(found)


def _cross_each_other(a: Tensor, b: Tensor, tolerance: float) -> Tensor:
    """Which of the pairs (M, 3, 3) cross. (M,)"""
    (normal_a, thick_a), (normal_b, thick_b) = _normal(a, tolerance), _normal(b, tolerance)
    sides_a, sides_b = _sides(a, b, normal_b, tolerance), _sides(b, a, normal_a, tolerance)
    straddle = _straddles(sides_a) & _straddles(sides_b) & thick_a & thick_b
    line = torch.nn.functional.normalize(torch.linalg.cross(normal_a, normal_b), dim=-1, eps=1e-300)
    low_a, high_a = _piece(a - a[:, :1], sides_a, line)
    low_b, high_b = _piece(b - a[:, :1], sides_b, line)
    return straddle & (torch.minimum(high_a, high_b) - torch.maximum(low_a, low_b) > tolerance)


def _normal(t: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
    """Unit normals (M, 3), and which triangles are higher than the tolerance."""
    normal = torch.linalg.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    twice_area = normal.norm(dim=-1)
    longest = (t - t.roll(1, 1)).norm(dim=-1).amax(1)
    return normal / twice_area.clamp(min=1e-300)[:, None], twice_area > tolerance * longest


def _sides(t: Tensor, other: Tensor, normal: Tensor, tolerance: float) -> Tensor:
    """Signed distances (M, 3) of the corners of t to the plane of `other`."""
    distance = ((t - other[:, :1]) * normal[:, None]).sum(-1)
    is_shared = (t[:, :, None] == other[:, None]).all(-1).any(-1)
    return torch.where(is_shared | (distance.abs() <= tolerance), 0.0, distance)


def _straddles(sides: Tensor) -> Tensor:
    return (sides.amin(1) < 0) & (sides.amax(1) > 0)


def _piece(t: Tensor, sides: Tensor, line: Tensor) -> tuple[Tensor, Tensor]:
    """Where, along the line, a triangle passes through the other's plane: from, to."""
    along = (t * line[:, None]).sum(-1)
    next_along, next_side = along.roll(-1, 1), sides.roll(-1, 1)
    step = torch.where(sides == next_side, 1.0, sides - next_side)
    passing = along + (next_along - along) * sides / step
    points = torch.cat([along, passing], 1)
    counts = torch.cat([sides == 0, sides * next_side < 0], 1)
    return torch.where(counts, points, torch.inf).amin(1), torch.where(counts, points, -torch.inf).amax(1)
