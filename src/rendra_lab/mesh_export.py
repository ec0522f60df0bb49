"""Meshes of fitted scenes as files, and pictures of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import torch
from torch import Tensor

from rendra.io import IO
from rendra.renderer.materials import Materials
from rendra.renderer.mesh.shader import HardFlatShader, HardPhongShader
from rendra.renderer.mesh.textures import TexturesVertex
from rendra.structures import Meshes
from rendra.transforms import axis_angle_to_matrix
from rendra_lab.errors import UserError
from rendra_lab.mesh_extraction import COLORS, extract_mesh, paint_mesh
from rendra_lab.mesh_quality import components, is_watertight
from rendra_lab.networks.radiance import RadianceScene
from rendra_lab.pictures import Headlight, OrbitCamera, Shading, Studio
from rendra_lab.settings import Count, Fraction, Positive
from rendra_lab.visualization import Picture, caption, save_picture, tile, to_picture

FORMATS = ("obj", "ply", "glb")
_NO_IMAGES = ("ply",)  # formats that hold colours of vertices alone
_AZIMUTHS = (30.0, 150.0, 270.0)
_CLAY = (0.78, 0.78, 0.76)


@dataclass(frozen=True)
class SurfaceSettings:
    """What is to be extracted, and written where. The settings of `extract_mesh`, and:

    Attributes:
        formats: endings of the files: obj (with its MTL and PNG), ply (colours at vertices), glb.
    """

    resolution: Positive = 256
    level: Fraction | None = None
    color: str | None = "vertex"
    keep: Fraction = 0.01
    smoothing: Count = 5
    num_faces: Positive | None = None
    texture_size: Positive = 1024
    formats: Sequence[str] = FORMATS

    def __post_init__(self) -> None:
        if unknown := sorted(set(self.formats) - set(FORMATS)):
            raise UserError(f"formats must be some of {', '.join(FORMATS)}, got {', '.join(map(str, unknown))}")
        if self.color not in COLORS:
            raise UserError(f"color must be vertex, texture or null, got {self.color!r}")

    def extract(self, scene: RadianceScene) -> Meshes:
        """The mesh of a scene, without faces where it has no surface."""
        return extract_mesh(
            scene, self.resolution, self.level, self.color, keep=self.keep, smoothing=self.smoothing,
            num_faces=self.num_faces, texture_size=self.texture_size,
        )  # fmt: skip


@dataclass(frozen=True)
class WrittenSurface:
    """What became of an extraction.

    Attributes:
        mesh: without faces where the scene has no surface; then there are no files.
        files: the meshes, and the picture last.
        seconds: that the extraction took.
    """

    mesh: Meshes
    files: tuple[Path, ...]
    seconds: float

    def __str__(self) -> str:
        """One line for people."""
        if not self.files:
            return "no mesh: nothing in the field is dense enough yet to stop half of the light"
        pieces = int(components(self.mesh).amax()) + 1
        size = f"{len(self.mesh.verts_packed()):,} vertices and {len(self.mesh.faces_packed()):,} faces"
        closed = "closed" if is_watertight(self.mesh) else "NOT closed"
        return (
            f"mesh of {size}, {closed}, {'1 piece' if pieces == 1 else f'{pieces} pieces'}, in {self.seconds:.1f} s: "
            f"{', '.join(path.name for path in self.files)}"
        )


def export_surface(
    scene: RadianceScene, settings: SurfaceSettings, stem: Path, up: Sequence[float] | None = None
) -> WrittenSurface:
    """Extracts the mesh of a scene and writes it: `<stem>.obj`, ... and a picture of it, `<stem>.png`.

    Args:
        scene: fitted.
        settings: what and how.
        stem: path of the files without their ending; the folder is made.
        up: the scene's upward direction in the picture; None: +y.
    """
    begun = perf_counter()
    mesh = settings.extract(scene)
    seconds = perf_counter() - begun
    if not len(mesh.faces_packed()):
        return WrittenSurface(mesh, (), seconds)
    stem.parent.mkdir(parents=True, exist_ok=True)
    files = [stem.parent / f"{stem.name}.{ending}" for ending in settings.formats]
    for path in files:
        IO().save_mesh(_as_format_holds(mesh, scene, settings, path.suffix[1:]).cpu(), path)
    picture = stem.parent / f"{stem.name}_views.png"  # an OBJ's texture is <stem>.png
    save_picture(picture, surface_sheet(mesh, up))
    return WrittenSurface(mesh, (*files, picture), seconds)


def surface_sheet(mesh: Meshes, up: Sequence[float] | None = None, size: int = 320) -> Picture:
    """A mesh (a batch of one) from three sides: in its colours, and below as of grey clay.

    Args:
        mesh: with faces.
        up: upward direction; None: +y.
        size: pixels of a picture's sides.
    """
    mesh = mesh.detach()
    if up is not None:
        verts = mesh.verts_packed()
        turned = verts @ _rotation_to_y(torch.tensor(up).to(verts))
        mesh = Meshes([turned], mesh.faces_list(), mesh.textures)
    clay = torch.tensor(_CLAY).to(mesh.verts_packed()).expand(len(mesh.verts_packed()), 3)
    grey = Meshes(mesh.verts_list(), mesh.faces_list(), TexturesVertex([clay]))
    even, lit = Headlight(ambient=1, diffuse=0, specular=0), Headlight(ambient=0.3, diffuse=0.7, specular=0)
    rows: list[tuple[Meshes, Headlight, torch.nn.Module, str]]
    rows = [(mesh, even, HardPhongShader(), "colours")] if mesh.textures is not None else []
    rows.append((grey, lit, HardFlatShader(), "shape"))
    pictures = []
    for shown, light, shader, name in rows:
        for azimuth in _AZIMUTHS:
            studio = Studio(OrbitCamera(azim=azimuth), light, Materials(), Shading(shader), (size, size))
            pictures.append(caption(to_picture(studio.render(shown)[..., :3]), f"{name} from {azimuth:.0f} degrees"))
    return tile(pictures, columns=len(_AZIMUTHS))


def _as_format_holds(mesh: Meshes, scene: RadianceScene, settings: SurfaceSettings, ending: str) -> Meshes:
    """The mesh itself, or with colours at its vertices where the format takes no image."""
    if settings.color != "texture" or ending not in _NO_IMAGES:
        return mesh
    box = scene.box
    return paint_mesh(mesh, scene, float((box[1] - box[0]).amax()) / settings.resolution, "vertex")


def _rotation_to_y(direction: Tensor) -> Tensor:
    """The shortest rotation (3, 3) with direction @ R = +y, for a direction of any length but 0."""
    direction = direction / direction.norm()
    y = torch.tensor([0.0, 1.0, 0.0]).to(direction)
    axis = torch.linalg.cross(direction, y)
    if float(axis.norm()) < 1e-6:  # along y already, or against it: half a turn about x
        axis = torch.tensor([torch.pi if float(direction[1]) < 0 else 0.0, 0.0, 0.0]).to(direction)
    else:
        axis = axis / axis.norm() * torch.acos(direction[1].clamp(-1, 1))
    return axis_angle_to_matrix(axis).T
