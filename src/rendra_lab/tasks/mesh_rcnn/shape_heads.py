"""Depth, voxels and mesh of what lies behind the boxes of a detector.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 3.1 and 4.2.
Letters: B pictures, R regions, M found objects, V voxels along each side.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor, nn

from rendra.structures import Meshes
from rendra_lab.detection.records import CellVerdicts, DepthVerdicts, Detections, MeshVerdicts, PhotoBatch
from rendra_lab.detection.regions import Maps, ObjectRegions
from rendra_lab.detection.roi_align import RoiAlign
from rendra_lab.networks.mesh_refinement import MeshRefinement
from rendra_lab.networks.voxel_head import VoxelHead, central_tetrahedra, cubified
from rendra_lab.settings import Count, Fraction, Positive
from rendra_lab.tasks.mesh_rcnn.depth_head import DepthHead, extents_of
from rendra_lab.tasks.mesh_rcnn.shape_targets import ShapeTargets, shape_targets, shapes_of


class ShapeHeads(nn.Module):
    """Three heads that share the features of a detector, each with regions of its own size: a `RegionHead`.

    Meshes begin as the surface of the voxels, through which no gradient goes, and are refined in the frame of their
    region: x and y of a vertex are where it is seen.

    Args:
        depth_pool, voxel_pool, mesh_pool: cut the regions of the heads; voxels have twice the cells of theirs.
        depth: tells depth extents.
        voxels: tells voxels, of any class.
        meshes: refines meshes; None: the surface of the voxels is the answer ("voxel-only").
        threshold: probability above which a voxel is filled.
        smoothing: of the voxels' surface, see `cubified`.
        points: of each true surface that a step learns from.
        most_regions: of a step that learn, drawn at random; None: all that hold objects.
        warmup_steps: first steps, in which meshes do not learn yet: untrained voxels are no surface to refine.
    """

    learned: Tensor  # steps so far; it is in checkpoints

    def __init__(
        self,
        depth_pool: RoiAlign,
        depth: DepthHead,
        voxel_pool: RoiAlign,
        voxels: VoxelHead,
        mesh_pool: RoiAlign,
        meshes: MeshRefinement | None,
        threshold: Fraction = 0.2,
        smoothing: Count = 0,
        points: Positive = 5000,
        most_regions: Positive | None = None,
        warmup_steps: Count = 0,
    ) -> None:
        super().__init__()
        self.depth_pool, self.depth = depth_pool, depth
        self.voxel_pool, self.voxels = voxel_pool, voxels
        self.mesh_pool = mesh_pool
        self.meshes: MeshRefinement | None = meshes
        self.threshold, self.smoothing = threshold, smoothing
        self.points = points
        self.most_regions = most_regions
        self.warmup_steps = warmup_steps
        self.register_buffer("learned", torch.zeros((), dtype=torch.int64))

    def learn(
        self, maps: Maps, regions: ObjectRegions, batch: PhotoBatch
    ) -> Mapping[str, DepthVerdicts | CellVerdicts | MeshVerdicts]:
        """See `RegionHead`: the fields `depths`, `voxels` and `meshes`.

        Raises:
            UserError: objects without shapes.
        """
        regions = self._drawn(regions)
        truth = self._truth(regions, batch)
        logits = self._voxels(maps, regions.boxes, regions.picture)
        depths = self._depths(maps, regions.boxes, regions.picture, regions.labels)
        said: dict[str, DepthVerdicts | CellVerdicts | MeshVerdicts] = {
            "depths": DepthVerdicts(depths, truth.log_extents),
            "voxels": CellVerdicts(logits, truth.voxels.to(logits)),
        }
        if self.meshes is not None:
            is_early = int(self.learned) < self.warmup_steps
            said["meshes"] = self._learn_meshes(self.meshes, maps, regions, logits, truth, is_early)
        self.learned += 1
        return said

    def describe(self, maps: Maps, found: Detections) -> Detections:
        """See `RegionHead`: depth extents, voxels and meshes, which begin as a cube where no voxel is filled."""
        logits = self._voxels(maps, found.boxes, found.picture)
        meshes = Meshes([], []).to(found.boxes.device)
        if len(found.boxes):
            meshes, _ = cubified(logits, self.threshold, self.smoothing)
            if self.meshes is not None:
                meshes = self.meshes(meshes, [self.mesh_pool(maps, found.boxes, found.picture)])[-1]
        extents = extents_of(self._depths(maps, found.boxes, found.picture, found.labels))
        return replace(found, depth_extents=extents, voxels=torch.sigmoid(logits), meshes=meshes)

    def _drawn(self, regions: ObjectRegions) -> ObjectRegions:
        if self.most_regions is None or len(regions.boxes) <= self.most_regions:
            return regions
        kept = torch.randperm(len(regions.boxes), device=regions.boxes.device)[: self.most_regions].sort().values
        return ObjectRegions(regions.picture[kept], regions.boxes[kept], regions.labels[kept], regions.objects[kept])

    def _truth(self, regions: ObjectRegions, batch: PhotoBatch) -> ShapeTargets:
        side, boxes = self.voxels.side, regions.boxes
        if not len(boxes):
            points = boxes.new_zeros(0, 0, 3)
            is_any = torch.zeros(0, side, side, side, dtype=torch.bool, device=boxes.device)
            return ShapeTargets(boxes.new_zeros(0), is_any, points, points, is_any[:, 0, 0, 0])
        lenses = batch.intrinsics.index_select(0, regions.picture)
        return shape_targets(shapes_of(batch), boxes, regions.objects, lenses, side, self.points)

    def _depths(self, maps: Maps, boxes: Tensor, picture: Tensor, labels: Tensor) -> Tensor:
        return self.depth(self.depth_pool(maps, boxes, picture), labels)

    def _voxels(self, maps: Maps, boxes: Tensor, picture: Tensor) -> Tensor:
        return self.voxels(self.voxel_pool(maps, boxes, picture))

    def _learn_meshes(
        self,
        refine: MeshRefinement,
        maps: Maps,
        regions: ObjectRegions,
        logits: Tensor,
        truth: ShapeTargets,
        is_early: bool,
    ) -> MeshVerdicts:
        if is_early or not len(
            regions.boxes
        ):  # something to refine all the same: the gradient of every weight is to be there
            cells = maps[0].new_zeros(1, maps[0].shape[1], self.mesh_pool.side, self.mesh_pool.side)
            nothing = maps[0].new_zeros(1, 1, 3)
            is_valid = torch.zeros(1, dtype=torch.bool, device=cells.device)
            return MeshVerdicts(refine(central_tetrahedra(1, cells), [cells]), nothing, nothing, is_valid)
        first, is_found = cubified(logits, self.threshold, self.smoothing)
        stages = refine(first, [self.mesh_pool(maps, regions.boxes, regions.picture)])
        return MeshVerdicts(stages, truth.points, truth.normals, is_found & truth.is_near)
