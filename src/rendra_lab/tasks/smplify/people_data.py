"""What all sources of people have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from lightning.pytorch import LightningDataModule

from rendra_lab.data.repeated import Repeated
from rendra_lab.errors import UserError
from rendra_lab.tasks.smplify.records import PeopleBatch

Picture = npt.NDArray[np.uint8]
"""(H, W, 3), sRGB."""


class PeopleData(LightningDataModule, ABC):
    """People in pictures, all in one batch; subclasses say where they come from.

    Attributes:
        people: everyone, after `setup`.

    Args:
        steps: optimisation steps an epoch.
    """

    people: PeopleBatch

    def __init__(self, steps: int = 10_000) -> None:
        super().__init__()
        self.steps = steps

    @abstractmethod
    def load(self) -> PeopleBatch:
        """Everyone; called once."""

    @abstractmethod
    def load_picture(self, index: int) -> Picture | None:
        """The picture of the person in row `index` of the batch; None where there is none. Never called before load.

        Raises:
            UserError: it is there and cannot be read.
        """

    def setup(self, stage: str) -> None:
        """Lightning's hook: loads the people once."""
        if not hasattr(self, "people"):
            self.people = replace(self.load(), picture_of=self.picture)

    def picture(self, person: int | str) -> Picture | None:
        """The picture that a person is in, read now.

        Args:
            person: row of the batch, or what the picture is called there.

        Returns:
            (H, W, 3), sRGB; None where only the joints are known.

        Raises:
            UserError: no such person, or a picture that cannot be read.
        """
        self.setup("fit")
        names = self.people.pictures
        if isinstance(person, str):
            if person not in names:
                raise UserError(f"there is no picture {person!r}; there are {len(names)}, the first is {names[0]!r}")
            return self.load_picture(names.index(person))
        if not 0 <= person < len(names):
            raise UserError(f"there is no person {person}; there are {len(names)}, counted from 0")
        return self.load_picture(person)

    def train_dataloader(self) -> Repeated[PeopleBatch]:
        """Everyone, once for every step."""
        return Repeated(self.people, self.steps)

    def test_dataloader(self) -> Repeated[PeopleBatch]:
        """Everyone, once."""
        return Repeated(self.people)
