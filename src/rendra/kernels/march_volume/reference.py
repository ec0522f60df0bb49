"""Marching rays through a grid, the specification: plain torch, any device, any float type, slow.

Sample j of a ray lies at p_j = origin + t_j direction, t_j = first + j step, in voxels: voxel (z, y, x) of the grid
has its centre at (x, y, z). Its raw values v_j are the trilinear mean of the 8 voxels around it, voxels outside the
grid counting as 0. With activations only samples between the outermost centres exist, 0 <= p <= size - 1.

    opacity a_j     activation(v_j0), or 1 - exp(-activation(v_j0) delta) where densities are meant
    colour  f_j     activation(v_j1), activation(v_j2), ...
    weight  w_j     a_j T_j, with T_j = prod_{k<j} (1 - a_k)             (Max, 1995; Mildenhall et al., 2020, Eq. 3)
    results         sum_j w_j f_j;  1 - prod_j (1 - a_j);  sum_j w_j t_j

A sample in an empty cell of the occupancy has a_j = 0, and so has one with T_j below `stop_below`. A ray that is not
finite sees NaN.
"""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

_SAMPLES_AT_ONCE = 2**20
_ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "none": lambda x: x,
    "sigmoid": torch.sigmoid,
    "softplus": F.softplus,
    "exp": torch.exp,
}


def march_volume(
    grid: Tensor,
    rays: Tensor,
    occupancy: Tensor | None,
    num_samples: int,
    mode: str,
    activations: tuple[str, str],
    stop_below: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Features (N, R, C), opacity (N, R) and depth (N, R) of rays (N, R, 9).

    The numbers of a ray are its origin, its direction, the first length, the step and delta; for the other arguments
    see the package's `march_volume`.
    """
    parts = []
    at_once = max(1, _SAMPLES_AT_ONCE // max(1, num_samples))
    for grid_rows, ray_rows in _pairs(grid, rays):
        chunks = [
            checkpoint(
                _march, grid_rows, chunk, occupancy, num_samples, mode, activations, stop_below, use_reentrant=False
            )
            for chunk in ray_rows.split(at_once)
        ]
        parts.append(torch.cat(chunks))
    flat = torch.cat(parts) if parts else _zeros(grid, (0, grid.shape[-1] + 1))
    features, opacity, depth = flat.view(*rays.shape[:2], grid.shape[-1] + 1).tensor_split((-2, -1), dim=-1)
    return features, opacity[..., 0], depth[..., 0]


def _pairs(grid: Tensor, rays: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Each grid (D, H, W, K) with its rays (R, 9)."""
    if len(grid) == 1:
        return [(grid[0], rays.flatten(0, 1))]
    return list(zip(grid, rays, strict=True))


def _march(
    grid: Tensor,
    rays: Tensor,
    occupancy: Tensor | None,
    num_samples: int,
    mode: str,
    activations: tuple[str, str],
    stop_below: float,
) -> Tensor:
    """Features, opacity and depth, (R, C + 2), of a few rays."""
    steps = torch.arange(num_samples, dtype=rays.dtype, device=rays.device)
    lengths = rays[:, 6:7] + rays[:, 7:8] * steps  # (R, S)
    points = rays[:, None, 0:3] + rays[:, None, 3:6] * lengths[..., None]  # (R, S, 3)
    values = _trilinear(grid, points)
    exists = torch.ones_like(lengths, dtype=torch.bool)
    if activations != ("none", "none"):
        exists &= ((points >= 0) & (points <= _last(grid))).all(-1)
    if occupancy is not None:
        exists &= _is_occupied(occupancy, grid, points)
    density = _ACTIVATIONS[activations[0]](values[..., 0])
    alpha = -torch.expm1(-density * rays[:, 8:9]) if mode == "density" else density
    alpha = torch.where(exists, alpha, 0.0)
    alpha = torch.where(_transmittance(alpha.detach()) < stop_below, 0.0, alpha)
    weights = alpha * _transmittance(alpha)
    features = _ACTIVATIONS[activations[1]](values[..., 1:])
    seen = torch.cat(
        (
            (weights[..., None] * features).sum(1),
            1 - (1 - alpha).prod(1, keepdim=True),
            (weights * lengths).sum(1, keepdim=True),
        ),
        dim=1,
    )
    return torch.where(rays.isfinite().all(1, keepdim=True), seen, torch.nan)


def _transmittance(alpha: Tensor) -> Tensor:
    """What reaches each sample (R, S)."""
    return F.pad(1 - alpha[:, :-1], (1, 0), value=1.0).cumprod(1) if alpha.shape[1] else alpha


def _trilinear(grid: Tensor, points: Tensor) -> Tensor:
    """Values (R, S, K) at points in voxels; 0 outside."""
    if points.numel() == 0:
        return _zeros(grid, (*points.shape[:2], grid.shape[-1]))
    places = (2 * points + 1) / (_last(grid) + 1) - 1
    planes = grid.movedim(-1, 0)[None]
    read = F.grid_sample(planes, places[None, None], "bilinear", "zeros", align_corners=False)
    return read[0, :, 0].movedim(0, -1)


def _zeros(grid: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Zeros with a gradient for the grid, which is 0."""
    return grid.flatten()[:0].sum().expand(shape)


def _is_occupied(occupancy: Tensor, grid: Tensor, points: Tensor) -> Tensor:
    """Whether the cell of the occupancy that holds a point, or lies nearest to it, is occupied. (R, S)"""
    count = torch.tensor(occupancy.shape[::-1], device=points.device)
    cells = (points * (count / _last(grid).clamp(min=1))).floor()
    x, y, z = torch.minimum(cells.clamp(min=0).long(), count - 1).unbind(-1)
    return occupancy[z, y, x] != 0


def _last(grid: Tensor) -> Tensor:
    """The last voxel along x, y and z. (3,)"""
    return torch.tensor([size - 1 for size in grid.shape[2::-1]], dtype=grid.dtype, device=grid.device)
