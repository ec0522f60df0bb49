"""VoxMesh: one picture of one object to a mesh of all of its sides, learned from shapes.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 4.1 (the ShapeNet experiments).
Shapes, axes and units: as of `ShapeBatch`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rendra.structures import Meshes
from rendra_lab.base_task import Task
from rendra_lab.detection.records import CellVerdicts, MeshVerdicts
from rendra_lab.frustums import Frustums
from rendra_lab.networks.mesh_refinement import MeshRefinement
from rendra_lab.settings import Positive
from rendra_lab.shape_records import ShapeBatch
from rendra_lab.tasks.voxmesh.records import ShapePrediction
from rendra_lab.tasks.voxmesh.starts import MeshStart, Start

_FARTHEST = 2.0  # of positions that graph convolutions are told, in half widths of the picture


class VoxMesh(Task[ShapeBatch, ShapePrediction]):
    """Voxels of the frustum behind a picture, their surface, and stages that refine it in the camera's axes.

    Args:
        backbone: pictures (B, 3, H, W) in [0, 1] to maps (B, C, h, w), fine ones first.
        start: what refinement begins with.
        refinement: reads all maps; None: the start is the answer.
        side_px: the shorter side that pictures are resized to; None keeps theirs.
        **parts: losses, metrics, optimizer, scheduler of `Task`.
    """

    def __init__(
        self,
        backbone: nn.Module,
        start: MeshStart,
        refinement: MeshRefinement | None,
        side_px: Positive | None = None,
        **parts: Any,
    ) -> None:
        super().__init__(**parts)
        self.backbone = backbone
        self.start = start
        self.refinement = refinement
        self.side_px = side_px

    def predict(self, batch: ShapeBatch) -> ShapePrediction:
        """The meshes; in training also voxels and meshes of all stages beside the truth."""
        frustums = whole_frustums(batch)
        maps = self.backbone(self._resized(batch.rgb))
        start = self.start(maps, self.global_step)
        starts = start.meshes.update_padded(frustums.to_camera(start.meshes.verts_padded()))
        stages = self._refined(starts, maps, frustums)
        return ShapePrediction(
            meshes=stages[-1] if stages else starts,
            starts=starts,
            voxels=self._voxels(start, frustums, batch) if self.training else None,
            refined=self._beside_truth(stages, start, batch) if self.training else None,
        )

    def panels(self, prediction: ShapePrediction, batch: ShapeBatch) -> dict[str, Tensor]:
        """The pictures, and the meshes as the cameras see them."""
        return {"input": batch.rgb.movedim(1, -1)}

    def meshes(self, prediction: ShapePrediction, batch: ShapeBatch) -> dict[str, Meshes]:
        """The first mesh, and the truth, in the camera's axes."""
        truth = Meshes([batch.shapes.verts[0]], [batch.shapes.faces[0]])
        return {"mesh": prediction.meshes[0], "start": prediction.starts[0], "truth": truth}

    def _resized(self, pictures: Tensor) -> Tensor:
        shorter = min(pictures.shape[-2:])
        if self.side_px is None or shorter == self.side_px:
            return pictures
        size = [round(side * self.side_px / shorter) for side in pictures.shape[-2:]]
        return F.interpolate(pictures, size, mode="bilinear", antialias=True)

    def _refined(self, starts: Meshes, maps: Sequence[Tensor], frustums: Frustums) -> tuple[Meshes, ...]:
        if self.refinement is None:
            return ()
        # near the plane of the camera projected positions have no bounds
        return self.refinement(starts, maps, lambda verts: frustums.from_camera(verts).clamp(-_FARTHEST, _FARTHEST))

    def _voxels(self, start: Start, frustums: Frustums, batch: ShapeBatch) -> CellVerdicts | None:
        if start.logits is None:
            return None
        truth = frustums.voxels_of(batch.shapes, start.logits.shape[-1])
        return CellVerdicts(start.logits, truth.to(start.logits))

    def _beside_truth(self, stages: tuple[Meshes, ...], start: Start, batch: ShapeBatch) -> MeshVerdicts | None:
        if not stages:
            return None
        is_valid = torch.full_like(batch.labels, start.is_real, dtype=torch.bool)
        return MeshVerdicts(stages, batch.shapes.points, batch.shapes.normals, is_valid)


def whole_frustums(batch: ShapeBatch) -> Frustums:
    """What the cameras see between the nearest and the farthest depth of their data."""
    height, width = batch.rgb.shape[-2:]
    box = batch.intrinsics.new_tensor([0.0, 0.0, width, height])
    return Frustums(box.expand(len(batch.rgb), 4), batch.depth_range, batch.intrinsics)
