"""What renderers of radiance fields give, and what exporters ask of a task that fits one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from lightning.pytorch import LightningModule
from torch import Tensor
from torch.nn import functional

from rendra_lab.data.ray_views import RayBatch, Scene, SceneViews
from rendra_lab.errors import UserError
from rendra_lab.normal_maps import normals_from_depth
from rendra_lab.records import TensorRecord
from rendra_lab.visualization import depth_image, normal_image


@dataclass(frozen=True)
class Rays(TensorRecord):
    """Q rays, and where on each to look."""

    origins: Float[Tensor, "Q 3"]  # in the world
    directions: Float[Tensor, "Q 3"]  # of length 1
    nearest: Float[Tensor, " Q"]  # distance along the ray
    farthest: Float[Tensor, " Q"]  # not beyond `nearest`: there is nothing on this ray

    @classmethod
    def of(cls, batch: RayBatch) -> Rays:
        """All rays of a batch, those of a pixel side by side."""
        return cls(
            batch.origins.reshape(-1, 3),
            batch.directions.reshape(-1, 3),
            batch.nearest.reshape(-1),
            batch.farthest.reshape(-1),
        )

    def slice(self, first: int, last: int) -> Rays:
        """The rays first, ..., last - 1."""
        return self._map(lambda value: value[first:last], lambda value: isinstance(value, Tensor))


@dataclass(frozen=True)
class RaysSeen(TensorRecord):
    """What each of Q rays saw."""

    rgb: Float[Tensor, "Q 3"]  # light, sRGB in [0, 1], with nothing behind it: not divided by the opacity
    opacity: Float[Tensor, " Q"]  # one minus transmittance at the end of the ray
    depth: Float[Tensor, " Q"]  # sum of distance times weight: not divided by the opacity
    rgb_coarse: Float[Tensor, "Q 3"] | None = None  # of the first pass of hierarchical sampling
    opacity_coarse: Float[Tensor, " Q"] | None = None

    @classmethod
    def join(cls, pieces: Sequence[RaysSeen]) -> RaysSeen:
        """One record of the rays of several, in order."""
        columns = {name: [getattr(piece, name) for piece in pieces] for name in cls.names()}
        joined: dict[str, Any] = {
            name: None if column[0] is None else torch.cat(column) for name, column in columns.items()
        }
        return cls(**joined)


@dataclass(frozen=True)
class RadiancePrediction(TensorRecord):
    """What the rays of pixels saw, averaged over the rays of each pixel; see `RayBatch` for the letters."""

    rgb: Float[Tensor, "*pixels 3"]  # sRGB in [0, 1], over the batch's background
    opacity: Float[Tensor, "*pixels"]  # one minus transmittance at the end of the ray
    depth: Float[Tensor, "*pixels"]  # mean distance along the ray where it is stopped; 0 where nothing is
    rgb_coarse: Float[Tensor, "*pixels 3"] | None = None  # of the first pass of hierarchical sampling


@runtime_checkable
class RadianceScene(Protocol):
    """A fitted scene that can be asked about points: what meshes, normals and baked grids are made from."""

    @property
    def box(self) -> Float[Tensor, "2 3"]:
        """Lowest and highest corner of the region that holds the scene, in the world."""

    def opacity_at(self, points: Float[Tensor, "M 3"], step: float) -> Float[Tensor, " M"]:
        """The opacity in [0, 1] of matter of thickness `step` (world units) as dense as at the points."""

    def color_at(self, points: Float[Tensor, "M 3"], directions: Float[Tensor, "M 3"]) -> Float[Tensor, "M 3"]:
        """The light, sRGB in [0, 1], that leaves the points against rays of such unit directions."""


def scene_of(task: LightningModule) -> Scene:
    """The scene that a task is about to be fitted to.

    Raises:
        UserError: its data are no views of one scene.
    """
    data = task.trainer.datamodule  # type: ignore[attr-defined]
    if not isinstance(data, SceneViews):
        raise UserError(
            f"{type(task).__name__} is fitted to posed views of one scene, and {type(data).__name__} has none: take "
            "data=cow_views, nerf_blender, transforms, colmap or llff"
        )
    return data.scene


def in_pieces(render: Callable[[Rays], RaysSeen], rays: Rays, at_once: int) -> RaysSeen:
    """What rays see, so many rendered together: the same as all at once, in bounded memory."""
    starts = range(0, max(len(rays.nearest), 1), at_once)
    return RaysSeen.join([render(rays.slice(first, first + at_once)) for first in starts])


def mean_over_rays(seen: RaysSeen, batch: RayBatch) -> RadiancePrediction:
    """What the pixels of a batch show: the mean of their rays, laid over the background."""
    shape = batch.nearest.shape  # (*pixels, K)
    opacity = seen.opacity.reshape(shape).mean(-1)
    depth = seen.depth.reshape(shape).mean(-1) / opacity.clamp_min(1e-6)
    coarse = None
    if seen.rgb_coarse is not None and seen.opacity_coarse is not None:
        coarse = _over_background(seen.rgb_coarse, seen.opacity_coarse.reshape(shape).mean(-1), batch)
    return RadiancePrediction(_over_background(seen.rgb, opacity, batch), opacity, depth, coarse)


def _over_background(rgb: Tensor, opacity: Tensor, batch: RayBatch) -> Tensor:
    light = rgb.reshape(*batch.nearest.shape, 3).mean(-2)
    return light + (1 - opacity)[..., None] * batch.background


def view_panels(prediction: RadiancePrediction, batch: RayBatch) -> dict[str, Tensor]:
    """A whole view, its rendering, where they differ, depth and normals; nothing of a batch of single pixels."""
    if batch.rgb.ndim != 4:
        return {}
    error = (prediction.rgb - batch.rgb).abs().mean(-1)
    return {
        "target": batch.rgb,
        "rendering": prediction.rgb,
        "error x 4": (4 * error).clamp(max=1)[..., None],
        "depth": depth_image(prediction.depth, prediction.opacity),
        "normals": normal_image(view_normals(prediction, batch)),
    }


def view_normals(prediction: RadiancePrediction, batch: RayBatch) -> Tensor:
    """Normals (H, W, 3) of a whole view in its camera's axes, see `normals_from_depth`."""
    directions = functional.normalize(batch.directions[0].mean(-2), dim=-1)
    return normals_from_depth(directions, prediction.depth[0], prediction.opacity[0])
