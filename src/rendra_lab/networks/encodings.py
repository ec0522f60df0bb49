"""Features of points and directions that a small network turns into density and colour.

Points lie in [0, 1]^3; who calls maps a scene there. Every module has a `width`: how many numbers it gives a point.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rendra.kernels.encode_grid import COMBINATIONS, encode_grid, encode_planes, grid_offsets, grid_resolutions
from rendra_lab.settings import Positive, Range


class HashGrid(nn.Module):
    """Grids of features from coarse to fine, hashed where they do not fit.

    Mueller et al., "Instant neural graphics primitives with a multiresolution hash encoding", SIGGRAPH 2022. The
    table starts uniform in +-1e-4 (Sec. 4).

    Args:
        levels: grids.
        features: numbers a level gives.
        log2_table_size: a level has at most 2^this rows. 30 keeps all levels of usual sizes dense.
        coarsest: cells along an axis of the first level.
        finest: cells along an axis of the last level; those between grow geometrically.

    Raises:
        ValueError: a size that cannot be.
    """

    def __init__(
        self,
        levels: Positive = 12,
        features: Positive = 2,
        log2_table_size: Annotated[int, Range(1, 24)] = 15,
        coarsest: Positive = 16,
        finest: Positive = 256,
    ) -> None:
        super().__init__()
        if features < 1:
            raise ValueError(f"a level needs at least one feature, got features={features}")
        self.resolutions = grid_resolutions(coarsest, finest, levels)
        self.offsets = grid_offsets(self.resolutions, log2_table_size)
        self.table = nn.Parameter(torch.empty(self.offsets[-1], features).uniform_(-1e-4, 1e-4))
        self.width = levels * features

    def forward(self, points: Float[Tensor, "M 3"]) -> Float[Tensor, "M D"]:
        """Features of points in [0, 1]^3; those outside are clamped to the cube."""
        return encode_grid(points, self.table, self.resolutions, self.offsets)

    def extra_repr(self) -> str:
        """Resolutions and size, for `print`."""
        rows, features = self.table.shape
        return f"resolutions={self.resolutions}, rows={rows}, features={features}"


class TriPlane(nn.Module):
    """Three planes of features at each of a few resolutions; the resolutions stand side by side.

    Fridovich-Keil et al., "K-Planes: explicit radiance fields in space, time, and appearance", CVPR 2023, without
    its planes of time. Planes that are multiplied start uniform in 0.1..0.5, as there: near zero, a product would
    have no gradient to leave it. Others start uniform in +-0.1.

    Args:
        resolutions: vertices along a side of the planes.
        features: numbers a plane gives.
        combine: how the three planes of a resolution become one: product, sum or concat.

    Raises:
        ValueError: a size or combination that cannot be.
    """

    def __init__(
        self, resolutions: Sequence[int] = (64, 128), features: Positive = 8, combine: str = "product"
    ) -> None:
        super().__init__()
        if not resolutions or min(resolutions) < 2 or features < 1:
            raise ValueError(
                "tri-planes need one or more resolutions of at least 2 vertices and at least one feature, got "
                f"resolutions={tuple(resolutions)}, features={features}"
            )
        if combine not in COMBINATIONS:
            raise ValueError(f"combine must be one of {', '.join(COMBINATIONS)}, got {combine!r}")
        low, high = (0.1, 0.5) if combine == "product" else (-0.1, 0.1)
        self.planes = nn.ParameterList(
            torch.empty(3, side, side, features).uniform_(low, high) for side in resolutions
        )
        self.combine = combine
        self.width = len(resolutions) * features * (3 if combine == "concat" else 1)

    def forward(self, points: Float[Tensor, "M 3"]) -> Float[Tensor, "M D"]:
        """Features of points in [0, 1]^3; those outside are clamped to the cube."""
        return torch.cat([encode_planes(points, planes, self.combine) for planes in self.planes], 1)


class SphericalHarmonics(nn.Module):
    """Real spherical harmonics of unit directions, orthonormal on the sphere; m runs from -l to l in each band l.

        Y_lm = sqrt((2 l + 1) / (4 pi) (l - |m|)! / (l + |m|)!) P_l^|m|(z) * (sqrt(2) cos(m phi) for m > 0, 1 for 0,
        sqrt(2) sin(|m| phi) for m < 0)

    without the Condon-Shortley sign, written as polynomials of x, y, z (Sloan, "Stupid spherical harmonics tricks",
    GDC 2008, appendix A2). Directions of another length are not normalised.

    Args:
        bands: bands l = 0 .. bands - 1, 1 to 4 of them: bands^2 numbers.

    Raises:
        ValueError: bands not in 1..4.
    """

    def __init__(self, bands: Annotated[int, Range(1, 5)] = 4) -> None:
        super().__init__()
        if not 1 <= bands <= 4:
            raise ValueError(f"spherical harmonics are there for 1 to 4 bands, got {bands}")
        self.bands = bands
        self.width = bands**2

    def forward(self, directions: Float[Tensor, "M 3"]) -> Float[Tensor, "M D"]:
        """Values of unit directions."""
        x, y, z = directions.unbind(-1)
        bands = (self._band_0, self._band_1, self._band_2, self._band_3)
        return torch.stack([value for band in bands[: self.bands] for value in band(x, y, z)], -1)

    @staticmethod
    def _band_0(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
        return [torch.full_like(x, _norm(1, 4))]

    @staticmethod
    def _band_1(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
        return [_norm(3, 4) * axis for axis in (y, z, x)]

    @staticmethod
    def _band_2(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
        return [
            _norm(15, 4) * x * y,
            _norm(15, 4) * y * z,
            _norm(5, 16) * (3 * z * z - 1),
            _norm(15, 4) * x * z,
            _norm(15, 16) * (x * x - y * y),
        ]

    @staticmethod
    def _band_3(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
        zz = z * z
        return [
            _norm(35, 32) * y * (3 * x * x - y * y),
            _norm(105, 4) * x * y * z,
            _norm(21, 32) * y * (5 * zz - 1),
            _norm(7, 16) * z * (5 * zz - 3),
            _norm(21, 32) * x * (5 * zz - 1),
            _norm(105, 16) * z * (x * x - y * y),
            _norm(35, 32) * x * (x * x - 3 * y * y),
        ]


def _norm(numerator: int, denominator: int) -> float:
    return math.sqrt(numerator / (denominator * math.pi))
