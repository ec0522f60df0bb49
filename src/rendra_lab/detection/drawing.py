"""Pictures of found objects: boxes, masks and names on a photograph, meshes in front of it and from other sides.

Meshes are in the axes of the photograph's camera: x right, y down, z forwards.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, cast

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from torch.nn import functional as F

from rendra.renderer.materials import Materials
from rendra.renderer.mesh.rasterizer import MeshRasterizer, RasterizationSettings
from rendra.renderer.mesh.shader import HardPhongShader, SoftSilhouetteShader
from rendra.renderer.mesh.textures import TexturesVertex
from rendra.structures import Meshes, join_meshes_as_scene
from rendra.utils import cameras_from_opencv_projection
from rendra_lab.detection.mask_pasting import pasted_masks
from rendra_lab.detection.records import Detections, PhotoBatch
from rendra_lab.pictures import Headlight, OrbitCamera, Shading, Studio
from rendra_lab.visualization import Picture, to_picture

Color = tuple[float, float, float]  # sRGB in [0, 1]

SIDES = {
    "as photographed": OrbitCamera(elev=5, azim=0, fov=30),
    "from the left": OrbitCamera(elev=20, azim=-65, fov=30),
    "from the right": OrbitCamera(elev=20, azim=65, fov=30),
    "from behind": OrbitCamera(elev=20, azim=150, fov=30),
}
_GOLDEN = 0.618034  # hues that are this far apart never come close to each other
_TINT = 0.45  # of a mask over its picture
_MATTE = Materials(specular_color=((0.15, 0.15, 0.15),))
_ASIDE_PX = 0.0137  # middles of pixels that lie on edges of voxels would belong to neither of their sides
_SEAM = 1e-10  # squared, in half sides of the picture: far below a pixel
_SHARP_SIGMA = 1e-6  # a silhouette with edges of about a pixel


def color_of(number: int) -> Color:
    """A colour for each number from 0: the first dozen are easily told apart."""
    return colorsys.hsv_to_rgb((0.58 + _GOLDEN * number) % 1, 0.75, 0.92)


def draw_objects(
    picture: Picture,
    boxes: Tensor,
    captions: Sequence[str],
    masks: Tensor | None = None,
    colors: Sequence[Color] | None = None,
) -> Picture:
    """A picture with boxes, names and tinted masks.

    Args:
        picture: (H, W, 3).
        boxes: (M, 4), x0, y0, x1, y1 in pixels.
        captions: of each box.
        masks: (M, H, W) bool, or none.
        colors: of each box; None: `color_of` its number.
    """
    height, width = picture.shape[:2]
    colors = [color_of(number) for number in range(len(boxes))] if colors is None else colors
    page = _tinted(picture, masks, colors)
    canvas = ImageDraw.Draw(page)
    thick = max(1, round(min(height, width) / 240))
    size = max(9, round(min(height, width) / 28))
    for box, text, color in reversed(list(zip(boxes.tolist(), captions, colors, strict=True))):
        ink = _bytes(color)
        corners = zip(box, 2 * (width, height), strict=True)
        left, top, right, bottom = (min(max(edge, 0), most) for edge, most in corners)
        canvas.rectangle((left, top, max(right - 1, left), max(bottom - 1, top)), outline=ink, width=thick)
        _write(canvas, (left, top), text, ink, size, width)
    return np.asarray(page)


def panels_of(batch: PhotoBatch, found: Detections, least_score: float = 0.5) -> dict[str, Tensor]:
    """Pictures of a batch with what was found, and with what is annotated: (B, H, W, 3) each, sRGB in [0, 1].

    Args:
        batch: pictures and annotations.
        found: in them.
        least_score: what is less sure is not drawn.
    """
    height, width = batch.rgb.shape[2:]
    sure = (found.scores >= least_score).nonzero()[:, 0]
    boxes, masks = found.boxes[sure], None
    if found.masks is not None:
        masks = pasted_masks(found.masks[sure], boxes, height, width)
    captions = [
        f"{label}: {score:.2f}"
        for label, score in zip(found.labels[sure].tolist(), found.scores[sure].tolist(), strict=True)
    ]
    true = batch.instances
    names = [str(label) for label in true.labels.tolist()]
    return {
        "found": _drawn_on(batch.rgb, found.picture[sure], boxes, captions, masks),
        "annotated": _drawn_on(batch.rgb, true.picture, true.boxes, names, true.masks),
    }


def _drawn_on(rgb: Tensor, picture: Tensor, boxes: Tensor, captions: Sequence[str], masks: Tensor | None) -> Tensor:
    pages = []
    for number, page in enumerate(rgb):
        rows = (picture == number).nonzero()[:, 0]
        texts = [captions[row] for row in rows.tolist()]
        own = None if masks is None else masks[rows]
        pages.append(draw_objects(to_picture(page.movedim(0, -1)), boxes[rows], texts, own))
    return torch.from_numpy(np.stack(pages)).to(rgb) / 255


def upright(meshes: Meshes) -> Meshes:
    """Meshes in axes x right, y up, z towards the viewer, as glTF has them and viewers expect."""
    turn = meshes.verts_packed().new_tensor([1.0, -1.0, -1.0])
    return Meshes([verts * turn for verts in meshes.verts_list()], meshes.faces_list(), meshes.textures)


def painted(mesh: Meshes, color: Color) -> Meshes:
    """A batch of one in one colour."""
    verts = mesh.verts_packed()
    return Meshes([verts], [mesh.faces_packed()], TexturesVertex([verts.new_tensor(color).expand(len(verts), 3)]))


def phong_view(mesh: Meshes, camera: OrbitCamera, color: Color, size: int = 256) -> Picture:
    """A lit view of a mesh (a batch of one, in the photograph's camera) on white; azimuth 0 is the photographer's."""
    studio = Studio(camera, Headlight(), _MATTE, Shading(HardPhongShader()), (size, size))
    return to_picture(studio.render(painted(upright(mesh), color)))


def silhouette_view(mesh: Meshes, camera: OrbitCamera, size: int = 256) -> Picture:
    """The outline of a mesh, white on black, from where `phong_view` sees it."""
    shading = Shading(SoftSilhouetteShader(), sigma=_SHARP_SIGMA, faces_per_pixel=8, shows="alpha")
    studio = Studio(camera, Headlight(), _MATTE, shading, (size, size))
    return to_picture(studio.render(painted(upright(mesh), (1.0, 1.0, 1.0)))[..., :3])


@torch.no_grad()
def draw_meshes(
    picture: Picture, meshes: Meshes, intrinsics: Tensor, colors: Sequence[Color] | None = None
) -> Picture:
    """Meshes in front of the photograph, where its camera sees them, lit from beside it.

    Args:
        picture: (H, W, 3).
        meshes: M, in the camera's axes, in front of it.
        intrinsics: (3, 3), pixels.
        colors: of each mesh; None: `color_of` its number.
    """
    if not len(meshes.faces_packed()):
        return picture
    colors = [color_of(number) for number in range(len(meshes))] if colors is None else colors
    scene = join_meshes_as_scene([painted(meshes[i], color) for i, color in enumerate(colors)])
    image, cover = _seen(scene, intrinsics, picture.shape[:2])
    behind = torch.from_numpy(np.array(picture)).to(image) / 255
    return to_picture(image * cover + behind * (1 - cover))


def _seen(scene: Meshes, intrinsics: Tensor, size: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Colour (H, W, 3) and coverage (H, W, 1) of a scene in the camera's axes, antialiased."""
    fine = 2
    height, width = (fine * side for side in size)
    lens = intrinsics.to(scene.verts_packed()).clone()
    lens[:2] *= fine
    lens[:2, 2] += _ASIDE_PX
    cameras = cameras_from_opencv_projection(
        torch.eye(3)[None].to(lens), torch.zeros(1, 3).to(lens), lens[None],
        torch.tensor([[height, width]], device=lens.device),
    )  # fmt: skip
    # without any blur the middle of a pixel that lies on an edge belongs to neither of its faces
    settings = RasterizationSettings(image_size=(height, width), blur_radius=_SEAM, cull_to_frustum=False)
    rasterizer = MeshRasterizer(cameras, settings)
    fragments = rasterizer(scene)
    lights = Headlight().lights(cast(Any, cameras))
    shaded = HardPhongShader(cameras=cameras, lights=lights, materials=_MATTE.to(scene.device))(fragments, scene)
    cover = (fragments.pix_to_face[0, ..., :1] >= 0).to(shaded)
    planes = torch.cat([shaded[0, ..., :3].clamp(0, 1) * cover, cover], dim=-1).permute(2, 0, 1)
    means = F.avg_pool2d(planes, fine).permute(1, 2, 0)
    return means[..., :3] / means[..., 3:].clamp_min(1e-6), means[..., 3:]


def _tinted(picture: Picture, masks: Tensor | None, colors: Sequence[Color]) -> Image.Image:
    """The picture under its masks; those of the first objects lie on top."""
    if masks is None:
        return Image.fromarray(picture)
    page = picture.astype(np.float32)
    for mask, color in reversed(list(zip(masks.cpu().numpy(), colors, strict=True))):
        page[mask] = (1 - _TINT) * picture[mask] + _TINT * 255 * np.asarray(color, np.float32)
    return Image.fromarray(page.round().astype(np.uint8))


def _write(
    canvas: ImageDraw.ImageDraw, corner: tuple[float, float], text: str, ink: tuple[int, ...], size: int, width: int
) -> None:
    """A line of text on a plate above the corner, or below it where the picture ends."""
    font = _font(size)
    left, top, right, bottom = font.getbbox(text)
    x = max(0, min(corner[0], width - (right - left) - 4))
    y = corner[1] - (bottom - top) - 5
    y = corner[1] if y < 0 else y
    canvas.rectangle((x, y, x + right - left + 4, y + bottom - top + 4), fill=ink)
    canvas.text((x + 2 - left, y + 2 - top), text, fill=(255, 255, 255), font=font)


def _bytes(color: Color) -> tuple[int, ...]:
    return tuple(round(255 * value) for value in color)


@lru_cache
def _font(size: int) -> Any:
    return ImageFont.load_default(size=size)
