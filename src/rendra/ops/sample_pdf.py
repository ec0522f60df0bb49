"""Random numbers from histograms: where along a ray to look again."""

import torch
from torch import Tensor


def sample_pdf(bins: Tensor, weights: Tensor, n_samples: int, det: bool = False, eps: float = 1e-5) -> Tensor:
    """Draw from piecewise constant densities, by inverting their distribution functions.

    The density of a bin is (weight + eps) / sum(weight + eps), spread evenly over its width (Mildenhall et al.,
    "NeRF", ECCV 2020, Sec. 5.2).

    Args:
        bins: (..., K + 1) edges of the bins, ascending.
        weights: (..., K) non-negative, of any sum.
        n_samples: how many to draw from each density.
        det: take the quantiles at n_samples even steps from 0 to 1, edges included, in place of random ones.
        eps: added to all weights, so that no bin is quite empty. Weights that are all 0 are the uniform density.

    Returns:
        (..., n_samples) in no order, or ascending if `det`. Differentiable with respect to both, the drawn
        probabilities held; detach them where looking again is no part of a gradient.

    Raises:
        ValueError: shapes that do not fit together, a negative weight, or fewer than 0 samples.
    """
    _check(bins, weights, n_samples, eps)
    mass = weights + eps
    mass = torch.where(mass.any(-1, keepdim=True), mass, 1.0)  # only without eps
    ends = mass.cumsum(-1)
    ends = ends / ends[..., -1:]  # (..., K) the distribution function at the upper edges
    starts = torch.cat((torch.zeros_like(ends[..., :1]), ends[..., :-1]), dim=-1)
    u = _probabilities(ends, n_samples, det)
    # the last edge, 1, is left out of the search: then every probability has a bin
    k = torch.searchsorted(ends[..., :-1].detach().contiguous(), u, right=True)
    lower, upper = bins[..., :-1].gather(-1, k), bins[..., 1:].gather(-1, k)
    start, end = starts.gather(-1, k), ends.gather(-1, k)
    height = torch.where(end > start, end - start, 1.0)  # 0 where a quantile meets an empty bin
    return lower + ((u - start) / height).clamp(0.0, 1.0) * (upper - lower)


def _probabilities(like: Tensor, n_samples: int, det: bool) -> Tensor:
    """Where to invert the distribution function: (..., n_samples) in [0, 1]."""
    shape = (*like.shape[:-1], n_samples)
    if not det:
        return torch.rand(shape, dtype=like.dtype, device=like.device)
    return torch.linspace(0.0, 1.0, n_samples, dtype=like.dtype, device=like.device).expand(shape).contiguous()


def _check(bins: Tensor, weights: Tensor, n_samples: int, eps: float) -> None:
    if weights.ndim == 0 or weights.shape[-1] == 0 or bins.shape != (*weights.shape[:-1], weights.shape[-1] + 1):
        raise ValueError(
            "bins and weights must have shapes (..., K + 1) and (..., K) with K > 0; "
            f"got {tuple(bins.shape)} and {tuple(weights.shape)}"
        )
    if n_samples < 0:
        raise ValueError(f"n_samples must not be negative, got {n_samples}")
    if (weights <= -eps).any() and (weights < 0).any():
        raise ValueError(f"weights must not be negative, got {weights.min().item():g}")
