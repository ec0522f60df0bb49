"""A sheet of pictures of a mesh or point cloud file: views from all sides, texture maps, and its faults in red."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.renderer.materials import Materials
from rendra.renderer.mesh.rasterizer import MeshRasterizer, RasterizationSettings
from rendra.renderer.mesh.shader import HardFlatShader, HardPhongShader
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesUV, TexturesVertex
from rendra.structures import Meshes, Pointclouds
from rendra.vis import texturesuv_islands_image
from rendra_lab.data.meshes import bounding_sphere, load_mesh
from rendra_lab.mesh_asset import Asset, Material
from rendra_lab.mesh_quality import nearest_distances
from rendra_lab.mesh_report import Findings
from rendra_lab.pictures import Headlight, OrbitCamera, Shading, Studio, point_marks
from rendra_lab.visualization import Picture, caption, tile, to_picture

_SIDES = {
    "front, from +z": OrbitCamera(elev=8, azim=0),
    "right, from +x": OrbitCamera(elev=8, azim=90),
    "back, from -z": OrbitCamera(elev=8, azim=180),
    "left, from -x": OrbitCamera(elev=8, azim=270),
    "top, from +y": OrbitCamera(elev=90, azim=0),
    "bottom, from -y": OrbitCamera(elev=-90, azim=0),
}
_CORNERS = [OrbitCamera(elev=elev, azim=azim) for elev in (30, -30) for azim in (45, 135, 225, 315)]
_GREY, _PALE, _RED = (0.74, 0.76, 0.8), (1.0, 0.7, 0.7), (0.9, 0.05, 0.05)
_SCOUT_PX = 160  # pictures from which the best view of a fault is chosen
_DEPTH_SLACK = 0.01  # of the radius, by which a line may lie behind the surface that it belongs to
_MOST_MARKS = 4_000_000  # pixels that the lines of one picture set
_MOST_POINTS = 20_000  # of a cloud that are drawn
_MOST_MAPS = 6
_MATTE = Materials(specular_color=((0.0, 0.0, 0.0),))


class NothingToSeeError(ValueError):
    """No picture can show what is in a file."""


@torch.no_grad()
def draw_sheet(asset: Asset, findings: Findings | None, size: int = 320) -> Picture:
    """Everything that there is to see of a file.

    Args:
        asset: the file.
        findings: where the faults of a mesh are.
        size: of one picture in pixels.

    Returns:
        uint8 (H, W, 3), captioned pictures in rows of three.

    Raises:
        NothingToSeeError: there is no finite point, or all are in one place.
    """
    return tile(list(_pictures(asset, findings, size)), columns=3)


def _pictures(asset: Asset, findings: Findings | None, size: int) -> Iterator[Picture]:
    shown = _dressed(asset) if asset.cloud is None else cloud_as_mesh(asset.cloud)
    if not len(shown.faces_packed()) or not bounding_sphere(shown)[1] > 0:
        raise NothingToSeeError(f"{asset.path.name} has no extent, so there is nothing to draw")
    shading = Shading(HardPhongShader())
    for name, camera in _SIDES.items():
        image = Studio(camera, Headlight(), _MATTE, shading, (size, size)).render(shown)
        yield caption(to_picture(image[..., :3]), name)
    yield from _maps(asset, size)
    if findings is not None:
        yield from _faults(findings, size)


def _dressed(asset: Asset) -> Meshes:
    """The mesh with its own colours, or grey."""
    assert asset.mesh is not None
    mesh = asset.mesh
    if asset.path.suffix.lower() == ".obj":  # which may have several materials
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the report has them already
            mesh = load_mesh(path=asset.path)
    mesh = _tucked(mesh)
    white = isinstance(mesh.textures, TexturesVertex) and bool((mesh.textures.verts_features_packed() == 1).all())
    if mesh.textures is None or white:
        mesh.textures = TexturesVertex([torch.tensor(_GREY).expand(len(mesh.verts_packed()), 3)])
    return mesh


def _tucked(mesh: Meshes) -> Meshes:
    """The mesh without what must not decide where the camera stands: vertices that no face uses, or not finite."""
    verts, faces = mesh.verts_packed(), mesh.faces_packed()
    finite = verts.isfinite().all(1)
    used = torch.zeros_like(finite)
    used[faces[finite[faces].all(1)].reshape(-1)] = True
    place = verts[used][:1] if used.any() else verts.new_zeros(1, 3)
    return mesh.update_padded(torch.where((used & finite)[:, None], verts, place)[None])


def cloud_as_mesh(cloud: Pointclouds, most: int = _MOST_POINTS) -> Meshes:
    """A small octahedron for each point, in its colour if it has one, else by height.

    Args:
        cloud: a batch of one.
        most: of larger clouds as many points are taken, evenly chosen. Points that are not finite are left out.
    """
    points, _, features = cloud.get_cloud(0)
    chosen = points.isfinite().all(1).nonzero()[:, 0]
    if len(chosen) > most:
        chosen = chosen[torch.arange(most, device=points.device) * len(chosen) // most]
    points = points[chosen].float()
    if features is not None and features.shape[1] in (3, 4):
        colors = features[chosen, :3].float().clamp(0, 1)
    else:
        colors = _by_height(points)
    return point_marks(points, _radius(points), colors)


def _radius(points: Tensor) -> float:
    """Of a point's mark: it fills some of the gap to its neighbour, and is never too small to be seen."""
    if len(points) < 2:
        return 1.0
    low, high = points.aminmax(dim=0)
    diagonal = float((high - low).norm())
    spacing = float(nearest_distances(points).median())
    return min(max(0.4 * spacing, 0.003 * diagonal), 0.01 * diagonal) or 1.0


def _by_height(points: Tensor) -> Tensor:
    """Blue below, yellow above. (P, 3)"""
    if not len(points):
        return points
    low, high = points[:, 1].aminmax()
    height = ((points[:, 1] - low) / (high - low).clamp_min(1e-12))[:, None]
    below, above = points.new_tensor([0.12, 0.3, 0.6]), points.new_tensor([0.95, 0.75, 0.2])
    return below + height * (above - below)


def _maps(asset: Asset, size: int) -> Iterator[Picture]:
    """The texture maps with the islands that the faces cut out of them; a blank one where there is no image."""
    if asset.uvs is None or asset.faces_uvs is None:
        return
    with_image = [material for material in asset.materials if material.image is not None]
    for material in (with_image or [Material("no image", image=torch.ones(size, size, 3))])[:_MOST_MAPS]:
        assert material.image is not None
        faces = asset.faces_uvs if material.faces is None else asset.faces_uvs[material.faces]
        texture = TexturesUV([material.image.cpu()], [faces.cpu()], [asset.uvs.cpu()])
        picture = np.asarray(texturesuv_islands_image(texture, size=size))
        yield caption(_padded(picture, size), f"texture map {material.name}".rstrip())


def _padded(picture: Picture, size: int) -> Picture:
    sheet = np.full((size, size, 3), 255, np.uint8)
    sheet[: picture.shape[0], : picture.shape[1]] = picture[:size, :size]
    return sheet


@dataclass(frozen=True)
class _Fault:
    """One kind of fault of a mesh.

    Attributes:
        name: what the caption says.
        edges: lines to draw, pairs of vertices (K, 2).
        faces: faces to paint, (F,) bool; None for none.
    """

    name: str
    edges: Tensor
    faces: Tensor | None


def _faults(findings: Findings, size: int) -> Iterator[Picture]:
    """One picture for each kind of fault, from where the most of it is seen."""
    mesh = _tucked(findings.mesh)
    faults = [_Fault(f"{name}: {len(edges):,} edges", edges, None) for name, edges in findings.edges.items()]
    faults += [_face_fault(mesh, name, chosen) for name, chosen in findings.faces.items()]
    faults = [fault for fault in faults if len(fault.edges)]
    if not faults:
        return
    scouts = [_Lens(mesh, camera, _SCOUT_PX) for camera in (*_SIDES.values(), *_CORNERS)]
    for fault in faults:
        seen = [int(_marks(mesh, scout, fault)[0].sum()) for scout in scouts]
        yield caption(_fault_picture(mesh, scouts[int(np.argmax(seen))].camera, fault, size), fault.name)


def _face_fault(mesh: Meshes, name: str, chosen: Tensor) -> _Fault:
    sides = mesh.faces_packed()[chosen][:, [[0, 1], [1, 2], [2, 0]]].flatten(0, 1)
    noun = "" if name.endswith("faces") else " faces"
    return _Fault(f"{name}: {int(chosen.sum()):,}{noun}", torch.unique(sides.sort(dim=1).values, dim=0), chosen)


class _Lens:
    """A view of a mesh, and how far each of its pixels sees.

    Attributes:
        camera: from where.
        cameras: the same for this mesh.
        size: pixels of the square picture.
        reach: view depth of what is seen in each pixel or next to it, infinite where that is nothing. (size, size)
    """

    def __init__(self, mesh: Meshes, camera: OrbitCamera, size: int) -> None:
        self.camera, self.cameras, self.size = camera, camera.cameras(mesh), size
        depth = MeshRasterizer(self.cameras, RasterizationSettings(image_size=size))(mesh).zbuf[0, ..., 0]
        depth = depth.masked_fill(depth < 0, torch.inf)
        self.reach = F.max_pool2d(depth[None], 3, 1, 1)[0] + _DEPTH_SLACK * bounding_sphere(mesh)[1]

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Column and row (P, 2) of points (P, 3), and how deep in the view they lie (P,)."""
        where = self.cameras.transform_points_screen(points, image_size=((self.size, self.size),))[:, :2]
        depth = self.cameras.get_world_to_view_transform().transform_points(points)[:, 2]
        return where.floor().long().clamp(0, self.size - 1), depth


def _marks(mesh: Meshes, lens: _Lens, fault: _Fault) -> tuple[Tensor, Tensor]:
    """Pixels on the lines of a fault that are in sight, and those that lie behind something. (H, W), (H, W) bool"""
    ends = mesh.verts_packed()[fault.edges]  # (K, 2, 3)
    pixels = lens.project(ends.flatten(0, 1))[0].view(-1, 2, 2)
    steps = (pixels[:, 1] - pixels[:, 0]).abs().amax(1) + 1
    every = -(-int(steps.sum()) // _MOST_MARKS)
    ends, steps = ends[::every], steps[::every]
    line = torch.arange(len(steps), device=steps.device).repeat_interleave(steps)
    number = torch.arange(len(line), device=steps.device) - (steps.cumsum(0) - steps)[line]
    along = (number / (steps[line] - 1).clamp_min(1))[:, None]
    where, depth = lens.project(torch.lerp(ends[line, 0], ends[line, 1], along))
    column, row = where.unbind(1)
    in_sight = depth <= lens.reach[row, column]
    visible, hidden = torch.zeros(2, lens.size, lens.size, dtype=torch.bool, device=mesh.device)
    visible[row[in_sight], column[in_sight]] = True
    hidden[row[~in_sight], column[~in_sight]] = True
    return visible, hidden


def _fault_picture(mesh: Meshes, camera: OrbitCamera, fault: _Fault, size: int) -> Picture:
    """Grey, with the faces and lines of a fault in red, lines behind something in pale red."""
    colors = torch.tensor(_GREY, device=mesh.device).repeat(len(mesh.faces_packed()), 1)
    red = colors.new_tensor(_RED)
    if fault.faces is not None:
        colors[fault.faces] = red
    painted = Meshes([mesh.verts_packed()], [mesh.faces_packed()], TexturesAtlas([colors[:, None, None]]))
    studio = Studio(camera, Headlight(), _MATTE, Shading(HardFlatShader()), (size, size))
    visible, hidden = _marks(mesh, _Lens(mesh, camera, size), fault)
    thick = F.max_pool2d(visible[None].float(), 3, 1, 1)[0] > 0
    image = torch.where(hidden[..., None], red.new_tensor(_PALE), studio.render(painted)[..., :3])
    return to_picture(torch.where(thick[..., None], red, image))
