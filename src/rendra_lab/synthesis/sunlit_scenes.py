"""Textured triangles under sun and sky, seen by a camera: pictures and depth.

World: x right, y down, z forwards, metres, as the axes of a camera that looks straight ahead; solids come with y up
and are turned over here. Colours of textures and tints are square roots of reflectances, pictures of light.
Letters: F triangles, S samples of a picture, H x W pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.renderer import MeshRasterizer, OrthographicCameras, PerspectiveCameras, RasterizationSettings
from rendra.structures import Meshes
from rendra_lab.synthesis.painted_faces import PaintedFaces
from rendra_lab.synthesis.ripmaps import Ripmaps

_SAMPLES = 2  # of a pixel along each side
_NEAREST_M = 0.2
_SEAM = 1e-10  # squared NDC by which triangles overlap: a ray on the edge of two would hit neither
_MAP_SIDE = 768  # of the shadow map, texels
_BIAS_M = 0.12  # how much nearer the sun something must be to throw a shadow
_OPENCV_TO_RENDRA = torch.tensor([-1.0, -1.0, 1.0])
_CONTACT_M = 0.9  # height below which walls get less light from the sky
_SKY_WIDTH, _SKY_TOP = (
    2.4,
    0.8,
)  # the range of slopes x / z, and the highest -y / z, that the picture of the sky spans


@dataclass(frozen=True)
class Daylight:
    """Light of a place.

    Attributes:
        to_sun: unit vector with y up.
        sun: colour of direct light; black: the sky is overcast, and there are no shadows.
        sky: colour of light from above.
        ground: colour of light from below.
        haze: colour of the air far away.
        haze_m: distance at which two thirds of what is seen are air.
        dome: (3, h, w) picture of the sky, the horizon at its lower edge.
    """

    to_sun: tuple[float, float, float]
    sun: tuple[float, float, float]
    sky: tuple[float, float, float]
    ground: tuple[float, float, float]
    haze: tuple[float, float, float]
    haze_m: float
    dome: Tensor


@dataclass(frozen=True)
class ContactShade:
    """How much of the sky the ground sees, on a grid; beyond it all of it."""

    share: npt.NDArray[np.float32]  # (rows along z, columns along x), 1: all
    low: tuple[float, float]  # x and z of the grid's corner
    cell: float  # metres


class SunlitScene:
    """A place ready for its pictures.

    Args:
        faces: of everything.
        textures: (T, H, W, 4): colour, and how much of it the tint multiplies.
        daylight: of the place.
        contact: on the ground.
        shaded: lowest and highest x, and lowest and highest z, within which there are shadows.
    """

    def __init__(
        self,
        faces: PaintedFaces,
        textures: Tensor,
        daylight: Daylight,
        contact: ContactShade,
        shaded: tuple[float, float, float, float] = (-18.0, 18.0, -8.0, 75.0),
    ) -> None:
        turned = _upright_to_camera(faces)
        self.verts = torch.from_numpy(turned.corners).reshape(-1, 3)
        self.faces = torch.arange(len(self.verts)).reshape(-1, 3)
        self.table = _face_table(turned)
        self.texture = torch.from_numpy(turned.texture)
        self.ripmaps = Ripmaps(textures)
        self.daylight = daylight
        self.contact = torch.from_numpy(contact.share)[None, None]
        self.contact_frame = (contact.low, contact.cell)
        sun = torch.tensor(daylight.to_sun)
        self.to_sun = sun * torch.tensor([1.0, -1.0, 1.0])
        self.shadows = _ShadowMap(self._mesh(), self.to_sun, shaded) if max(daylight.sun) > 0 else None

    def take(self, intrinsics: Tensor, world_to_camera: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """One picture.

        Args:
            intrinsics: (3, 3) pixels, without skew.
            world_to_camera: (4, 4).
            size: H and W.

        Returns:
            sRGB (3, H, W) uint8, and z (1, H, W) at the middles of the pixels, inf where only sky is seen.
        """
        _, depth = self._hits(intrinsics, world_to_camera, size)
        finer = torch.diag(torch.tensor([_SAMPLES, _SAMPLES, 1.0])) @ intrinsics
        fine_size = (size[0] * _SAMPLES, size[1] * _SAMPLES)
        face, z = self._hits(finer, world_to_camera, fine_size)
        rays = _rays(finer, fine_size)
        world_rays = rays @ world_to_camera[:3, :3]  # rows by the transposed inverse
        picture = self._sky(world_rays)
        seen = (face >= 0).nonzero()[:, 0]
        if len(seen):
            some_rays, some_z = world_rays.index_select(0, seen), z.index_select(0, seen)
            centre = -world_to_camera[:3, :3].T @ world_to_camera[:3, 3]
            pitch = torch.stack([1 / finer[0, 0], 1 / finer[1, 1]])
            axes = world_to_camera[:2, :3]  # of the picture, in the world
            light = self._shade(face.index_select(0, seen), centre + some_rays * some_z[:, None], some_rays, some_z,
                                axes * pitch[:, None])  # fmt: skip
            picture.index_copy_(0, seen, light)
        shrunk = F.avg_pool2d(picture.T.reshape(1, 3, *fine_size), _SAMPLES)[0]
        rgb = (shrunk.clamp(0, 1).sqrt() * 255).round().to(torch.uint8)
        return rgb, depth.reshape(1, *size)

    def _mesh(self) -> Meshes:
        return Meshes([self.verts], [self.faces])

    def _hits(self, intrinsics: Tensor, world_to_camera: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """What each pixel sees: triangles (H * W,), -1 for none, and z (H * W,), inf for none."""
        camera = PerspectiveCameras(
            focal_length=torch.stack([intrinsics[0, 0], intrinsics[1, 1]])[None],
            principal_point=intrinsics[:2, 2][None],
            R=(world_to_camera[:3, :3].T * _OPENCV_TO_RENDRA)[None],
            T=(world_to_camera[:3, 3] * _OPENCV_TO_RENDRA)[None],
            image_size=(size,),
            in_ndc=False,
        )
        settings = RasterizationSettings(size, blur_radius=_SEAM, z_clip_value=_NEAREST_M, cull_to_frustum=True)
        fragments = MeshRasterizer(camera, settings)(self._mesh())
        face, z = fragments.pix_to_face.flatten(), fragments.zbuf.flatten()
        return face, torch.where(face >= 0, z, torch.inf)

    def _shade(self, face: Tensor, place: Tensor, ray: Tensor, z: Tensor, steps: Tensor) -> Tensor:
        """Light (S, 3) that comes from triangles.

        Args:
            face: (S,) int64.
            place: (S, 3) where they are hit.
            ray: (S, 3) towards them, 1 along the camera's axis.
            z: (S,).
            steps: (2, 3) by how much a ray differs from that of the next sample, across and down.
        """
        row = self.table.index_select(0, face)
        plane, lit, tint = row[:, 0:3], row[:, 3:6], row[:, 6:9]
        along_u, along_v = row[:, 9:12], row[:, 12:15]
        uv = torch.stack([(along_u * place).sum(1), (along_v * place).sum(1)], 1) + row[:, 15:17]
        towards = (plane * ray).sum(1)  # negative: its front is seen
        steep = torch.where(towards.abs() < 1e-4, 1e-4, towards)
        footprint = torch.zeros_like(uv)
        for step in steps:
            moved = z[:, None] * (step - ray * ((plane @ step) / steep)[:, None])
            reach = torch.stack([(along_u * moved).sum(1), (along_v * moved).sum(1)], 1).abs()
            footprint = torch.maximum(footprint, reach)
        texel = self.ripmaps.sample(self.texture.index_select(0, face), uv, footprint)
        color = texel[:, :3] * torch.lerp(torch.ones_like(tint), tint, texel[:, 3:])
        normal = torch.where(towards[:, None] > 0, -lit, lit)
        return self._through_air(color.square() * self._light(place, normal), z)

    def _light(self, place: Tensor, normal: Tensor) -> Tensor:
        """What falls on surfaces: (S, 3)."""
        day = self.daylight
        up = (0.5 - 0.5 * normal[:, 1:2]).clamp(0, 1)
        around = torch.lerp(torch.tensor(day.ground), torch.tensor(day.sky), up)
        light = around * self._openness(place, normal)[:, None]
        if self.shadows is not None:
            facing = (normal @ self.to_sun).clamp_min(0)
            light = light + torch.tensor(day.sun) * (facing * self.shadows.lit(place, normal))[:, None]
        return light

    def _openness(self, place: Tensor, normal: Tensor) -> Tensor:
        """The share (S,) of the sky that nothing near hides: less of it at the foot of walls and beside cars."""
        (x, z), cell = self.contact_frame
        rows, columns = self.contact.shape[-2:]
        grid = torch.stack([(place[:, 0] - x) / (columns * cell), (place[:, 2] - z) / (rows * cell)], -1) * 2 - 1
        on_ground = F.grid_sample(
            self.contact, grid[None, None], padding_mode="border", align_corners=False
        ).flatten()
        height = (-place[:, 1] / _CONTACT_M).clamp(0, 1)
        on_wall = 0.62 + 0.38 * height.sqrt()
        is_ground = (normal[:, 1] < -0.9) & (place[:, 1] > -0.25)
        return torch.where(is_ground, on_ground, on_wall)

    def _through_air(self, light: Tensor, z: Tensor) -> Tensor:
        air = 1 - torch.exp(-z / self.daylight.haze_m)
        return torch.lerp(light, torch.tensor(self.daylight.haze).expand_as(light), air[:, None])

    def _sky(self, rays: Tensor) -> Tensor:
        """Light (S, 3) of the sky in directions of the world."""
        forwards = rays[:, 2].clamp_min(1e-3)
        across, up = rays[:, 0] / forwards, -rays[:, 1] / forwards
        grid = torch.stack([across / _SKY_WIDTH, 1 - 2 * up / _SKY_TOP], -1)[None, None]
        seen = F.grid_sample(self.daylight.dome[None], grid, padding_mode="border", align_corners=False)
        return seen[0, :, 0].T.contiguous()


class _ShadowMap:
    """Which surface is nearest to the sun, over a rectangle of ground."""

    def __init__(self, mesh: Meshes, to_sun: Tensor, shaded: tuple[float, float, float, float]) -> None:
        forward = -to_sun / to_sun.norm()
        sideways = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), forward)
        sideways = sideways / sideways.norm()
        self.axes = torch.stack([sideways, torch.linalg.cross(forward, sideways), forward])  # rows
        x0, x1, z0, z1 = shaded
        corners = torch.cartesian_prod(torch.tensor([x0, x1]), torch.tensor([-14.0, 0.0]), torch.tensor([z0, z1]))
        flat = corners @ self.axes.T
        low, high = flat.amin(0), flat.amax(0)
        self.scale = 2 / (high - low)[:2]
        self.middle = (high + low)[:2] / 2
        self.shaded = shaded
        camera = OrthographicCameras(
            focal_length=self.scale[None],
            principal_point=(-self.middle * self.scale)[None],
            R=self.axes.T[None],
            T=torch.tensor([[0.0, 0.0, 500.0]]),
        )
        settings = RasterizationSettings(image_size=_MAP_SIDE, cull_to_frustum=True)
        z = MeshRasterizer(camera, settings)(mesh).zbuf.flatten()
        self.depth = torch.where(z >= 0, z, torch.inf)

    def lit(self, place: Tensor, normal: Tensor) -> Tensor:
        """1 where the sun shines on places (S, 3), 0 in shadow: (S,)."""
        there = (place + 0.05 * normal) @ self.axes.T
        ndc = (there[:, :2] - self.middle) * self.scale
        inside = (ndc.abs() < 1).all(1)
        # columns and rows of pictures count against the axes of NDC
        column, row = (((1 - ndc) / 2 * _MAP_SIDE).long().clamp(0, _MAP_SIDE - 1)).unbind(1)
        nearest = self.depth.index_select(0, row * _MAP_SIDE + column)
        return torch.where(inside & (there[:, 2] + 500.0 > nearest + _BIAS_M), 0.0, 1.0)


def _upright_to_camera(faces: PaintedFaces) -> PaintedFaces:
    """With y down, and without triangles that have no area."""
    over = np.array([1, -1, 1], np.float32)
    corners = faces.corners * over
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    keep = area > 1e-7
    return PaintedFaces(
        np.ascontiguousarray(corners[keep]), faces.uv[keep], faces.texture[keep], faces.tint[keep],
        faces.light_normal[keep] * over,
    )  # fmt: skip


def _face_table(faces: PaintedFaces) -> Tensor:
    """What shading needs of each triangle: (F, 17).

    The unit normal, that by which light falls on it (on the same side), the tint, how u and v grow per metre of the
    world, and both at the world's origin.
    """
    corners, uv = torch.from_numpy(faces.corners).double(), torch.from_numpy(faces.uv).double()
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = torch.linalg.cross(first, second)
    along_first, along_second = torch.linalg.cross(second, normal), torch.linalg.cross(normal, first)
    area = normal.square().sum(1, keepdim=True)
    grown = uv[:, 1:] - uv[:, :1]  # (F, 2, 2): edge, u or v
    per_metre = [(along_first * grown[:, :1, i] + along_second * grown[:, 1:, i]) / area for i in (0, 1)]
    at_origin = torch.stack([uv[:, 0, i] - (per_metre[i] * corners[:, 0]).sum(1) for i in (0, 1)], 1)
    unit = F.normalize(normal, dim=1)
    lit = torch.from_numpy(faces.light_normal).double()
    unit = torch.where(((unit * lit).sum(1) < 0)[:, None], -unit, unit)
    lit = torch.where((lit == 0).all(1, keepdim=True), unit, F.normalize(lit, dim=1))
    tint = torch.from_numpy(faces.tint).double()
    return torch.cat([unit, lit, tint, *per_metre, at_origin], 1).float()


def _rays(intrinsics: Tensor, size: tuple[int, int]) -> Tensor:
    """Directions (H * W, 3) through the middles of pixels, of z 1, in the camera's axes."""
    y = (torch.arange(size[0]) + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1]
    x = (torch.arange(size[1]) + 0.5 - intrinsics[0, 2]) / intrinsics[0, 0]
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([columns, rows, torch.ones_like(rows)], -1).reshape(-1, 3)
