"""Overlapping balls, the specification: plain torch, any device, all pairs, in float64.

Balls i < j of a body meet if their groups are looked at, both are finite, and |c_i - c_j|^2 < (r_i + r_j)^2: those
that touch do not. Squares are summed x, y, z, so that every implementation rounds alike.
"""

import torch
from torch import Tensor

_PAIRS_AT_ONCE = 2**21


def sphere_pairs(centers: Tensor, radii: Tensor, groups: Tensor, group_pairs: Tensor) -> tuple[Tensor, Tensor]:
    """Starts (N + 1,) and pairs (M, 2); see the package's `sphere_pairs`."""
    count, size = radii.shape
    is_looked_at = _matrix(groups, group_pairs)
    places = torch.arange(size, device=centers.device)
    bodies = max(1, _PAIRS_AT_ONCE // max(1, size * size))
    rows = max(1, _PAIRS_AT_ONCE // max(1, size))  # below S for single bodies only: the order is kept
    found = [torch.empty((0, 3), dtype=torch.int64, device=centers.device)]
    for body in range(0, count, bodies):
        balls = torch.cat([centers, radii[..., None]], dim=2)[body : body + bodies].double()
        for row in range(0, size, rows):
            i = places[row : row + rows]
            meet = _overlap(balls[:, row : row + rows], balls) & (i[:, None] < places)
            meet &= is_looked_at[groups[i]][:, groups]
            found.append(meet.nonzero() + torch.stack([i.new_tensor(body), i[0], i.new_tensor(0)]))
    all_found = torch.cat(found)
    numbers = torch.bincount(all_found[:, 0], minlength=count)
    return torch.cat([numbers.new_zeros(1), numbers.cumsum(0)]), all_found[:, 1:].contiguous()


def _matrix(groups: Tensor, group_pairs: Tensor) -> Tensor:
    """(G, G) bool, symmetric: the pairs of groups that are looked at."""
    size = int(groups.max()) + 1 if len(groups) else 0
    matrix = torch.zeros(size, size, dtype=torch.bool, device=groups.device)
    first, second = group_pairs[(group_pairs < size).all(1)].unbind(1)
    matrix[first, second] = True
    return matrix | matrix.T


def _overlap(some: Tensor, balls: Tensor) -> Tensor:
    """(n, R, S) of some balls (n, R, 4) with all (n, S, 4)."""
    apart = some[:, :, None, :3] - balls[:, None, :, :3]
    squared = apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1] + apart[..., 2] * apart[..., 2]
    reach = some[:, :, None, 3] + balls[:, None, :, 3]
    are_finite = some.isfinite().all(-1)[:, :, None] & balls.isfinite().all(-1)[:, None]
    return (squared < reach * reach) & are_finite
