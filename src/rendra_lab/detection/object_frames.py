"""Between the frames of boxes, in which objects are rebuilt, and the camera that saw them.

How deep an object reaches is told relative to its box: e = (far - near) / c * f / h with c = (near + far) / 2, the
focal length f and the height h of the box in pixels: the depth that as many pixels would span at c, in heights of
the box. A picture scaled, or a world scaled, leaves it alone; and so a picture cannot say what c is: whoever knows
gives it (Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 4.2).

Letters: N frustums, M found objects. Axes, pixels and boxes: as of `rendra_lab.detection.records`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from rendra.structures import Meshes
from rendra_lab.detection.records import Detections
from rendra_lab.frustums import Frustums

# (far - near) / (far + near): what is flatter gets this much depth, and of what reaches nearer to the camera, or
# behind it, the nearest part is left out
_LEAST_SHARE, _MOST_SHARE = 1e-3, 0.9


def depth_ranges(verts: Sequence[Float[Tensor, "_ 3"]]) -> Float[Tensor, "N 2"]:
    """Nearest and farthest z of N objects in a camera's axes, fit for frustums: above 0 and apart.

    Args:
        verts: of each, at least one, the farthest in front of the camera.
    """
    if not verts:
        return torch.zeros(0, 2)
    near, far = torch.stack([torch.stack(each[:, 2].aminmax()) for each in verts]).unbind(1)
    share = ((far - near) / (far + near).clamp_min(1e-12)).clamp(_LEAST_SHARE, _MOST_SHARE)
    return torch.stack([far * (1 - share) / (1 + share), far], dim=1)


def depth_extents(frustums: Frustums) -> Float[Tensor, " N"]:
    """How deep frustums are over how high their boxes are, seen from their middle: e above."""
    near, far = frustums.depth_range.unbind(1)
    return 2 * (far - near) / (far + near) * frustums.intrinsics[:, 1, 1] / _heights(frustums.boxes)


def frustums_of(
    extents: Float[Tensor, " N"],
    boxes: Float[Tensor, "N 4"],
    intrinsics: Float[Tensor, "N 3 3"],
    center_depths: Float[Tensor, " N"],
) -> Frustums:
    """The inverse of `depth_extents`, for objects whose middles are known to lie at c: c +- c e h / (2 f)."""
    share = (extents * _heights(boxes) / (2 * intrinsics[:, 1, 1])).clamp(_LEAST_SHARE, _MOST_SHARE)
    return Frustums(boxes, torch.stack([center_depths * (1 - share), center_depths * (1 + share)], 1), intrinsics)


def meshes_in_camera(meshes: Meshes, frustums: Frustums) -> Meshes:
    """N meshes in the frames of N frustums, taken to the axes of the cameras.

    What lies behind its frustum comes to lie at most twice as far as its farthest depth: where the frame's z' goes
    on, there soon is no depth that it could stand for.
    """
    near, far = frustums.depth_range.unbind(1)
    last = 2 * (1 / near - 0.5 / far) / (1 / near - 1 / far) - 1
    verts = meshes.verts_padded()
    if not verts.numel():
        return meshes
    kept = torch.cat([verts[..., :2], verts[..., 2:].minimum(last[:, None, None])], dim=-1)
    return meshes.update_padded(frustums.to_camera(kept))


def rebuilt_in_camera(
    detections: Detections, intrinsics: Float[Tensor, "B 3 3"], center_depths: Float[Tensor, " M"]
) -> Meshes:
    """The meshes of found objects in the axes of their cameras.

    Args:
        detections: with meshes and depth extents.
        intrinsics: of the pictures.
        center_depths: (nearest z + farthest z) / 2 of each object, from whoever knows: all else about it, its size
            too, follows.

    Raises:
        ValueError: detections without meshes.
    """
    if detections.meshes is None or detections.depth_extents is None:
        raise ValueError("these detections have no meshes: they come from a detector without heads for shapes")
    lenses = intrinsics.index_select(0, detections.picture)
    return meshes_in_camera(
        detections.meshes, frustums_of(detections.depth_extents, detections.boxes, lenses, center_depths)
    )


def _heights(boxes: Tensor) -> Tensor:
    return (boxes[:, 3] - boxes[:, 1]).clamp_min(1e-3)
