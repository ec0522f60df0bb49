"""A sphere deformed to a point cloud.

The objective is a sum of terms on the surface: how far the cloud is from it, how far it is from the cloud, how smooth
it is. Steps that are diffused over the surface (`surface.SpherePyramid`) and refined on the way keep it free of folds
without paying for smoothness with accuracy; steps of single vertices are the book's.
Shapes: P points, S samples of the surface.  Units: the cloud's own, moved and scaled by `CloudBatch`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from rendra.ops import sample_points_from_meshes
from rendra.structures import Meshes
from rendra_lab.base_task import Task
from rendra_lab.records import TensorRecord
from rendra_lab.tasks.mesh_fit.data import CloudBatch
from rendra_lab.tasks.mesh_fit.surface import SpherePyramid
from rendra_lab.tasks.mesh_fit.views import CloudViews


@dataclass(frozen=True)
class SurfacePrediction(TensorRecord):
    """The surface as it stands, in the normalised frame."""

    mesh: Meshes  # a batch of one
    samples: Float[Tensor, "1 S 3"]  # uniform over the surface


class MeshFit(Task[CloudBatch, SurfacePrediction]):
    """Fit one closed surface to one cloud.

    Args:
        surface: what is deformed.
        samples: points S drawn from the surface at every step; None draws as many as the cloud has (the book).
        refine_at: the steps at which the surface's second, third, ... level begins.
        check_every: steps after which the surface is asked whether it crosses itself (`SpherePyramid.check`).
        views: draws cloud and surface.
        **parts: losses, metrics, optimizer, scheduler of `Task`.
    """

    def __init__(
        self,
        surface: SpherePyramid,
        samples: int | None = None,
        refine_at: Sequence[int] | int = (),
        check_every: int = 4,
        views: CloudViews | None = None,
        **parts: Any,
    ) -> None:
        super().__init__(**parts)
        refine_at = [refine_at] if isinstance(refine_at, int) else refine_at
        if len(refine_at) != len(surface.offsets) - 1 or sorted(refine_at) != list(refine_at):
            levels = len(surface.offsets)
            raise ValueError(f"module.refine_at: {levels} levels begin at {levels - 1} rising steps, got {refine_at}")
        if samples is not None and samples < 1:
            raise ValueError(f"module.samples must be at least 1, or null, got {samples}")
        self.surface = surface
        self.samples = samples
        if check_every < 1:
            raise ValueError(f"module.check_every must be at least 1, got {check_every}")
        self.refine_at = list(refine_at)
        self.check_every = check_every
        self.views = views or CloudViews()

    def predict(self, batch: CloudBatch) -> SurfacePrediction:
        """The surface, and points on it."""
        mesh = self.surface()
        return SurfacePrediction(mesh, sample_points_from_meshes(mesh, self.samples or batch.points.shape[1]))

    def on_fit_start(self) -> None:
        """Lightning's hook: puts the sphere round the cloud, unless a checkpoint did."""
        if not bool(self.surface.is_placed):
            self.surface.place(self.trainer.datamodule.cloud.points[0].to(self.device))  # type: ignore[attr-defined]

    def on_train_batch_start(self, batch: CloudBatch, batch_idx: int) -> None:
        """Lightning's hook: now and then takes back what made the surface cross itself; refines it in time."""
        step = self.global_step
        level = sum(begin <= step for begin in self.refine_at)
        is_coarse = level > int(self.surface.level)
        if is_coarse or (step > 0 and step % self.check_every == 0):
            self.surface.check()
        if is_coarse:
            self.surface.refine_to(level)
        super().on_train_batch_start(batch, batch_idx)

    def finish(self) -> None:
        """Takes back what made the surface cross itself since the last check."""
        self.surface.check()

    def panels(self, prediction: SurfacePrediction, batch: CloudBatch) -> dict[str, Tensor]:
        """The cloud and the surface, from the front and from the side."""
        return self.views(batch.points[0], prediction.mesh)

    def meshes(self, prediction: SurfacePrediction, batch: CloudBatch) -> dict[str, Meshes]:
        """The surface, where the cloud was and as large."""
        return {"surface": batch.restored(prediction.mesh)}
