"""VoxMesh: one picture of one object to a mesh of all of its sides, learned from shapes.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 4.1 (the ShapeNet experiments).
Shapes, axes and units: as of `ShapeBatch`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rendra.structures import Meshes
from rendra_lab.base_task import Task, with_rate
from rendra_lab.detection.drawing import draw_meshes, upright
from rendra_lab.detection.records import CellVerdicts, MeshVerdicts
from rendra_lab.frustums import Frustums
from rendra_lab.mesh_scores import true_meshes
from rendra_lab.networks.mesh_refinement import MeshRefinement
from rendra_lab.settings import Positive, Size
from rendra_lab.shape_records import ShapeBatch
from rendra_lab.tasks.voxmesh.records import ShapePrediction
from rendra_lab.tasks.voxmesh.starts import MeshStart, Start
from rendra_lab.visualization import to_picture

_FARTHEST = 2.0  # of positions that graph convolutions are told, in half widths of the picture
_SHOWN = 4  # pictures of a batch in its panels


class VoxMesh(Task[ShapeBatch, ShapePrediction]):
    """Voxels of the frustum behind a picture, their surface, and stages that refine it in the camera's axes.

    Args:
        backbone: pictures (B, 3, H, W) in [0, 1] to maps (B, C, h, w), fine ones first.
        start: what refinement begins with.
        refinement: reads all maps; None: the start is the answer.
        side_px: the shorter side that pictures are resized to; None keeps theirs.
        backbone_lr: learning rate of the backbone, which may have learned elsewhere; None: the optimizer's.
        **parts: losses, metrics, optimizer, scheduler of `Task`.
    """

    def __init__(
        self,
        backbone: nn.Module,
        start: MeshStart,
        refinement: MeshRefinement | None,
        side_px: Positive | None = None,
        backbone_lr: Size | None = None,
        **parts: Any,
    ) -> None:
        super().__init__(**parts)
        self.backbone = backbone
        self.start = start
        self.refinement = refinement
        self.side_px = side_px
        self.backbone_lr = backbone_lr

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
        """The first pictures, and what their cameras would see of the meshes and of the truth."""
        shown = batch.rgb[:_SHOWN].movedim(1, -1)
        pages = {"input": shown, "start": _drawn(prediction.starts, batch, shown)}
        if prediction.starts is not prediction.meshes:
            pages["mesh"] = _drawn(prediction.meshes, batch, shown)
        return {**pages, "truth": _drawn(true_meshes(batch.shapes), batch, shown)}

    def meshes(self, prediction: ShapePrediction, batch: ShapeBatch) -> dict[str, Meshes]:
        """The first mesh, what it began with, and the truth: x right, y up, z towards the camera."""
        truth = true_meshes(batch.shapes)
        named = {"mesh": prediction.meshes, "start": prediction.starts, "truth": truth}
        return {name: upright(each[0]) for name, each in named.items()}

    def parameter_groups(self) -> Iterable[Any]:
        """All that learns; the backbone apart if it has a rate of its own."""
        return with_rate(super().parameter_groups(), self.backbone, self.backbone_lr)

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


def _drawn(meshes: Meshes, batch: ShapeBatch, pages: Tensor) -> Tensor:
    """One mesh of each, on white: as large as the pages (P, H, W, 3)."""
    paper = to_picture(torch.ones_like(pages[0]))
    drawn = [draw_meshes(paper, meshes[i], batch.intrinsics[i]) for i in range(len(pages))]
    return torch.stack([torch.from_numpy(each).to(pages) / 255 for each in drawn])
