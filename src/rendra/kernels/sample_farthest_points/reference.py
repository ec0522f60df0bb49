"""Farthest point sampling, the specification: plain torch, any device, any float type, slow.

1. The squared distance of two points is the sum of (p_d - q_d)^2 over the dimensions in their order.
2. After each point that is taken, every point knows its squared distance to the nearest of those taken so far.
3. Taken next is the point whose is largest; among equals the one of lowest index. Where all that is left coincides
   with points taken already, that is index 0, again and again.
"""

import torch
from torch import Tensor


def sample_farthest_points(points: Tensor, lengths: Tensor, num_samples: Tensor, start: Tensor) -> Tensor:
    """Indices (N, max num_samples), -1 behind the last; see the package's `sample_farthest_points`."""
    numbers = num_samples.tolist()
    picked = torch.full((len(points), max(numbers, default=0)), -1, dtype=torch.int64, device=points.device)
    for n, (length, number, first) in enumerate(zip(lengths.tolist(), numbers, start.tolist(), strict=True)):
        for i, index in enumerate(_sample(points[n, :length], min(number, length), first)):
            picked[n, i] = index
    return picked


def _sample(cloud: Tensor, number: int, first: int) -> list[Tensor]:
    """Indices of one cloud (L, D), each a tensor of no dimension."""
    taken = [torch.tensor(first, device=cloud.device)][:number]
    nearest = torch.full_like(cloud[:, 0], float("inf")) if cloud.shape[1] else cloud.new_zeros(len(cloud))
    while len(taken) < number:
        squared = torch.zeros_like(nearest)
        for axis in cloud.unbind(1):
            squared = squared + (axis - axis[taken[-1]]) ** 2
        nearest = torch.minimum(nearest, squared)
        taken.append((nearest == nearest.max()).to(torch.uint8).argmax())
    return taken
