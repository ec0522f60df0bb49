"""Samples of rays in the occupied cells of a box, the specification: plain torch, any device, any float type, slow.

Sample k of a ray reaches from t_k to min(t_{k+1}, farthest), where

    t_k = d(u + (offset + k) step),    d(u) = u up to the knee K = step / growth,
                                       d(u) = K (1 + growth)^((u - K) / step) behind it,

and d(u) is `nearest` for offset = k = 0: steps are equally long up to the knee, then `growth` times the distance at
which they begin. Without growth there is no knee. The rules:
1. A sample exists if k < 2^24 and t_k < farthest.
2. It is kept if its middle (t_k + min(t_{k+1}, farthest)) / 2 lies in an occupied cell: floor((o + t d - low) cells /
   (high - low)) along each axis, so that a point between two cells belongs to the upper one and the upper faces of
   the box lie outside.
3. A ray has none if nearest < farthest fails, its direction is zero, or any number but `farthest` is not finite.
4. Of a ray's samples the first `max_samples` are kept.
5. With stop_below > 0 a sample is kept only if the product of 1 - opacity[its cell], in float64, over the samples
   kept before it on its ray is at least `stop_below`: before the first it is 1.
All samples are asked, up to the distance behind which no point of the box can lie, some at a time.
"""

import math

import torch
from torch import Tensor

LATTICE_END = 2**24
_SAMPLES_AT_ONCE = 2**20


Rays = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Origins and directions (R, 3), nearest, farthest and offset (R,)."""


def traverse(
    rays: Rays,
    occupied: Tensor,
    box: Tensor,
    step: float,
    growth: float,
    max_samples: int | None,
    opacity: Tensor | None = None,
    stop_below: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """First sample of each ray (R + 1,), and starts, ends and ray (M,) of the samples."""
    origins, directions, nearest, farthest, offset = rays
    sizes = _lattice_sizes(rays, box, step, growth)
    longest = max(sizes.tolist(), default=0)
    opacity = nearest.new_zeros(occupied.shape) if opacity is None else opacity
    parts = [(nearest[:0], nearest[:0], sizes[:0], opacity.flatten()[:0])]
    rows = max(1, _SAMPLES_AT_ONCE // max(1, longest))
    for some in torch.arange(len(origins), device=origins.device).split(rows):
        here = origins[some], directions[some], nearest[some], farthest[some], offset[some]
        for first in range(0, max(sizes[some].tolist(), default=0), _SAMPLES_AT_ONCE):
            k = torch.arange(first, min(first + _SAMPLES_AT_ONCE, longest), device=origins.device)
            starts, ends, kept, (x, y, z) = _samples(here, k, occupied, box, step, growth)
            kept &= k < sizes[some, None]
            alphas = opacity[z[kept], y[kept], x[kept]]
            parts.append((starts[kept], ends[kept], some[:, None].expand_as(kept)[kept], alphas))
    starts, ends, index, alphas = (torch.cat(column) for column in zip(*parts, strict=True))
    rank = torch.arange(len(index), device=index.device) - _firsts(index, len(origins))[index]
    kept = _is_lit(alphas, index, rank, stop_below) if stop_below > 0 else torch.ones_like(rank, dtype=torch.bool)
    if max_samples is not None:
        kept &= rank < max_samples
    starts, ends, index = starts[kept], ends[kept], index[kept]
    return _firsts(index, len(origins)), starts, ends, index


def _lattice_sizes(rays: Rays, box: Tensor, step: float, growth: float) -> Tensor:
    """A bound (R,) on the number of samples to ask."""
    origins, directions, nearest, farthest, _ = rays
    is_ray = (nearest < farthest) & (directions != 0).any(1) & nearest.isfinite()
    is_ray &= origins.isfinite().all(1) & directions.isfinite().all(1)
    corners = torch.cartesian_prod(*box.T)
    reach = torch.linalg.norm(corners - origins[:, None], dim=-1).amax(1) / torch.linalg.norm(directions, dim=-1)
    end = torch.minimum(farthest, 1.001 * reach.nan_to_num(math.inf) + 2 * step)
    steps = (_place(end, step, growth) - _place(nearest, step, growth)) / step * 1.001 + 4
    return torch.where(is_ray, steps.clamp(0, LATTICE_END), 0).to(torch.int64)


def _samples(
    rays: Rays, k: Tensor, occupied: Tensor, box: Tensor, step: float, growth: float
) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, ...]]:
    """Starts, ends (R, K) of samples k of some rays, which lie in occupied cells, and those cells' x, y, z."""
    origins, directions, nearest, farthest, offset = rays
    base, pace = _place(nearest, step, growth)[:, None], nearest.new_tensor(step)
    edges = torch.stack((k, k + 1)).to(nearest.dtype)[:, None]
    starts, ends = _distance(base + (offset[:, None] + edges) * pace, step, growth)
    exists = starts < farthest[:, None]
    ends = torch.minimum(ends, farthest[:, None])
    size = torch.tensor(occupied.shape[::-1], device=box.device)
    scale = size.to(box.dtype) / (box[1] - box[0])
    middles = (0.5 * (starts + ends))[..., None]
    places = ((origins[:, None] + middles * directions[:, None] - box[0]) * scale).floor()
    inside = ((places >= 0) & (places < size)).all(-1)
    x, y, z = torch.where(inside[..., None], places, 0.0).to(torch.int64).unbind(-1)
    return starts, ends, exists & inside & occupied[z, y, x], (x, y, z)


def _is_lit(alphas: Tensor, index: Tensor, rank: Tensor, stop_below: float) -> Tensor:
    """Whether light reaches each sample (M,), the one with that rank on the ray with that index."""
    lit = torch.empty_like(index, dtype=torch.bool)
    longest = int(rank.max()) + 1 if len(rank) else 1
    rows = max(1, _SAMPLES_AT_ONCE // longest)
    for first in range(0, int(index.max()) + 1 if len(index) else 0, rows):
        here = (index >= first) & (index < first + rows)
        spread = alphas.new_zeros((rows, longest), dtype=torch.float64)
        spread[index[here] - first, rank[here]] = alphas[here].double()
        before = torch.cat((torch.ones_like(spread[:, :1]), (1 - spread).cumprod(1)[:, :-1]), dim=1)
        lit[here] = before[index[here] - first, rank[here]] >= stop_below
    return lit


def _distance(place: Tensor, step: float, growth: float) -> Tensor:
    if growth == 0:
        return place
    knee, rate = place.new_tensor(step / growth), place.new_tensor(math.log1p(growth) / step)
    return torch.where(place > knee, knee * torch.exp((place - knee) * rate), place)


def _place(distance: Tensor, step: float, growth: float) -> Tensor:
    """The inverse of `_distance`."""
    if growth == 0:
        return distance
    knee, rate = distance.new_tensor(step / growth), distance.new_tensor(math.log1p(growth) / step)
    return torch.where(distance > knee, knee + torch.log(distance / knee) / rate, distance)


def _firsts(index: Tensor, num_rays: int) -> Tensor:
    """First sample of each ray (R + 1,) of samples sorted by ray."""
    return torch.searchsorted(index, torch.arange(num_rays + 1, device=index.device))
