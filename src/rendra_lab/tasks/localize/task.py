"""The displacement of a depth camera that sees several known meshes.

One displacement moves the points of all meshes; the chamfer distance (Fan et al., "A point set generation network",
CVPR 2017) says how far they are from what is seen, without knowing which point is which. Far from the solution it is
nearly a paraboloid about the truth, so that plain gradient steps reach it from anywhere, in any unit of length.
Shapes: N meshes of different sizes, S samples of each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rendra.ops import sample_points_from_meshes
from rendra.structures import Meshes
from rendra_lab.base_task import Task
from rendra_lab.records import TensorRecord
from rendra_lab.tasks.localize.data import SightBatch
from rendra_lab.tasks.localize.views import picture


@dataclass(frozen=True)
class DisplacementPrediction(TensorRecord):
    """The known meshes where the estimate puts them."""

    samples: Float[Tensor, "N S 3"]  # uniform over the displaced surfaces
    displacement: Float[Tensor, "1 3"]


class Localize(Task[SightBatch, DisplacementPrediction]):
    """Fit one displacement to a batch of meshes.

    Args:
        start: the displacement to begin with.
        **parts: losses, metrics, optimizer, scheduler of `Task`.
    """

    def __init__(self, start: Sequence[float] = (0.0, 0.0, 0.0), **parts: Any) -> None:
        super().__init__(**parts)
        if len(start) != 3 or not all(isinstance(each, int | float) and math.isfinite(each) for each in start):
            raise ValueError(f"module.start must be three numbers such as [0,0,0], got {list(start)}")
        self.displacement = nn.Parameter(torch.tensor([[float(each) for each in start]]))

    def predict(self, batch: SightBatch) -> DisplacementPrediction:
        """Points on the known meshes, displaced; as many of each as are seen."""
        samples = sample_points_from_meshes(batch.known, batch.points.shape[1])
        return DisplacementPrediction(samples + self.displacement, self.displacement)

    def panels(self, prediction: DisplacementPrediction, batch: SightBatch) -> dict[str, Tensor]:
        """Each mesh where the estimate puts it, among the points that were seen of it."""
        return {
            name: picture(points, batch.seen[index], batch.known[index], prediction.displacement[0])
            for index, (name, points) in enumerate(zip(batch.titles, batch.points, strict=True))
        }

    def meshes(self, prediction: DisplacementPrediction, batch: SightBatch) -> dict[str, Meshes]:
        """The known meshes at their estimated places."""
        moved = batch.known.offset_verts(prediction.displacement[0])
        return {name: moved[index] for index, name in enumerate(batch.titles)}

    def facts(self, prediction: DisplacementPrediction, batch: SightBatch) -> dict[str, Any]:
        """The displacement, for other programs: `displacement.json`."""
        estimate, truth = prediction.displacement[0], batch.displacement[0]
        error = float((estimate - truth).norm())
        return {"displacement": {"estimate": estimate.tolist(), "truth": truth.tolist(), "error": error}}
