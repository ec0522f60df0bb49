"""Compositing of lists of points, the specification: plain torch, any device, any float type, slow.

With a_k the opacity of slot k of a list and f_k the features of the point in it, over the slots that hold one:

    alpha:  sum_k f_k a_k prod_{l<k} (1 - a_l)      (Porter and Duff's "over", SIGGRAPH 1984, from front to back)
    sum:    sum_k f_k a_k
    norm:   sum_k f_k a_k / max(sum_k a_k, 1e-4)

Some lists at a time, and each such block is computed again in the backward pass, so that memory stays bounded.
"""

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

MODES = ("alpha", "sum", "norm")
_NORM_EPS = 1e-4
_NUMBERS_AT_ONCE = 2**22


def composite_points(idx: Tensor, alphas: Tensor, features: Tensor, mode: str) -> Tensor:
    """See the package's `composite_points`; same arguments, same meaning."""
    if not idx.numel() or not len(features):
        # nothing to add up, yet part of the graph
        return features.new_zeros((len(idx), features.shape[1])) + 0 * (alphas.sum() + features.sum())
    lists = max(1, _NUMBERS_AT_ONCE // (idx.shape[1] * (features.shape[1] + 4)))
    blocks = [
        checkpoint(_block, *block, features, mode, use_reentrant=False)
        for block in zip(idx.split(lists), alphas.split(lists), strict=True)
    ]
    return torch.cat(blocks)


def _block(idx: Tensor, alphas: Tensor, features: Tensor, mode: str) -> Tensor:
    """The outputs (q, C) of some lists."""
    alphas = torch.where(idx >= 0, alphas, 0.0)
    weights = alphas
    if mode == "alpha":
        weights = alphas * F.pad((1 - alphas).cumprod(1), (1, -1), value=1.0)
    elif mode == "norm":
        weights = alphas / alphas.sum(1, keepdim=True).clamp(min=_NORM_EPS)
    slots = features.index_select(0, idx.clamp(min=0).flatten()).view(*idx.shape, features.shape[1])
    return (weights[..., None] * slots).sum(1)
