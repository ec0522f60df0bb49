"""What controlling and measuring need to know of a generator, and of the world that it learned."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from rendra_lab.tasks.giraffe.box_sampler import BoxSampler
from rendra_lab.tasks.giraffe.camera_sampler import CameraSampler
from rendra_lab.tasks.giraffe.records import MadePictures, Scenes


@runtime_checkable
class SceneMaker(Protocol):
    """Draws scenes at random and makes pictures of them: a `Generator`, or what behaves like one."""

    boxes: BoxSampler
    cameras: CameraSampler

    def sample(self, count: int, generator: torch.Generator, temperature: float = 1.0) -> Scenes:
        """So many scenes, their codes scaled by the temperature."""
        ...

    def __call__(self, scenes: Scenes) -> MadePictures:
        """Their pictures."""
        ...

    def alpha_maps(self, scenes: Scenes) -> Float[Tensor, "B T V V"]:
        """The opacity of each object, and last of the background, as if it were alone."""
        ...


@dataclass(frozen=True)
class Reach:
    """Where training put objects and cameras: as far as controls go unless they are told otherwise.

    Attributes:
        turns: least and most angle of objects about z, in turns.
        low, high: corners of the box in which the middles of objects lie.
        polar: least and most angle between z and the way to the camera, radians.
        half_frame: tangent of half the field of view.
    """

    turns: tuple[float, float]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    polar: tuple[float, float]
    half_frame: float

    @classmethod
    def of(cls, maker: SceneMaker) -> Reach:
        """As far as a maker's samplers go."""
        boxes, cameras = maker.boxes, maker.cameras
        low, high = (tuple(end.tolist()) for end in boxes.translation)
        highest, lowest = (math.acos(1 - 2 * part) for part in cameras.polar)
        return cls(boxes.turns, low, high, (highest, lowest), math.tan(math.radians(cameras.fov_deg) / 2))

    @property
    def is_full_turn(self) -> bool:
        """Whether objects were seen from all sides; also where all had one heading, and nothing was said."""
        extent = self.turns[1] - self.turns[0]
        return extent >= 1 or extent == 0

    def along(self, direction: Float[Tensor, "B 3"]) -> tuple[Float[Tensor, " B"], Float[Tensor, " B"]]:
        """The middle and the half of what the box extends along directions of unit length."""
        low, high = direction.new_tensor(self.low), direction.new_tensor(self.high)
        return direction @ ((low + high) / 2), direction.abs() @ ((high - low) / 2)
