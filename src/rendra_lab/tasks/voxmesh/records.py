"""What VoxMesh answers; what it is given is `rendra_lab.shape_records.ShapeBatch`."""

from __future__ import annotations

from dataclasses import dataclass

from rendra.structures import Meshes
from rendra_lab.detection.records import CellVerdicts, MeshVerdicts
from rendra_lab.records import TensorRecord


@dataclass(frozen=True)
class ShapePrediction(TensorRecord):
    """One mesh for each of B pictures, in the axes of its camera; in training also what losses ask for."""

    meshes: Meshes  # of the last stage
    starts: Meshes  # what the first stage began with: the surface of voxels, or spheres
    voxels: CellVerdicts | None = None  # (B, V, V, V) over the frustum of the picture: in training, if there are any
    refined: MeshVerdicts | None = None  # all stages: in training, if there are any
