"""What is at a point: density and features, of whatever its latent codes say.

Niemeyer and Geiger, "GIRAFFE", CVPR 2021, Eq. 3 and the supplementary's Fig. 1; details are those of its published
code. Letters: L stretches of rays with K points each; T things, each with codes of its own; H hidden units.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.settings import Count, Positive, Size


class Stretches(NamedTuple):
    """Points of pieces of rays, each piece within one thing's space."""

    thing: Int[Tensor, " L"]  # whose codes
    points: Float[Tensor, "L K 3"]
    directions: Float[Tensor, "L 3"]  # of unit length


class FieldValues(NamedTuple):
    """A field at points."""

    density: Float[Tensor, "L K"]  # 1 / length, before noise and ReLU
    hidden: Float[Tensor, "L K H"]  # what `to_features` makes features of


class FeatureField(nn.Module):
    """A network of points, directions and two latent codes: shape alone decides the density.

    The last layer is linear, and so is compositing: `forward` leaves it out, and `to_features` applies it once a ray
    instead of once a point.

    Args:
        features: M_f channels.
        hidden: units of each layer.
        layers: before the density.
        code: numbers of each latent code.
        point_octaves, view_octaves: frequencies pi, 2 pi, 4 pi .. of the encodings.
        skips: layers, counted from 1, behind which points and shape are added once more; but not behind the last.
        point_scale: points are divided by it before they are encoded.
        views_downscaled: directions too, as in the published code.
        density_scale: densities are multiplied by it.

    Raises:
        UserError: skips that no layer has.
    """

    def __init__(
        self,
        features: Positive = 128,
        hidden: Positive = 128,
        layers: Positive = 8,
        code: Positive = 256,
        point_octaves: Positive = 10,
        view_octaves: Positive = 4,
        skips: Sequence[Count] = (),
        point_scale: Size = 2.0,
        views_downscaled: bool = False,
        density_scale: Size = 1.0,
    ) -> None:
        super().__init__()
        if not all(1 <= number < layers for number in skips):
            raise UserError(f"skips must be among the layers 1 to {layers - 1}, got {list(skips)} of {layers} layers")
        self.features, self.hidden, self.code = features, hidden, code
        self.point_octaves, self.view_octaves = point_octaves, view_octaves
        self.point_scale, self.views_downscaled, self.density_scale = point_scale, views_downscaled, density_scale
        self.from_points = nn.Linear(6 * point_octaves, hidden)
        self.from_shape = nn.Linear(code, hidden)
        self.trunk = nn.ModuleList(nn.Linear(hidden, hidden) for _ in range(layers - 1))
        self.skips = tuple(sorted(set(skips) - {layers - 1}))
        self.skips_from_points = nn.ModuleList(nn.Linear(6 * point_octaves, hidden) for _ in self.skips)
        self.skips_from_shape = nn.ModuleList(nn.Linear(code, hidden) for _ in self.skips)
        self.to_density = nn.Linear(hidden, 1)
        self.to_view = nn.Linear(hidden, hidden)
        self.from_appearance = nn.Linear(code, hidden)
        self.from_directions = nn.Linear(6 * view_octaves, hidden)
        self.out = nn.Linear(hidden, features)

    def forward(self, at: Stretches, shape: Float[Tensor, "T Z"], appearance: Float[Tensor, "T Z"]) -> FieldValues:
        """Densities before noise, and hidden features, at points of things with these codes."""
        encoded = octaves(at.points / self.point_scale, self.point_octaves)
        x = F.relu(self.from_points(encoded) + _each(self.from_shape(shape), at.thing))
        skips = dict(zip(self.skips, zip(self.skips_from_points, self.skips_from_shape, strict=True), strict=True))
        for number, layer in enumerate(self.trunk, 1):
            x = F.relu(layer(x))
            if number in skips:
                of_points, of_shape = skips[number]
                x = x + of_points(encoded) + _each(of_shape(shape), at.thing)
        directions = at.directions / self.point_scale if self.views_downscaled else at.directions
        seen = self.from_directions(octaves(directions, self.view_octaves))[:, None]
        hidden = F.relu(self.to_view(x) + _each(self.from_appearance(appearance), at.thing) + seen)
        return FieldValues(self.to_density(x).squeeze(-1), hidden)

    def to_features(self, hidden: Float[Tensor, "L H"], weight: Float[Tensor, " L"]) -> Float[Tensor, "L C"]:
        """Features of sums of hidden ones: `weight` is the sum of their weights."""
        return F.linear(hidden, self.out.weight) + weight[:, None] * self.out.bias


def octaves(x: Float[Tensor, "*any D"], count: int) -> Float[Tensor, "*any 2*D*count"]:
    """Sines and cosines of 2^i pi x for i = 0 .. count - 1: all sines of an octave, then all cosines."""
    waves = [(sign, 2.0**number * math.pi) for number in range(count) for sign in (torch.sin, torch.cos)]
    return torch.cat([wave(factor * x) for wave, factor in waves], -1)


def _each(values: Tensor, thing: Tensor) -> Tensor:
    """Values (T, H) of stretches' things: (L, 1, H)."""
    return values.index_select(0, thing)[:, None]
