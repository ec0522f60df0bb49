"""SMPLify: pose, shape and place of a body from the joints of one picture.

Bogo et al., "Keep it SMPL: Automatic Estimation of 3D Human Pose and Shape from a Single Image", ECCV 2016.
All people of a batch are fitted side by side; one step of the solver is one step of training.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import torch
from torch import Tensor, nn

from rendra.body import SMPL
from rendra_lab.base_task import Task
from rendra_lab.errors import UserError
from rendra_lab.networks.sizes import take_sizes
from rendra_lab.tasks.smplify.camera_start import CameraStart
from rendra_lab.tasks.smplify.markers import Marker, MarkerSet
from rendra_lab.tasks.smplify.records import LSP_JOINTS, FitPrediction, PeopleBatch

_BODY_JOINTS = (
    "right_ankle", "right_knee", "right_hip", "left_hip", "left_knee", "left_ankle", "right_wrist", "right_elbow",
    "right_shoulder", "left_shoulder", "left_elbow", "left_wrist", "neck",
)  # fmt: skip
"""Of the body, for each of LSP's but the last, which is the top of the head."""


def picture_markers(body: SMPL) -> list[Marker]:
    """LSP's joints, as points of a body."""
    joints = [Marker.joint(body, body.joint_index(name)) for name in _BODY_JOINTS]
    return [*joints, Marker.vertex(body, body.head_top)]


class BodyProblem:
    """The objective of all fits at their present weights, for solvers of least squares; see `solvers.Problem`."""

    def __init__(self, task: SMPLify, batch: PeopleBatch, step: int) -> None:
        self.task, self.batch, self.step = task, batch, step

    def rows(self, x: Tensor) -> Tensor:
        """Residuals (N, R) of fits (N, P)."""
        return self._rows(self.task.markers(x).points, x)

    def linearized(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals (N, R), and their derivatives (N, R, P): the points' are known, the terms' follow forward."""
        motion = self.task.markers(x, derivatives=True)
        assert motion.jacobian is not None
        eye = torch.eye(x.shape[1], dtype=x.dtype, device=x.device)
        along_x = eye[:, None].expand(-1, len(x), -1)

        def derivative(point: Tensor, number: Tensor) -> Tensor:
            return torch.func.jvp(self._rows, (motion.points, x), (point, number))[1]

        rows = torch.func.vmap(derivative)(motion.jacobian.movedim(-1, 0), along_x)
        return self._rows(motion.points, x), rows.permute(1, 2, 0)

    def _rows(self, points: Tensor, x: Tensor) -> Tensor:
        return self.task.rows_of(self.task.prediction_of(points, x, self.batch), self.batch, self.step)


class SMPLify(Task[PeopleBatch, FitPrediction]):
    """Fit a body to every person of a batch.

    Args:
        body: the model.
        start: places the bodies.
        flip: also begin from behind where the start leaves it open; the better fit counts.
        **parts: losses, metrics, optimizer, scheduler of `Task`.
    """

    person: Tensor  # (N,) whose fit each row is
    is_flipped: Tensor  # (N,)

    def __init__(self, body: SMPL, start: CameraStart, flip: bool = True, **parts: Any) -> None:
        super().__init__(**parts)
        if body.num_joints < 24:
            raise UserError(f"body: SMPLify needs SMPL's 24 joints, and this body has {body.num_joints}")
        self.body = body
        self.start = start
        self.flip = flip
        self.markers = MarkerSet(body, picture_markers(body))
        self.x = nn.Parameter(torch.zeros(1, 3 * body.num_joints + body.num_betas + 3))
        self.register_buffer("person", torch.zeros(1, dtype=torch.int64))
        self.register_buffer("is_flipped", torch.zeros(1, dtype=torch.bool))
        self._batches: tuple[PeopleBatch, PeopleBatch] | None = None

    def setup(self, stage: str) -> None:
        """Lightning's hook: a body for everyone, or two where it is open which way they look."""
        if stage == "fit":
            self.place(self.trainer.datamodule.people)  # type: ignore[attr-defined]

    @torch.no_grad()
    def place(self, batch: PeopleBatch) -> None:
        """Begin: the mean body at rest, as the torso says."""
        rest = self.markers(torch.zeros_like(self.x[:1])).points[0]
        heading, place, is_open = self.start(batch, rest)
        again = is_open.nonzero()[:, 0] if self.flip else torch.zeros(0, dtype=torch.int64)
        self.person = torch.cat([torch.arange(len(heading)), again])
        self.is_flipped = torch.arange(len(self.person)) >= len(heading)
        x = torch.zeros(len(self.person), self.x.shape[1])
        x[:, :3] = torch.cat([heading, self.start.flipped(heading[again])])
        x[:, -3:] = place[self.person]
        self.x = nn.Parameter(x)

    def predict(self, batch: PeopleBatch) -> FitPrediction:
        """All fits while they are made; then each person's best one, with its surface."""
        points = self.markers(self.x).points
        people = self.fits(batch)
        prediction = self.prediction_of(points, self.x, people)
        return prediction if self.training else self._best(prediction, batch, people)

    def problem(self, batch: PeopleBatch) -> BodyProblem:
        """What a solver is given before every step."""
        return BodyProblem(self, self.fits(batch), self.global_step)

    def fits(self, batch: PeopleBatch) -> PeopleBatch:
        """The people of a batch, one for each fit."""
        if self._batches is None or self._batches[0] is not batch:
            self._batches = batch, batch.select(self.person)
        return self._batches[1]

    def rows_of(self, prediction: FitPrediction, people: PeopleBatch, step: int) -> Tensor:
        """Residuals (N, R) of all terms."""
        return torch.cat([term.residual_rows(prediction, people, step) for _, term in self._weighted()], dim=1)

    def prediction_of(self, points: Tensor, x: Tensor, people: PeopleBatch) -> FitPrediction:
        """What the terms read of fits (N, P) with markers (N, M, 3)."""
        joints, spheres = points[:, : len(LSP_JOINTS)], points[:, len(LSP_JOINTS) :]
        numbers = 3 * self.body.num_joints
        return FitPrediction(
            pose=x[:, :numbers],
            betas=x[:, numbers:-3],
            translation=x[:, -3:],
            joints_px=project(joints, people.focal_px, people.center_px),
            spheres=spheres,
            person=self.person,
            is_flipped=self.is_flipped,
        )

    def on_train_batch_start(self, batch: PeopleBatch, batch_idx: int) -> None:
        """Lightning's hook: hands the problem to the solver."""
        super().on_train_batch_start(batch, batch_idx)
        for optimizer in self.trainer.optimizers:
            if getattr(optimizer, "needs_problem", False):
                optimizer.problem = self.problem(batch)  # type: ignore[attr-defined]

    def _best(self, prediction: FitPrediction, batch: PeopleBatch, people: PeopleBatch) -> FitPrediction:
        """Each person's fit whose joints lie better, with its joints and surface."""
        chosen = self.chosen(prediction, people, len(batch.joints_px))
        best = prediction._map(lambda value: value.index_select(0, chosen), lambda value: isinstance(value, Tensor))
        body = self.body(best.betas, best.pose, best.translation)
        return replace(best, joints=body.joints, verts=body.verts)

    def chosen(self, prediction: FitPrediction, people: PeopleBatch, count: int) -> Tensor:
        """The fit (B,) of each person whose terms of the picture alone are smaller."""
        terms = [term for _, term in self._weighted() if term.prediction == "joints_px"]
        rows = [term.residual_rows(prediction, people, self.global_step) for term in terms]
        data = torch.cat(rows, dim=1).square().sum(1) if rows else prediction.joints_px.new_zeros(len(self.person))
        best = data.new_full((count,), torch.inf).scatter_reduce(0, self.person, data, "amin")
        is_best = data <= best[self.person]
        order = torch.arange(len(data), device=data.device)
        first = torch.where(is_best, order, len(data))
        return first.new_full((count,), len(data)).scatter_reduce(0, self.person, first, "amin")

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Torch's hook: takes on the number of fits that a checkpoint has."""
        named = [("x", self.x), ("person", self.person), ("is_flipped", self.is_flipped)]
        take_sizes(cast(Any, named), state_dict, prefix)
        super()._load_from_state_dict(state_dict, prefix, *args)


def project(points: Tensor, focal_px: Tensor, center_px: Tensor) -> Tensor:
    """Points (N, M, 3) in the camera's axes to pixels (N, M, 2); those beside the camera's plane stay finite."""
    depth = points[..., 2:].clamp_min(1e-3)
    return focal_px[:, None, None] * points[..., :2] / depth + center_px[:, None]
