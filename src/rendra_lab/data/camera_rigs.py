"""Cameras about one object: where they stand for training, and where between them for validation and test.

All look at the origin with +Y up, as `look_at_view_transform` has it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rendra.renderer.cameras import look_at_view_transform
from rendra_lab.errors import UserError

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
_CANDIDATES = 4000  # for held-out views; the fifth of them farthest from the training views is chosen from
_SPREAD = 0.35  # of a forward-facing grid to each side, in parts of its distance


def rig(views: str, counts: tuple[int, int, int], distance: float, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Positions of cameras for training (counts[0], 3), validation (counts[1], 3) and test (counts[2], 3).

    Args:
        views: `sphere`, a Fibonacci spiral over all elevations, turned about +Y at random; `ring`, the book's: at
            elevation 0, from azimuth 0 to 360 degrees, so that the first and the last coincide; `forward`, a grid
            on a plane before the -Z side.
        counts: of the three.
        distance: from the origin; of the middle of a `forward` grid.
        seed: of the turn.

    Returns:
        Held-out positions lie where training views are far, well apart from each other.

    Raises:
        UserError: unknown views, or numbers that cannot be.
    """
    if views not in _ARRANGEMENTS:
        raise UserError(f"data.views must be one of {', '.join(_ARRANGEMENTS)}, got {views!r}")
    if len(counts) != 3 or min(counts) < 0 or counts[0] < 1:
        raise UserError(
            f"data.counts are whole numbers of training (at least 1), validation and test views: {counts}"
        )
    if not distance > 0:
        raise UserError(f"data.distance must be positive, got {distance}")
    arrange = _ARRANGEMENTS[views]
    turn = 2 * math.pi * float(torch.rand((), generator=torch.Generator().manual_seed(seed)))
    train = distance * arrange(counts[0], turn)
    held_out = counts[1] + counts[2]
    candidates = distance * arrange(max(_CANDIDATES, 20 * held_out), turn)
    chosen = _between(train, candidates, held_out)
    return train, chosen[: counts[1]], chosen[counts[1] :]


def look_at_origin(positions: Tensor) -> tuple[Tensor, Tensor]:
    """R (N, 3, 3) and T (N, 3) of cameras at positions (N, 3)."""
    if not len(positions):
        return positions.new_zeros(0, 3, 3), positions.new_zeros(0, 3)
    R, T = look_at_view_transform(eye=positions)
    return R, T


def _between(train: Tensor, candidates: Tensor, count: int) -> Tensor:
    """The `count` best separated of those candidates that are far from every training position."""
    if not count:
        return candidates[:0]
    clearance = torch.cdist(candidates, train).amin(1)
    far = candidates[clearance.argsort(descending=True, stable=True)[: max(count, len(candidates) // 5)]]
    chosen, gap = [0], torch.cdist(far, far[:1])[:, 0]
    while len(chosen) < count:
        chosen.append(int(gap.argmax()))
        gap = gap.minimum(torch.cdist(far, far[chosen[-1:]])[:, 0])
    return far[chosen]


def _sphere(count: int, turn: float) -> Tensor:
    index = torch.arange(count, dtype=torch.float64)
    height = 1 - (2 * index + 1) / count
    angle = _GOLDEN_ANGLE * index + turn
    radius = (1 - height.square()).sqrt()
    return torch.stack([radius * angle.sin(), height, radius * angle.cos()], dim=1).float()


def _ring(count: int, turn: float) -> Tensor:
    azimuth = torch.deg2rad(torch.linspace(-180, 180, count) + 180)
    return torch.stack([azimuth.sin(), torch.zeros(count), azimuth.cos()], dim=1)


def _forward(count: int, turn: float) -> Tensor:
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    across, down = (_SPREAD * torch.linspace(-1, 1, side) if side > 1 else torch.zeros(1) for side in (columns, rows))
    y, x = torch.meshgrid(-down, across, indexing="ij")
    return torch.stack([x.flatten(), y.flatten(), torch.full((rows * columns,), -1.0)], dim=1)[:count]


_ARRANGEMENTS = {"sphere": _sphere, "ring": _ring, "forward": _forward}
