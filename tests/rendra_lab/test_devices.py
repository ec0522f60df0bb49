"""Scenes, poses, searches, tasks and their scores stay on the device of the batch."""

from functools import partial

import pytest
import torch
from far_device import Far, far  # noqa: F401
from torch import nn

from rendra_lab import losses, metrics, visualization
from rendra_lab.camera_starts import GivenStart, MultiStart
from rendra_lab.data.meshes import load_mesh
from rendra_lab.data.view_sequences import RenderedSequence
from rendra_lab.networks.camera_pose import LookAtPose, SixDofPose
from rendra_lab.networks.mesh_view import MeshView
from rendra_lab.optimizers import LevenbergMarquardt
from rendra_lab.tasks.pose.task import Pose
from rendra_lab.tasks.pose_track.task import PoseTrack
from rendra_lab.terms import LossTerm, MetricTerm


def parts():
    squares = losses.SummedSquaredError(8)
    return {
        "losses": {"texture": LossTerm(squares), "silhouette": LossTerm(squares, 1.0, "silhouette", "silhouette")},
        "metrics": {
            "rotation_deg": MetricTerm(metrics.rotation_error_deg, "R", "R"),
            "position_percent": MetricTerm(metrics.position_error_percent, "position", "position"),
            "iou": MetricTerm(metrics.iou, "silhouette", "silhouette"),
            "psnr": MetricTerm(metrics.psnr),
            "ssim": MetricTerm(metrics.ssim),
        },
        "optimizer": partial(torch.optim.SGD, lr=0.1),
    }


def moved(task, device):
    for module in task.modules():
        for name, buffer in module._buffers.items():
            module._buffers[name] = buffer.to(device)
        for name, parameter in module._parameters.items():
            module._parameters[name] = nn.Parameter(parameter.detach().to(device))
    return task


@pytest.mark.parametrize("pose", [LookAtPose, SixDofPose])
@pytest.mark.parametrize("start", [GivenStart((0.5, 1.5, 2.6)), MultiStart(2, 2, ((16, 8, 1, 1),))])
@pytest.mark.parametrize("task", [Pose, partial(PoseTrack, frames=2)])
def test_a_fit_stays_where_its_batch_lies(far, task, start, pose) -> None:  # noqa: F811
    scene = MeshView(load_mesh("ico_sphere", level=0), image_size=16)
    data = RenderedSequence(scene, frames=2)  # on the CPU, by the scene that the task takes along afterwards
    data.setup("fit")
    batch = data.target.to(far, non_blocking=True)
    toy = moved(task(scene, pose(), start, **parts()), far)
    toy.pose.place(*start(scene, toy.pose, batch, toy.residuals_of))
    optimizer = LevenbergMarquardt(list(toy.pose.parameters()))
    optimizer.residuals = lambda: toy.residuals(batch)
    optimizer.step()
    prediction = toy.predict(batch)
    toy.objective(prediction, batch)[0].backward()
    assert isinstance(toy.pose.delta.grad, Far)
    assert all(isinstance(value, Far) for value in toy.score(prediction, batch).values())
    with torch.no_grad():
        for image in toy.panels(prediction.detach(), batch).values():
            assert visualization.to_picture(image).shape == (16, 16, 3)
    assert all(isinstance(fact["rendra"]["T"], list) for fact in toy.facts(prediction.detach(), batch).values())
