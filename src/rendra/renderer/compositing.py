"""Points that rasterisation found behind each pixel, nearest first, to images: by opacity or by weighted sums.

Letters: N images of H x W pixels, K points a pixel, P points of all clouds together, C feature channels.
"""

import torch
from torch import Tensor

from rendra.kernels.composite_points import composite_points


def alpha_composite(pointsidx: Tensor, alphas: Tensor, pt_clds: Tensor) -> Tensor:
    """Front-to-back compositing: sum_k f_k a_k prod_{l<k} (1 - a_l).

    Porter and Duff, "Compositing digital images", SIGGRAPH 1984. Differentiable in opacities and features.

    Args:
        pointsidx: (N, K, H, W) integers, packed index of the points behind each pixel, nearest first; negative where
            there is none.
        alphas: (N, K, H, W) opacity of each, in [0, 1]; what stands where there is no point is ignored.
        pt_clds: (C, P) features of the packed points.

    Returns:
        (N, C, H, W), 0 where no point is.

    Raises:
        ValueError: shapes, types or devices that do not fit, or an index beyond the points.
    """
    return _composite(pointsidx, alphas, pt_clds, "alpha")


def norm_weighted_sum(pointsidx: Tensor, alphas: Tensor, pt_clds: Tensor) -> Tensor:
    """Weighted mean, whatever the order: sum_k f_k a_k / max(sum_k a_k, 1e-4).

    Args:
        pointsidx, alphas, pt_clds: as of `alpha_composite`; so are result and errors.
    """
    return _composite(pointsidx, alphas, pt_clds, "norm")


def weighted_sum(pointsidx: Tensor, alphas: Tensor, pt_clds: Tensor) -> Tensor:
    """Weighted sum, whatever the order: sum_k f_k a_k.

    Args:
        pointsidx, alphas, pt_clds: as of `alpha_composite`; so are result and errors.
    """
    return _composite(pointsidx, alphas, pt_clds, "sum")


def _composite(pointsidx: Tensor, alphas: Tensor, pt_clds: Tensor, mode: str) -> Tensor:
    if pointsidx.ndim != 4 or pointsidx.is_floating_point() or pointsidx.dtype == torch.bool:
        raise ValueError(
            f"pointsidx must be integers of shape (N, K, H, W), got {pointsidx.dtype} of {tuple(pointsidx.shape)}"
        )
    if alphas.shape != pointsidx.shape:
        raise ValueError(
            f"alphas must have the shape of pointsidx, {tuple(pointsidx.shape)}; got {tuple(alphas.shape)}"
        )
    if pt_clds.ndim != 2 or not pt_clds.is_floating_point() or pt_clds.dtype != alphas.dtype:
        raise ValueError(
            f"pt_clds must be {alphas.dtype} of shape (C, P), like the alphas; got {pt_clds.dtype} of "
            f"{tuple(pt_clds.shape)}"
        )
    images, layers, height, width = pointsidx.shape
    lists = pointsidx.permute(0, 2, 3, 1).reshape(images * height * width, layers).long()
    opacities = alphas.permute(0, 2, 3, 1).reshape(lists.shape)
    composed = composite_points(lists, opacities, pt_clds.t(), mode)
    return composed.view(images, height, width, pt_clds.shape[0]).permute(0, 3, 1, 2)
