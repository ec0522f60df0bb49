"""Depth, voxels and mesh of what lies behind the boxes of a detector.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 3.1 and 4.2.
Letters: B pictures, R regions, M found objects, V voxels along each side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rendra.structures import Meshes
from rendra_lab.detection.records import CellVerdicts, DepthVerdicts, Detections, MeshVerdicts, PhotoBatch
from rendra_lab.detection.roi_align import RoiAlign
from rendra_lab.networks.mesh_refinement import MeshRefinement
from rendra_lab.networks.voxel_head import VoxelHead, central_tetrahedra, cubified
from rendra_lab.settings import Fraction, Positive
from rendra_lab.tasks.mesh_rcnn.depth_head import DepthHead, extents_of
from rendra_lab.tasks.mesh_rcnn.shape_targets import ShapeTargets, shape_targets, shapes_of

Maps = Sequence[Float[Tensor, "B D _ _"]]


@dataclass(frozen=True)
class ShapeVerdicts:
    """What the heads said of regions with objects, and what they should have."""

    depths: DepthVerdicts
    voxels: CellVerdicts
    meshes: MeshVerdicts


class ShapeHeads(nn.Module):
    """Three heads that share the features of a detector, each with regions of its own size.

    Meshes begin as the surface of the voxels, through which no gradient goes, and are refined in the frame of their
    region: x and y of a vertex are where it is seen.

    Args:
        depth_pool, voxel_pool, mesh_pool: cut the regions of the heads; voxels have twice the cells of theirs.
        depth: tells depth extents.
        voxels: tells voxels, of any class.
        meshes: refines meshes.
        threshold: probability above which a voxel is filled.
        points: of each true surface that a step learns from.
        most_regions: of a step that learn, drawn at random; None: all that hold objects.
    """

    def __init__(
        self,
        depth_pool: RoiAlign,
        depth: DepthHead,
        voxel_pool: RoiAlign,
        voxels: VoxelHead,
        mesh_pool: RoiAlign,
        meshes: MeshRefinement,
        threshold: Fraction = 0.2,
        points: Positive = 5000,
        most_regions: Positive | None = None,
    ) -> None:
        super().__init__()
        self.depth_pool, self.depth = depth_pool, depth
        self.voxel_pool, self.voxels = voxel_pool, voxels
        self.mesh_pool, self.meshes = mesh_pool, meshes
        self.threshold = threshold
        self.points = points
        self.most_regions = most_regions

    def learn(
        self, maps: Maps, boxes: Float[Tensor, "R 4"], objects: Int[Tensor, " R"], batch: PhotoBatch
    ) -> ShapeVerdicts:
        """What the heads say of regions with objects, beside the truth.

        Args:
            maps: features of the pictures.
            boxes: of the regions.
            objects: which of the annotated objects lies in each.
            batch: the pictures and their objects.

        Raises:
            UserError: objects without shapes.
        """
        drawn = torch.randperm(len(boxes), device=boxes.device)[: self.most_regions]
        boxes, objects = boxes[drawn], objects[drawn]
        picture, labels = (
            each.index_select(0, objects) for each in (batch.instances.picture, batch.instances.labels)
        )
        truth = self._truth(boxes, objects, picture, batch)
        logits = self._voxels(maps, boxes, picture)
        return ShapeVerdicts(
            DepthVerdicts(self._depths(maps, boxes, picture, labels), truth.log_extents),
            CellVerdicts(logits, truth.voxels.to(logits)),
            self._learn_meshes(maps, boxes, picture, logits, truth),
        )

    def rebuild(self, maps: Maps, found: Detections) -> Detections:
        """Found objects with depth extents, voxels and meshes; those without a voxel begin as a cube."""
        logits = self._voxels(maps, found.boxes, found.picture)
        meshes = Meshes([], []).to(found.boxes.device)
        if len(found.boxes):
            first, _ = cubified(logits, self.threshold)
            meshes = self.meshes(first, [self.mesh_pool(maps, found.boxes, found.picture)])[-1]
        extents = extents_of(self._depths(maps, found.boxes, found.picture, found.labels))
        return replace(found, depth_extents=extents, voxels=torch.sigmoid(logits), meshes=meshes)

    def _truth(self, boxes: Tensor, objects: Tensor, picture: Tensor, batch: PhotoBatch) -> ShapeTargets:
        side = self.voxels.side
        if not len(boxes):
            none, points = boxes.new_zeros(0), boxes.new_zeros(0, 0, 3)
            is_any = torch.zeros(0, side, side, side, dtype=torch.bool, device=boxes.device)
            return ShapeTargets(none, is_any, points, points, is_any[:, 0, 0, 0])
        lenses = batch.intrinsics.index_select(0, picture)
        return shape_targets(shapes_of(batch), boxes, objects, lenses, side, self.points)

    def _depths(self, maps: Maps, boxes: Tensor, picture: Tensor, labels: Tensor) -> Tensor:
        return self.depth(self.depth_pool(maps, boxes, picture), labels)

    def _voxels(self, maps: Maps, boxes: Tensor, picture: Tensor) -> Tensor:
        return self.voxels(self.voxel_pool(maps, boxes, picture))

    def _learn_meshes(
        self, maps: Maps, boxes: Tensor, picture: Tensor, logits: Tensor, truth: ShapeTargets
    ) -> MeshVerdicts:
        if not len(
            boxes
        ):  # something to refine all the same: several processes wait for the gradient of every weight
            cells = maps[0].new_zeros(1, maps[0].shape[1], self.mesh_pool.side, self.mesh_pool.side)
            nothing = maps[0].new_zeros(1, 1, 3)
            is_valid = torch.zeros(1, dtype=torch.bool, device=boxes.device)
            stages = self.meshes(central_tetrahedra(1, cells), [cells])
            return MeshVerdicts(stages, nothing, nothing, is_valid)
        first, is_found = cubified(logits, self.threshold)
        stages = self.meshes(first, [self.mesh_pool(maps, boxes, picture)])
        return MeshVerdicts(stages, truth.points, truth.normals, is_found & truth.is_near)
