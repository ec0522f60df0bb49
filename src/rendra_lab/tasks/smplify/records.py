"""What SMPLify is given and what it answers.

Letters: N fits (a person may be fitted twice, from both sides), B people, K = 14 joints of the picture in LSP's
order, J joints of the body, C betas, V vertices.
Pixels: x right, y down, the middle of the first pixel at 0.5.
World: OpenCV's camera axes, x right, y down, z forward, metres; the camera stands at the origin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rendra_lab.records import TensorRecord
from rendra_lab.tasks.smplify.body_spheres import Balls

LSP_JOINTS = (
    "right_ankle", "right_knee", "right_hip", "left_hip", "left_knee", "left_ankle", "right_wrist", "right_elbow",
    "right_shoulder", "left_shoulder", "left_elbow", "left_wrist", "neck", "head_top",
)  # fmt: skip

_HIPS_AND_NECK = tuple(LSP_JOINTS.index(name) for name in ("right_hip", "left_hip", "neck"))

USUAL_HEIGHT_PX = 300.0
"""Of a person in the pictures that the weights of Bogo et al. were chosen for: LSP's, enlarged twice."""


@dataclass(frozen=True)
class BodyTruth(TensorRecord):
    """The bodies themselves, where they are known."""

    pose: Float[Tensor, "B P"]  # P = 3 J: rotation vectors, the first one into the camera's axes
    betas: Float[Tensor, "B C"]
    translation: Float[Tensor, "B 3"]
    joints: Float[Tensor, "B J 3"]
    verts: Float[Tensor, "B V 3"]
    clean_px: Float[Tensor, "B K 2"]  # the joints of the picture without noise


@dataclass(frozen=True)
class PeopleBatch(TensorRecord):
    """People in pictures, one each: all of a data set, fitted side by side."""

    joints_px: Float[Tensor, "B K 2"]
    confidence: Float[Tensor, "B K"]  # 0: not found, and joints_px means nothing
    size_px: Float[Tensor, "B 2"]  # height and width of the picture
    focal_px: Float[Tensor, " B"]
    center_px: Float[Tensor, "B 2"]  # principal point, x and y
    weight: Float[Tensor, "B K"]  # of each joint, found or not; 0 where people mean another place than bodies have
    pictures: tuple[str, ...]  # what each picture is called: a path, or a name where there is none
    truth: BodyTruth | None = None
    picture_of: Callable[[int], Any] | None = None  # (H, W, 3) uint8, or None: read when asked for

    @property
    def counted(self) -> Float[Tensor, "B K"]:
        """Weight of each joint: 0 for those that were not found, whatever stands there."""
        return self.weight * (self.confidence > 0)

    @property
    def height_px(self) -> Float[Tensor, " B"]:
        """How large each person is: the longer side of the box about the joints that were found."""
        found = (self.confidence > 0)[..., None]
        high = torch.where(found, self.joints_px, -torch.inf).amax(1)
        low = torch.where(found, self.joints_px, torch.inf).amin(1)
        return (high - low).amax(1).clamp_min(1.0)

    @property
    def enlarge(self) -> Float[Tensor, " B"]:
        """By what the paper's pictures, in which a person has about 300 pixels, are larger than this one."""
        return USUAL_HEIGHT_PX / self.height_px

    def select(self, rows: Tensor) -> PeopleBatch:
        """The people of rows (N,), some perhaps twice."""
        return self._map(lambda value: value.index_select(0, rows), lambda value: isinstance(value, Tensor))


def joint_weights(people: int, hips_and_neck: float) -> Tensor:
    """Weights (people, 14) of LSP's joints: 1, and another for hips and neck.

    People mark hips and neck elsewhere than bodies have these joints: Bogo et al. leave them out.
    """
    weights = torch.ones(people, len(LSP_JOINTS))
    weights[:, _HIPS_AND_NECK] = hips_and_neck
    return weights


@dataclass(frozen=True)
class FitPrediction(TensorRecord):
    """Bodies as they are fitted now."""

    pose: Float[Tensor, "N P"]  # P = 3 J
    betas: Float[Tensor, "N C"]
    translation: Float[Tensor, "N 3"]
    joints_px: Float[Tensor, "N K 2"]
    spheres: Balls  # that fill the body
    person: Int[Tensor, " N"]  # whose fit this is
    is_flipped: Bool[Tensor, " N"]  # begun with the back to the camera instead of the front, or the other way round
    joints: Float[Tensor, "N J 3"] | None = None  # in the world; not while it is fitted
    verts: Float[Tensor, "N V 3"] | None = None
