"""NeRF: a radiance field fitted to posed images of one scene.

Mildenhall et al., "NeRF", ECCV 2020, arXiv:2003.08934. Which field, and where along a ray it is asked, are parts that
the task is handed; a pixel's colour is the mean over its rays.
Shapes: as of `RayBatch`.  Units: distances in those of the scene, colour is sRGB in [0, 1].
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from rendra_lab.base_task import Task
from rendra_lab.data.ray_views import RayBatch
from rendra_lab.errors import UserError
from rendra_lab.networks.radiance import RadiancePrediction, Rays, mean_over_rays, scene_of, view_panels
from rendra_lab.tasks.nerf.renderers import RayRenderer
from rendra_lab.tasks.nerf.samplers import HierarchicalRenderer


class NeRF(Task[RayBatch, RadiancePrediction]):
    """Fit one field to one scene.

    Args:
        renderer: asks a field about rays.
        **parts: losses, metrics, optimizer, scheduler of `Task`.

    Raises:
        UserError: a coarse field that no loss looks at.
    """

    def __init__(self, renderer: RayRenderer, **parts: Any) -> None:
        super().__init__(**parts)
        self.renderer = renderer
        read = {term.prediction for _, term in self._weighted()}
        if isinstance(renderer, HierarchicalRenderer) and "rgb_coarse" not in read:
            raise UserError(
                "sampler=hierarchical has a coarse field, which no loss trains: say loss=[rgb,rgb_coarse,opacity]"
            )

    def predict(self, batch: RayBatch) -> RadiancePrediction:
        """What the rays of a batch see."""
        return mean_over_rays(self.renderer(Rays.of(batch)), batch)

    def setup(self, stage: str) -> None:
        """Lightning's hook: says where the scene lies, before a checkpoint may and processes agree on sizes."""
        if stage != "fit":
            return
        self.renderer.place(scene_of(self))

    def on_train_batch_start(self, batch: RayBatch, batch_idx: int) -> None:
        """Lightning's hook: lets the renderer learn where there is nothing."""
        self.renderer.refresh(self.global_step)
        super().on_train_batch_start(batch, batch_idx)

    def panels(self, prediction: RadiancePrediction, batch: RayBatch) -> dict[str, Tensor]:
        """The view, its rendering, and where they differ."""
        return view_panels(prediction, batch)

    @property
    def box(self) -> Tensor:
        """See `RadianceScene`."""
        return self.renderer.field.box

    def opacity_at(self, points: Tensor, step: float) -> Tensor:
        """See `RadianceScene`."""
        found = self.renderer.field.opacity(points, points.new_full((len(points),), step))
        return found * self.renderer.looks_at(points)

    def color_at(self, points: Tensor, directions: Tensor) -> Tensor:
        """See `RadianceScene`."""
        return self.renderer.field(points, directions, points.new_ones(len(points)))[1]
