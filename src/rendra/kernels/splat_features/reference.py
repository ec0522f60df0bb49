"""Splatting of features, the specification: plain torch, any device, any float type, slow.

Points k of a pixel are those whose distance d_k to its middle is below the radius r, the K nearest by depth (ties:
lower index), near first. With

    a_k = (1 - sqrt(clamp(d_k^2 / r^2, 1e-3, 1)))^tau,    T_k = prod_{l<k} (1 - a_l)

the pixel's feature and its opacity are

    alphacomposite  sum a_k T_k f_k                          sum a_k T_k, both over those with T_k >= stop_below
    wsum            sum a_k f_k                              min(sum a_k, 1)
    wsumnorm        sum a_k f_k / max(sum a_k, 1e-4)         min(sum a_k, 1)
    naive           f_1                                      1 if there is a point, else 0

(Wiles et al., "SynSin", CVPR 2020, Sec. 3.2, and its published code). Where a point lies within sqrt(1e-3) r of the
middle, or where a_k = 0, no gradient reaches its place. Each block of pixels looks at the points that can reach it
and is computed again in the backward pass, so that memory stays bounded.
"""

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

_ALPHACOMPOSITE, _WSUM, _WSUMNORM, _NAIVE = range(4)
_NEAREST, _LEAST = 1e-3, 1e-4
_SIDE = 32  # of a block of pixels
_PAIRS_AT_ONCE = 2**22


def splat_features(
    points: Tensor,
    order: Tensor,
    features: Tensor,
    height: int,
    width: int,
    radius: float,
    points_per_pixel: int,
    mode: int,
    tau: float,
    stop_below: float,
) -> tuple[Tensor, Tensor]:
    """Image (B, H, W, C) and opacity (B, H, W).

    `order` (B, P) int32 lists the points of each cloud, near first, as rows of all clouds (B P); -1 for those that
    are left out. The rest as in the package's `splat_features`.
    """
    rows, table = points.flatten(0, 1), features.flatten(0, 1)
    settings = radius, points_per_pixel, mode, tau, stop_below
    images, opacities = [], []
    for near_first in order:
        listed = near_first[near_first >= 0].long()
        columns = []
        for y in torch.arange(height, device=points.device).split(_SIDE):
            blocks = [
                _block(rows, listed, table, y, x, settings)
                for x in torch.arange(width, device=points.device).split(_SIDE)
            ]
            columns.append([torch.cat(parts, 1) for parts in zip(*blocks, strict=True)])
        image, opacity = (torch.cat(parts) for parts in zip(*columns, strict=True))
        images.append(image)
        opacities.append(opacity)
    if not images:
        none = features.sum()  # zero, and part of the graph
        return none.expand(0, height, width, features.shape[2]), none.expand(0, height, width)
    return torch.stack(images), torch.stack(opacities)


def _block(
    rows: Tensor, listed: Tensor, table: Tensor, y: Tensor, x: Tensor, settings: tuple[float, int, int, float, float]
) -> tuple[Tensor, Tensor]:
    """Image (h, w, C) and opacity (h, w) of the pixels in rows y and columns x."""
    corner, far_corner = torch.stack((x[0], y[0])) + 0.5, torch.stack((x[-1], y[-1])) + 0.5
    places = rows.detach().index_select(0, listed)
    can_reach = ((places > corner - settings[0]) & (places < far_corner + settings[0])).all(1)
    listed = listed[can_reach]
    middles = torch.cartesian_prod(y, x).flip(1).to(rows.dtype) + 0.5
    parts = [
        checkpoint(_pixels, rows, listed, table, some, *settings, use_reentrant=False)
        for some in middles.split(max(1, _PAIRS_AT_ONCE // max(1, len(listed))))
    ]
    image, opacity = (torch.cat(pixels) for pixels in zip(*parts, strict=True))
    return image.view(len(y), len(x), -1), opacity.view(len(y), len(x))


def _pixels(
    rows: Tensor,
    listed: Tensor,
    table: Tensor,
    middles: Tensor,
    radius: float,
    points_per_pixel: int,
    mode: int,
    tau: float,
    stop_below: float,
) -> tuple[Tensor, Tensor]:
    """Image (N, C) and opacity (N,) of the pixels with these middles (N, 2)."""
    places = rows.index_select(0, listed)
    squared = (middles[:, None] - places).square().sum(-1)
    counts = squared < radius**2
    counts = counts & (counts.cumsum(1) <= points_per_pixel)
    if mode == _NAIVE:
        weights = counts.to(rows.dtype)
        opacity = weights.sum(1)
    else:
        alphas = _alphas(squared / radius**2, counts, tau)
        weights, opacity = _weights(alphas, mode, stop_below)
    return weights @ table.index_select(0, listed), opacity


def _alphas(squared: Tensor, counts: Tensor, tau: float) -> Tensor:
    """Of each point at each pixel (N, n), from squared distances in radii; zero where it does not count."""
    # what does not count is put where the root and the power have slopes
    height = 1 - torch.where(counts, squared, 0.25).clamp(_NEAREST, 1).sqrt()
    counts = counts & (height > 0)
    return torch.where(counts, torch.where(counts, height, 0.5) ** tau, 0.0)


def _weights(alphas: Tensor, mode: int, stop_below: float) -> tuple[Tensor, Tensor]:
    """Weights (N, n) and opacity (N,)."""
    if mode == _ALPHACOMPOSITE:
        if not alphas.shape[1]:
            return alphas, alphas.sum(1)
        light = F.pad(torch.log1p(-alphas).cumsum(1), (1, -1)).exp()
        weights = torch.where(light >= stop_below, alphas * light, 0.0)
        return weights, weights.sum(1)
    total = alphas.sum(1)
    if mode == _WSUMNORM:
        alphas = alphas / total.clamp(min=_LEAST)[:, None]
    return alphas, total.clamp(max=1)
