"""Sequences of views: what one camera saw as it moved."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor

from rendra.renderer.cameras import look_at_view_transform
from rendra_lab.data.repeated import StepByStep
from rendra_lab.data.views import ViewBatch, check_visible, render_views
from rendra_lab.networks.mesh_view import MeshView
from rendra_lab.settings import Positive


class FrameByFrame(StepByStep[ViewBatch]):
    """Yields frame after frame, each several times; one pass is one epoch.

    Args:
        frames: the frames, a batch of one each.
        times: how often each is yielded.
    """

    def __init__(self, frames: Sequence[ViewBatch], times: int = 1) -> None:
        self.frames = frames
        self.times = times

    def __len__(self) -> int:
        return len(self.frames) * self.times

    def batch_of(self, step: int) -> ViewBatch:
        """The frame of a step."""
        return self.frames[step // self.times % len(self.frames)]


class RenderedSequence(LightningDataModule):
    """Views from a camera that looks at the origin and moves evenly from a first to a last position.

    Args:
        scene: the mesh to render.
        frames: number of views.
        steps_per_frame: optimisation steps spent on each.
        distance: first and last distance from the origin, in world units.
        elevation_deg: first and last angle above the horizontal plane.
        azimuth_deg: first and last angle around +Y, from +Z.
    """

    def __init__(
        self,
        scene: MeshView,
        frames: Positive = 24,
        steps_per_frame: Positive = 6,
        distance: tuple[float, float] = (3.0, 2.5),
        elevation_deg: tuple[float, float] = (30.0, 50.0),
        azimuth_deg: tuple[float, float] = (10.0, 150.0),
    ) -> None:
        super().__init__()
        if frames < 1 or steps_per_frame < 1:
            raise ValueError(f"a sequence needs frames and steps, got {frames} and {steps_per_frame}")
        self.scene = scene
        self.steps_per_frame = steps_per_frame
        distances, elevations, azimuths = (_even(frames, *ends) for ends in (distance, elevation_deg, azimuth_deg))
        self.R, self.T = look_at_view_transform(distances, elevations, azimuths)

    def setup(self, stage: str) -> None:
        """Lightning's hook, before the fit and again before the test: renders the views, once.

        UserError where one shows nothing.
        """
        if hasattr(self, "views"):
            return
        views = render_views(self.scene, self.R, self.T)
        check_visible(views.silhouette, self.scene, "a frame of the sequence (data.distance)")
        self.views = [views.select(i) for i in range(len(self.R))]
        self.target = self.views[0]

    def train_dataloader(self) -> FrameByFrame:
        """Every frame, `steps_per_frame` times."""
        return FrameByFrame(self.views, self.steps_per_frame)

    def test_dataloader(self) -> FrameByFrame:
        """Every frame once."""
        return FrameByFrame(self.views)


def _even(count: int, first: float, last: float) -> Tensor:
    return torch.linspace(float(first), float(last), count)
