"""A volume of density and colour fitted to posed images of one scene.

The book's chapter 5 fits every voxel by gradient descent through a volume renderer (Max, "Optical models for direct
volume rendering", 1995). Here voxels become finer on the way, and empty space is left out.
Shapes: as of `RayBatch`.  Units: distances in those of the scene, colour is sRGB in [0, 1].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from rendra_lab.base_task import Task
from rendra_lab.data.ray_views import RayBatch
from rendra_lab.networks.radiance import RadiancePrediction, Rays, mean_over_rays, scene_of, view_panels
from rendra_lab.tasks.volume.book import BookVolume
from rendra_lab.tasks.volume.grid import VolumeGrid


@dataclass(frozen=True, kw_only=True)
class VolumePrediction(RadiancePrediction):
    """What the rays of pixels saw, and how rough the volume is."""

    roughness: Float[Tensor, ""]  # mean squared difference of neighbouring voxels, where it is measured; else 0


class Volume(Task[RayBatch, VolumePrediction]):
    """Fit one volume to one scene.

    Args:
        volume: of voxels.
        refine_at: the steps at which its second, third, ... level begins.
        look_every: steps after which cells that have become empty are found.
        look_from: the first step at which they are: before, everything is thin.
        smooth_every: steps after which the volume's roughness is measured; it counts so many times as much then.
        **parts: losses, metrics, optimizer, scheduler of `Task`.
    """

    def __init__(
        self,
        volume: VolumeGrid | BookVolume,
        refine_at: Sequence[int] | int = (),
        look_every: int = 50,
        look_from: int = 100,
        smooth_every: int = 4,
        **parts: Any,
    ) -> None:
        super().__init__(**parts)
        refine_at = [refine_at] if isinstance(refine_at, int) else list(refine_at)
        if len(refine_at) != len(volume.voxels) - 1 or sorted(refine_at) != refine_at:
            levels = len(volume.voxels)
            raise ValueError(f"module.refine_at: {levels} levels begin at {levels - 1} rising steps, got {refine_at}")
        if min(look_every, smooth_every) < 1:
            raise ValueError(
                f"module.look_every and module.smooth_every must be at least 1, got {look_every} and {smooth_every}"
            )
        self.volume = volume
        self.refine_at = refine_at
        self.look_every = look_every
        self.look_from = look_from
        self.smooth_every = smooth_every

    def predict(self, batch: RayBatch) -> VolumePrediction:
        """What the rays of a batch see."""
        seen = mean_over_rays(self.volume(Rays.of(batch)), batch)
        return VolumePrediction(**vars(seen), roughness=self._roughness())

    def _roughness(self) -> Tensor:
        if self.training and self.global_step % self.smooth_every == 0:
            return self.smooth_every * self.volume.roughness()
        return self.volume.box.new_zeros(())

    def setup(self, stage: str) -> None:
        """Lightning's hook: lays the voxels into the scene, before a checkpoint may and processes agree on sizes."""
        if stage != "fit":
            return
        if not bool(self.volume.is_placed):
            self.volume.place(scene_of(self))

    def on_train_batch_start(self, batch: RayBatch, batch_idx: int) -> None:
        """Lightning's hook: goes on at a finer level when it is time, and looks for empty space."""
        step = self.global_step
        level = sum(begin <= step for begin in self.refine_at)
        if level > int(self.volume.level):
            self.volume.refine_to(level)
        if step >= self.look_from and step % self.look_every == 0:
            self.volume.look_for_space()
        super().on_train_batch_start(batch, batch_idx)

    def panels(self, prediction: VolumePrediction, batch: RayBatch) -> dict[str, Tensor]:
        """The view, its rendering, and where they differ."""
        return view_panels(prediction, batch)

    @property
    def box(self) -> Tensor:
        """See `RadianceScene`."""
        return self.volume.box

    def opacity_at(self, points: Tensor, step: float) -> Tensor:
        """See `RadianceScene`."""
        return self.volume.opacity(points, step)

    def color_at(self, points: Tensor, directions: Tensor) -> Tensor:
        """See `RadianceScene`: the same all round."""
        return self.volume.read(points)[1]
