"""Rays of cameras: which, and where along them to look.

A ray goes through a point of the image, usually in NDC (+X left, +Y up, the short side from -1 to 1). It starts in
the plane of the camera's centre, where view depth is 0, and its direction goes one unit of view depth, so that
lengths are depths; with unit directions they are distances.

Letters: N cameras, R rays of each, S samples along a ray, H W image height and width.
"""

import warnings
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rendra.renderer.batching import ragged
from rendra.renderer.camera_base import CamerasBase
from rendra.renderer.implicit.utils import (
    HeterogeneousRayBundle,
    RayBundle,
    ray_bundle_to_ray_points,
    ray_bundle_variables_to_ray_points,
)

__all__ = [
    "GridRaysampler",
    "HeterogeneousRayBundle",
    "MonteCarloRaysampler",
    "MultinomialRaysampler",
    "NDCGridRaysampler",
    "NDCMultinomialRaysampler",
    "RayBundle",
    "ray_bundle_to_ray_points",
    "ray_bundle_variables_to_ray_points",
]


@dataclass(frozen=True)
class _Depths:
    """The depths to sample, the same for all rays of a camera."""

    min_depth: float | Tensor
    max_depth: float | Tensor
    n_pts_per_ray: int
    stratified: bool

    def lengths(self, cameras: CamerasBase, shape: tuple[int, ...], owner: Tensor | None = None) -> Tensor:
        """Lengths (*shape, S) of rays whose cameras are `owner` (R,), or 0 to N - 1 along the first dimension.

        Even steps are not stored for every ray: the result is an expanded view.
        """
        nearest, farthest = (self._bound(bound, cameras) for bound in (self.min_depth, self.max_depth))
        steps = torch.linspace(0.0, 1.0, self.n_pts_per_ray, dtype=cameras.R.dtype, device=cameras.R.device)
        depths = torch.lerp(nearest, farthest, steps[None])  # (N or 1, S)
        if owner is not None and len(depths) > 1:
            depths = depths[owner]
        lengths = depths.view(len(depths), *[1] * (len(shape) - 1), -1).expand(*shape, -1)
        return _jitter(lengths) if self.stratified else lengths

    @staticmethod
    def _bound(bound: float | Tensor, cameras: CamerasBase) -> Tensor:
        """A number, or a tensor of one for every camera, as (1, 1) or (N, 1)."""
        column = torch.as_tensor(bound, dtype=cameras.R.dtype, device=cameras.R.device).reshape(-1, 1)
        if len(column) not in (1, len(cameras.R)):
            raise ValueError(
                f"min_depth and max_depth must be numbers, or one for each of the {len(cameras.R)} cameras; "
                f"got {len(column)}"
            )
        return column


class MultinomialRaysampler(nn.Module):
    """Rays through the points of a regular grid: all of them, or a random choice.

    The grid has `image_width` columns from `min_x` to `max_x` and `image_height` rows from `min_y` to `max_y`, ends
    included; the first row and column are those of the minima.

    Args:
        min_x, max_x, min_y, max_y: NDC of the outermost grid points; a minimum may be the larger one.
        image_width, image_height: W and H.
        n_pts_per_ray: S.
        min_depth, max_depth: of the first and the last sample: numbers, or tensors (N,), one for each camera.
        n_rays_per_image: draw so many grid points for each camera, without repetition while they last.
        n_rays_total: draw so many rays in all, each from a camera drawn with repetition.
        unit_directions: directions of length 1.
        stratified_sampling: move every sample to a random place between the midpoints to its neighbours; the
            first and the last move inwards only.

    Raises:
        ValueError: if both numbers of rays are given, or a size or number is out of range.
    """

    def __init__(
        self,
        *,
        min_x: float,
        max_x: float,
        min_y: float,
        max_y: float,
        image_width: int,
        image_height: int,
        n_pts_per_ray: int,
        min_depth: float | Tensor,
        max_depth: float | Tensor,
        n_rays_per_image: int | None = None,
        n_rays_total: int | None = None,
        unit_directions: bool = False,
        stratified_sampling: bool = False,
    ) -> None:
        super().__init__()
        if image_width < 1 or image_height < 1:
            raise ValueError(f"image_width and image_height must be at least 1, got {image_width}, {image_height}")
        _check_numbers(n_rays_per_image, n_rays_total, n_pts_per_ray)
        self.min_x, self.max_x, self.min_y, self.max_y = min_x, max_x, min_y, max_y
        self.image_width, self.image_height = image_width, image_height
        self.n_pts_per_ray = n_pts_per_ray
        self.min_depth, self.max_depth = min_depth, max_depth
        self.n_rays_per_image, self.n_rays_total = n_rays_per_image, n_rays_total
        self.unit_directions = unit_directions
        self.stratified_sampling = stratified_sampling

    def forward(
        self,
        cameras: CamerasBase,
        *,
        mask: Tensor | None = None,
        min_depth: float | Tensor | None = None,
        max_depth: float | Tensor | None = None,
        n_rays_per_image: int | None = None,
        n_pts_per_ray: int | None = None,
        stratified_sampling: bool | None = None,
        n_rays_total: int | None = None,
        **kwargs: Any,
    ) -> RayBundle | HeterogeneousRayBundle:
        """Cast rays.

        Args:
            cameras: N of them.
            mask: (N, H, W), draw grid points in proportion to it; never where it is 0. Without a number of rays,
                every camera gets as many as the smallest mask has grid points.
            min_depth, max_depth, n_rays_per_image, n_pts_per_ray, stratified_sampling, n_rays_total: used in place
                of what the constructor got.
            **kwargs: ignored.

        Returns:
            A bundle of shape (N, H, W, ...) for the whole grid, or (N, R, 1, ...) for a choice. With `n_rays_total`
            a `HeterogeneousRayBundle` of shape (n_rays_total, 1, 1, ...), sorted by camera.

        Raises:
            ValueError: as in the constructor; or the mask has another shape, is negative, or 0 everywhere.
        """
        depths = _Depths(
            _first_given(min_depth, self.min_depth),
            _first_given(max_depth, self.max_depth),
            _first_given(n_pts_per_ray, self.n_pts_per_ray),
            _first_given(stratified_sampling, self.stratified_sampling),
        )
        count = _first_given(n_rays_per_image, self.n_rays_per_image)
        total = _first_given(n_rays_total, self.n_rays_total)
        _check_numbers(count, total, depths.n_pts_per_ray)
        grid, n = self._grid(cameras), len(cameras.R)
        weights = None if mask is None else _mask_weights(mask, (n, *grid.shape[:2]))
        if total is not None:
            ids, counts = _draw_cameras(cameras, total)
            chosen = None if weights is None else weights[ids]
            xys = _draw_points(grid, len(ids), int(counts.max()), chosen)
            return _heterogeneous_bundle(cameras, (ids, counts), xys, depths, self.unit_directions)
        if count is None and weights is not None:
            count = int((weights > 0).sum(1).min()) if n > 0 else 0
        xys = grid.repeat(n, 1, 1, 1) if count is None else _draw_points(grid, n, count, weights)
        return _bundle(cameras, xys, depths, self.unit_directions)

    def _grid(self, cameras: CamerasBase) -> Tensor:
        """The grid points (H, W, 2), as precise as the cameras."""
        dtype, device = cameras.R.dtype, cameras.R.device
        x = torch.linspace(self.min_x, self.max_x, self.image_width, dtype=dtype, device=device)
        y = torch.linspace(self.min_y, self.max_y, self.image_height, dtype=dtype, device=device)
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)


class NDCMultinomialRaysampler(MultinomialRaysampler):
    """Rays through the pixel centres of an image, in the order of its pixels: row 0 is the top, column 0 the left.

    Arguments as of `MultinomialRaysampler`, which is given the range of the image in NDC.
    """

    def __init__(
        self,
        *,
        image_width: int,
        image_height: int,
        n_pts_per_ray: int,
        min_depth: float | Tensor,
        max_depth: float | Tensor,
        n_rays_per_image: int | None = None,
        n_rays_total: int | None = None,
        unit_directions: bool = False,
        stratified_sampling: bool = False,
    ) -> None:
        super().__init__(
            **_pixel_centres(image_width, image_height),
            image_width=image_width,
            image_height=image_height,
            n_pts_per_ray=n_pts_per_ray,
            min_depth=min_depth,
            max_depth=max_depth,
            n_rays_per_image=n_rays_per_image,
            n_rays_total=n_rays_total,
            unit_directions=unit_directions,
            stratified_sampling=stratified_sampling,
        )


class GridRaysampler(MultinomialRaysampler):
    """The former name of `MultinomialRaysampler`: positional arguments, always the whole grid by default."""

    def __init__(
        self,
        min_x: float,
        max_x: float,
        min_y: float,
        max_y: float,
        image_width: int,
        image_height: int,
        n_pts_per_ray: int,
        min_depth: float,
        max_depth: float,
    ) -> None:
        _warn_renamed("GridRaysampler", "MultinomialRaysampler")
        super().__init__(
            min_x=min_x,
            max_x=max_x,
            min_y=min_y,
            max_y=max_y,
            image_width=image_width,
            image_height=image_height,
            n_pts_per_ray=n_pts_per_ray,
            min_depth=min_depth,
            max_depth=max_depth,
        )


class NDCGridRaysampler(NDCMultinomialRaysampler):
    """The former name of `NDCMultinomialRaysampler`: positional arguments, always the whole image by default."""

    def __init__(
        self, image_width: int, image_height: int, n_pts_per_ray: int, min_depth: float, max_depth: float
    ) -> None:
        _warn_renamed("NDCGridRaysampler", "NDCMultinomialRaysampler")
        super().__init__(
            image_width=image_width,
            image_height=image_height,
            n_pts_per_ray=n_pts_per_ray,
            min_depth=min_depth,
            max_depth=max_depth,
        )


class MonteCarloRaysampler(nn.Module):
    """Rays through uniformly random points of a rectangle of the image.

    Args:
        min_x, max_x, min_y, max_y: the rectangle, in NDC.
        n_rays_per_image: R, or None if `n_rays_total` is given.
        n_pts_per_ray: S.
        min_depth, max_depth: of the first and the last sample: numbers, or tensors (N,), one for each camera.
        n_rays_total, unit_directions, stratified_sampling: as of `MultinomialRaysampler`.

    Raises:
        ValueError: unless exactly one number of rays is given, and none is out of range.
    """

    def __init__(
        self,
        min_x: float,
        max_x: float,
        min_y: float,
        max_y: float,
        n_rays_per_image: int | None,
        n_pts_per_ray: int,
        min_depth: float | Tensor,
        max_depth: float | Tensor,
        *,
        n_rays_total: int | None = None,
        unit_directions: bool = False,
        stratified_sampling: bool = False,
    ) -> None:
        super().__init__()
        _check_numbers(n_rays_per_image, n_rays_total, n_pts_per_ray)
        if n_rays_per_image is None and n_rays_total is None:
            raise ValueError("one of n_rays_per_image and n_rays_total must be given")
        self.min_x, self.max_x, self.min_y, self.max_y = min_x, max_x, min_y, max_y
        self.n_rays_per_image, self.n_rays_total = n_rays_per_image, n_rays_total
        self.n_pts_per_ray = n_pts_per_ray
        self.min_depth, self.max_depth = min_depth, max_depth
        self.unit_directions = unit_directions
        self.stratified_sampling = stratified_sampling

    def forward(
        self, cameras: CamerasBase, *, stratified_sampling: bool | None = None, **kwargs: Any
    ) -> RayBundle | HeterogeneousRayBundle:
        """Cast rays.

        Args:
            cameras: N of them.
            stratified_sampling: used in place of what the constructor got.
            **kwargs: ignored.

        Returns:
            A bundle of shape (N, R, ...). With `n_rays_total` a `HeterogeneousRayBundle` of shape
            (n_rays_total, 1, ...), sorted by camera.
        """
        stratified = _first_given(stratified_sampling, self.stratified_sampling)
        depths = _Depths(self.min_depth, self.max_depth, self.n_pts_per_ray, stratified)
        if self.n_rays_total is not None:
            ids, counts = _draw_cameras(cameras, self.n_rays_total)
            xys = self._points(cameras, len(ids), int(counts.max()))
            return _heterogeneous_bundle(cameras, (ids, counts), xys, depths, self.unit_directions)
        assert self.n_rays_per_image is not None
        xys = self._points(cameras, len(cameras.R), self.n_rays_per_image)
        return _bundle(cameras, xys, depths, self.unit_directions)

    def _points(self, cameras: CamerasBase, n: int, count: int) -> Tensor:
        """Random points (N, R, 2) of the rectangle."""
        u = torch.rand(n, count, 2, dtype=cameras.R.dtype, device=cameras.R.device)
        low = u.new_tensor([self.min_x, self.min_y])
        return low + u * u.new_tensor([self.max_x - self.min_x, self.max_y - self.min_y])


def _bundle(cameras: CamerasBase, xys: Tensor, depths: _Depths, unit_directions: bool) -> RayBundle:
    """The rays through points (N, ..., 2)."""
    origins, directions = _cast(cameras, xys, unit_directions)
    return RayBundle(origins, directions, depths.lengths(cameras, tuple(xys.shape[:-1])), xys)


def _heterogeneous_bundle(
    cameras: CamerasBase, drawn: tuple[Tensor, Tensor], xys: Tensor, depths: _Depths, unit_directions: bool
) -> HeterogeneousRayBundle:
    """The rays through points (M, longest, ..., 2), of which every drawn camera keeps its number."""
    ids, counts = drawn
    rows = ragged(counts)
    cast = (*_cast(cameras[ids], xys, unit_directions), xys)
    origins, directions, kept = (rows.take(each)[:, None] for each in cast)  # (R, 1, ..., 3)
    lengths = depths.lengths(cameras, tuple(kept.shape[:-1]), ids.repeat_interleave(counts))
    return HeterogeneousRayBundle(origins, directions, lengths, kept, ids, counts)


def _cast(cameras: CamerasBase, xys: Tensor, unit_directions: bool) -> tuple[Tensor, Tensor]:
    """Origins and directions (N, ..., 3) of the rays through points (N, ..., 2), from what lies at depth 1 and 2."""
    flat = xys.flatten(1, -2)
    ones = torch.ones_like(flat[..., :1])
    projected = torch.cat((torch.cat((flat, ones), dim=-1), torch.cat((flat, 2 * ones), dim=-1)), dim=1)
    near, far = cameras.unproject_points(projected, from_ndc=True).split(flat.shape[1], dim=1)
    directions = far - near
    origins = near - directions
    if unit_directions:
        directions = F.normalize(directions, dim=-1)
    shape = (*xys.shape[:-1], 3)
    return origins.reshape(shape), directions.reshape(shape)


def _jitter(lengths: Tensor) -> Tensor:
    """Move each length (..., S) to a random place between the midpoints to its neighbours."""
    middles = 0.5 * (lengths[..., 1:] + lengths[..., :-1])
    lower = torch.cat((lengths[..., :1], middles), dim=-1)
    upper = torch.cat((middles, lengths[..., -1:]), dim=-1)
    return torch.lerp(lower, upper, torch.rand_like(lower))


def _draw_cameras(cameras: CamerasBase, total: int) -> tuple[Tensor, Tensor]:
    """Which cameras (M,) get rays, and how many each (M,), if `total` rays choose theirs at random."""
    if len(cameras.R) == 0:
        raise ValueError(f"cannot draw n_rays_total={total} rays from 0 cameras")
    owners = torch.randint(len(cameras.R), (total,), device=cameras.R.device)
    ids, counts = owners.unique(return_counts=True)
    return ids, counts


def _draw_points(grid: Tensor, n: int, count: int, weights: Tensor | None) -> Tensor:
    """Random points (N, count, 1, 2) of a grid (H, W, 2), for every camera its own, by weights (N, H W)."""
    points = grid.flatten(0, 1)
    rows = _draw_evenly(n, len(points), count, grid) if weights is None else _draw_weighted(weights, count)
    return points[rows][:, :, None]


def _draw_evenly(n: int, size: int, count: int, like: Tensor) -> Tensor:
    """Random indices (N, count) below `size`, different ones while they last."""
    if count > size:
        return torch.randint(size, (n, count), device=like.device)
    return torch.rand(n, size, device=like.device).topk(count, dim=1).indices


def _draw_weighted(weights: Tensor, count: int) -> Tensor:
    """Random indices (N, count) in proportion to weights (N, size), different ones while they last.

    The largest of w / e with e exponentially distributed are a draw without repetition (Efraimidis and Spirakis,
    "Weighted random sampling with a reservoir", 2006).
    """
    is_few = (weights > 0).sum(1) < count
    race = weights / torch.empty_like(weights).exponential_().clamp_(min=torch.finfo(weights.dtype).tiny)
    drawn = race.topk(min(count, weights.shape[1]), dim=1).indices
    if not is_few.any():
        return drawn
    repeated = torch.multinomial(weights, count, replacement=True)
    return torch.where(is_few[:, None], repeated, F.pad(drawn, (0, count - drawn.shape[1])))


def _mask_weights(mask: Tensor, shape: tuple[int, ...]) -> Tensor:
    """A checked mask as weights (N, H W) of the grid points."""
    if tuple(mask.shape) != shape:
        raise ValueError(f"mask must have shape (N, H, W) = {shape}, got {tuple(mask.shape)}")
    weights = mask.detach().flatten(1).float()
    if not (weights >= 0).all() or weights.isinf().any():
        raise ValueError("mask must hold finite numbers that are not negative")
    is_empty = ~weights.any(1)
    if is_empty.any():
        raise ValueError(f"mask is 0 everywhere for camera {is_empty.nonzero()[0, 0].item()}")
    return weights


def _check_numbers(per_image: int | None, total: int | None, n_pts_per_ray: int) -> None:
    if per_image is not None and total is not None:
        raise ValueError(
            f"n_rays_per_image and n_rays_total cannot both be given, got n_rays_per_image={per_image} and "
            f"n_rays_total={total}"
        )
    for name, number, least in (
        ("n_rays_per_image", per_image, 1),
        ("n_rays_total", total, 1),
        ("n_pts_per_ray", n_pts_per_ray, 0),
    ):
        if number is not None and number < least:
            raise ValueError(f"{name} must be at least {least}, got {number}")


def _first_given(override: Any, stored: Any) -> Any:
    return stored if override is None else override


def _pixel_centres(width: int, height: int) -> dict[str, float]:
    """NDC of the outermost pixel centres of an image, whose left and top are positive."""
    if width < 1 or height < 1:
        raise ValueError(f"image_width and image_height must be at least 1, got {width}, {height}")
    short = min(width, height)
    x, y = (width - 1) / short, (height - 1) / short
    return {"min_x": x, "max_x": -x, "min_y": y, "max_y": -y}


def _warn_renamed(old: str, new: str) -> None:
    """The deprecation warning of the former names, at the caller's caller."""
    warnings.warn(f"{old} is deprecated, use {new} instead.", PendingDeprecationWarning, stacklevel=3)
