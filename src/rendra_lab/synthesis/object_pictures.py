"""Pictures of objects before a background, and which pixel shows which of them: what worlds of objects make.

Letters: B pictures, M objects that a picture can show, S x S pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float, Int, UInt8
from torch import Tensor

from rendra_lab.records import TensorRecord


@dataclass(frozen=True)
class ObjectPictures(TensorRecord):
    """Pictures, and what only the world that made them knows."""

    rgb: UInt8[Tensor, "B 3 S S"]  # sRGB
    owners: UInt8[Tensor, "B S S"]  # the object that a pixel shows, from 1; 0: the background
    heading: Float[Tensor, "B M"]  # radians about up, the object's front from +x towards +y; NaN: it has no front
    kind: Int[Tensor, "B M"]  # as the world numbers them; -1: there is no such object


@runtime_checkable
class ObjectWorld(Protocol):
    """A world of objects: a seed is a picture."""

    def settings(self) -> tuple[object, ...]:
        """All but seed and size that determines a picture, the edition of the world's code with it."""
        ...

    def pictures(self, seeds: Sequence[int], side: int) -> ObjectPictures:
        """One picture of S = `side` for each seed, on the CPU."""
        ...
