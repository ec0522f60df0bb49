"""Pictures of one mesh, or of points, for people: orbiting cameras, lights, antialiasing, galleries, turntables.

Images are (H, W, 4) RGBA in [0, 1], alpha not premultiplied.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from PIL import Image, ImageColor
from torch import Tensor, nn
from torch.nn import functional as F

from rendra.renderer.blending import BlendParams
from rendra.renderer.cameras import FoVOrthographicCameras, FoVPerspectiveCameras, look_at_view_transform
from rendra.renderer.lighting import DirectionalLights, PointLights
from rendra.renderer.materials import Materials
from rendra.renderer.mesh.rasterizer import MeshRasterizer, RasterizationSettings
from rendra.renderer.mesh.renderer import MeshRenderer
from rendra.renderer.mesh.textures import TexturesVertex
from rendra.structures.meshes import Meshes
from rendra_lab.data.meshes import bounding_sphere
from rendra_lab.errors import UserError
from rendra_lab.visualization import Picture, caption, save_animation, tile, to_picture

Cameras = FoVPerspectiveCameras | FoVOrthographicCameras

FILE_NAMES = {
    "picture": "render.png",
    "cutout": "render.png",
    "gallery": "gallery.png",
    "gif": "turntable.gif",
    "mp4": "turntable.mp4",
}
_SHOWS = ("color", "alpha", "depth")
_OCTAHEDRON = (
    (0, 1, 2),
    (1, 3, 2),
    (3, 4, 2),
    (4, 0, 2),
    (1, 0, 5),
    (3, 1, 5),
    (4, 3, 5),
    (0, 4, 5),
)  # +x +y +z -x ...
_EDGE_ALPHA = 1e-4  # a soft edge ends where its sigmoid has fallen to this


@dataclass(frozen=True)
class OrbitCamera:
    """A camera on a sphere round a mesh, looking at its middle.

    Attributes:
        dist: from the point looked at; None: as near as the whole mesh fits into the picture.
        elev: degrees above the horizontal plane.
        azim: degrees about the y axis, 0 on the +z side.
        at: the point looked at; None: the middle of the mesh's bounding box.
        fov: degrees across the short side of the picture.
        orthographic: parallel rays instead, with the same scale at the point looked at.
    """

    dist: float | None = None
    elev: float = 15.0
    azim: float = 150.0
    at: Sequence[float] | None = None
    fov: float = 40.0
    orthographic: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.fov < 180:
            raise UserError(f"camera.fov must lie between 0 and 180 degrees, got {self.fov!r}")
        if self.dist is not None and not self.dist > 0:
            raise UserError(f"camera.dist must be positive, or null to fit the mesh; got {self.dist!r}")
        if self.at is not None and len(self.at) != 3:
            raise UserError(f"camera.at must be three numbers, or null for the mesh's middle; got {self.at!r}")

    def cameras(self, mesh: Meshes) -> Cameras:
        """The camera, on the mesh's device, with near and far planes round the mesh."""
        centre, radius = bounding_sphere(mesh)
        target = centre if self.at is None else torch.tensor(self.at, dtype=centre.dtype, device=centre.device)
        reach = float((centre - target).norm()) + max(radius, 1e-6)
        half = np.radians(self.fov) / 2
        dist = 1.03 * reach / float(np.sin(half)) if self.dist is None else float(self.dist)
        R, T = look_at_view_transform(
            dist, self.elev, self.azim, at=target[None], device=mesh.device
        )  # (1, 3, 3), (1, 3)
        znear, zfar = max(dist - 1.1 * reach, 0.01 * dist), dist + 1.1 * reach
        if not self.orthographic:
            return FoVPerspectiveCameras(znear=znear, zfar=zfar, fov=self.fov, R=R, T=T, device=mesh.device)
        side = dist * float(np.tan(half))
        return FoVOrthographicCameras(
            znear=znear, zfar=zfar, max_x=side, min_x=-side, max_y=side, min_y=-side, R=R, T=T, device=mesh.device
        )


@dataclass(frozen=True)
class Headlight:
    """Parallel light that comes with the camera.

    Attributes:
        right, above: how far the light stands aside of the viewer, in parts of the way towards them.
        ambient, diffuse, specular: brightness in [0, 1].
    """

    right: float = 0.35
    above: float = 0.6
    ambient: float = 0.58
    diffuse: float = 0.47
    specular: float = 0.12

    def lights(self, cameras: Cameras) -> DirectionalLights:
        """The light of these cameras."""
        offset = cameras.R.new_tensor([-self.right, self.above, -1.0])  # view space: +x left, +z away
        return DirectionalLights(
            direction=cameras.R @ offset,
            ambient_color=((self.ambient,) * 3,),
            diffuse_color=((self.diffuse,) * 3,),
            specular_color=((self.specular,) * 3,),
            device=cameras.device,
        )


@dataclass(frozen=True)
class Shading:
    """A shader and the rasterisation that it needs.

    Attributes:
        shader: one of `rendra.renderer.mesh.shader`; takes cameras, lights and materials at its call.
        sigma: width of a soft edge in squared NDC; None for hard edges.
        gamma: of the softmax over depth.
        faces_per_pixel: layers that are blended.
        shows: `color`; `alpha`, a mask in white on black; or `depth`, near in white and far in grey.
    """

    shader: nn.Module
    sigma: float | None = None
    gamma: float = 1e-4
    faces_per_pixel: int = 1
    shows: str = "color"

    def __post_init__(self) -> None:
        if self.shows not in _SHOWS:
            raise UserError(f"shader.shows must be one of {', '.join(_SHOWS)}, got {self.shows!r}")

    def settings(self, image_size: tuple[int, int]) -> RasterizationSettings:
        """How to rasterise an image of (height, width) pixels."""
        blur = 0.0 if self.sigma is None else float(np.log(1 / _EDGE_ALPHA - 1)) * self.sigma
        return RasterizationSettings(image_size=image_size, blur_radius=blur, faces_per_pixel=self.faces_per_pixel)


@dataclass(frozen=True)
class Studio:
    """Everything about a picture but the mesh.

    Attributes:
        camera: where from.
        light: lights of `rendra.renderer.lighting`, or a Headlight.
        material: of the surface.
        shading: how.
        size: (height, width) in pixels.
        background: RGB in [0, 1].
        antialias: factor by which the picture is rendered larger and then averaged.
    """

    camera: OrbitCamera
    light: Any
    material: Materials
    shading: Shading
    size: tuple[int, int] = (512, 512)
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    antialias: int = 2

    def __post_init__(self) -> None:
        height, width = self.size
        if not all(isinstance(side, int) and 1 <= side <= 8192 for side in self.size):
            raise UserError(f"size, width and height must be whole pixels from 1 to 8192, got {width!r} x {height!r}")
        if not (isinstance(self.antialias, int) and 1 <= self.antialias <= 8):
            raise UserError(f"antialias must be a whole number from 1 to 8, got {self.antialias!r}")

    @torch.no_grad()
    def render(self, mesh: Meshes) -> Tensor:
        """The picture of a batch of one mesh, (H, W, 4); the background stands behind it where alpha is 0."""
        height, width = (side * self.antialias for side in self.size)
        cameras = self.camera.cameras(mesh)
        rasterizer = MeshRasterizer(cameras, self.shading.settings((height, width)))
        raw = MeshRenderer(rasterizer, self.shading.shader)(
            mesh,
            cameras=cameras,
            lights=self.light.lights(cameras) if isinstance(self.light, Headlight) else self.light.to(mesh.device),
            materials=self.material.to(mesh.device),
            blend_params=BlendParams(self.shading.sigma or 1e-4, self.shading.gamma, self.background),
        )
        image = self._as_color(raw[0], cameras)
        return F.avg_pool2d(image.clamp(0, 1).permute(2, 0, 1), self.antialias).permute(1, 2, 0)

    @torch.no_grad()
    def sees(self, mesh: Meshes) -> bool:
        """Whether any part of the mesh lies in the picture."""
        rasterizer = MeshRasterizer(self.camera.cameras(mesh), RasterizationSettings(image_size=self.size))
        return bool((rasterizer(mesh).pix_to_face >= 0).any())

    def _as_color(self, raw: Tensor, cameras: Cameras) -> Tensor:
        """What the shader gave, as RGBA; colours stand over the background already."""
        if self.shading.shows == "color":
            return raw
        if self.shading.shows == "alpha":
            return torch.cat([raw[..., 3:].expand(-1, -1, 3), torch.ones_like(raw[..., 3:])], dim=-1)
        depth = raw[..., :1]
        seen = depth < cast(Tensor, cameras.zfar)  # what the shader gives where nothing is
        near, far = (depth[seen].aminmax()) if seen.any() else (depth.new_zeros(()), depth.new_ones(()))
        light = 1 - 0.8 * (depth - near) / (far - near).clamp_min(1e-9)
        return torch.cat([(light * seen).expand(-1, -1, 3), torch.ones_like(depth)], dim=-1)


def point_marks(points: Tensor, radius: float | Tensor, colors: Tensor | Sequence[float]) -> Meshes:
    """Points as one mesh of octahedra, so that they are drawn like any surface.

    Args:
        points: (P, 3).
        radius: from a point to the corners of its octahedron.
        colors: RGB in [0, 1], (P, 3), or (3,) for all.
    """
    count, device = len(points), points.device
    corners = torch.cat([torch.eye(3), -torch.eye(3)]).to(points) * radius
    sides = torch.tensor(_OCTAHEDRON, device=device) + 6 * torch.arange(count, device=device)[:, None, None]
    painted = torch.as_tensor(colors).to(points).expand(count, 3).repeat_interleave(6, dim=0)
    verts = (points[:, None] + corners).flatten(0, 1)
    return Meshes([verts], [sides.flatten(0, 1)], TexturesVertex([painted]))


def cut_out(image: Tensor, background: Sequence[float]) -> Tensor:
    """RGBA (H, W, 4) without the background that its colours were blended with; alpha not premultiplied."""
    rgb, alpha = image[..., :3], image[..., 3:]
    behind = rgb.new_tensor(background)
    return torch.cat([((rgb - (1 - alpha) * behind) / alpha.clamp_min(1e-6)).clamp(0, 1) * (alpha > 0), alpha], -1)


def kind_of_picture(gallery: bool, turntable: str | None, transparent: bool) -> str:
    """Which of FILE_NAMES the settings of `scripts/render.py` ask for.

    Raises:
        ValueError: they contradict each other.
    """
    if turntable not in (None, "gif", "mp4"):
        raise UserError(f"turntable must be null, gif or mp4, got {turntable!r}")
    if gallery + (turntable is not None) + transparent > 1:
        raise UserError("gallery=true, turntable=... and transparent=true exclude each other: choose one")
    return "gallery" if gallery else turntable or ("cutout" if transparent else "picture")


def draw(kind: str, studio: Studio, mesh: Meshes, output: Path, frames: int = 36, fps: float = 18.0) -> str:
    """Render one of FILE_NAMES to the file `output`.

    Returns:
        One line that says what was drawn, and that nothing is seen where that is so.

    Raises:
        UserError: the ending of `output` does not fit, `fps` is no rate, or an MP4 without the extra [view].
    """
    what = f"{len(mesh.verts_packed()):,} vertices, {len(mesh.faces_packed()):,} faces"
    if kind in ("gif", "mp4"):
        if not isinstance(fps, int | float) or not 0 < fps <= 1000:
            raise UserError(f"fps must lie above 0, at most 1000, got {fps!r}")
        _demand_writable(kind, output)
        save_animation(output, list(turntable(studio, mesh, frames)), fps, hold_s=0)
        return f"turntable of {what}, {frames} frames"
    if kind == "gallery":
        save_image(output, torch.from_numpy(gallery(studio, mesh) / 255.0), transparent=False)
        return f"six lightings of {what}{_out_of_place(mesh)}"
    image = studio.render(mesh)
    if kind == "cutout":
        image = cut_out(image, studio.background)
    save_image(output, image, transparent=kind == "cutout")
    size = f"{studio.size[1]} x {studio.size[0]} pixels"
    seen = "" if studio.sees(mesh) else "; NOTHING IS SEEN: leave camera.dist and camera.at at null, or move them"
    return f"{what}, {size}{seen}"


def _out_of_place(mesh: Meshes) -> str:
    """What to say of a mesh that does not suit the gallery's cameras, which stand 2.7 from the origin."""
    centre, radius = bounding_sphere(mesh)
    suits = 0.1 < float(centre.norm()) + radius < 2.7 and float(centre.norm()) < 1
    return "" if suits else "; the cameras stand 2.7 from the origin, so this mesh needs mesh.normalize=extent"


def _demand_writable(kind: str, output: Path) -> None:
    if output.suffix.lower() != f".{kind}":
        raise UserError(f"turntable={kind} writes a .{kind} file, but output is {output}")
    if kind == "mp4" and find_spec("av") is None:
        raise UserError("an MP4 needs a video encoder: pip install 'rendra[view]'; or choose turntable=gif")


def gallery(studio: Studio, mesh: Meshes) -> Picture:
    """One captioned sheet of six lightings: the pictures of "3D Deep Learning with Python", chapter 2.

    Light before and behind the cow, no ambient light, green and red highlights, none. Cameras, lights and
    materials are the book's; size, shading and background those of the studio.
    """
    pictures = []
    for title, camera, light, material in _lightings():
        scene = replace(studio, camera=camera, light=light, material=material)
        pictures.append(caption(to_picture(scene.render(mesh)[..., :3]), title))
    return tile(pictures, columns=3)


def turntable(studio: Studio, mesh: Meshes, frames: int) -> Iterator[Picture]:
    """Pictures of the camera's way once round the mesh, `frames` of them in equal steps.

    Raises:
        ValueError: fewer than two frames.
    """
    if not (isinstance(frames, int) and frames >= 2):
        raise UserError(f"a turntable needs at least 2 frames, got {frames!r}")
    for frame in range(frames):
        camera = replace(studio.camera, azim=studio.camera.azim + 360 * frame / frames)
        yield to_picture(replace(studio, camera=camera).render(mesh)[..., :3])


def save_image(path: str | Path, image: Tensor, transparent: bool) -> Path:
    """Write (H, W, 4) as PNG, JPEG or whatever else the ending of the path says; makes the folder.

    Raises:
        ValueError: an ending that no format has, or transparency in a format without.
    """
    path = Path(path)
    known = Image.registered_extensions()
    if path.suffix.lower() not in known:
        raise UserError(f"output must end in .png, .jpg or another image format, got {path}")
    if transparent and known[path.suffix.lower()] not in ("PNG", "WEBP", "TIFF"):
        raise UserError(f"{path.suffix} files cannot be transparent; choose .png")
    pixels = (image if transparent else image[..., :3]).mul(255).round().to("cpu", torch.uint8).numpy()
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return path


def parse_color(color: str | Sequence[float]) -> tuple[float, float, float]:
    """RGB in [0, 1] from a name, `#rrggbb` or three numbers in [0, 1].

    Raises:
        UserError: it is none of these.
    """
    try:
        values = [value / 255 for value in ImageColor.getrgb(color)[:3]] if isinstance(color, str) else list(color)
        valid = len(values) == 3 and all(0 <= value <= 1 for value in values)
    except (TypeError, ValueError):
        valid = False
    if not valid:
        raise UserError(f"background must be a colour name, #rrggbb or [r,g,b] in [0, 1], got {color!r}")
    return values[0], values[1], values[2]


def _lightings() -> Iterator[tuple[str, OrbitCamera, PointLights, Materials]]:
    front = OrbitCamera(dist=2.7, elev=0, azim=180, at=(0, 0, 0), fov=60)
    above = replace(front, elev=10, azim=-150)
    before, behind = PointLights(location=[[0.0, 0.0, -3.0]]), PointLights(location=[[0.0, 0.0, 1.0]])
    dark = PointLights(location=[[0.0, 0.0, 1.0]], ambient_color=((0.0, 0.0, 0.0),))
    corner = PointLights(location=[[2.0, 2.0, -2.0]])
    yield "light in front", front, before, Materials()
    yield "light behind", front, behind, Materials()
    yield "dark: no ambient light", front, dark, Materials()
    yield "green highlights, shininess 10", above, corner, Materials(specular_color=((0.0, 1.0, 0.0),), shininess=10)
    yield "red highlights, shininess 20", above, corner, Materials(specular_color=((1.0, 0.0, 0.0),), shininess=20)
    yield "no highlights", above, corner, Materials(specular_color=((0.0, 0.0, 0.0),), shininess=0)
