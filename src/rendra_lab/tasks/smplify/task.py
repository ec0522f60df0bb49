"""SMPLify: pose, shape and place of a body from the joints of one picture.

Bogo et al., "Keep it SMPL: Automatic Estimation of 3D Human Pose and Shape from a Single Image", ECCV 2016.
All people of a batch are fitted side by side; one step of the solver is one step of training.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import torch
from torch import Tensor, nn

from rendra.body import SMPL, SMPL_JOINTS
from rendra_lab.base_task import Task
from rendra_lab.errors import UserError
from rendra_lab.networks.sizes import take_sizes
from rendra_lab.settings import Count
from rendra_lab.tasks.smplify.body_spheres import BodySpheres
from rendra_lab.tasks.smplify.camera_start import CameraStart
from rendra_lab.tasks.smplify.markers import Marker, MarkerSet, Motion
from rendra_lab.tasks.smplify.portraits import Portraits, sheet_of
from rendra_lab.tasks.smplify.pose_prior import PosePrior
from rendra_lab.tasks.smplify.records import LSP_JOINTS, FitPrediction, PeopleBatch
from rendra_lab.terms import LossTerm

_BODY_JOINTS = (
    "right_ankle", "right_knee", "right_hip", "left_hip", "left_knee", "left_ankle", "right_wrist", "right_elbow",
    "right_shoulder", "left_shoulder", "left_elbow", "left_wrist", "neck",
)  # fmt: skip
"""Of the body, for each of LSP's but the last, which is the top of the head."""
_NEAREST = 1e-3  # metres before the camera
_LAST_STEP = 2**62  # fits are compared by the weights of the end


def picture_markers(body: SMPL) -> list[Marker]:
    """LSP's joints, as points of a body."""
    joints = [Marker.joint(body, body.joint_index(name)) for name in _BODY_JOINTS]
    return [*joints, Marker.vertex(body, body.head_top)]


class BodyProblem:
    """The objective of all fits at their present weights, for solvers of least squares; see `solvers.Problem`."""

    def __init__(self, task: SMPLify, people: PeopleBatch, step: int) -> None:
        self.task, self.people, self.step = task, people, step
        self.rows_at_work = task.rows_at_work

    def rows(self, x: Tensor) -> Tensor:
        """Residuals (N, R) of fits (N, P)."""
        prediction = self.task.prediction_of(self.task.markers(x).points, x, self.people)
        return torch.cat(
            [term.residual_rows(prediction, self.people, self.step) for term in self.task.terms()], dim=1
        )

    def linearized(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals (N, R), and their derivatives (N, R, P)."""
        motion = self.task.markers(x, derivatives=True)
        prediction = self.task.prediction_of(motion.points, x, self.people)
        changes = self._changes(motion, x)
        rows, derivatives = [], []
        for term in self.task.terms():
            rows.append(term.residual_rows(prediction, self.people, self.step))
            derivatives.append(
                term.row_derivatives(prediction, self.people, changes[str(term.prediction)], self.step)
            )
        return torch.cat(rows, dim=1), torch.cat(derivatives, dim=1)

    def _changes(self, motion: Motion, x: Tensor) -> dict[str, Tensor]:
        """How each field (N, ...) of the prediction changes with each number of a fit: (N, ..., P)."""
        assert motion.jacobian is not None
        numbers = 3 * self.task.body.num_joints
        eye = torch.eye(x.shape[1], dtype=x.dtype, device=x.device).expand(len(x), -1, -1)
        joints, spheres = motion.jacobian[:, : len(LSP_JOINTS)], motion.jacobian[:, len(LSP_JOINTS) :]
        carried = torch.zeros_like(spheres)
        carried[..., :numbers] = spheres[..., :numbers]  # a body must not grow thin where it touches itself
        return {
            "pose": eye[:, :numbers],
            "betas": eye[:, numbers:-3],
            "translation": eye[:, -3:],
            "joints_px": project_changes(motion.points[:, : len(LSP_JOINTS)], joints, self.people.focal_px),
            "spheres": carried,
        }


class SMPLify(Task[PeopleBatch, FitPrediction]):
    """Fit a body to every person of a batch.

    Args:
        body: the model.
        start: places the bodies.
        poses: what they begin as: everyone as the mean of each component, side by side; None: all in the T-pose.
        flip: also begin from behind where the start leaves it open.
        choose: which of a person's fits counts: that of the least `objective`, or whose joints lie best in the
            `picture`, as Bogo et al. choose between the two sides.
        narrow: pairs [step, count]: from that step on, so many fits of each person are gone on with, the best by the
            weights of the end.
        shown: people in the panels, from the first on.
        **parts: losses, metrics, optimizer, scheduler of `Task`.

    Raises:
        UserError: a body without SMPL's joints, a prior of another skeleton, or another word for `choose`.
    """

    person: Tensor  # (N,) whose fit each row is
    is_flipped: Tensor  # (N,)
    is_at_work: Tensor  # (N,) False for a fit that was given up for a better one of the same person

    def __init__(
        self,
        body: SMPL,
        start: CameraStart,
        poses: PosePrior | None = None,
        flip: bool = True,
        choose: str = "objective",
        narrow: Sequence[Sequence[int]] = (),
        shown: Count = 4,
        **parts: Any,
    ) -> None:
        super().__init__(**parts)
        if body.joint_names[: len(SMPL_JOINTS)] != SMPL_JOINTS:
            raise UserError(f"body: SMPLify needs SMPL's 24 joints, and this body has {body.num_joints} others")
        if choose not in ("objective", "picture"):
            raise UserError(f"module.choose must be objective or picture, got {choose!r}")
        if poses is not None and poses.num_numbers != 3 * (body.num_joints - 1):
            raise UserError(
                f"prior: of {poses.num_numbers // 3} joints, and this body has {body.num_joints - 1} besides its root"
            )
        self.body = body
        self.start = start
        self.poses = poses
        self.flip = flip
        self.choose = choose
        self.narrow = {int(step): int(count) for step, count in narrow}
        if any(count < 1 for count in self.narrow.values()):
            raise UserError(f"module.narrow keeps at least one fit of everyone, got {dict(self.narrow)}")
        self.shown = shown
        self.portraits = Portraits(body.faces, size=160)
        self.spheres = BodySpheres(body)
        markers = [*picture_markers(body), *self.spheres.markers]
        self.markers = MarkerSet(body, markers).double()  # objectives that differ in their ninth digit only
        self.x = nn.Parameter(torch.zeros(1, 3 * body.num_joints + body.num_betas + 3, dtype=torch.float64))
        self.register_buffer("person", torch.zeros(1, dtype=torch.int64))
        self.register_buffer("is_flipped", torch.zeros(1, dtype=torch.bool))
        self.register_buffer("is_at_work", torch.ones(1, dtype=torch.bool))
        self._batches: tuple[PeopleBatch, PeopleBatch] | None = None

    def setup(self, stage: str) -> None:
        """Lightning's hook: a body for everyone, and more where it is open how they stand."""
        if stage == "fit":
            self.place(self.trainer.datamodule.people)  # type: ignore[attr-defined]

    @torch.no_grad()
    def place(self, batch: PeopleBatch) -> None:
        """Begin: bodies of the mean shape, where and how the torso says, in every pose to begin with."""
        rest = self.markers(torch.zeros_like(self.x[:1])).points[0, : len(LSP_JOINTS)].float()
        heading, place, is_open = self.start(batch, rest)
        again = is_open.nonzero()[:, 0] if self.flip else torch.zeros(0, dtype=torch.int64)
        person = torch.cat([torch.arange(len(heading), device=heading.device), again])
        heading = torch.cat([heading, self.start.flipped(heading[again])])
        means = rest.new_zeros(1, 3 * self.body.num_joints - 3) if self.poses is None else self.poses.means
        self.person = person.repeat(len(means))
        self.is_flipped = (torch.arange(len(person), device=heading.device) >= len(place)).repeat(len(means))
        self.is_at_work = torch.ones_like(self.is_flipped)
        x = self.x.new_zeros(len(self.person), self.x.shape[1])
        x[:, :3] = heading.repeat(len(means), 1)
        x[:, 3 : 3 * self.body.num_joints] = means.repeat_interleave(len(person), 0)
        x[:, -3:] = place[self.person]
        self.x = nn.Parameter(x)

    def predict(self, batch: PeopleBatch) -> FitPrediction:
        """All fits while they are made; then each person's best one, with its surface."""
        x = self.x.index_select(0, self.rows_at_work)
        people = self.fits(batch)
        prediction = self.prediction_of(self.markers(x).points, x, people)
        return prediction if self.training else self._best(prediction, batch, people)

    def panels(self, prediction: FitPrediction, batch: PeopleBatch) -> dict[str, Tensor]:
        """The first people: their joints, and their bodies from three sides."""
        rows = [
            self.portraits.draw(prediction, batch, person) for person in range(min(self.shown, len(prediction.pose)))
        ]
        return sheet_of(rows) if rows else {}

    def objective(self, prediction: FitPrediction, batch: PeopleBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """See `Task`: the sum over all fits."""
        return super().objective(prediction, self.fits(batch))

    def problem(self, batch: PeopleBatch, step: int) -> BodyProblem:
        """What a solver is given before every step."""
        return BodyProblem(self, self.fits(batch), step)

    @property
    def rows_at_work(self) -> Tensor:
        """The fits (n,) that are gone on with; all others have been given up."""
        return self.is_at_work.nonzero()[:, 0]

    def fits(self, batch: PeopleBatch) -> PeopleBatch:
        """The people of a batch, one for each fit at work."""
        person = self.person[self.rows_at_work]
        if self._batches is None or self._batches[0] is not batch or len(self._batches[1].joints_px) != len(person):
            people = replace(batch, truth=None).select(person)  # no term knows the truth
            self._batches = batch, _as_floats(people, torch.float64)
        return self._batches[1]

    @torch.no_grad()
    def give_up(self, batch: PeopleBatch, count: int) -> None:
        """Go on with the best `count` fits of each person."""
        rows, people = self.rows_at_work, self.fits(batch)
        x = self.x.index_select(0, rows)
        cost = self._costs(self.prediction_of(self.markers(x).points, x, people), people)
        order = torch.argsort(cost, stable=True)
        order = order[torch.argsort(self.person[rows][order], stable=True)]  # by person, then by cost
        person = self.person[rows][order]
        rank = torch.arange(len(person), device=person.device) - torch.searchsorted(person, person)
        self.is_at_work[rows[order[rank >= count]]] = False

    def terms(self) -> list[LossTerm]:
        """Those of the objective."""
        return [term for _, term in self._weighted()]

    def prediction_of(self, points: Tensor, x: Tensor, people: PeopleBatch) -> FitPrediction:
        """What the terms read of fits (N, P) with markers (N, M, 3)."""
        joints, middles = points[:, : len(LSP_JOINTS)], points[:, len(LSP_JOINTS) :]
        numbers = 3 * self.body.num_joints
        betas = x[:, numbers:-3]
        return FitPrediction(
            pose=x[:, :numbers],
            betas=betas,
            translation=x[:, -3:],
            joints_px=project(joints, people.focal_px, people.center_px),
            spheres=self.spheres.balls(middles, betas),
            person=self.person[self.rows_at_work],
            is_flipped=self.is_flipped[self.rows_at_work],
        )

    def on_train_batch_start(self, batch: PeopleBatch, batch_idx: int) -> None:
        """Lightning's hook: hands the problem to the solver."""
        super().on_train_batch_start(batch, batch_idx)
        if self.global_step in self.narrow:
            self.give_up(batch, self.narrow[self.global_step])
        for optimizer in self.trainer.optimizers:
            if getattr(optimizer, "needs_problem", False):
                optimizer.problem = self.problem(batch, self.global_step)  # type: ignore[attr-defined]

    def _best(self, prediction: FitPrediction, batch: PeopleBatch, people: PeopleBatch) -> FitPrediction:
        """Each person's fit that counts, with its joints and surface."""
        chosen = self.chosen(prediction, people, len(batch.joints_px))
        best = prediction._map(lambda value: value.index_select(0, chosen), lambda value: isinstance(value, Tensor))
        best = _as_floats(best, torch.float32)
        body = self.body(best.betas, best.pose, best.translation)
        return replace(best, joints=body.joints, verts=body.verts)

    def energies(self, prediction: FitPrediction, batch: PeopleBatch) -> dict[str, tuple[Tensor, float]]:
        """What each term comes to for each person (B,), without its weight, and the weight of the end."""
        found = {}
        for name, term in self._weighted():
            weight = term.weight_at(_LAST_STEP)
            rows = term.residual_rows(prediction, batch, _LAST_STEP)
            found[name] = (rows.square().sum(1) / weight if weight > 0 else rows.new_zeros(len(rows)), weight)
        return found

    def chosen(self, prediction: FitPrediction, people: PeopleBatch, count: int) -> Tensor:
        """The fit (B,) of each of `count` people that counts."""
        cost, person = self._costs(prediction, people), prediction.person
        least = cost.new_full((count,), torch.inf).scatter_reduce(0, person, cost, "amin")
        order = torch.arange(len(cost), device=cost.device)
        first = torch.where(cost <= least[person], order, len(cost))
        return first.new_full((count,), len(cost)).scatter_reduce(0, person, first, "amin")

    def _costs(self, prediction: FitPrediction, people: PeopleBatch) -> Tensor:
        """What fits (N,) are compared by."""
        terms = [term for term in self.terms() if self.choose == "objective" or term.prediction == "joints_px"]
        rows = [term.residual_rows(prediction, people, _LAST_STEP).square().sum(1) for term in terms]
        return torch.stack(rows).sum(0) if rows else self.x.new_zeros(len(prediction.person))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Torch's hook: takes on the number of fits that a checkpoint has."""
        named = [("x", self.x), ("person", self.person), ("is_flipped", self.is_flipped)]
        named += [("is_at_work", self.is_at_work)]
        take_sizes(cast(Any, named), state_dict, prefix)
        super()._load_from_state_dict(state_dict, prefix, *args)


def _as_floats(record: Any, dtype: torch.dtype) -> Any:
    return record._map(
        lambda value: value.to(dtype), lambda value: isinstance(value, Tensor) and value.is_floating_point()
    )


def project(points: Tensor, focal_px: Tensor, center_px: Tensor) -> Tensor:
    """Points (N, M, 3) in the camera's axes to pixels (N, M, 2); those beside the camera's plane stay finite."""
    depth = points[..., 2:].clamp_min(_NEAREST)
    return focal_px[:, None, None] * points[..., :2] / depth + center_px[:, None]


def project_changes(points: Tensor, changes: Tensor, focal_px: Tensor) -> Tensor:
    """How pixels (N, M, 2) change as points (N, M, 3) do: (N, M, 2, P) of changes (N, M, 3, P)."""
    depth = points[..., 2:].clamp_min(_NEAREST)
    ahead = (points[..., 2:] >= _NEAREST)[..., None]
    sideways = points[..., :2] / depth
    slope = changes[..., :2, :] - sideways[..., None] * changes[..., 2:, :] * ahead
    return (focal_px[:, None, None] / depth)[..., None] * slope
