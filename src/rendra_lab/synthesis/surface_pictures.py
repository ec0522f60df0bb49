"""Pictures of places made of triangles whose materials and light are known: what a camera sees, and how far it is.

Axes of cameras are OpenCV's: x right, y down, z forwards. Colours inside are linear, those of pictures sRGB.
Letters: F faces, V views, H x W pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn import functional as F

from rendra.ops import interpolate_face_attributes
from rendra.renderer import MeshRasterizer, PerspectiveCameras, RasterizationSettings
from rendra.structures import Meshes
from rendra_lab.records import TensorRecord
from rendra_lab.synthesis.posed_views import PosedViews
from rendra_lab.synthesis.texture_pyramid import TexturePyramid

GAMMA = 2.2
_SIDE = 2  # samples of a pixel along each of its sides
_NEAREST = 0.02  # metres
_CRACK = 1e-10  # squared NDC: what lies on the edge between two faces belongs to them, not to what is behind
_CONTRAST = 0.2  # how far tones are drawn apart in the middle
_GRAZING = 0.06  # cosines below it are taken for it: surfaces seen so flatly would be one colour


@dataclass(frozen=True)
class LitSurfaces(TensorRecord):
    """Triangles with all that their colour follows from; what they show does not depend on who looks.

    Attributes:
        verts: corners in the world, metres.
        faces: rows of them.
        places: of the corners of faces on their pictures, in sides of the picture.
        light: that reaches the corners of faces, or that they shine with.
        which: the picture of each face.
        tint: linear colour by which it is multiplied.
        scale: sides of the picture a metre.
    """

    verts: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    places: Float[Tensor, "F 3 2"]
    light: Float[Tensor, "F 3 3"]
    which: Int[Tensor, " F"]
    tint: Float[Tensor, "F 3"]
    scale: Float[Tensor, " F"]


@torch.no_grad()
def picture_views(
    surfaces: LitSurfaces,
    pictures: TexturePyramid,
    intrinsics: Float[Tensor, "V 3 3"],
    world_to_camera: Float[Tensor, "V 4 4"],
    size: tuple[int, int],
) -> PosedViews:
    """Pictures and depth of surfaces that fill all that is seen, four samples a pixel.

    Args:
        surfaces: what is there.
        pictures: linear colours of their materials.
        intrinsics: pixels.
        world_to_camera: columns.
        size: H and W.
    """
    mesh = Meshes([surfaces.verts], [surfaces.faces])
    fine = (size[0] * _SIDE, size[1] * _SIDE)
    colors, depths = [], []
    for matrix, pose in zip(intrinsics, world_to_camera, strict=True):
        samples = intrinsics.new_tensor([_SIDE, _SIDE, 1])[:, None] * matrix
        shown = shade(surfaces, pictures, mesh, samples, pose, fine)
        colors.append(to_bytes(F.avg_pool2d(shown[None], _SIDE)[0]))
        depths.append(faces_seen(mesh, matrix, pose, size)[1][None])
    return PosedViews(torch.stack(colors), torch.stack(depths), intrinsics, world_to_camera)


def shade(
    surfaces: LitSurfaces,
    pictures: TexturePyramid,
    mesh: Meshes,
    intrinsics: Float[Tensor, "3 3"],
    pose: Float[Tensor, "4 4"],
    size: tuple[int, int],
) -> Float[Tensor, "3 H W"]:
    """One picture, a sample a pixel, sRGB; black where nothing is.

    Args:
        surfaces: what is there.
        pictures: of their materials.
        mesh: the same surfaces.
        intrinsics: pixels.
        pose: world to camera.
        size: H and W.
    """
    fragments = _rasterizer(intrinsics, pose, size)(mesh)
    corners = torch.cat([surfaces.places, surfaces.light], -1)
    seen = interpolate_face_attributes(fragments.pix_to_face, fragments.bary_coords, corners)[0, :, :, 0].flatten(
        0, 1
    )
    face, z = fragments.pix_to_face.flatten(), fragments.zbuf.flatten()
    hit = (face >= 0).nonzero()[:, 0]
    face, z, seen = face[hit], z[hit], seen.index_select(0, hit)
    extent = _footprint(surfaces, intrinsics, pose, (hit // size[1], hit % size[1]), face, z.clamp_min(_NEAREST))
    albedo = pictures.look_up(surfaces.which[face], seen[:, :2], extent) * surfaces.tint.index_select(0, face)
    picture = albedo.new_zeros(size[0] * size[1], 3)
    picture[hit] = toned(albedo * seen[:, 2:])
    return picture.view(*size, 3).movedim(-1, 0)


def faces_seen(
    mesh: Meshes, intrinsics: Float[Tensor, "3 3"], pose: Float[Tensor, "4 4"], size: tuple[int, int]
) -> tuple[Int[Tensor, "H W"], Float[Tensor, "H W"]]:
    """The face that is seen at the middle of each pixel, -1 for none, and its depth, inf for none.

    Args:
        mesh: one mesh, in the world.
        intrinsics: pixels.
        pose: world to camera.
        size: H and W.
    """
    fragments = _rasterizer(intrinsics, pose, size)(mesh)
    face, z = fragments.pix_to_face[0, ..., 0], fragments.zbuf[0, ..., 0]
    return face, torch.where(face >= 0, z, torch.inf)


def toned(radiance: Tensor) -> Tensor:
    """Colours as a camera shows them: what is too bright fades out instead of ending at white; sRGB in [0, 1]."""
    shown = (1.06 * (1 - torch.exp(-1.35 * radiance))).clamp(0, 1).pow(1 / GAMMA)
    return torch.lerp(shown, shown.square() * (3 - 2 * shown), _CONTRAST)


def to_bytes(picture: Float[Tensor, "3 H W"]) -> UInt8[Tensor, "3 H W"]:
    """The bytes of sRGB in [0, 1]."""
    return (picture.clamp(0, 1) * 255).round().to(torch.uint8)


def _footprint(
    surfaces: LitSurfaces, intrinsics: Tensor, pose: Tensor, pixels: tuple[Tensor, Tensor], face: Tensor, z: Tensor
) -> Tensor:
    """Sides (N,) of the squares that samples at rows and columns cover on their pictures, in sides of the picture.

    A sample at distance t on a surface that the camera stands h above covers (z / f)^2 t / h.
    """
    y, x = ((pixels[axis] + 0.5 - intrinsics[1 - axis, 2]) / intrinsics[1 - axis, 1 - axis] for axis in (0, 1))
    stretch = (1 + x.square() + y.square()).sqrt()  # distance by depth
    eye = -pose[:3, :3].mT @ pose[:3, 3]
    corners = surfaces.verts[surfaces.faces]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    above = ((eye - corners[:, 0]) * normal).sum(1).abs() / normal.norm(dim=1).clamp_min(1e-12)
    cosine = (above[face] / (z * stretch)).clamp(_GRAZING, 1)
    return z / intrinsics[0, 0] * cosine.rsqrt() * surfaces.scale[face]


def _rasterizer(intrinsics: Tensor, pose: Tensor, size: tuple[int, int]) -> MeshRasterizer:
    """Of one camera; rendra's axes are x left, y up."""
    flip = pose.new_tensor([-1.0, -1.0, 1.0])
    cameras = PerspectiveCameras(
        focal_length=torch.stack([intrinsics[0, 0], intrinsics[1, 1]])[None],
        principal_point=intrinsics[:2, 2][None],
        R=(flip[:, None] * pose[:3, :3]).mT[None],
        T=(flip * pose[:3, 3])[None],
        in_ndc=False,
        image_size=[size],
        device=pose.device,
    )
    settings = RasterizationSettings(size, blur_radius=_CRACK, z_clip_value=_NEAREST, cull_to_frustum=True)
    return MeshRasterizer(cameras, settings)
