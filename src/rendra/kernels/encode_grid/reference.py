"""Encodings of points by grids of features, the specification: plain torch, any device, any float type, slow.

Rules, for a point x in [0, 1]^3 and a grid of N cells an axis:
1. Coordinates outside [0, 1] are clamped, and get no gradient. A NaN gives NaN.
2. The cell is floor(N x), and N - 1 where x = 1; the N + 1 vertices an axis lie at k / N.
3. Inside a cell features are multilinear in x. On a border the derivative is that of the upper cell.
4. A level whose (N + 1)^3 vertices fit in its rows is dense, row x + (N + 1) (y + (N + 1) z). Another one is hashed:
   (x xor y 2654435761 xor z 805459861) mod rows        (Mueller et al., SIGGRAPH 2022, Eq. 4; 32 bits)
5. Planes are those of (x, y), (x, z) and (y, z): planes[p, j, i] is the feature at i / (R - 1) of the first
   coordinate and j / (R - 1) of the second.

Chunks of points are recomputed in the backward pass, so that memory stays bounded.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

_LOOKUPS_AT_ONCE = 2**22
_PRIMES = (1, 2654435761, 805459861)
_PLANE_AXES = ((0, 1), (0, 2), (1, 2))


def encode_grid(points: Tensor, table: Tensor, resolutions: Sequence[int], offsets: Sequence[int]) -> Tensor:
    """Features (M, L F); see the package's `encode_grid` for the arguments."""
    width = table.shape[1]
    sizes = [end - begin for begin, end in pairwise(offsets)]

    def encode(part: Tensor) -> Tensor:
        rows, weights = [], []
        for resolution, size, offset in zip(resolutions, sizes, offsets[:-1], strict=True):
            cell, fraction = _cell(part, resolution)
            for corner in torch.cartesian_prod(*[torch.arange(2, device=part.device)] * 3):
                rows.append(offset + _row(cell + corner, resolution, size))
                weights.append(torch.where(corner.bool(), fraction, 1 - fraction).prod(-1))
        found = table.index_select(0, torch.stack(rows, 1).view(-1)).view(len(part), len(sizes), 8, width)
        return (found * torch.stack(weights, 1).view(len(part), len(sizes), 8, 1)).sum(2).flatten(1)

    return _in_chunks(encode, points, 8 * len(sizes) * width)


def encode_planes(points: Tensor, planes: Tensor, combine: str) -> Tensor:
    """Features (M, F), or (M, 3 F) for concat; see the package's `encode_planes` for the arguments."""
    side, width = planes.shape[1], planes.shape[3]
    flat = planes.reshape(-1, width)

    def encode(part: Tensor) -> Tensor:
        cell, fraction = _cell(part, side - 1)
        sums = []
        for plane, axes in enumerate(_PLANE_AXES):
            total = part.new_zeros(())
            for corner in torch.cartesian_prod(*[torch.arange(2, device=part.device)] * 2):
                i, j = (cell[:, list(axes)] + corner).unbind(1)
                weight = torch.where(corner.bool(), fraction[:, list(axes)], 1 - fraction[:, list(axes)]).prod(-1)
                total = total + weight[:, None] * flat.index_select(0, (plane * side + j) * side + i)
            sums.append(total)
        if combine == "concat":
            return torch.cat(sums, 1)
        return sums[0] * sums[1] * sums[2] if combine == "product" else sums[0] + sums[1] + sums[2]

    return _in_chunks(encode, points, 12 * width)


def _cell(points: Tensor, resolution: int) -> tuple[Tensor, Tensor]:
    """Lowest corner (M, 3) of the cell of each point, and where in the cell it is: (M, 3) in [0, 1]."""
    scaled = points.clamp(0, 1) * resolution
    cell = scaled.detach().nan_to_num().floor().clamp(max=resolution - 1)
    return cell.long(), scaled - cell


def _row(vertex: Tensor, resolution: int, size: int) -> Tensor:
    """Row of each vertex (M, 3) in a level of `size` rows."""
    x, y, z = vertex.unbind(-1)
    if (resolution + 1) ** 3 <= size:
        return x + (resolution + 1) * (y + (resolution + 1) * z)
    return (x * _PRIMES[0] ^ y * _PRIMES[1] ^ z * _PRIMES[2]) % size


def _in_chunks(encode: Callable[[Tensor], Tensor], points: Tensor, lookups: int) -> Tensor:
    """`encode` of a few points after the other, each recomputed in its backward pass."""
    parts = points.split(max(1, _LOOKUPS_AT_ONCE // lookups))
    return torch.cat([checkpoint(encode, part, use_reentrant=False) for part in parts])
