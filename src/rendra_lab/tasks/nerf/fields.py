"""What every radiance field answers: how much of a ray a sample stops, and the light that leaves it.

Letters: M points, Q rays.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn


class RadianceField(nn.Module, ABC):
    """Density or opacity, and light, at points of a box. Subclasses say which of the two their matter is."""

    is_density: bool = True  # longer samples stop more light; False: a sample's opacity is the same at any length
    box: Tensor  # (2, 3) lowest and highest corner of what may hold anything, in the world

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("box", torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))

    def place(self, box: Tensor) -> None:
        """Say where the scene lies: (2, 3), lowest and highest corner, in the world."""
        self.box.copy_(box)

    @abstractmethod
    def forward(
        self, points: Tensor, directions: Tensor, steps: Tensor, ray_index: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Opacity and light of samples.

        Args:
            points: (M, 3) in the world.
            directions: (M, 3) of length 1, of the ray through each point; or (Q, 3) if `ray_index` is given.
            steps: (M,) lengths of the samples along their rays, world units.
            ray_index: (M,) int64 in [0, Q), each point's ray: what depends on directions alone is then done once a
                ray.

        Returns:
            Opacities (M,) in [0, 1]: 1 - exp(-density * step) where matter is a density. And light (M, 3), sRGB in
            [0, 1].
        """

    @abstractmethod
    def opacity(self, points: Tensor, steps: Tensor) -> Tensor:
        """The opacities alone, (M,), of samples at points (M, 3) of lengths (M,)."""
