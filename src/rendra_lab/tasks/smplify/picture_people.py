"""People whose joints others have found: checked, and made into one batch."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from rendra_lab.data.picture_files import read_upright
from rendra_lab.errors import UserError
from rendra_lab.settings import Fraction, check_numbers
from rendra_lab.tasks.smplify.joint_layouts import Joints
from rendra_lab.tasks.smplify.people_data import PeopleData, Picture
from rendra_lab.tasks.smplify.records import LSP_JOINTS, PeopleBatch, joint_weights

MOST_PEOPLE = 100_000


@dataclass(frozen=True)
class GivenPerson:
    """A person of a file."""

    where: str  # file and person, for complaints
    picture: str  # what the picture is called
    path: Path | None  # of the picture, where there is one
    size: tuple[int, int]  # its height and width
    joints: Joints  # (14, 3) in LSP's order


class PicturePeople(PeopleData):
    """People of files; subclasses say of which. The principal point is the middle of the picture.

    Args:
        focal_px: in pixels of the picture. None: its diagonal, as Li et al., "CLIFF", ECCV 2022, take it for
            photographs of unknown cameras: 53 degrees from corner to corner.
        first: the first person taken, counted from 0.
        count: how many people; None for all that follow.
        hips_and_neck: what these joints count, 1 as the others do; 0: not at all, as in the code of Bogo et al.
        steps: optimisation steps an epoch.

    Raises:
        UserError: a focal length that is not positive, or a negative number of people.
    """

    def __init__(
        self,
        focal_px: float | None,
        first: int = 0,
        count: int | None = None,
        hips_and_neck: float = 0.0,
        steps: int = 10_000,
    ) -> None:
        super().__init__(steps)
        check_numbers("data", Fraction, hips_and_neck=hips_and_neck)
        if focal_px is not None and not (focal_px > 0 and math.isfinite(focal_px)):
            raise UserError(f"data.focal_px must be a number of pixels above zero, got {focal_px!r}")
        if first < 0:
            raise UserError(f"data.first counts people from 0, got {first}")
        if count is not None and count < 1:
            raise UserError(f"data.count must be at least 1, or null for all people; got {count}")
        self.focal_px = focal_px
        self.first = first
        self.count = count
        self.hips_and_neck = hips_and_neck

    @abstractmethod
    def read(self) -> list[GivenPerson]:
        """The people of `taken`, with joints that `check_joints` has seen."""

    def taken(self, total: int, where: Path) -> range:
        """Which of all people of a file are taken.

        Raises:
            UserError: none, or more than 100,000.
        """
        if total == 0:
            raise UserError(f"{where} holds no people; expected one at least")
        if self.first >= total:
            raise UserError(f"data.first={self.first}, but {where} holds {total} people, counted from 0")
        rows = range(self.first, total if self.count is None else min(total, self.first + self.count))
        if len(rows) > MOST_PEOPLE:
            raise UserError(
                f"{where} holds {len(rows):,} people; at most {MOST_PEOPLE:,} are fitted: give data.count"
            )
        return rows

    def load(self) -> PeopleBatch:
        """Everyone.

        Raises:
            UserError: joints that cannot be, or a file that cannot be read.
        """
        people = self.read()
        for person in people:
            _demand_inside(person)
        joints = torch.from_numpy(np.stack([person.joints for person in people])).float()
        size = torch.tensor([person.size for person in people], dtype=torch.float32)
        focal = size.norm(dim=1) if self.focal_px is None else torch.full((len(people),), float(self.focal_px))
        self._paths = [person.path for person in people]
        return PeopleBatch(
            joints_px=joints[..., :2].contiguous(),
            confidence=joints[..., 2].contiguous(),
            size_px=size,
            focal_px=focal,
            center_px=size.flip(1) / 2,
            weight=joint_weights(len(people), self.hips_and_neck),
            pictures=tuple(person.picture for person in people),
        )

    def load_picture(self, index: int) -> Picture | None:
        """The picture, upright; None where there is none."""
        path = self._paths[index]
        return None if path is None else read_upright(path, f"person {index}")


def check_joints(joints: Joints, names: Sequence[str], where: str, least_confidence: float = 0.0) -> Joints:
    """Joints (K, 3) as others wrote them: confidences above 1 become 1, those that are not found all zeros.

    Args:
        joints: x, y and confidence.
        names: of the K joints.
        where: file and person, for complaints.
        least_confidence: what is below it counts as not found.

    Raises:
        UserError: a confidence that is negative or no number, a joint that is found at no number, or none found.
    """
    sure = joints[:, 2]
    bad = np.flatnonzero(~(np.isfinite(sure) & (sure >= 0)))
    if len(bad):
        raise UserError(
            f"{where}, {names[bad[0]]}: the confidence is {sure[bad[0]]:g}; expected a number from 0 to 1"
        )
    found = (sure > 0) & (sure >= least_confidence)
    bad = np.flatnonzero(found & ~np.isfinite(joints[:, :2]).all(axis=1))
    if len(bad):
        x, y, confidence = joints[bad[0]]
        raise UserError(
            f"{where}, {names[bad[0]]}: it is found with confidence {confidence:g} at ({x:g}, {y:g}); "
            "expected finite numbers, or the confidence 0"
        )
    if not found.any():
        limit = f" of at least {least_confidence:g}" if least_confidence > 0 else " above 0"
        raise UserError(f"{where}: all joints are missing; expected one at least with a confidence{limit}")
    return np.where(found[:, None], np.minimum(joints, [np.inf, np.inf, 1.0]), 0.0)


def box_size(joints: Joints) -> tuple[int, int]:
    """Height and width of a picture that is not there: its margin right and below is that left and above.

    So the middle of the picture is the middle of the box about the joints, as it is in pictures cut out about people.
    """
    found = joints[joints[:, 2] > 0, :2]
    low, high = found.min(axis=0), found.max(axis=0)
    width, height = np.ceil(np.maximum(high + np.maximum(low, 0), 1)).astype(int).tolist()
    return height, width


def _demand_inside(person: GivenPerson) -> None:
    """Refuse joints that are more than the picture's size away from it."""
    height, width = person.size
    x, y, confidence = person.joints.T
    outside = (x < -width) | (x > 2 * width) | (y < -height) | (y > 2 * height)
    bad = np.flatnonzero(outside & (confidence > 0))
    if len(bad):
        raise UserError(
            f"{person.where}, {LSP_JOINTS[bad[0]]}: it is at ({x[bad[0]]:g}, {y[bad[0]]:g}), far outside its "
            f"picture; expected x from {-width} to {2 * width} and y from {-height} to {2 * height}, "
            f"for {width} x {height} pixels"
        )
