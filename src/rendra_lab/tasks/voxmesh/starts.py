"""Meshes that refinement begins with: the surface of predicted voxels, or a sphere.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 4.1: "VoxMesh", "Sphere-Init" and
"Pixel2Mesh+". All in the frame of the picture's frustum (`rendra_lab.frustums`), [-1, 1]^3.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn

from rendra.structures import Meshes
from rendra.utils import ico_sphere
from rendra_lab.networks.voxel_head import VoxelHead, central_tetrahedra, cubified
from rendra_lab.records import TensorRecord
from rendra_lab.settings import Count, Fraction, Size


@dataclass(frozen=True)
class Start(TensorRecord):
    """Where refinement begins."""

    meshes: Meshes
    logits: Float[Tensor, "B V V V"] | None  # of voxels
    is_real: bool  # false: tetrahedra that stand in while voxels are not worth refining yet


class MeshStart(nn.Module, ABC):
    """Feature maps of B pictures to B meshes."""

    @abstractmethod
    def forward(self, maps: Sequence[Tensor], step: int) -> Start:
        """What to refine.

        Args:
            maps: (B, C, H, W) each, fine ones first.
            step: of the fit, counted from 0.
        """


class VoxelStart(MeshStart):
    """The surface of voxels that are probably filled.

    Args:
        head: predicts them.
        threshold: the probability.
        warmup_steps: first steps of a fit, in which voxels are learned alone. An untrained head fills every voxel:
            so large a mesh would only cost time.
        smoothing: of the surface, see `cubified`.
    """

    def __init__(
        self, head: VoxelHead, threshold: Fraction = 0.2, warmup_steps: Count = 100, smoothing: Count = 0
    ) -> None:
        super().__init__()
        self.head = head
        self.threshold = threshold
        self.warmup_steps = warmup_steps
        self.smoothing = smoothing

    def forward(self, maps: Sequence[Tensor], step: int) -> Start:
        """The cubified voxels; tetrahedra in the first steps of a fit."""
        logits = self.head(maps)
        if self.training and step < self.warmup_steps:
            return Start(central_tetrahedra(len(logits), like=logits), logits, is_real=False)
        return Start(cubified(logits, self.threshold, self.smoothing)[0], logits, is_real=True)


class SphereStart(MeshStart):
    """The same ball in front of every camera.

    Args:
        level: how often the icosahedron is subdivided: 2 gives 162 vertices, 4 gives 2562.
        radius: in the frame of the frustum, whose half width is 1.
    """

    def __init__(self, level: Count = 4, radius: Size = 0.5) -> None:
        super().__init__()
        ball = ico_sphere(level)
        self.register_buffer("verts", ball.verts_packed() * radius, persistent=False)
        self.register_buffer("faces", ball.faces_packed(), persistent=False)

    def forward(self, maps: Sequence[Tensor], step: int) -> Start:
        """Spheres, whatever the maps show."""
        count = len(maps[0])
        parts = (self.get_buffer(name).expand(count, -1, -1) for name in ("verts", "faces"))
        return Start(Meshes(*parts), None, is_real=True)
