"""The mesh of a radiance field: its surface, without hollows and floaters, in the field's colours.

The surface is where a share of the light of a ray that meets it head-on is stopped (see `optical_depth`), whether the
density rises to ten or to ten thousand behind it; the share is the one that gives the mesh the outlines of the field.
A level of the density itself would lie outside of it in a dense field, and inside of it in a thin one.

A vertex has the colour of the ray that comes straight at it: the one direction that is known for every point of every
scene, and never a grazing one, where fields are worst. A colour that changes with the viewer keeps only that one.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from rendra.ops import distance_to_surface, marching_cubes, taubin_smoothing
from rendra.renderer import TexturesUV, TexturesVertex
from rendra.structures import Meshes
from rendra_lab.errors import UserError
from rendra_lab.mesh_quality import components
from rendra_lab.networks.radiance import RadianceScene
from rendra_lab.optical_depth import Density, LightFromOutside, density_of, light_from_outside
from rendra_lab.synthesis.atlas import paint, unwrap
from rendra_lab.synthesis.remeshing import collapse_edges

COLORS = ("vertex", "texture", None)
FACES_OF_A_TEXTURED_MESH = 20_000  # charts of more faces are too many for an image
_SPARE = 3  # faces before a decimation for each one after it: enough to choose from, few enough to be quick
_WINDOW = (1.5, -1.0)  # voxels along the normal between which a vertex may settle
_SKIN = 0.025  # of the box, if that is more: how soft the skin of a body may be
_SAMPLES = 10
_SPREAD = 0.75  # voxels: how far the topology looks around; where vertices then settle does not
_GRAIN = 128  # voxels along the longest side, at most, of which that are voxels: finer ones show a field's own grain
_BISECTIONS = 3
_LOOKS = (0.75, 0.0, -0.75, -1.5)  # voxels above a point of the surface where its colour is gathered
_MATTERS = 0.02  # of a ray's light: what is stopped where less is has no visible colour


@torch.no_grad()
def extract_mesh(
    scene: RadianceScene,
    resolution: int = 256,
    level: float | None = None,
    color: str | None = "vertex",
    *,
    keep: float = 0.01,
    smoothing: int = 0,
    num_faces: int | None = None,
    texture_size: int = 1024,
    viewpoints: Tensor | None = None,
) -> Meshes:
    """The surface of a fitted scene as a batch of one closed mesh, faces counter-clockwise seen from outside.

    Args:
        scene: what answers about points.
        resolution: voxels along the longest side of its box; the density is asked for near the surface alone.
        level: share of the light of a head-on ray that is stopped before the surface, in (0, 1). Of a body that a
            straight ray passes with more than (1 - level)^2 of its light, nothing is found. None: the one at which
            the mesh has the outlines of the field (`rendra_lab.optical_depth.silhouette_level`).
        color: `vertex` for colours at the vertices, `texture` for an image of `texture_size` texels a side,
            None for neither.
        keep: components with fewer faces than this share of the largest one's are floaters, and left out;
            1 keeps the largest alone.
        smoothing: Taubin steps afterwards, for noisy fields.
        num_faces: at most so many, long where the surface is flat; None keeps all, but textured meshes get 20,000.
        texture_size: texels along a side.
        viewpoints: (P, 3) places inside the box that are known to be free, such as cameras; a room is then seen
            from within.

    Returns:
        The mesh in the world, on the scene's device; without faces where the field has no surface.

    Raises:
        UserError: a setting that cannot be, or a texture too small for the surface.
    """
    _check(resolution, level, color, keep, num_faces)
    box = scene.box.detach().float()
    spacing = float((box[1] - box[0]).amax()) / resolution
    density = density_of(scene, spacing)
    around = density_of(scene, spacing, spread=_SPREAD * max(1.0, resolution / _GRAIN) * spacing)
    light = light_from_outside(around, box, resolution, None if level is None else 1 - level, viewpoints)
    if num_faces is None and color == "texture":
        num_faces = FACES_OF_A_TEXTURED_MESH
    mesh = _isosurface(light, num_faces)
    if not len(mesh.faces_packed()):
        return mesh
    mesh = _without_floaters(_settle(mesh, density, light), keep)
    if num_faces is not None and len(mesh.faces_packed()) > num_faces:
        mesh = _settle(_decimate(mesh, num_faces), density, light)
    if smoothing:
        mesh = taubin_smoothing(mesh, num_iter=smoothing)
    return paint_mesh(mesh, scene, spacing, color, texture_size)


@torch.no_grad()
def paint_mesh(
    mesh: Meshes, scene: RadianceScene, spacing: float, color: str | None = "vertex", texture_size: int = 1024
) -> Meshes:
    """A mesh (a batch of one with faces, closed for a texture) in the colours that a scene has along its surface.

    Args:
        mesh: near the scene's surface.
        scene: what answers about points.
        spacing: how far mesh and surface may be apart, world units.
        color: as in `extract_mesh`.
        texture_size: texels along a side.

    Raises:
        UserError: a texture too small for the charts of the mesh.
    """
    if color is None:
        return mesh
    if color == "vertex":
        colors = _seen_head_on(scene, mesh.verts_packed(), mesh.verts_normals_packed(), spacing)
        return Meshes(mesh.verts_list(), mesh.faces_list(), TexturesVertex([colors]))
    verts, faces = (part.cpu().numpy() for part in (mesh.verts_packed().double(), mesh.faces_packed()))

    def colour(points: np.ndarray) -> np.ndarray:
        wanted = torch.from_numpy(points).to(mesh.verts_packed())
        return _seen_head_on(scene, wanted, _normals_at(mesh, wanted), spacing).cpu().numpy()

    try:
        atlas = unwrap(verts, faces, texture_size)
    except ValueError as error:
        raise UserError(f"{error}; take a larger texture_size, fewer num_faces, or color=vertex") from error
    image = paint(atlas, verts, faces, texture_size, colour, background=np.full(3, 0.5))
    maps, faces_uvs, uvs = (
        torch.from_numpy(part).to(mesh.device) for part in (image, atlas.faces_uvs, atlas.uvs.astype(np.float32))
    )
    return Meshes(mesh.verts_list(), mesh.faces_list(), TexturesUV([maps], [faces_uvs], [uvs]))


def _check(resolution: int, level: float | None, color: str | None, keep: float, num_faces: int | None) -> None:
    if not 8 <= resolution <= 1024:
        raise UserError(f"resolution is a number of voxels from 8 to 1024, got {resolution!r}")
    if level is not None and not 0 < level < 1:
        raise UserError(f"level is a share of light between 0 and 1, or null, got {level!r}")
    if color not in COLORS:
        raise UserError(f"color must be vertex, texture or null, got {color!r}")
    if not 0 <= keep <= 1:
        raise UserError(f"keep is a share of the largest component, from 0 to 1, got {keep!r}")
    if num_faces is not None and num_faces < 100:
        raise UserError(f"num_faces must be at least 100, or null for all, got {num_faces!r}")


def _isosurface(light: LightFromOutside, num_faces: int | None) -> Meshes:
    """Where the light has the level of the core; of every second, third ... point, where few faces are wanted."""
    lattice, level = light.lattice, light.core
    dark = light.light < level
    if not dark.any():
        return Meshes([lattice.low.new_zeros(0, 3)], [torch.zeros(0, 3, dtype=torch.int64, device=dark.device)])
    spans = [(dark.any(dim=dims).nonzero()) for dims in ((1, 2), (0, 2), (0, 1))]
    first = torch.cat([span[0] for span in spans]) - 1
    last = torch.cat([span[-1] for span in spans]) + 1
    (x0, y0, z0), (x1, y1, z1) = first.tolist(), last.tolist()
    part = light.light[x0 : x1 + 1, y0 : y1 + 1, z0 : z1 + 1]
    step = 1 if num_faces is None else _stride(part < level, num_faces)
    rest = [-(size - 1) % step for size in part.shape]
    part = torch.nn.functional.pad(part, [side for more in reversed(rest) for side in (0, more)], value=1.0)
    volume = part[::step, ::step, ::step].permute(2, 1, 0)[None]
    (verts,), (faces,) = marching_cubes(volume, level, return_local_coords=False)
    verts = lattice.low + (verts * step + first.to(verts)) * lattice.spacing
    return Meshes([verts], [faces])


def _stride(dark: Tensor, num_faces: int) -> int:
    """How many points to go at once so that a surface has about `_SPARE` faces for each that is wanted."""
    sides = sum(int((dark.narrow(d, 1, dark.shape[d] - 1) != dark.narrow(d, 0, dark.shape[d] - 1)).sum())
                for d in range(3))  # fmt: skip
    return max(1, math.floor(math.sqrt(1.3 * sides / (_SPARE * num_faces))))


def _without_floaters(mesh: Meshes, keep: float) -> Meshes:
    """The largest component and those whose faces number at least a share of its."""
    if not len(mesh.faces_packed()):
        return mesh
    labels = components(mesh)
    sizes = torch.bincount(labels)
    large = sizes >= keep * sizes[0]
    if keep == 1:
        large[1:] = False
    faces = mesh.faces_packed()[large[labels]]
    used, faces = faces.unique(return_inverse=True)
    return Meshes([mesh.verts_packed()[used]], [faces])


def _decimate(mesh: Meshes, num_faces: int) -> Meshes:
    verts, faces = mesh.verts_packed(), mesh.faces_packed()
    try:
        fewer = collapse_edges(verts.double().cpu().numpy(), faces.cpu().numpy(), num_faces)
    except ValueError as error:
        raise UserError(f"num_faces: {error}") from error
    few_verts, few_faces = (torch.from_numpy(part).to(verts.device) for part in fewer)
    return Meshes([few_verts.to(verts.dtype)], [few_faces])


def _settle(mesh: Meshes, density: Density, light: LightFromOutside) -> Meshes:
    """The mesh with each vertex moved along its normal to where the light of a ray that comes in has the level.

    A ray begins where it is clearest, so that neither haze nor another part of the body darkens it. A vertex whose
    ray does not reach the level near it stays.
    """
    verts, normals = mesh.verts_packed(), mesh.verts_normals_packed()
    spacing = light.lattice.spacing
    outer = max(_WINDOW[0] * spacing, _SKIN * (max(light.lattice.shape) - 3) * spacing)
    steps = torch.linspace(outer, _WINDOW[1] * spacing, _SAMPLES, device=verts.device)

    def density_along(heights: Tensor) -> Tensor:
        """(V, S) at heights (V, S) above the vertices."""
        points = verts[:, None] + heights[..., None] * normals[:, None]
        return density(points.view(-1, 3)).view(heights.shape)

    heights = steps.expand(len(verts), -1)
    sigma = density_along(heights)
    above = int((steps >= 0).sum())
    clearest = above - 1 - sigma[:, :above].flip(1).argmin(1)
    sigma = torch.where(torch.arange(_SAMPLES, device=verts.device) < clearest[:, None], 0, sigma)
    gained = (sigma[:, 1:] + sigma[:, :-1]) / 2 * (steps[0] - steps[1])
    depth = torch.cat([torch.zeros_like(sigma[:, :1]), gained.cumsum(1)], 1)
    wanted = -math.log(light.level)
    reached = depth >= wanted
    behind = reached.to(torch.int8).argmax(1)
    settles = reached.any(1) & (behind > 0)
    before = (behind - 1).clamp_min(0)[:, None]
    start_height, start_sigma, start_depth = (values.gather(1, before)[:, 0] for values in (heights, sigma, depth))
    height = _crossing(
        density_along, start_height, start_sigma, wanted - start_depth, sigma.gather(1, behind[:, None])[:, 0],
        float(steps[0] - steps[1]),
    )  # fmt: skip
    moved = verts + torch.where(settles, height, torch.zeros_like(height))[:, None] * normals
    return Meshes([moved], mesh.faces_list())


def _crossing(
    density_along: Density, height: Tensor, sigma: Tensor, missing: Tensor, end_sigma: Tensor, length: float
) -> Tensor:
    """The heights (V,) at which rays that go down from `height` gain the depth `missing` within `length`."""
    for _ in range(_BISECTIONS):
        length /= 2
        middle = density_along((height - length)[:, None])[:, 0]
        left = missing - (sigma + middle) / 2 * length
        beyond = left > 0
        height = torch.where(beyond, height - length, height)
        missing = torch.where(beyond, left, missing)
        sigma, end_sigma = torch.where(beyond, middle, sigma), torch.where(beyond, end_sigma, middle)
    gain = (sigma + end_sigma) / 2 * length
    return height - length * (missing / gain.clamp_min(1e-12)).clamp(0, 1)


def _normals_at(mesh: Meshes, points: Tensor) -> Tensor:
    """Unit normals (M, 3), smooth across faces, of a mesh at the places nearest to points (M, 3)."""
    nearest = distance_to_surface(points, mesh)
    corners = mesh.faces_packed().index_select(0, nearest.face).view(-1)
    a, b, c = mesh.verts_packed().index_select(0, corners).view(-1, 3, 3).unbind(1)
    areas = [
        torch.linalg.cross(p - nearest.point, q - nearest.point).norm(dim=1) for p, q in ((b, c), (c, a), (a, b))
    ]
    weights = torch.stack(areas, 1)
    normals = mesh.verts_normals_packed().index_select(0, corners).view(-1, 3, 3)
    return torch.nn.functional.normalize((weights[..., None] * normals).sum(1), dim=1)


def _seen_head_on(scene: RadianceScene, points: Tensor, normals: Tensor, spacing: float) -> Tensor:
    """The colours (M, 3) of rays that come straight at points (M, 3) of the surface."""
    density = density_of(scene, spacing)
    heights = torch.tensor(_LOOKS, device=points.device, dtype=points.dtype) * spacing
    along = points[:, None] + heights[:, None] * normals[:, None]  # (M, 4, 3)
    matter = density(along.view(-1, 3)).view(len(points), -1) * (spacing * (_LOOKS[0] - _LOOKS[1]))
    before = torch.exp(matter - matter.cumsum(1))
    weights = before * -torch.expm1(-matter)
    weights[:, 1] += 1e-6  # where nothing is stopped: the colour of the point itself
    weights = weights / weights.sum(1, keepdim=True)
    weights = torch.where(weights < _MATTERS, torch.zeros_like(weights), weights)
    rows, places = weights.nonzero().unbind(1)
    colors = torch.zeros_like(points)
    for chosen in torch.arange(len(rows), device=points.device).split(1 << 17):
        row = rows[chosen]
        seen = scene.color_at(along[row, places[chosen]], -normals[row]).to(points.dtype).nan_to_num(0.5)
        colors.index_add_(0, row, seen * weights[row, places[chosen], None])
    return (colors / weights.sum(1, keepdim=True)).clamp(0, 1)
