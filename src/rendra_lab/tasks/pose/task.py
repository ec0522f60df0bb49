"""The camera of one picture of a known mesh, by differentiable rendering.

The pose is changed until the mesh, rendered from it, looks like the picture: in its silhouette (Liu et al., "Soft
Rasterizer", ICCV 2019) and, where asked, in its colours.
Shapes: B cameras (one here), H W image.  Poses: x_view = x_world @ R + T.  Colour is sRGB in [0, 1].
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rendra_lab.base_task import Task
from rendra_lab.camera_starts import GivenStart, MultiStart
from rendra_lab.data.views import ViewBatch
from rendra_lab.networks.camera_pose import CameraPose, PosePrediction
from rendra_lab.networks.mesh_view import MeshView
from rendra_lab.visualization import silhouette_overlay


class Pose(Task[ViewBatch, PosePrediction]):
    """Fit one camera to one view.

    Args:
        scene: the known mesh, intrinsics and lights; shared with the data.
        pose: the camera to learn.
        start: says where to begin.
        **parts: losses, metrics, optimizer, scheduler of `Task`.
    """

    start_R: Tensor
    start_T: Tensor

    def __init__(self, scene: MeshView, pose: CameraPose, start: GivenStart | MultiStart, **parts: Any) -> None:
        super().__init__(**parts)
        self.scene = scene
        self.pose = pose
        self.start = start
        self.register_buffer("start_R", torch.eye(3)[None])
        self.register_buffer("start_T", torch.zeros(1, 3))

    def predict(self, batch: ViewBatch) -> PosePrediction:
        """The view from the camera as it stands."""
        R, T = self.pose()
        silhouette, rgb = self.scene(R, T)
        return PosePrediction(rgb, silhouette, R, T)

    def on_fit_start(self) -> None:
        """Lightning's hook: places the camera, unless a checkpoint did."""
        if bool(self.pose.is_placed):
            return
        target = self.trainer.datamodule.target.to(self.device)  # type: ignore[attr-defined]
        R, T = self.start(self.scene, self.pose, target, self.residuals_of)
        self.pose.place(R, T)
        self.start_R.copy_(R)
        self.start_T.copy_(T)

    def panels(self, prediction: PosePrediction, batch: ViewBatch) -> dict[str, Tensor]:
        """Target, start, the fit now, and where the two outlines differ."""
        _, start = self.scene(self.start_R, self.start_T)
        return {
            "target": batch.rgb[0],
            "start": start[0],
            "fit": prediction.rgb[0],
            "difference": silhouette_overlay(prediction.silhouette[0], batch.silhouette[0]),
        }

    def facts(self, prediction: PosePrediction, batch: ViewBatch) -> dict[str, Any]:
        """The camera, for other programs: `camera.json`."""
        return {"camera": self.scene.describe_camera(prediction.R[0], prediction.T[0])}
