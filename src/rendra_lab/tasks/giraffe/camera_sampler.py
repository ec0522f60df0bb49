"""Who looks at a scene: cameras on a sphere round the world's middle, and their rays.

Niemeyer and Geiger, "GIRAFFE", CVPR 2021, and the published code. A turn is 2 pi; the camera looks along its own -z.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rendra_lab.errors import UserError
from rendra_lab.settings import Fraction, Range, Size
from rendra_lab.tasks.giraffe.records import Cameras

_Fov = Annotated[float, Range(0.0, 179.0, closed=False)]


class Rays(NamedTuple):
    """What P pixels of each picture look at: the points origin + depth * direction."""

    origins: Float[Tensor, "B 3"]
    directions: Float[Tensor, "B P 3"]  # their part along the view is 1: they are longer towards the corners


class CameraSampler:
    """Draws cameras that look at the world's middle from around it, uniformly on a part of a sphere.

    Three things are otherwise in the published code, and options here: pixels that stand at the ends of the
    picture instead of at the middles of equal parts (`end_points_included`, which zooms out by V / (V - 1)); axes
    whose length is not 1 but depends on the other pictures of the batch, so that who looks from higher up zooms in
    (`batch_normalized_look_at`); one turn of the background for a whole batch (`one_background_turn`). That code
    enumerates pixels column by column and transposes the features afterwards; here they come row by row.

    Args:
        fov_deg: angle between the left and the right side of the picture.
        radius: least and greatest distance from the middle.
        azimuth: least and greatest angle about z, turns; 0 looks from +x.
        polar: least and greatest v, where arccos(1 - 2 v) is the angle between the eye and up: 0 is above, 0.5 level.
        background_turns: least and greatest angle about z of what the background shows.
        end_points_included, batch_normalized_look_at, one_background_turn: see above; all false.

    Raises:
        UserError: ranges that cannot be.
    """

    def __init__(
        self,
        fov_deg: _Fov = 49.13,
        radius: Sequence[Size] = (2.732, 2.732),
        azimuth: Sequence[float] = (0.0, 0.0),
        polar: Sequence[Fraction] = (0.25, 0.25),
        background_turns: Sequence[float] = (0.0, 0.0),
        end_points_included: bool = False,
        batch_normalized_look_at: bool = False,
        one_background_turn: bool = False,
    ) -> None:
        if not 0 < fov_deg < 180:
            raise UserError(f"cameras.fov_deg must be above 0 and below 180, got {fov_deg}")
        ranges = {"radius": radius, "azimuth": azimuth, "polar": polar, "background_turns": background_turns}
        if wrong := [name for name, ends in ranges.items() if len(ends) != 2]:
            raise UserError(
                f"cameras.{wrong[0]} must be two numbers, the least and the greatest, got {list(ranges[wrong[0]])}"
            )
        if not 0 < radius[0] <= radius[1] or not 0 <= polar[0] <= polar[1] <= 1:
            raise UserError(
                "cameras.radius must be two numbers above 0 and cameras.polar two from 0 to 1, the least first, got "
                f"{radius} and {polar}"
            )
        self.fov_deg = fov_deg
        self.radius = radius
        self.azimuth = azimuth
        self.polar = polar
        self.background_turns = background_turns
        self.end_points_included = end_points_included
        self.batch_normalized_look_at = batch_normalized_look_at
        self.one_background_turn = one_background_turn

    def sample(self, count: int, generator: torch.Generator) -> Cameras:
        """Cameras of B = `count` scenes, on the generator's device."""
        parts = torch.rand((4, count), generator=generator, device=generator.device)
        azimuth, polar, radius, turn = (
            low + part * (high - low)
            for part, (low, high) in zip(
                parts, (self.azimuth, self.polar, self.radius, self.background_turns), strict=True
            )
        )
        return self.at(azimuth, polar, radius, turn[:1].expand(count) if self.one_background_turn else turn)

    def at(self, azimuth: Tensor, polar: Tensor, radius: Tensor, background_turn: Tensor) -> Cameras:
        """Cameras at given places (B,), in the units of the ranges."""
        around, down = 2 * math.pi * azimuth, (1 - 2 * polar).clamp(-1, 1).acos()
        sin, cos, zero = down.sin(), down.cos(), torch.zeros_like(down)
        x = torch.stack([-around.sin(), around.cos(), zero], -1)
        y = torch.stack([-cos * around.cos(), -cos * around.sin(), sin], -1)
        z = torch.stack([sin * around.cos(), sin * around.sin(), cos], -1)
        if self.batch_normalized_look_at and len(sin):
            length = (sin / sin.max().clamp_min(1e-5))[:, None]
            x, y = length * x, length * y
        upper = torch.stack([x, y, z, radius[:, None] * z], -1)
        last = upper.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(upper), 1, 4)
        return Cameras(torch.cat([upper, last], 1), 2 * math.pi * background_turn)

    def rays(self, cameras: Cameras, side: int) -> Rays:
        """Of pictures of `side` x `side` pixels, row by row from the upper left."""
        matrix = cameras.camera_to_world
        middles = torch.arange(side, device=matrix.device, dtype=matrix.dtype)
        ticks = 2 * middles / max(side - 1, 1) - 1 if self.end_points_included else (2 * middles + 1) / side - 1
        ticks = math.tan(math.radians(self.fov_deg) / 2) * ticks
        y, x = torch.meshgrid(-ticks, ticks, indexing="ij")
        own = torch.stack([x, y, -torch.ones_like(x)], -1).view(-1, 3)
        return Rays(matrix[:, :3, 3], own @ matrix[:, :3, :3].mT)
