"""Surface normals out of depth: what a rendered view says about the shape of what it shows.

A plane m . (x - o) = 1 is met by the ray o + t d where 1 / t = m . d. With the directions of a view written as
(p, q, 1) in its own axes and z the depth along the last of them, the inverse depth 1 / z = m . (p, q, 1) is linear
in (p, q) on every plane, whatever the lens: the normal at a pixel is the gradient of inverse depth about it.

Letters: H W image.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

_SOLID = 0.5  # opacity from which on a pixel shows a surface
_NEAR_PLANE = 0.01  # share of the depth by which a neighbour may be off the plane and still count half
_REACH = 2  # pixels that are looked at on every side


def normals_from_depth(directions: Tensor, depth: Tensor, opacity: Tensor, axes: str = "camera") -> Tensor:
    """Normals of the surfaces that a view shows.

    A plane is fitted to the inverse depth of the pixels about each one. A first guess takes the smaller of the
    differences to both sides, so that it does not reach over an edge; neighbours off the guessed plane count less.

    Args:
        directions: (H, W, 3), rays of length 1 through the pixels, from one point.
        depth: (H, W), distance along the rays.
        opacity: (H, W) in [0, 1]; below 0.5 there is no surface.
        axes: `camera`, where +X is right, +Y up and +Z towards the viewer; or `world`.

    Returns:
        (H, W, 3) of length 1, towards the viewer; zeros where there is no surface or too little of it.

    Raises:
        ValueError: unknown axes.
    """
    if axes not in ("camera", "world"):
        raise ValueError(f"axes must be camera or world, got {axes!r}")
    frame = view_axes(directions)
    local = directions @ frame  # right, up, forwards
    ahead = local[..., 2].clamp_min(1e-6)
    z = depth * ahead
    seen = (opacity > _SOLID) & (z > 0) & (local[..., 2] > 1e-6)
    slope = local[..., :2] / ahead[..., None]
    inverse = torch.where(seen, 1 / z.clamp_min(1e-12), 0)
    guess, has_guess = _one_sided(slope, inverse, seen)
    gradient, middle = _fitted_plane(slope, inverse, seen, guess)
    normal = torch.cat([gradient, (middle - (gradient * slope).sum(-1))[..., None]], dim=-1)
    normal = -functional.normalize(normal, dim=-1) * (seen & has_guess)[..., None]
    return normal @ frame.T if axes == "world" else normal * normal.new_tensor([1.0, 1.0, -1.0])


def view_axes(directions: Tensor) -> Tensor:
    """The axes of a view, (3, 3): in columns, right, up and forwards in the world, from its rays (H, W, 3)."""
    forward = functional.normalize(directions.mean((0, 1)), dim=0)
    across = (directions[:, -1] - directions[:, 0]).mean(0)
    down = (directions[-1] - directions[0]).mean(0)
    if directions.shape[1] < 2:
        across = torch.linalg.cross(down, forward)
    right = functional.normalize(across - (across @ forward) * forward, dim=0)
    up = torch.linalg.cross(right, forward)
    return torch.stack([right, up, forward], dim=1)


def _one_sided(slope: Tensor, inverse: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """The gradient (H, W, 2) of inverse depth from the nearer neighbour on each axis, and where it is known."""
    steps, rises, known = [], [], []
    for shift in ((0, 1), (1, 0)):
        (before, fall, back), (after, rise, ahead) = (
            (
                _neighbour(seen, *there) & seen,
                _neighbour(inverse, *there) - inverse,
                _neighbour(slope, *there) - slope,
            )
            for there in ((-shift[0], -shift[1]), shift)
        )
        first = before & (~after | (fall.abs() <= rise.abs()))
        rises.append(torch.where(first, fall, rise))
        steps.append(torch.where(first[..., None], back, ahead))
        known.append(before | after)
    (a, b), (c, d) = steps[0].unbind(-1), steps[1].unbind(-1)
    both = known[0] & known[1]
    determinant = torch.where(both, a * d - b * c, 1)
    gradient = torch.stack([rises[0] * d - b * rises[1], a * rises[1] - rises[0] * c], dim=-1)
    return gradient / determinant[..., None] * both[..., None], both


def _fitted_plane(slope: Tensor, inverse: Tensor, seen: Tensor, guess: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient (H, W, 2) and value (H, W) at each pixel of the plane through its neighbourhood, by least squares."""
    sums = torch.zeros(9, *inverse.shape, dtype=inverse.dtype, device=inverse.device)
    reach = range(-_REACH, _REACH + 1)
    for shift in ((row, column) for row in reach for column in reach):
        there, value, place = (_neighbour(image, *shift) for image in (seen, inverse, slope))
        p, q = (place - slope).unbind(-1)
        rise = value - inverse
        off = (rise - guess[..., 0] * p - guess[..., 1] * q) / (_NEAR_PLANE * inverse).clamp_min(1e-12)
        weight = there / (1 + off.square().square())
        sums += weight * torch.stack([torch.ones_like(p), p, q, rise, p * p, p * q, q * q, p * rise, q * rise])
    total, p, q, rise, pp, pq, qq, p_rise, q_rise = sums / sums[0].clamp_min(1e-12)
    pp, pq, qq = pp - p * p, pq - p * q, qq - q * q
    p_rise, q_rise = p_rise - p * rise, q_rise - q * rise
    determinant = pp * qq - pq * pq
    spread = determinant > 1e-3 * pp * qq  # else the neighbours that count stand in one line
    safe = torch.where(spread, determinant, 1)
    fitted = torch.stack([p_rise * qq - pq * q_rise, pp * q_rise - p_rise * pq], dim=-1) / safe[..., None]
    gradient = torch.where(spread[..., None], fitted, guess)
    shift_of_middle = rise - gradient[..., 0] * p - gradient[..., 1] * q
    return gradient, inverse + torch.where(spread, shift_of_middle, 0)


def _neighbour(image: Tensor, rows: int, columns: int) -> Tensor:
    """The pixel so many rows down and columns to the right of each one; zeros beyond the edge. (H, W, ...)."""
    height, width = image.shape[:2]
    found = torch.zeros_like(image)
    if abs(rows) < height and abs(columns) < width:
        to = (slice(max(0, -rows), height - max(0, rows)), slice(max(0, -columns), width - max(0, columns)))
        here = (slice(max(0, rows), height - max(0, -rows)), slice(max(0, columns), width - max(0, -columns)))
        found[to] = image[here]
    return found
