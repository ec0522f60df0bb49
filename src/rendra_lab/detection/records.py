"""What detectors are given and what they answer.

Letters: B pictures, H x W pixels, N annotated objects and M found ones of all pictures together, C classes.
Pictures are sRGB in [0, 1]. Pixels: x right, y down, the middle of the first pixel at 0.5. Boxes are x0, y0, x1, y1
in pixels, edges and not indices: a box about the first pixel alone is 0, 0, 1, 1.
Cameras: as of `rendra_lab.shape_records`.
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from rendra.structures import Meshes
from rendra_lab.records import TensorRecord
from rendra_lab.shape_records import Shapes


@dataclass(frozen=True)
class Instances(TensorRecord):
    """All annotated objects of a batch of pictures, those of the first picture first."""

    picture: Int[Tensor, " N"]  # in which picture of the batch
    boxes: Float[Tensor, "N 4"]  # about what is seen of it
    labels: Int[Tensor, " N"]  # class, from 0
    masks: Bool[Tensor, "N H W"]  # what is seen of it
    shapes: Shapes | None = None  # in the axes of its picture's camera


@dataclass(frozen=True)
class PhotoBatch(TensorRecord):
    """Pictures with what stands in them. Smaller pictures are filled up at the right and the bottom."""

    rgb: Float[Tensor, "B 3 H W"]
    sizes: Int[Tensor, "B 2"]  # height and width of each picture without what was filled up
    intrinsics: Float[Tensor, "B 3 3"]  # pixels
    instances: Instances
    picture_ids: list[str]  # for tables, pictures and complaints


@dataclass(frozen=True)
class Detections(TensorRecord):
    """All objects that were found in a batch of pictures, those of the first picture first, the surest first."""

    picture: Int[Tensor, " M"]
    boxes: Float[Tensor, "M 4"]
    labels: Int[Tensor, " M"]
    scores: Float[Tensor, " M"]  # in (0, 1]
    masks: Float[Tensor, "M S S"] | None = None  # probability over the box, S x S cells
    # of Mesh R-CNN:
    depth_extents: Float[Tensor, " M"] | None = (
        None  # of the object along z, over the height of its box (see frustums)
    )
    voxels: Float[Tensor, "M V V V"] | None = None  # probability, [z, y, x] over the frustum of the box
    meshes: Meshes | None = None  # one of each, in the frame of its box: `rendra_lab.frustums`


@dataclass(frozen=True)
class AnchorVerdicts(TensorRecord):
    """What the region proposals said of the anchors that were drawn for training, and what they should have."""

    logits: Float[Tensor, " A"]
    labels: Float[Tensor, " A"]  # 1 object, 0 background
    deltas: Float[Tensor, "P 4"]  # of anchors with label 1
    target_deltas: Float[Tensor, "P 4"]


@dataclass(frozen=True)
class BoxVerdicts(TensorRecord):
    """What the box head said of the regions that were drawn for training; class C is the background."""

    logits: Float[Tensor, "R C1"]
    labels: Int[Tensor, " R"]
    deltas: Float[Tensor, "F 4"]  # of regions with an object, those of its class
    target_deltas: Float[Tensor, "F 4"]


@dataclass(frozen=True)
class CellVerdicts(TensorRecord):
    """Logits and truth of masks (F, S, S) or voxels (F, V, V, V) of regions with an object, of its class."""

    logits: Float[Tensor, "F ..."]
    targets: Float[Tensor, "F ..."]


@dataclass(frozen=True)
class DepthVerdicts(TensorRecord):
    """Logarithms of depth extents over box heights, of regions with an object, of its class."""

    values: Float[Tensor, " F"]
    targets: Float[Tensor, " F"]


@dataclass(frozen=True)
class MeshVerdicts(TensorRecord):
    """Meshes of all stages of refinement, and points of the true surfaces, in one frame."""

    stages: tuple[Meshes, ...]  # F meshes each
    points: Float[Tensor, "F P 3"]
    normals: Float[Tensor, "F P 3"]
    is_valid: Bool[Tensor, " F"]  # a mesh that stands in for an empty one teaches nothing


@dataclass(frozen=True)
class DetectorPrediction(TensorRecord):
    """In training verdicts for the losses and no detections; in evaluation detections alone."""

    detections: Detections | None = None
    anchors: AnchorVerdicts | None = None
    boxes: BoxVerdicts | None = None
    masks: CellVerdicts | None = None
    depths: DepthVerdicts | None = None
    voxels: CellVerdicts | None = None
    meshes: MeshVerdicts | None = None
