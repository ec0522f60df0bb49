"""What renderers of radiance fields give, and what exporters ask of a task that fits one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from rendra_lab.records import TensorRecord


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
