"""Fields whose features are looked up in trainable grids, and read by small networks.

Mueller et al., "Instant neural graphics primitives", SIGGRAPH 2022 (hash grids; Sec. 5.4 has the two networks);
Fridovich-Keil et al., "K-Planes", CVPR 2023 (tri-planes).
Shapes: M points.  Densities are per unit of length of the world.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from rendra.kernels.composite import alphas_of
from rendra_lab.errors import UserError
from rendra_lab.settings import Count, Positive, Size, check_numbers
from rendra_lab.tasks.nerf.fields import RadianceField

_LARGEST_EXPONENT = 12.0  # exp(12) per unit of length is opaque at every step anybody takes


class _TruncatedExp(torch.autograd.Function):
    """exp(x), cut off where it is opaque, with a gradient there that still can lower it."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = x.clamp(max=_LARGEST_EXPONENT).exp()
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        (y,) = ctx.saved_tensors
        return gradients[0] * y


@runtime_checkable
class Encoding(Protocol):
    """Turns points or directions (M, 3) into features (M, width)."""

    width: int

    def __call__(self, points: Tensor, /) -> Tensor:
        """Features (M, width)."""


class GridField(RadianceField):
    """Density and light from the features that an encoding finds at a point.

    The matter is a density: a sample of length s is opaque by 1 - exp(-density s).

    Args:
        encoding: points (M, 3) in the unit cube to features (M, `encoding.width`).
        directions: unit vectors (M, 3) to features (M, `directions.width`); null: the light is the same all round.
        width: of the hidden layers.
        density_layers: hidden layers between the features and the density.
        color_layers: hidden layers between the density's features and the light.
        memory: features that the density network hands on to the light's.
        start_density: everywhere, before training, in units of 1 / (longest side of the box).
    """

    def __init__(
        self,
        encoding: Encoding,
        directions: Encoding | None = None,
        width: Positive = 64,
        density_layers: Count = 1,
        color_layers: Count = 2,
        memory: Count = 15,
        start_density: float = 1.0,
    ) -> None:
        super().__init__()
        check_numbers("field", Positive, width=width)
        check_numbers("field", Count, density_layers=density_layers, color_layers=color_layers, memory=memory)
        check_numbers("field", Size, start_density=start_density)
        if memory == 0 and directions is None:
            raise UserError("field.memory is 0 and field.directions null: then light depends on nothing")
        self.encoding: Encoding = encoding
        self.directions: Encoding | None = directions
        self.start_density = start_density
        self.density_net = perceptron([encoding.width, *[width] * density_layers, 1 + memory])
        sees = 0 if directions is None else directions.width
        self.color_net = perceptron([memory + sees, *[width] * color_layers, 3])

    def forward(
        self, points: Tensor, directions: Tensor, steps: Tensor, ray_index: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Opacities (M,) and light (M, 3) of samples; see `RadianceField`."""
        features = self._features(points)
        known = features[:, 1:]
        if self.directions is not None:
            seen = self.directions(directions)
            known = torch.cat([known, seen if ray_index is None else seen.index_select(0, ray_index)], dim=1)
        return self._alpha(features[:, 0], steps), self.color_net(known).sigmoid()

    def opacity(self, points: Tensor, steps: Tensor) -> Tensor:
        """Opacities (M,) of samples."""
        return self._alpha(self._features(points)[:, 0], steps)

    def _features(self, points: Tensor) -> Tensor:
        low, high = self.box
        return self.density_net(self.encoding((points - low) / (high - low)))

    def _alpha(self, raw: Tensor, steps: Tensor) -> Tensor:
        size = (self.box[1] - self.box[0]).amax()
        density = _TruncatedExp.apply(raw) * (self.start_density / size)
        return alphas_of(density, steps)


def perceptron(widths: Sequence[int]) -> nn.Sequential:
    """Linear layers of these widths with ReLU between them, without biases."""
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(widths):
        layers += [nn.Linear(inputs, outputs, bias=False), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])
