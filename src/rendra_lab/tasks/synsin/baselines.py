"""New views without any learning, to stand beside those with: the input as it is, and the input moved by a depth.

Holes take the mean colour of what was seen: they cost what not knowing costs, and not what black costs.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.synthesis.posed_views import to_other_view
from rendra_lab.tasks.synsin.records import PairBatch


class WarpedView(NamedTuple):
    """A new view, and where it is anything but a guess."""

    rgb: Float[Tensor, "B 3 H W"]
    covered: Bool[Tensor, "B 1 H W"]


def baselines(batch: PairBatch, constant_depth: float | None) -> dict[str, Tensor]:
    """New views (B, 3, H, W), as many as what is known allows: `copy`, `true_warp` and `constant_warp`.

    Args:
        batch: pairs.
        constant_depth: of everything that the inputs show, metres; None leaves that warp out.
    """
    views = {"copy": copied(batch)}
    if batch.truth is not None:
        views["true_warp"] = warped_by_depth(batch, batch.truth.depth).rgb
    if constant_depth is not None:
        views["constant_warp"] = warped_by_plane(batch, constant_depth).rgb
    return views


def copied(batch: PairBatch) -> Tensor:
    """The input as if nothing had moved: (B, 3, H, W)."""
    return batch.input


def warped_by_depth(batch: PairBatch, depth: Float[Tensor, "B 1 H W"]) -> WarpedView:
    """Every pixel of the input where the target's camera sees it, of several at a place the nearest.

    Cracks, which are holes with a neighbour that was hit, take the mean of such neighbours, as the masks of the
    paper's evaluation close them.

    Args:
        batch: pairs.
        depth: z of the inputs; inf for sky.
    """
    height, width = depth.shape[-2:]
    pixels, z = to_other_view(depth, batch.intrinsics, batch.input_to_target, batch.target_intrinsics)
    inside = ((pixels >= 0) & (pixels < pixels.new_tensor([width, height]))).all(-1) & (z > 0)
    column, row = torch.where(inside[..., None], pixels, 0).long().unbind(-1)
    nowhere = height * width
    places = torch.where(inside, row * width + column, nowhere).flatten(1)
    source = _nearest(places, torch.where(depth[:, 0].isinf(), torch.inf, z).flatten(1), nowhere)
    hit = (source < nowhere).view(-1, 1, height, width)
    colors = batch.input.flatten(2).gather(2, source.clamp_max(nowhere - 1)[:, None].expand(-1, 3, -1))
    rgb = torch.where(hit, colors.view_as(batch.input), 0.0)
    around = F.avg_pool2d(torch.cat([rgb, hit.to(rgb)], 1), 3, 1, 1)
    share = around[:, 3:]
    closed = torch.where(hit, rgb, around[:, :3] / share.clamp_min(1e-6))
    return _with_holes(closed, share > 0, batch)


def warped_by_plane(batch: PairBatch, depth: float) -> WarpedView:
    """The input as a picture on a wall, `depth` in front of its camera and square to it: without any cracks."""
    height, width = batch.input.shape[-2:]
    R, t = batch.input_to_target[:, :3, :3], batch.input_to_target[:, None, :3, 3]
    directions = (
        _rays(batch.target_intrinsics, height, width) @ R
    )  # a row times R: the turn back, to the input's axes
    origin = -t @ R
    along = (depth - origin[..., 2:]) / directions[..., 2:]
    on_wall = (origin + along * directions) @ batch.intrinsics.mT
    pixels = (on_wall[..., :2] / depth).view(-1, height, width, 2)
    size = pixels.new_tensor([width, height])
    covered = ((pixels >= 0) & (pixels <= size)).all(-1) & (along > 0).view(-1, height, width)
    grid = torch.where(covered[..., None], 2 * pixels / size - 1, 0.0)
    rgb = F.grid_sample(batch.input, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return _with_holes(rgb, covered[:, None], batch)


def _nearest(places: Tensor, z: Tensor, count: int) -> Tensor:
    """Which of P points (B, P) is the nearest at each of `count` places: (B, count), `P` where there is none.

    Places of `count` are none; of equally near points the first one wins.
    """
    last = places.shape[1]
    nearest = z.new_full((len(z), count + 1), torch.inf).scatter_reduce(1, places, z, "amin")
    order = torch.arange(last, device=z.device).expand_as(places)
    order = torch.where(z <= nearest.gather(1, places), order, last)
    return order.new_full((len(z), count + 1), last).scatter_reduce(1, places, order, "amin")[:, :count]


def _rays(intrinsics: Tensor, height: int, width: int) -> Tensor:
    """Directions with z = 1 through the pixels of cameras (B, 3, 3): (B, H W, 3)."""
    y, x = torch.meshgrid(
        torch.arange(height, device=intrinsics.device, dtype=intrinsics.dtype) + 0.5,
        torch.arange(width, device=intrinsics.device, dtype=intrinsics.dtype) + 0.5,
        indexing="ij",
    )
    return torch.stack([x, y, torch.ones_like(x)], -1).view(1, -1, 3) @ torch.linalg.inv(intrinsics).mT


def _with_holes(rgb: Tensor, covered: Tensor, batch: PairBatch) -> WarpedView:
    """The mean colour of what is covered everywhere else; of the input where nothing is."""
    count = covered.sum((2, 3), keepdim=True)
    seen = torch.where(covered, rgb, 0.0).sum((2, 3), keepdim=True) / count.clamp_min(1)
    mean = torch.where(count > 0, seen, batch.input.mean((2, 3), keepdim=True))
    return WarpedView(torch.where(covered, rgb, mean), covered)
