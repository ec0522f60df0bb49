"""What the heads for shapes should have said of a region: the object behind it, in the region's own frame.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 4.2. The frame of a region is the
frustum between its box and the true depths of its object: `rendra_lab.frustums`.
Letters: B pictures, N objects, R regions, V voxels along each side, P points.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rendra_lab.detection.object_frames import depth_extents, depth_ranges
from rendra_lab.detection.records import PhotoBatch
from rendra_lab.errors import UserError
from rendra_lab.frustums import Frustums
from rendra_lab.records import TensorRecord
from rendra_lab.shape_records import Shapes

_FARTHEST = 5.0  # an object of which some part lies so far out of its region teaches no mesh (published)


@dataclass(frozen=True)
class ShapeTargets(TensorRecord):
    """The truth about R regions, in their own frames."""

    log_extents: Float[Tensor, " R"]
    voxels: Bool[Tensor, "R V V V"]
    points: Float[Tensor, "R P 3"]
    normals: Float[Tensor, "R P 3"]
    is_near: Bool[Tensor, " R"]  # no point lies farther than 5 from the middle along any axis; else points are zeros


def shapes_of(batch: PhotoBatch) -> Shapes:
    """The annotated shapes of a batch.

    Raises:
        UserError: there are objects, and none has a shape.
    """
    shapes = batch.instances.shapes
    if shapes is None:
        raise UserError(
            f"the picture {batch.picture_ids[0]!r} and those beside it have objects without shapes, which "
            "task=mesh_rcnn learns from: task=mask_rcnn does without"
        )
    return shapes


def shape_targets(
    shapes: Shapes,
    boxes: Float[Tensor, "R 4"],
    objects: Int[Tensor, " R"],
    intrinsics: Float[Tensor, "R 3 3"],
    side: int,
    points: int,
) -> ShapeTargets:
    """The objects behind regions, as their heads should see them.

    Args:
        shapes: of all objects.
        boxes: of the regions.
        objects: which of the shapes lies behind each region.
        intrinsics: of the camera of each region's picture.
        side: V.
        points: how many of each object are drawn, at random; all where it has fewer.
    """
    depths = depth_ranges(shapes.verts).to(boxes).index_select(0, objects)
    frames = Frustums(boxes, depths, intrinsics)
    drawn = torch.randperm(shapes.points.shape[1], device=boxes.device)[:points]
    chosen = _chosen(shapes, objects)
    seen, outwards = chosen.points[:, drawn], chosen.normals[:, drawn]
    own = frames.from_camera(seen)
    is_near = (own.abs() <= _FARTHEST).all(-1).all(-1)
    return ShapeTargets(
        depth_extents(frames).log(),
        frames.voxels_of(chosen, side),
        torch.where(is_near[:, None, None], own, 0.0),
        frames.turned_from_camera(seen, outwards),
        is_near,
    )


def _chosen(shapes: Shapes, index: Tensor) -> Shapes:
    numbers = index.tolist()
    return Shapes(
        points=shapes.points.index_select(0, index),
        normals=shapes.normals.index_select(0, index),
        voxels=shapes.voxels.index_select(0, index),
        voxels_to_camera=shapes.voxels_to_camera.index_select(0, index),
        verts=tuple(shapes.verts[number] for number in numbers),
        faces=tuple(shapes.faces[number] for number in numbers),
    )
