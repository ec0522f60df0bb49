"""Joints that a detector found: `data=joints_json`."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rendra_lab.data.picture_files import find_picture, upright_size
from rendra_lab.errors import UserError
from rendra_lab.tasks.smplify.joint_files import FoundPerson, JointFiles
from rendra_lab.tasks.smplify.joint_layouts import Joints
from rendra_lab.tasks.smplify.picture_people import GivenPerson, PicturePeople, check_joints

log = logging.getLogger(__name__)

_SHARES_REACH = 3.0  # landmarks are shares of the picture if most of them are smaller than this


class JointsJSON(PicturePeople):
    """People of JSON files; each person is a row, several of them perhaps of one picture.

    Args:
        path: a file, or a folder of them; see `joint_files`.
        layout: openpose_body25, openpose_coco18, coco17, mediapipe33, lsp14; auto goes by what the file says and by
            the number of joints, and logs which it is.
        images: folder of the pictures; None looks beside the file, and does without those that are not there.
        size: height and width of pictures that are not there and of which the file says nothing.
        focal_px: in the picture's pixels; None: the picture's diagonal.
        least_confidence: joints below it count as not found. MediaPipe gives all joints some place.
        **people: `first`, `count`, `hips_and_neck` and `steps` of `PicturePeople`.
    """

    def __init__(
        self,
        path: str | Path,
        layout: str = "auto",
        images: str | Path | None = None,
        size: Sequence[int] | None = None,
        focal_px: float | None = None,
        least_confidence: float = 0.1,
        **people: Any,
    ) -> None:
        super().__init__(focal_px, **people)
        if size is not None and (len(size) != 2 or not all(isinstance(side, int) and side > 0 for side in size)):
            raise UserError(f"data.size must be [height,width] in whole pixels, got {size!r}")
        if not 0 <= least_confidence <= 1:
            raise UserError(f"data.least_confidence must lie between 0 and 1, got {least_confidence!r}")
        self.files = JointFiles(layout)
        self.path = Path(path)
        self.images = None if images is None else Path(images)
        self.size = None if size is None else (size[0], size[1])
        self.least_confidence = least_confidence

    def read(self) -> list[GivenPerson]:
        """The people of the file or of all files, in their order."""
        if not self.path.exists():
            raise UserError(f"there is no file or folder {self.path}")
        if self.images is not None and not self.images.is_dir():
            raise UserError(f"there is no folder {self.images}, which data.images names")
        people = self.files.read(self.path)
        taken = [people[row] for row in self.taken(len(people), self.path)]
        layouts = Counter(person.layout.name for person in taken)
        log.info("%s: %s", self.path, ", ".join(f"{count} people of {name}" for name, count in layouts.items()))
        if self.files.left_out:
            log.info("%s: %d annotations without a labelled joint are left out", self.path, self.files.left_out)
        seen: dict[str, tuple[Path | None, tuple[int, int] | None]] = {}
        return [self._person(person, seen) for person in taken]

    def _person(
        self, person: FoundPerson, seen: dict[str, tuple[Path | None, tuple[int, int] | None]]
    ) -> GivenPerson:
        name = person.pictures[0]
        if name not in seen:
            seen[name] = self._picture(person)
        picture, actual = seen[name]
        size = self._size_of(person, picture, actual)
        joints = check_joints(
            _in_pixels(person, size), person.layout.joints, person.where, least_confidence=self.least_confidence
        )
        called = name if picture is None else str(picture)
        return GivenPerson(person.where, called, picture, size, person.layout.to_lsp(joints))

    def _picture(self, person: FoundPerson) -> tuple[Path | None, tuple[int, int] | None]:
        """The picture and its size, where it is there."""
        beside = self.path if self.path.is_dir() else self.path.parent
        path = find_picture(self.images or beside, person.pictures, person.where)
        if path is None and self.images is not None:
            called = " or ".join(map(repr, person.pictures))
            raise UserError(f"{person.where}: there is no picture {called} in {self.images}")
        return path, None if path is None else upright_size(path, person.where)

    def _size_of(self, person: FoundPerson, picture: Path | None, actual: tuple[int, int] | None) -> tuple[int, int]:
        if actual is not None and person.size is not None and actual != person.size:
            said, is_so = (f"{width} x {height}" for height, width in (person.size, actual))
            raise UserError(
                f"{person.where}: the picture is said to be {said} pixels large, but {picture} is {is_so}"
            )
        size = actual or person.size or self.size
        if size is None:
            raise UserError(
                f"{person.where}: how large is the picture {person.pictures[0]!r}? It is not beside the file: give "
                "data.images=FOLDER or data.size=[height,width]"
            )
        return size


def _in_pixels(person: FoundPerson, size: tuple[int, int]) -> Joints:
    """Joints (K, 3) in pixels, the middle of the first one at 0.5."""
    height, width = size
    joints = person.numbers.copy()
    places = np.abs(joints[:, :2][np.isfinite(joints[:, :2])])
    if person.layout.name == "mediapipe33" and (places.size == 0 or np.median(places) <= _SHARES_REACH):
        return joints * [width, height, 1.0]
    joints[:, :2] += 0.5 - person.layout.first_pixel
    return joints
