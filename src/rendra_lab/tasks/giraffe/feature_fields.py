"""What is at a point: density and features, of whatever its latent codes say.

Niemeyer and Geiger, "GIRAFFE", CVPR 2021, Eq. 3 and the supplementary's Fig. 1; details are those of its published
code. Letters: L stretches of rays with K points each; T things, each with codes of its own; H hidden units.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.networks.initialization import he_init
from rendra_lab.settings import Count, Positive, Size

_FEW, _MANY = 4096, 1 << 20  # points at a time, which fit into a core's cache, or keep a GPU busy


class Stretches(NamedTuple):
    """Points of pieces of rays, each piece within one thing's space."""

    thing: Int[Tensor, " L"]  # whose codes
    origins: Float[Tensor, "L 3"]
    directions: Float[Tensor, "L 3"]  # of any length
    depths: Float[Tensor, "L K"]  # points are origin + depth * direction
    wanted: Bool[Tensor, "L K"]  # nobody looks at the others; the wanted ones of a stretch come first


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
        point_octaves, view_octaves: frequencies pi, 2 pi, 4 pi .. of the encodings; without any of the view's, a
            point looks the same from everywhere.
        skips: layers, counted from 1, behind which points and shape are added once more; but not behind the last.
        point_scale: points are divided by it before they are encoded.
        views_downscaled: directions too, as in the published code.
        density_scale: densities are multiplied by it.
        torch_init: weights begin as PyTorch's do, as published: then everything looks nearly the same at first.

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
        view_octaves: Count = 4,
        skips: Sequence[Count] = (),
        point_scale: Size = 2.0,
        views_downscaled: bool = False,
        density_scale: Size = 1.0,
        torch_init: bool = False,
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
        self.from_directions = nn.Linear(6 * view_octaves, hidden) if view_octaves else None
        self.out = nn.Linear(hidden, features)
        if not torch_init:
            self._he_init()

    def forward(self, at: Stretches, shape: Float[Tensor, "T Z"], appearance: Float[Tensor, "T Z"]) -> FieldValues:
        """Densities before noise, and hidden features, at points of things with these codes.

        What is not wanted is 0 or not, as is convenient. Without gradients points are looked at a few at a time, so
        that near memory is enough, and hardly any but those that are wanted.
        """
        if torch.is_grad_enabled() or not at.depths.numel():
            return self._at(at, shape, appearance)
        counts = at.wanted.sum(1)
        order = counts.argsort(descending=True)
        density, hidden = at.depths.new_zeros(at.depths.shape), at.depths.new_zeros((*at.depths.shape, self.hidden))
        points = _FEW if at.depths.device.type == "cpu" else _MANY
        for rows in order.split(max(points // at.depths.shape[1], 1)):
            most = int(counts[rows[0]])
            if most == 0:
                break
            part = Stretches(*(each.index_select(0, rows) for each in at))
            part = part._replace(depths=part.depths[:, :most], wanted=part.wanted[:, :most])
            values = self._at(part, shape, appearance)
            density[rows, :most], hidden[rows, :most] = values.density, values.hidden
        return FieldValues(density, hidden)

    def _he_init(self) -> None:
        for layer in self.trunk:
            assert isinstance(layer, nn.Linear)
            he_init(layer)
        for layer in (self.from_points, self.from_shape, *self.skips_from_points, *self.skips_from_shape):
            assert isinstance(layer, nn.Linear)
            he_init(layer, summands=2)
        of_ray = [self.to_view, self.from_appearance, *([self.from_directions] if self.from_directions else [])]
        for layer in of_ray:
            he_init(layer, summands=len(of_ray))
        for layer in (self.to_density, self.out):
            he_init(layer, slope=1.0)

    def _at(self, at: Stretches, shape: Tensor, appearance: Tensor) -> FieldValues:
        points = at.origins.T[:, :, None] + at.depths * at.directions.T[:, :, None]
        encoded = octaves(points / self.point_scale, self.point_octaves).flatten(1).mT
        rows, each = at.depths.shape, lambda values: values.index_select(0, at.thing)[:, None]
        x = self.from_points(encoded).unflatten(0, rows) + each(self.from_shape(shape))
        skips = dict(zip(self.skips, zip(self.skips_from_points, self.skips_from_shape, strict=True), strict=True))
        x = F.relu_(x).flatten(0, 1)
        for number, layer in enumerate(self.trunk, 1):
            x = F.relu_(layer(x))
            if number in skips:
                of_points, of_shape = skips[number]
                x = (of_points(encoded).unflatten(0, rows) + each(of_shape(shape))).flatten(0, 1) + x
        of_ray = each(self.from_appearance(appearance))
        if self.from_directions is not None:
            directions = F.normalize(at.directions.T, dim=0) / (self.point_scale if self.views_downscaled else 1.0)
            of_ray = of_ray + self.from_directions(octaves(directions, self.view_octaves).mT)[:, None]
        hidden = F.relu_(self.to_view(x).unflatten(0, rows) + of_ray)
        return FieldValues(self.to_density(x).view(rows), hidden)

    def to_features(self, hidden: Float[Tensor, "L H"], weight: Float[Tensor, " L"]) -> Float[Tensor, "L C"]:
        """Features of sums of hidden ones: `weight` is the sum of their weights."""
        return F.linear(hidden, self.out.weight) + weight[:, None] * self.out.bias


def octaves(x: Float[Tensor, "D ..."], count: int) -> Float[Tensor, "E ..."]:
    """Sines and cosines of 2^i pi x for i = 0 .. count - 1: all sines of an octave, then all cosines.

    Angles are doubled, which costs a tenth of the sines; rounding doubles too, as that of 2^i x does.
    """
    waves = [(math.pi * x).sin(), (math.pi * x).cos()]
    for _ in range(count - 1):
        sin, cos = waves[-2:]
        waves += [2 * sin * cos, (cos - sin) * (cos + sin)]
    return torch.cat(waves)
