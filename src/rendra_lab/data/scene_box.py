"""Where a scene lies: the box that may hold anything, out of silhouettes and cameras.

Silhouettes bound a scene best: whatever is in it projects into each of them, so it lies in their visual hull
(Laurentini, "The Visual Hull Concept for Silhouette-Based Image Understanding", PAMI 1994). The hull is carved out
of a grid of cells, conservatively: a cell goes only where the whole of it is seen to lie outside some silhouette.
Photographs without alpha leave the cameras: what they look at, and how much of it they see.

Letters: N images, C cells that are left.
"""

from __future__ import annotations

import functools
import itertools
import logging
import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.data.posed_images import PosedImages, distorted
from rendra_lab.errors import UserError

log = logging.getLogger(__name__)

_OPAQUE = 13  # alpha of 255 from which a pixel belongs to the silhouette: 5 per cent
_LONGEST_MASK = 256  # pixels; larger silhouettes are shrunk, never losing what they cover
_RESOLUTION = 64  # cells of a side in which the box is carved
_BLOCK = 4  # cells of a side that are judged together first
_MOST_VIEWS = 64  # that the box is carved with: fewer make it larger, never too small
_SEEN_BY = 0.25  # share of the views that must see a cell that counts for the box
_PARALLEL = 1e-4  # least eigenvalue of the axes' mean projector: they meet at about half a degree
_ALIKE = 0.8  # length of the mean axis from which cameras face one way
_RELATIVE_MARGIN = 1e-3


@dataclass(frozen=True)
class _Silhouette:
    """One view of what is to be carved."""

    covered: Tensor  # (h + 1, w + 1) int32: covered pixels above and left of each corner
    R: Tensor  # (3, 3)
    T: Tensor  # (3,)
    intrinsics: Tensor  # (4,) fx fy cx cy in pixels of `covered`
    distortion: Tensor | None  # (1, 8), None for a pinhole
    fisheye: Tensor  # (1,)
    magnification: float  # how much the lens enlarges at most, as against a pinhole


def estimate_box(images: PosedImages, depth_range: tuple[float, float] | None = None) -> Tensor:
    """The lowest and the highest corner of what may hold anything: (2, 3), in the world.

    Where the images have silhouettes, it is the bounding box of their visual hull, never smaller than what they
    all show. Elsewhere it is a cube about the point that the cameras look at, as large as nearly all of them see
    it; or, if they face one way and `depth_range` is known, what they see between its distances.

    Raises:
        UserError: the views say too little: parallel ones without silhouettes that meet, and no depth range.
    """
    if len(images) == 0:
        raise UserError("the box of a scene cannot be estimated from no images: give data.box")
    if has_silhouettes(images):
        box = _box_of_hull(images, depth_range)
        if box is not None:
            return box
        log.warning("the silhouettes have nothing in common, so the box of the scene is that of its cameras")
    return _box_of_cameras(images, depth_range)


def has_silhouettes(images: PosedImages) -> bool:
    """Whether alpha divides at least half of the images into an object and something that is not."""
    if not images.has_alpha:
        return False
    bounds = images.first_pixel.tolist()
    shares = [
        float((images.pixels[a:b:step, 3] >= _OPAQUE).float().mean())
        for a, b in itertools.pairwise(bounds)
        if (step := max(1, (b - a) // 16384)) and b > a
    ]
    return 2 * sum(0 < share < 0.98 for share in shares) >= max(1, len(shares))


def cells_along(box: Tensor, across: int, least: int = 1) -> tuple[int, int, int]:
    """Cells along z, y and x of a box (2, 3), about cubes: `across` along its longest side, `least` at least."""
    sides = box[1] - box[0]
    x, y, z = (max(least, round(across * float(side / sides.amax()))) for side in sides)
    return z, y, x


def carve(images: PosedImages, box: Tensor, resolution: int | tuple[int, int, int]) -> Tensor:
    """Which cells of a box may hold anything, judged by the silhouettes.

    A cell is empty only if it and all its neighbours lie fully outside the silhouette of some view that has all of
    the cell in its picture. Images without silhouettes leave everything, and so do, with a warning, silhouettes
    that have nothing in common.

    Args:
        images: of the scene.
        box: (2, 3), its lowest and highest corner in the world.
        resolution: cells along z, y and x, or along each of them.

    Returns:
        (D, H, W) bool, in the order z, y, x.
    """
    shape = (resolution,) * 3 if isinstance(resolution, int) else tuple(resolution)
    if not has_silhouettes(images):
        return torch.ones(shape, dtype=torch.bool, device=box.device)
    kept, _ = _carved(_silhouettes(images, range(len(images))), box, shape)
    if len(kept) == 0:
        log.warning("the silhouettes have nothing in common, so all of the box may hold something")
        return torch.ones(shape, dtype=torch.bool, device=box.device)
    cells = torch.zeros(math.prod(shape), device=box.device)
    cells[kept] = 1
    return F.max_pool3d(cells.reshape(1, 1, *shape), 3, stride=1, padding=1)[0, 0] > 0


def _box_of_hull(images: PosedImages, depth_range: tuple[float, float] | None) -> Tensor | None:
    """The bounding box of the visual hull; None where nothing is left of it."""
    count = min(len(images), _MOST_VIEWS)
    chosen = [round(i * len(images) / count) for i in range(count)]
    views = _silhouettes(images, chosen)
    box = _start_of_hull(images, depth_range)
    for _ in range(3):
        found = _shrunk(views, box, _RESOLUTION // 2)
        if found is None or not bool(_touching(found, box)):
            break
        box = torch.lerp(box.mean(0), box, 2.0)  # the hull of a box that was too small reaches its walls
    return None if found is None else _shrunk(views, found, _RESOLUTION)


def _start_of_hull(images: PosedImages, depth_range: tuple[float, float] | None) -> Tensor:
    """A box that is surely larger than what the images show."""
    focus = _focus(images)
    if focus is None:
        return _box_of_cameras(images, depth_range)
    seen = _seen_radius(images, focus)
    half = (
        1.8 * torch.quantile(seen, 0.9) if bool((seen > 0).any()) else (images.positions - focus).norm(dim=1).mean()
    )
    return torch.stack([focus - half, focus + half])


def _touching(inner: Tensor, outer: Tensor) -> Tensor:
    edge = (outer[1] - outer[0]) / (2 * _RESOLUTION)
    return ((inner[0] < outer[0] + edge) | (inner[1] > outer[1] - edge)).any()


def _shrunk(views: list[_Silhouette], box: Tensor, resolution: int) -> Tensor | None:
    """The bounding box, with a cell around it, of what carving leaves in a box."""
    shape = (resolution,) * 3
    kept, seen = _carved(views, box, shape)
    kept = kept[seen >= max(1.0, _SEEN_BY * len(views))]
    if len(kept) == 0:
        return None
    zyx = torch.stack(torch.unravel_index(kept, shape), dim=1)
    lowest, highest = zyx.amin(0).flip(0) - 1, zyx.amax(0).flip(0) + 2
    cell = (box[1] - box[0]) / resolution
    return torch.stack([box[0] + lowest.clamp_min(0) * cell, box[0] + highest.clamp_max(resolution) * cell])


def _carved(views: list[_Silhouette], box: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Flat numbers (C,) of the cells that are left, and how many views have each in their picture (C,).

    Blocks of cells are judged first: most lie outside, or so far inside that their cells need no look.
    """
    cell = (box[1] - box[0]) / torch.tensor(shape[::-1], device=box.device)
    blocks = [-(-n // _BLOCK) for n in shape]
    block = _lattice(blocks, box.device)
    left, inside, seen = _judged(views, _middles(block, box[0], cell * _BLOCK), 0.5 * _BLOCK * float(cell.norm()))
    fine = (block[left][:, None] * _BLOCK + _lattice([_BLOCK] * 3, box.device)).reshape(-1, 3)
    sure, seen = (per_block.repeat_interleave(_BLOCK**3) for per_block in (inside, seen))
    within = (fine < torch.tensor(shape, device=box.device)).all(1)
    fine, sure, seen = fine[within], sure[within], seen[within]
    numbers = (fine[:, 0] * shape[1] + fine[:, 1]) * shape[2] + fine[:, 2]
    doubtful = numbers[~sure]
    left, _, seen_fine = _judged(views, _middles(fine[~sure], box[0], cell), 0.5 * float(cell.norm()))
    return torch.cat([numbers[sure], doubtful[left]]), torch.cat([seen[sure], seen_fine])


def _lattice(shape: list[int], device: torch.device) -> Tensor:
    """All z, y, x of a grid: (D H W, 3), x fastest."""
    return torch.cartesian_prod(*(torch.arange(n, device=device) for n in shape))


def _middles(zyx: Tensor, lowest: Tensor, cell: Tensor) -> Tensor:
    """The middles (3, M) of cells (M, 3) of a grid."""
    return ((zyx.flip(1) + 0.5) * cell + lowest).T.contiguous()


def _judged(views: list[_Silhouette], centres: Tensor, radius: float) -> tuple[Tensor, Tensor, Tensor]:
    """Which balls (3, M) no silhouette excludes (C,); of them: whether each covers them, how many show them (C,)."""
    left = torch.arange(centres.shape[1], device=centres.device)
    inside = torch.ones_like(left, dtype=torch.bool)
    seen = torch.zeros_like(left, dtype=torch.int32)
    # views far from each other follow one another, so that little is left after a few
    for number in sorted(range(len(views)), key=lambda i: i * 0.618034 % 1):
        outside, covered, in_picture = _judge(views[number], centres, radius)
        inside, seen = inside & covered, seen + in_picture
        if bool(outside.any()):
            rest = (~outside).nonzero()[:, 0]
            centres, left, inside, seen = (t.index_select(-1, rest) for t in (centres, left, inside, seen))
    return left, inside, seen


def _judge(view: _Silhouette, centres: Tensor, radius: float) -> tuple[Tensor, Tensor, Tensor]:
    """Whether balls (3, C) lie fully outside the silhouette, within it, and within the picture: (C,) each.

    A ball of radius r at depth z and slope s moves no point further on the plane at depth 1 than
    r sqrt(1 + s^2) / (z - r).
    """
    in_view = torch.addmm(view.T[:, None], view.R.T, centres)
    depth = in_view[2].clamp_min(1.001 * radius)
    slope = -in_view[:2] / depth
    reach = (slope[0] * slope[0] + slope[1] * slope[1] + 1).sqrt() * (radius * view.magnification) / (depth - radius)
    if view.distortion is not None:
        slope = distorted(slope.T, view.distortion.expand(len(depth), -1), view.fisheye.expand(len(depth))).T
    in_picture = in_view[2] > 1.001 * radius
    bounds = []
    focal, principal = view.intrinsics[:2].tolist(), view.intrinsics[2:].tolist()
    for axis, size in enumerate((view.covered.shape[1] - 1, view.covered.shape[0] - 1)):
        middle, around = slope[axis] * focal[axis] + principal[axis], reach * focal[axis]
        low, high = (middle - around).floor_(), (middle + around).ceil_()
        in_picture &= (low >= 0) & (high <= size)
        bounds.append((low.clamp_(0, size).int(), high.clamp_(0, size).int()))
    (x0, x1), (y0, y1) = bounds
    table, width = view.covered.reshape(-1), view.covered.shape[1]
    top, bottom = y0 * width, y1 * width
    corners = [table.index_select(0, at) for at in (bottom + x1, top + x1, bottom + x0, top + x0)]
    covered = corners[0] - corners[1] - corners[2] + corners[3]
    return in_picture & (covered == 0), in_picture & (covered == (x1 - x0) * (y1 - y0)), in_picture


def _silhouettes(images: PosedImages, chosen: range | list[int]) -> list[_Silhouette]:
    bounds, sizes = images.first_pixel.tolist(), images.sizes.tolist()
    views = []
    for index in chosen:
        alpha = images.pixels[bounds[index] : bounds[index + 1], 3].reshape(sizes[index])
        factor = max(1, math.ceil(max(sizes[index]) / _LONGEST_MASK))
        mask = (_largest(alpha, factor) >= _OPAQUE).to(torch.int32)
        table = F.pad(mask.cumsum(0, dtype=torch.int32).cumsum(1, dtype=torch.int32), (1, 0, 1, 0))
        has_lens = bool(images.distortion[index].any()) or bool(images.fisheye[index])
        views.append(
            _Silhouette(
                covered=table,
                R=images.R[index],
                T=images.T[index],
                intrinsics=images.intrinsics[index] / factor,
                distortion=images.distortion[index][None] if has_lens else None,
                fisheye=images.fisheye[index][None],
                magnification=_magnification(images, index) if has_lens else 1.0,
            )
        )
    return views


def _largest(alpha: Tensor, factor: int) -> Tensor:
    """The largest value of each block of `factor` pixels a side; blocks at the lower right may be smaller."""
    if factor == 1:
        return alpha
    height, width = alpha.shape
    alpha = F.pad(alpha, (0, -width % factor, 0, -height % factor))
    rows = functools.reduce(torch.maximum, [alpha[i::factor] for i in range(factor)])
    return functools.reduce(torch.maximum, [rows[:, i::factor] for i in range(factor)])


def _magnification(images: PosedImages, index: int) -> float:
    """How much further apart the lens shows neighbouring directions than a pinhole would, at most."""
    height, width = images.sizes[index].tolist()
    across, down = torch.linspace(0, width, 33), torch.linspace(0, height, 33)
    grid = torch.stack(torch.meshgrid(across, down, indexing="xy"), dim=-1).to(images.intrinsics)
    xy = grid.reshape(-1, 2)
    _, directions = images.rays(torch.full((len(xy),), index, device=xy.device), xy)
    in_view = directions @ images.R[index]
    slope = (-in_view[:, :2] / in_view[:, 2:].clamp_min(1e-3)).reshape(33, 33, 2)
    shown = (grid - images.intrinsics[index, 2:]) / images.intrinsics[index, :2]
    ratios = [
        shown.diff(dim=axis).norm(dim=-1) / slope.diff(dim=axis).norm(dim=-1).clamp_min(1e-6) for axis in (0, 1)
    ]
    return 1.25 * max(1.0, *(float(ratio.amax()) for ratio in ratios))


def _box_of_cameras(images: PosedImages, depth_range: tuple[float, float] | None) -> Tensor:
    """What the cameras look at."""
    axes = images.R[:, :, 2]
    if depth_range is not None and float(axes.mean(0).norm()) > _ALIKE:
        return box_of_frusta(images, depth_range)
    focus = _focus(images)
    if focus is None and depth_range is None:
        raise UserError(
            "the cameras face one way and their axes do not meet, so nothing says how far away the scene is: "
            "give data.depth_range=[near,far] or data.box=[[x,y,z],[x,y,z]]"
        )
    if focus is None or not bool(((focus - images.positions) * axes).sum(1).median() > 0):
        return _box_around(images, depth_range)
    seen = _seen_radius(images, focus)
    if not bool((seen > 0).any()):
        seen = 0.5 * (images.positions - focus).norm(dim=1)
    half = torch.quantile(seen[seen > 0], 0.05)
    return torch.stack([focus - half, focus + half])


def _box_around(images: PosedImages, depth_range: tuple[float, float] | None) -> Tensor:
    """A box about cameras that look away from each other: as far as they see, or thrice as wide as they stand."""
    positions = images.positions
    lowest, highest = positions.amin(0), positions.amax(0)
    reach = (highest - lowest).norm().clamp_min(1e-3) if depth_range is None else depth_range[1]
    return torch.stack([lowest - reach, highest + reach])


def box_of_frusta(images: PosedImages, depth_range: tuple[float, float]) -> Tensor:
    """The bounding box (2, 3) of what the images see between two distances along their rays."""
    count = 5
    steps = torch.linspace(0, 1, count, device=images.R.device)
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1).reshape(-1, 2)
    xy = grid * images.sizes.flip(1)[:, None]
    view = torch.arange(len(images), device=xy.device).repeat_interleave(count * count)
    origins, directions = images.rays(view, xy.reshape(-1, 2).to(images.intrinsics))
    points = torch.cat([origins + depth * directions for depth in depth_range])
    lowest, highest = points.amin(0), points.amax(0)
    margin = _RELATIVE_MARGIN * (highest - lowest).amax()  # rays of the picture's corner may not graze the walls
    return torch.stack([lowest - margin, highest + margin])


def _focus(images: PosedImages) -> Tensor | None:
    """The point (3,) nearest to all optical axes, by least squares; None where they are parallel."""
    axes = images.R[:, :, 2].double()
    across = torch.eye(3, dtype=axes.dtype, device=axes.device) - axes[:, :, None] * axes[:, None]
    mean = across.mean(0)
    if float(torch.linalg.eigvalsh(mean)[0]) < _PARALLEL:
        return None
    moments = (across @ images.positions.double()[:, :, None])[:, :, 0].mean(0)
    return torch.linalg.solve(mean, moments).to(images.R.dtype)


def _seen_radius(images: PosedImages, focus: Tensor) -> Tensor:
    """The radius (N,) of the largest ball about a point that each camera sees whole; negative if it sees none."""
    count = len(images)
    width, height = images.sizes[:, 1], images.sizes[:, 0]
    nothing = torch.zeros_like(width)
    corners = torch.stack(
        [
            torch.stack([u, v], 1)
            for u, v in ((nothing, nothing), (width, nothing), (width, height), (nothing, height))
        ],
        dim=1,
    )
    view = torch.arange(count, device=corners.device).repeat_interleave(4)
    _, directions = images.rays(view, corners.reshape(-1, 2).to(images.intrinsics))
    directions = directions.reshape(count, 4, 3)
    inwards = F.normalize(torch.linalg.cross(directions, directions.roll(-1, 1), dim=-1), dim=-1)
    inwards = inwards * (inwards * images.R[:, None, :, 2]).sum(-1, keepdim=True).sign()
    return (inwards * (focus - images.positions)[:, None]).sum(-1).amin(1)
