"""Pictures of displaced meshes: what was seen, and the known mesh where the estimate puts it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rendra.renderer import HardFlatShader, Materials, TexturesVertex
from rendra.structures import Meshes, join_meshes_as_scene
from rendra_lab.pictures import Headlight, OrbitCamera, Shading, Studio, point_marks

_SEEN, _ESTIMATE = (0.16, 0.42, 0.80), (0.93, 0.62, 0.25)
_SHOWN = 700  # points of a mesh
_MARK = 0.01  # size of a point, in radii of the scene
_FOV_DEG = 40.0
_SIZE = (300, 300)


def picture(points: Tensor, seen: Meshes, known: Meshes, estimate: Tensor) -> Tensor:
    """An image (H, W, 3) of points (S, 3) of a mesh that was seen, and of the known mesh moved by the estimate (3,).

    The camera stands aside of the way from the known mesh to the seen one, and does not follow the estimate.
    """
    points = points[:: -(-len(points) // _SHOWN)]
    moved = known.offset_verts(estimate)
    corners = torch.cat([seen.verts_packed(), known.verts_packed()])
    low, high = corners.amin(0), corners.amax(0)
    radius = float((high - low).norm()) / 2
    scene = [_painted(moved, _ESTIMATE), point_marks(points, _MARK * radius, _SEEN)]
    camera = OrbitCamera(
        dist=max(radius, 1e-6) / math.sin(math.radians(_FOV_DEG / 2)),
        elev=15.0,
        azim=_azimuth_deg(seen.verts_packed().mean(0) - known.verts_packed().mean(0)),
        at=((low + high) / 2).tolist(),
        fov=_FOV_DEG,
    )
    light = Headlight(ambient=0.35, diffuse=0.65, specular=0.0)
    studio = Studio(camera, light, Materials(), Shading(HardFlatShader()), _SIZE)
    return studio.render(join_meshes_as_scene(scene))[..., :3]


def _azimuth_deg(way: Tensor) -> float:
    """Where a camera looks across a way (3,), so that its length is seen."""
    return math.degrees(math.atan2(-float(way[2]), float(way[0]))) if float(way[[0, 2]].norm()) > 0 else 0.0


def _painted(mesh: Meshes, colour: tuple[float, float, float]) -> Meshes:
    verts = mesh.verts_packed()
    return Meshes([verts], [mesh.faces_packed()], TexturesVertex([verts.new_tensor(colour).expand_as(verts)]))
