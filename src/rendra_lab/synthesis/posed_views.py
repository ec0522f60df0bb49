"""Views of generated places with their depth, and the contract of whatever makes them.

Axes of cameras are OpenCV's: x right, y down, z forwards. Pixels: x right, y down, the first one's middle at 0.5.
Letters: V views of one place, H x W pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from rendra_lab.records import TensorRecord


@dataclass(frozen=True)
class PosedViews(TensorRecord):
    """V pictures of one place, each from a pose of its own."""

    rgb: UInt8[Tensor, "V 3 H W"]  # sRGB
    depth: Float[Tensor, "V 1 H W"]  # z in metres of what is seen at the middle of a pixel; inf: nothing but sky
    intrinsics: Float[Tensor, "V 3 3"]  # pixels
    world_to_camera: Float[Tensor, "V 4 4"]  # columns: camera = matrix @ (x, y, z, 1)


@runtime_checkable
class World(Protocol):
    """Places without end, each of a seed: the same seed and settings, the same place and the same pictures."""

    def settings(self) -> tuple[object, ...]:
        """All that determines the pictures of a place besides its seed, an edition of the world among it.

        Its `repr` names the cache of pictures: plain numbers, strings and tuples.
        """
        ...

    def views(self, seed: int, count: int, size: tuple[int, int]) -> PosedViews:
        """Views of the place of a seed.

        Any two of them are a pair such as one is to be made of the other, in no particular order.

        Args:
            seed: of the place and of where it is seen from.
            count: V, at least 2.
            size: H and W.
        """
        ...


def seen_by(
    depth: Float[Tensor, "B 1 H W"],
    intrinsics: Float[Tensor, "B 3 3"],
    to_other: Float[Tensor, "B 4 4"],
    other_depth: Float[Tensor, "B 1 h w"],
    other_intrinsics: Float[Tensor, "B 3 3"],
    tolerance: float = 0.03,
) -> Bool[Tensor, "B 1 H W"]:
    """Which pixels of a view show what another view sees too.

    A pixel is lifted by its depth and looked up at the nearest pixel of the other view: it is seen where that pixel's
    surface is not nearer than it by more than the tolerance. Sky is seen where the other view shows sky in the same
    direction.

    Args:
        depth: z of the view; inf for sky.
        intrinsics: of the view, pixels.
        to_other: from the view's axes to the other's.
        other_depth: z of the other view.
        other_intrinsics: of the other view, pixels.
        tolerance: share of the depth, to which the slope of the surface within a pixel is added.
    """
    pixels, z = to_other_view(depth, intrinsics, to_other, other_intrinsics)
    height, width = other_depth.shape[-2:]
    limits = pixels.new_tensor([width, height])
    inside = ((pixels >= 0) & (pixels < limits)).all(-1) & (z > 0)  # (B, H, W)
    column, row = torch.where(inside[..., None], pixels, 0).long().unbind(-1)
    flat = (row * width + column).flatten(1)

    def looked_up(values: Tensor) -> Tensor:
        return values.flatten(1).gather(1, flat).view(z.shape)

    there, slope = looked_up(other_depth), looked_up(_slope(other_depth))
    is_sky = torch.isinf(depth[:, 0])
    near = z <= there * (1 + tolerance) + slope
    return (inside & torch.where(is_sky, torch.isinf(there), near & torch.isfinite(there)))[:, None]


def to_other_view(
    depth: Float[Tensor, "B 1 H W"],
    intrinsics: Float[Tensor, "B 3 3"],
    to_other: Float[Tensor, "B 4 4"],
    other_intrinsics: Float[Tensor, "B 3 3"],
) -> tuple[Float[Tensor, "B H W 2"], Float[Tensor, "B H W"]]:
    """Where another camera sees what the pixels of a view show.

    Args:
        depth: z of the view; inf for what is infinitely far, which moves with the rotation alone.
        intrinsics: of the view, pixels.
        to_other: from the view's axes to the other's.
        other_intrinsics: of the other view, pixels.

    Returns:
        Pixels x and y, and z (1 for what is infinitely far and in front), in the other view. Where z is not
        positive, the pixel means nothing.
    """
    height, width = depth.shape[-2:]
    y, x = torch.meshgrid(
        torch.arange(height, device=depth.device, dtype=depth.dtype) + 0.5,
        torch.arange(width, device=depth.device, dtype=depth.dtype) + 0.5,
        indexing="ij",
    )
    rays = torch.stack([x, y, torch.ones_like(x)], -1) @ torch.linalg.inv(intrinsics).mT[:, None]
    is_far = torch.isinf(depth).movedim(1, -1)
    points = rays * torch.where(is_far, 1.0, depth.movedim(1, -1))
    moved = points @ to_other[:, None, :3, :3].mT
    moved = torch.where(is_far, moved, moved + to_other[:, None, None, :3, 3])
    z = moved[..., 2]
    flat = moved @ other_intrinsics[:, None].mT
    return flat[..., :2] / torch.where(z.abs() < 1e-6, 1e-6, z)[..., None], z


def _slope(depth: Tensor) -> Tensor:
    """How much depth changes within half a pixel, on the smoother side of it along each axis."""
    steps = torch.zeros_like(depth)
    for axis in (-2, -1):
        change = depth.diff(dim=axis).abs().nan_to_num(0.0, 0.0)
        edge = change.narrow(axis, 0, 1)
        before, after = torch.cat([edge, change], axis), torch.cat([change, change.narrow(axis, -1, 1)], axis)
        steps = steps + torch.minimum(before, after) / 2
    return steps
