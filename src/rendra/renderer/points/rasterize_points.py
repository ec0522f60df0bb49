"""Point clouds in NDC to the points that each pixel sees."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from rendra.kernels.rasterize_points import rasterize_points as _rasterize_kernel
from rendra.renderer.utils import parse_image_size
from rendra.structures.pointclouds import Pointclouds

Radius = float | Sequence[Any] | Tensor


def rasterize_points(
    pointclouds: Pointclouds,
    image_size: int | Sequence[int] = 256,
    radius: Radius = 0.01,
    points_per_pixel: int = 8,
    bin_size: int | None = None,
    max_points_per_bin: int | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Find the points whose discs cover each pixel's centre.

    Differentiable with respect to the points through depths and distances.

    Args:
        pointclouds: batch of N, points with x and y in NDC (+X left, +Y up, short image side in [-1, 1]) and z the
            view depth. Only points with z > 0 are seen.
        image_size: side of a square image, or (H, W), in pixels.
        radius: of the discs, in NDC; one number, or one for each point: see `packed_radius`.
        points_per_pixel: K, the nearest points that are kept for each pixel; any number.
        bin_size, max_points_per_bin: accepted for compatibility and ignored; the binning here is exact, no bin
            overflows.

    Returns:
        idx (N, H, W, K) int64, index of the packed point, nearest first, ties by lower index; zbuf (N, H, W, K), view
        depth; dists (N, H, W, K), squared NDC distance from the pixel's centre. Empty slots hold -1.

    Raises:
        ValueError: sizes, radius or number of points that cannot be.
    """
    return _rasterize_kernel(
        pointclouds.points_packed(),
        packed_radius(radius, pointclouds).detach(),
        pointclouds.cloud_to_packed_first_idx(),
        pointclouds.num_points_per_cloud(),
        parse_image_size(image_size),
        points_per_pixel,
    )


def packed_radius(radius: Radius, pointclouds: Pointclouds) -> Tensor:
    """One radius for each packed point (sum P,), with the gradients of what was given.

    Args:
        radius: a number or a tensor with one element; (N, P) as `points_padded()`, where padding is ignored, also as
            nested lists; (sum P,) as `points_packed()`; or a list of N tensors (P_i,).
        pointclouds: what they belong to.

    Raises:
        ValueError: another shape, or a radius that is negative or NaN.
    """
    points = pointclouds.points_packed()
    if isinstance(radius, (list, tuple)) and radius and all(isinstance(each, Tensor) for each in radius):
        sizes = [tuple(each.shape) for each in radius]
        if sizes != [(len(cloud),) for cloud in pointclouds.points_list()]:
            raise ValueError(
                f"radius must hold one number for each point of each cloud, got tensors of shapes {sizes}"
            )
        given = torch.cat(list(radius)).to(points)
    else:
        given = torch.as_tensor(radius).to(points)
    padded = (len(pointclouds), int(pointclouds.num_points_per_cloud().max()) if len(pointclouds) else 0)
    if given.numel() == 1 and given.ndim < 2:
        given = given.reshape(1).expand(len(points))
    elif given.shape == padded:
        given = given.reshape(-1).index_select(0, pointclouds.padded_to_packed_idx())
    if given.shape != points.shape[:1]:
        raise ValueError(
            f"radius must be a number, or a list or tensor of shape {padded}, one for each padded point, or "
            f"({len(points)},), one for each packed point; got shape {tuple(given.shape)}"
        )
    return given
