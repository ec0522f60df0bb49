"""Objects in front of a camera, as the tasks that rebuild them know the truth.

Letters: N objects, P points, V voxels along each side.
Cameras look along +z, x right, y down (OpenCV's axes). Metres, where anybody knows. Pixels: x right, y down, the
middle of the first pixel at 0.5. Pictures are sRGB in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from rendra_lab.records import TensorRecord


@dataclass(frozen=True)
class Shapes(TensorRecord):
    """Surfaces and insides of N objects in the axes of the cameras that see them.

    Grids are indexed [z, y, x] over the cube [-1, 1]^3 of the object's own axes; voxel i of V is the interval
    [-1 + 2 i / V, -1 + 2 (i + 1) / V].
    """

    points: Float[Tensor, "N P 3"]  # uniform on the surface, hidden parts too
    normals: Float[Tensor, "N P 3"]  # of them, outwards, of length 1
    voxels: Bool[Tensor, "N V V V"]  # filled where the object is
    voxels_to_camera: Float[Tensor, "N 4 4"]  # columns: a point (x, y, z, 1) of the cube to the camera's axes
    verts: tuple[Float[Tensor, "_ 3"], ...]  # N meshes
    faces: tuple[Int[Tensor, "_ 3"], ...]


@dataclass(frozen=True)
class ShapeBatch(TensorRecord):
    """Pictures of one object each, and the object: what `task=voxmesh` learns from."""

    rgb: Float[Tensor, "B 3 H W"]
    intrinsics: Float[Tensor, "B 3 3"]  # pixels
    depth_range: Float[Tensor, "B 2"]  # nearest and farthest z of where an object may be: the same for all objects
    labels: Int[Tensor, " B"]  # class of each
    shapes: Shapes
    shape_ids: list[str]  # which model it is of: splits keep models apart
