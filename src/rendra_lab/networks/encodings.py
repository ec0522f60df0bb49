"""Features of points and directions that a small network turns into density and colour.

Points lie in [0, 1]^3; who calls maps a scene there. Every module has a `width`: how many numbers it gives a point.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rendra.kernels.encode_grid import encode_grid, grid_offsets, grid_resolutions


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
        levels: int = 12,
        features: int = 2,
        log2_table_size: int = 15,
        coarsest: int = 16,
        finest: int = 256,
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
