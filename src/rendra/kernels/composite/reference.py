"""Compositing of samples along rays, the specification: plain torch, any device, any float type, slow.

With a_j the opacity of sample j of a ray, first the nearest, and

    T_j = prod_{k<j} (1 - a_k)    its transmittance, or exp(-sum_{k<j} x_k) where a_k = 1 - exp(-x_k),
    w_j = a_j T_j                 its weight, 0 if T_j < stop_below,

the ray's features are sum_j w_j f_j, its opacity sum_j w_j and its depth sum_j w_j t_j (Max, "Optical models for
direct volume rendering", 1995; Mildenhall et al., "NeRF", ECCV 2020, Eq. 3). A ray without samples has zeros.

Rays are laid side by side in rows as long as the longest, some rows at a time, and each such block is computed again
in the backward pass, so that memory stays bounded.
"""

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

_NUMBERS_AT_ONCE = 2**22


def composite(
    values: Tensor,
    deltas: Tensor | None,
    features: Tensor,
    positions: Tensor,
    ray_first: Tensor,
    stop_below: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Features (R, C), opacity (R,), depth (R,) and weights (M,); `values` are densities where there are deltas."""
    blocks = [
        checkpoint(_block, values, deltas, features, positions, rays, stop_below, use_reentrant=False)
        for rays in _blocks(ray_first, features.shape[1] + 8)
    ]
    if not blocks:
        nothing = features.new_zeros(0)
        return features.new_zeros((0, features.shape[1])), nothing, nothing, nothing
    out, opacity, depth, weights = (torch.cat(parts) for parts in zip(*blocks, strict=True))
    return out, opacity, depth, weights


def visible(alphas: Tensor, ray_first: Tensor, threshold: float) -> Tensor:
    """Whether T_j >= threshold (M,)."""
    masks = []
    for rays in _blocks(ray_first, 4):
        index, inside = _rows(rays)
        masks.append((_transmittance_of_alphas(_spread(alphas, index, inside)) >= threshold)[inside])
    return torch.cat(masks) if masks else torch.zeros_like(alphas, dtype=torch.bool)


def _blocks(ray_first: Tensor, numbers_a_sample: int) -> list[Tensor]:
    """First sample and end (r, 2) of some rays at a time."""
    rays = torch.stack((ray_first[:-1], ray_first[1:]), dim=1)
    if not len(rays):
        return []
    longest = int((rays[:, 1] - rays[:, 0]).max())
    return list(rays.split(max(1, _NUMBERS_AT_ONCE // max(1, longest * numbers_a_sample))))


def _rows(rays: Tensor) -> tuple[Tensor, Tensor]:
    """Index of the sample at each place (r, S) of a block, and which places hold one."""
    longest = int((rays[:, 1] - rays[:, 0]).max())
    index = rays[:, :1] + torch.arange(longest, device=rays.device)
    inside = index < rays[:, 1:]
    return torch.where(inside, index, 0), inside


def _spread(packed: Tensor, index: Tensor, inside: Tensor) -> Tensor:
    """Packed (M, ...) laid in rows (r, S, ...), zeros where there is no sample."""
    rows = packed.index_select(0, index.flatten()).view(*index.shape, *packed.shape[1:])
    return torch.where(inside.view(*inside.shape, *[1] * (packed.ndim - 1)), rows, 0.0)


def _transmittance_of_alphas(alphas: Tensor) -> Tensor:
    return F.pad((1 - alphas).cumprod(1), (1, -1), value=1.0) if alphas.shape[1] else alphas


def _block(
    values: Tensor, deltas: Tensor | None, features: Tensor, positions: Tensor, rays: Tensor, stop_below: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The outputs of some rays, and the weights of their samples."""
    index, inside = _rows(rays)
    alphas = _spread(values, index, inside)
    if deltas is None:
        transmittance = _transmittance_of_alphas(alphas)
    else:
        thickness = alphas * _spread(deltas, index, inside)
        alphas = -torch.expm1(-thickness)
        before = F.pad(thickness.cumsum(1), (1, -1)) if thickness.shape[1] else thickness
        transmittance = torch.exp(-before)
    weights = torch.where(transmittance >= stop_below, alphas * transmittance, 0.0)
    out = (weights[..., None] * _spread(features, index, inside)).sum(1)
    depth = (weights * _spread(positions, index, inside)).sum(1)
    return out, weights.sum(1), depth, weights[inside]
