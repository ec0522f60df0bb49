"""Losses that several tasks use. Each takes the prediction, then the target, and returns a scalar.

Shapes: images are (B, H, W, C), masks (B, H, W), but every loss on images takes any shape that broadcasts; clouds are
(B, P, 3). A mask is a weight per element in [0, 1], broadcast against the error; its mean then runs over the weight.
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from rendra.loss import chamfer_distance
from rendra.loss.point_mesh_distance import point_face_distance
from rendra.ops import knn_points
from rendra.structures import Meshes
from rendra_lab.settings import Amount, Size


class SquaredError:
    """The mean of squared differences, as a sum of squares that Gauss-Newton methods can use."""

    def __call__(self, prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
        """The mean of (prediction - target)^2 over the elements, weighted by the mask: a scalar."""
        return _mean((prediction - target).square(), mask)

    def residuals(self, prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
        """The vector (R,) whose squared length is the value of the call."""
        difference = prediction - target
        if mask is None:
            return difference.reshape(-1) / max(difference.numel(), 1) ** 0.5
        weight = _broadcast_mask(mask, difference)
        return (difference * (weight / weight.sum().clamp_min(1e-12)).sqrt()).reshape(-1)


class SummedSquaredError:
    """The sum of squared differences over the pixels: the book's image loss, which grows with the image.

    Args:
        side_px: images with a longer short side are compared at about this size, each pixel the mean of a square,
            and the sum is scaled back. Outlines that are off by several pixels then overlap: the loss is smooth
            enough for Gauss-Newton steps. None compares every pixel.
    """

    def __init__(self, side_px: int | None = None) -> None:
        if side_px is not None and side_px < 1:
            raise ValueError(f"side_px must be at least 1, or null for every pixel, got {side_px}")
        self.side_px = side_px

    def __call__(self, prediction: Tensor, target: Tensor) -> Tensor:
        """The loss of images (B, H, W) or (B, H, W, C): a scalar."""
        return self.residuals(prediction, target).square().sum()

    def residuals(self, prediction: Tensor, target: Tensor) -> Tensor:
        """The differences as a vector (R,)."""
        difference = prediction - target
        shrink = 1 if self.side_px is None else max(1, min(difference.shape[1:3]) // self.side_px)
        if shrink > 1:
            planes = difference[:, None] if difference.ndim == 3 else difference.movedim(-1, 1)
            difference = shrink * avg_pool2d(planes, shrink, ceil_mode=True)
        return difference.reshape(-1)


def absolute_error(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """The mean of |prediction - target|, weighted by the mask: a scalar."""
    return _mean((prediction - target).abs(), mask)


def huber(prediction: Tensor, target: Tensor, mask: Tensor | None = None, delta: float = 0.1) -> Tensor:
    """The mean of d^2 / 2 where |d| <= delta, else delta (|d| - delta / 2), d = prediction - target."""
    size = (prediction - target).abs()
    near = size.clamp(max=delta)
    return _mean(near * (size - 0.5 * near), mask)


def pseudo_huber(prediction: Tensor, target: Tensor, mask: Tensor | None = None, scale: Size = 0.1) -> Tensor:
    """The mean of s (sqrt(1 + d^2 / s^2) - 1), d = prediction - target: d^2 / 2s near 0, |d| - s far from it."""
    squared = (prediction - target).square() / scale**2
    return _mean(scale * squared / (1 + (1 + squared).sqrt()), mask)


def silhouette_iou(prediction: Tensor, target: Tensor) -> Tensor:
    """One minus the soft intersection over union of two coverages in [0, 1], averaged over the batch.

    Shapes: (B, H, W) both. Intersection is the sum of p t, union of p + t - p t; two empty masks agree (0).
    Source: Liu et al., "Soft Rasterizer", ICCV 2019, Eq. 8.
    """
    both = (prediction * target).flatten(1).sum(1)
    either = (prediction + target - prediction * target).flatten(1).sum(1)
    return (1 - torch.where(either > 0, both / either.clamp_min(1e-12), torch.ones_like(both))).mean()


def binary_cross_entropy(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """The mean of -t log p - (1 - t) log(1 - p) of probabilities in [0, 1]; finite at 0 and 1: a scalar."""
    safe = prediction.clamp(1e-6, 1 - 1e-6)
    return _mean(-(target * safe.log() + (1 - target) * (1 - safe).log()), mask)


def mean_square(prediction: Tensor) -> Tensor:
    """The mean of squares of the prediction alone: the simplest regulariser."""
    return prediction.square().mean()


def chamfer(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean squared distances of two clouds (B, P, 3), (B, Q, 3) to each other's nearest points, summed: a scalar."""
    return cast(Tensor, chamfer_distance(prediction, target)[0])


def cloud_to_surface(mesh: Meshes, points: Tensor) -> Tensor:
    """The mean squared distance of points (1, P, 3) from the surface of a batch of one mesh: a scalar."""
    # index_select: plain indexing adds up its gradient in parallel, in whatever order the threads come
    triangles = mesh.verts_packed().index_select(0, mesh.faces_packed().reshape(-1)).view(-1, 3, 3)
    first = torch.zeros(1, dtype=torch.long, device=points.device)
    return point_face_distance(points[0], first, triangles, first, points.shape[1], 0.0).mean()


def surface_to_cloud(samples: Tensor, points: Tensor, spacing: Tensor, slack: Amount = 1.0) -> Tensor:
    """How far samples of a surface are from a cloud, in squares of what exceeds a slack: a scalar.

    A cloud says where a surface is only up to the gaps between its points: within them the surface is free, and
    smooth.

    Args:
        samples: (B, S, 3), on the surface.
        points: (B, P, 3), the cloud.
        spacing: (B,), the distance between neighbours in the cloud.
        slack: free distance, in spacings.
    """
    distance = knn_points(samples, points).dists[..., 0].clamp_min(1e-12).sqrt()
    return (distance - slack * spacing[:, None]).clamp_min(0).square().mean()


class SheetSeparation:
    """Keeps two sheets of one surface that lie back to back, or face to face, from touching.

    Of the vertices nearest to a vertex, the nearest one whose normal points the other way is on the other sheet; what
    their distance along the normal lacks is squared, and averaged over the vertices. The sheets stay on the side
    where they are, so that the term prevents folds and does not undo them.

    Args:
        distance: at which sheets stop noticing each other.
        neighbours: how many of the nearest vertices are looked at.
        opposite: cosine of the two normals below which they belong to different sheets.
        most: vertices that are asked at a time, drawn at random; they stand for all.
    """

    def __init__(
        self, distance: float, neighbours: int = 24, opposite: float = -0.2, most: int | None = 2500
    ) -> None:
        if not distance > 0 or neighbours < 1 or (most is not None and most < 1):
            raise ValueError(
                "distance must be positive, neighbours and most at least 1, "
                f"got distance={distance}, neighbours={neighbours}, most={most}"
            )
        self.distance = distance
        self.neighbours = neighbours
        self.opposite = opposite
        self.most = most

    def __call__(self, mesh: Meshes) -> Tensor:
        """The term of a batch of one mesh: a scalar."""
        verts = mesh.verts_packed()
        with torch.no_grad():
            normals = mesh.verts_normals_packed()
            asked = torch.randperm(len(verts), device=verts.device)[: self.most]
            near = knn_points(verts[None, asked], verts[None], K=min(self.neighbours, len(verts))).idx[0]
            away = ((verts[asked, None] - verts[near]) * normals[asked, None]).sum(-1).abs()
            same_sheet = (normals[asked, None] * normals[near]).sum(-1) >= self.opposite
            gap, which = away.masked_fill(same_sheet, torch.inf).min(1)
            close = (gap < self.distance).nonzero()[:, 0]
            here, there = asked[close], near[close, which[close]]
        across = verts.index_select(0, here) - verts.index_select(0, there)
        gap = (across * normals[here]).sum(-1).abs()
        return (self.distance - gap).square().sum() / max(len(asked), 1)


def _mean(error: Tensor, mask: Tensor | None) -> Tensor:
    if mask is None:
        return error.mean()
    weight = _broadcast_mask(mask, error)
    return (error * weight).sum() / weight.sum().clamp_min(1e-12)


def _broadcast_mask(mask: Tensor, error: Tensor) -> Tensor:
    """A mask (B, H, W) meets an image (B, H, W, C) at its last dimension."""
    mask = mask.to(error.dtype)
    return (mask[..., None] if mask.ndim == error.ndim - 1 else mask).expand_as(error)
