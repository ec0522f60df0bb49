"""Points to fragments, the specification: plain torch, any device, any float type, slow.

For every pixel centre p and every point (x, y, z) of its image with radius r (facts of PyTorch3D's public
rasteriser, version 0.7.9):
1. The distance is d = (p_x - x)^2 + (p_y - y)^2, in NDC: +X left, +Y up, the short side spans [-1, 1].
2. The point is a hit where d < r^2 and z > 0; points with a coordinate that is not finite are none.
3. The K hits of least depth z are kept, nearest first; ties go to the lower index.

The choice of hits carries no gradient; what is reported of them does, by autograd. Tiles of the image are split until
the pairs of their pixels and of the points that reach them are few.
"""

import torch
from torch import Tensor

_PAIRS_AT_ONCE = 2**18  # (pixel, point) pairs; larger tiles have more pairs in all, and those are sorted


def rasterize_points(
    points: Tensor,
    radius: Tensor,
    cloud_to_packed_first_idx: Tensor,
    num_points_per_cloud: Tensor,
    image_size: tuple[int, int],
    points_per_pixel: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """See the package's `rasterize_points`; same arguments, same meaning."""
    axes = tuple(_pixel_centres(side, min(image_size), points) for side in image_size)
    ranges = zip(cloud_to_packed_first_idx.tolist(), num_points_per_cloud.tolist(), strict=True)
    with torch.no_grad():
        images = [
            _nearest_hits(points, radius, first, first + count, axes, points_per_pixel) for first, count in ranges
        ]
    shape = (len(images), *image_size, points_per_pixel)
    idx = torch.stack(images) if images else points.new_empty(shape, dtype=torch.int64)

    hit = idx >= 0
    x, y, depth = points.index_select(0, idx[hit]).unbind(1)
    rows, columns = (axis.expand(shape)[hit] for axis in (axes[0][:, None, None], axes[1][:, None]))
    empty = points.new_full(shape, -1.0)
    dists = _squared_distance(columns, rows, x, y)
    return idx, empty.masked_scatter(hit, depth), empty.masked_scatter(hit, dists)


def _pixel_centres(size: int, short: int, like: Tensor) -> Tensor:
    """NDC (size,) of the pixel centres along one axis, falling."""
    return torch.arange(size - 1, -size, -2, dtype=like.dtype, device=like.device) / short


def _squared_distance(px: Tensor, py: Tensor, x: Tensor, y: Tensor) -> Tensor:
    dx, dy = px - x, py - y
    return dx * dx + dy * dy


def _nearest_hits(
    points: Tensor, radius: Tensor, first: int, end: int, axes: tuple[Tensor, ...], layers: int
) -> Tensor:
    """Point indices (H, W, K) of one image, -1 where there are fewer hits."""
    rows, columns = axes
    result = torch.full((len(rows), len(columns), layers), -1, dtype=torch.int64, device=points.device)
    is_drawn = points[first:end].isfinite().all(1) & (points[first:end, 2] > 0)
    todo = [((0, len(rows), 0, len(columns)), first + is_drawn.nonzero().squeeze(1))]
    while todo:
        (top, bottom, left, right), candidates = todo.pop()
        # centres fall along the axes; a point reaches a tile if it reaches the tile's nearest row and column
        nearest_x = points[candidates, 0].clamp(columns[right - 1], columns[left])
        nearest_y = points[candidates, 1].clamp(rows[bottom - 1], rows[top])
        reach = _squared_distance(nearest_x, nearest_y, points[candidates, 0], points[candidates, 1])
        candidates = candidates[reach < radius[candidates] * radius[candidates]]
        height, width = bottom - top, right - left
        if not len(candidates):
            continue
        if len(candidates) * height * width <= _PAIRS_AT_ONCE or height * width == 1:
            tile = _hits_of_tile(points, radius, candidates, rows[top:bottom], columns[left:right], layers)
            result[top:bottom, left:right, : tile.shape[2]] = tile
        elif height >= width:
            middle = (top + bottom) // 2
            todo += [((top, middle, left, right), candidates), ((middle, bottom, left, right), candidates)]
        else:
            middle = (left + right) // 2
            todo += [((top, bottom, left, middle), candidates), ((top, bottom, middle, right), candidates)]
    return result


def _hits_of_tile(
    points: Tensor, radius: Tensor, candidates: Tensor, rows: Tensor, columns: Tensor, layers: int
) -> Tensor:
    """Point indices (h, w, at most K) of one tile."""
    x, y, z = points[candidates].unbind(1)
    dists = _squared_distance(columns[:, None], rows[:, None, None], x, y)
    is_hit = dists < radius[candidates] * radius[candidates]
    # candidates ascend, and the sort is stable: ties go to the lower index
    order = torch.where(is_hit, z, torch.inf).argsort(dim=-1, stable=True)[..., :layers]
    return torch.where(is_hit.gather(-1, order), candidates[order], -1)
