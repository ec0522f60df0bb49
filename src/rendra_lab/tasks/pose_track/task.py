"""The camera through a sequence of frames of a known mesh: each fit starts from the last frame's pose.

Shapes: B cameras (one at a time), N frames, H W image.  Poses: x_view = x_world @ R + T.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import torch
from torch import Tensor

from rendra_lab.base_task import Task
from rendra_lab.camera_starts import GivenStart, MultiStart
from rendra_lab.data.views import ViewBatch
from rendra_lab.networks.camera_pose import CameraPose, PosePrediction
from rendra_lab.networks.mesh_view import MeshView
from rendra_lab.settings import Positive
from rendra_lab.visualization import silhouette_overlay


class PoseTrack(Task[ViewBatch, PosePrediction]):
    """Follow one camera.

    Args:
        scene: the known mesh, intrinsics and lights; shared with the data.
        pose: the camera to learn.
        start: says where to begin in the first frame.
        frames: number of frames N.
        **parts: losses, metrics, optimizer, scheduler of `Task`.
    """

    track_R: Tensor  # (N, 3, 3), NaN where no frame was fitted yet, as in track_T (N, 3)
    track_T: Tensor
    frame: Tensor

    def __init__(
        self, scene: MeshView, pose: CameraPose, start: GivenStart | MultiStart, frames: Positive, **parts: Any
    ) -> None:
        super().__init__(**parts)
        self.scene = scene
        self.pose = pose
        self.start = start
        self.register_buffer("track_R", torch.full((frames, 3, 3), torch.nan))
        self.register_buffer("track_T", torch.full((frames, 3), torch.nan))
        self.register_buffer("frame", torch.tensor(0))

    def predict(self, batch: ViewBatch) -> PosePrediction:
        """A finished frame from its pose; the frame in work, and those to come, from the camera as it stands."""
        frame = int(batch.frame)
        is_finished = frame != int(self.frame) and bool(self.track_T[frame].isfinite().all())
        R, T = (self.track_R[frame, None], self.track_T[frame, None]) if is_finished else self.pose()
        silhouette, rgb = self.scene(R, T)
        return PosePrediction(rgb, silhouette, R, T)

    def on_fit_start(self) -> None:
        """Lightning's hook: places the camera in the first frame, unless a checkpoint did."""
        if not bool(self.pose.is_placed):
            target = self.trainer.datamodule.target.to(self.device)  # type: ignore[attr-defined]
            self.pose.place(*self.start(self.scene, self.pose, target, self.residuals_of))

    def on_train_batch_start(self, batch: ViewBatch, batch_idx: int) -> None:
        """Lightning's hook: a new frame starts from the pose of the last."""
        if int(batch.frame) != int(self.frame):
            self.finish()
            self.pose.place(*(x.detach() for x in self.pose()))
            self.frame.fill_(int(batch.frame))
            for optimizer in self.trainer.optimizers:
                # Adam's moments were the last frame's; Levenberg-Marquardt's settled widths stay, in its groups
                optimizer.state = defaultdict(dict)
        super().on_train_batch_start(batch, batch_idx)

    def finish(self) -> None:
        """Notes the pose of the frame in work."""
        R, T = self.pose()
        self.track_R[int(self.frame)] = R[0].detach()
        self.track_T[int(self.frame)] = T[0].detach()

    def panels(self, prediction: PosePrediction, batch: ViewBatch) -> dict[str, Tensor]:
        """Target, fit, and where the two outlines differ."""
        return {
            "target": batch.rgb[0],
            "fit": prediction.rgb[0],
            "difference": silhouette_overlay(prediction.silhouette[0], batch.silhouette[0]),
        }
