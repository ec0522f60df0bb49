"""From one file of a mesh or point cloud to another, of any registered format.

Kept is whatever the target can hold; what it cannot is named in a warning. Nothing is ever written over the source
or the files that it names. Letters: V verts, F faces, P points.
"""

import math
import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rendra.io._carried_colors import atlas_as_image, colors_at_verts, normals_at_verts, packed_materials
from rendra.io._mesh_as_cloud import cloud_of_verts
from rendra.io._obj_text import parse_obj
from rendra.io._source import read_source
from rendra.io.errors import require_file
from rendra.io.obj_io import Faces, Properties, load_obj, load_objs_as_meshes
from rendra.io.pluggable import IO
from rendra.ops.sample_points_from_meshes import sample_points_from_meshes
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesBase, TexturesUV, TexturesVertex
from rendra.structures import Meshes, Pointclouds

# What textures a format holds; any that is not listed decides for itself.
_HELD: dict[str, tuple[type[TexturesBase], ...]] = {
    ".obj": (TexturesUV, TexturesVertex),
    ".glb": (TexturesUV, TexturesVertex),
    ".gltf": (TexturesUV, TexturesVertex),
    ".ply": (TexturesVertex,),
    ".off": (TexturesVertex, TexturesAtlas),
    ".stl": (),
}
_WITH_COMPANIONS = (".obj", ".gltf")
_WITHOUT_NORMALS = (".stl",)
NORMALS_LOST = "normals are not kept: some vertices have several, or none"
_MOST_SAMPLES = 50_000_000  # with normals and colours under 10 GB
# Rows are where x, y and z of a row vector go.
_TURNS = {
    "z-to-y": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    "y-to-z": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
}


@dataclass(frozen=True)
class Conversion:
    """What happens between two files: first the turn, then the shift, then the scale.

    Attributes:
        up: "z-to-y" or "y-to-z", a quarter turn about x that brings the one axis to the other; None for no turn.
        center: move the middle of the bounding box to the origin.
        scale: factor; None for 1.
        fit: scale so that the longest side of the bounding box becomes this; None for no such scale.
        sample: draw so many points from the surface, evenly, with normals and colours; None for no cloud.
        vertices: make a cloud of the vertices.
        seed: of the drawing.
        textures: keep colours and images.
        binary: binary or text, where the format has both; None for its own choice.
        decimals: digits behind the point of text; None for the format's own choice.
        overwrite: replace files that exist; never those of the source.
    """

    up: str | None = None
    center: bool = False
    scale: float | None = None
    fit: float | None = None
    sample: int | None = None
    vertices: bool = False
    seed: int = 0
    textures: bool = True
    binary: bool | None = None
    decimals: int | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.up is not None and self.up not in _TURNS:
            raise ValueError(f"up is {self.up!r}; expected {' or '.join(_TURNS)}")
        for name, value in (("scale", self.scale), ("fit", self.fit)):
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value}; expected a positive number")
        if self.sample is not None and self.sample < 1:
            raise ValueError(f"sample is {self.sample}; expected 1 point or more")
        if self.sample is not None and self.sample > _MOST_SAMPLES:
            raise ValueError(f"sample is {self.sample}; expected at most {_MOST_SAMPLES:,} points")
        if not -(2**63) <= self.seed < 2**64:
            raise ValueError(f"seed is {self.seed}; expected a whole number of 64 bits")
        if self.scale is not None and self.fit is not None:
            raise ValueError("scale and fit exclude each other")
        if self.sample is not None and self.vertices:
            raise ValueError("sample and vertices exclude each other")


@dataclass(frozen=True)
class Converted:
    """What was written: the file, and how many vertices (or points) and faces it holds; no faces in a cloud."""

    path: Path
    num_verts: int
    num_faces: int


def convert(
    source: str | os.PathLike[str], target: str | os.PathLike[str], options: Conversion | None = None
) -> Converted:
    """Read a mesh or a point cloud, change it as asked, and write it as what the target's suffix says.

    A file without faces is a cloud. Image textures go to formats without images as colours of the vertices; colours
    of faces go to formats with images as an image; several materials of an OBJ file go as one image.

    Args:
        source: file to read.
        target: file to write; an OBJ file with an image gets a .mtl and a .png file beside it.
        options: what happens in between; nothing if None.

    Raises:
        MeshFormatError: the source is malformed.
        FileExistsError: the target, or a file that would be written beside it, exists or belongs to the source.
        ValueError: a suffix without a format, or a target that cannot hold what the source is.
        OSError: a file cannot be read or written.
    """
    source, target, options = Path(source), Path(target), options or Conversion()
    _demand_free(source, target, options)
    data = read_geometry(source, options.textures)
    if isinstance(data, Meshes) and (options.sample is not None or options.vertices or not _holds_meshes(target)):
        data = _as_cloud(data, options)
    elif isinstance(data, Pointclouds) and options.sample is not None:
        raise ValueError(f"{source} holds points without faces: there is no surface to sample")
    data = _moved(data, options)
    return (
        _write_cloud(data, target, options)
        if isinstance(data, Pointclouds)
        else _write_mesh(data, source, target, options)
    )


def _suffixes(interpreters: Any) -> set[str]:
    return {suffix for each in interpreters for suffix in each.known_suffixes}


def _holds_meshes(path: Path) -> bool:
    return path.suffix.lower() in _suffixes(IO().mesh_interpreters)


def _demand_free(source: Path, target: Path, options: Conversion) -> None:
    """Nothing that exists stands in the way, and the suffix is one that is known."""
    io = IO()
    known = _suffixes(io.mesh_interpreters) | _suffixes(io.pointcloud_interpreters)
    for path in (source, target):
        if path.suffix.lower() not in known:
            raise ValueError(
                f"{path}: no format has the suffix {path.suffix!r}; there are {', '.join(sorted(known))}"
            )
    require_file(source)
    if os.path.realpath(source) == os.path.realpath(target) or (target.exists() and target.samefile(source)):
        raise FileExistsError(f"{target} is the input itself")
    if target.is_dir():
        raise IsADirectoryError(f"{target} is a folder")
    _demand_new(target, options)


def _demand_new(path: Path, options: Conversion) -> None:
    if path.exists() and not options.overwrite:
        raise FileExistsError(f"{path} exists")


def read_geometry(source: Path, textures: bool = True) -> Meshes | Pointclouds:
    """Read a file into a batch of one as it is meant to look: normals and the colours of all materials included.

    Args:
        source: its suffix chooses the format.
        textures: read colours and images.

    Returns:
        A mesh, or a cloud where there are no faces.

    Raises:
        OSError: the file cannot be read.
        ValueError: no format has its suffix, or it is malformed (MeshFormatError).
    """
    if source.suffix.lower() != ".obj":
        return IO().load_geometry(source, textures)
    mesh = _read_obj(source, textures)
    return cloud_of_verts(mesh) if mesh.isempty() else mesh


def _read_obj(source: Path, textures: bool) -> Meshes:
    """An OBJ file with its normals, and the colours of all its materials."""
    verts, faces, properties = load_obj(source, load_textures=textures)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # load_obj gave them already, and the images are packed here
        mesh = load_objs_as_meshes([source], load_textures=textures)
    if not isinstance(mesh.textures, TexturesVertex) and _needs_packing(faces, properties):
        names = parse_obj(read_source(source)).material_names
        mesh.textures = packed_materials(names, faces, properties)
    if properties.normals is None:
        return mesh
    normals = normals_at_verts(len(verts), faces, properties.normals)
    if normals is None:
        warnings.warn(NORMALS_LOST, stacklevel=4)
        return mesh
    return Meshes(mesh.verts_list(), mesh.faces_list(), mesh.textures, verts_normals=[normals])


def _needs_packing(faces: Faces, properties: Properties) -> bool:
    """Whether one image does not show all materials."""
    images, colors = properties.texture_images or {}, properties.material_colors or {}
    colored = bool(images) or any("diffuse_color" in each for each in colors.values())
    plain = len(faces.materials_idx.unique()) > len(images) or bool((faces.textures_idx < 0).any())
    return len(faces.verts_idx) > 0 and (len(images) > 1 or (plain and colored))


def _as_cloud(mesh: Meshes, options: Conversion) -> Pointclouds:
    if options.sample is None:
        if isinstance(mesh.textures, TexturesUV | TexturesAtlas):
            mesh.textures = colors_at_verts(mesh)
        return cloud_of_verts(mesh)
    generator = torch.Generator().manual_seed(options.seed)
    drawn = sample_points_from_meshes(
        mesh, options.sample, return_normals=True, return_textures=mesh.textures is not None, generator=generator
    )
    return Pointclouds(drawn[0], normals=drawn[1], features=drawn[2] if len(drawn) > 2 else None)


def _moved(data: Meshes | Pointclouds, options: Conversion) -> Meshes | Pointclouds:
    """The same, turned, shifted and scaled."""
    points = given = data.verts_packed() if isinstance(data, Meshes) else data.points_packed()
    normals = _given_normals(data)
    if options.up is not None:
        turn = points.new_tensor(_TURNS[options.up])
        points, normals = points @ turn, None if normals is None else normals @ turn
    if len(points) and (options.center or options.fit is not None):
        low, high = torch.aminmax(points, dim=0)
        if options.center:
            points = points - (low + high) / 2
        points = points * _fitting(high - low, options.fit)
    points = points * (1.0 if options.scale is None else options.scale)
    _demand_representable(given, points)
    listed = None if normals is None else [normals]
    if isinstance(data, Meshes):
        return Meshes([points], data.faces_list(), data.textures, verts_normals=listed)
    return Pointclouds([points], normals=listed, features=data.features_list())


def _demand_representable(before: Tensor, after: Tensor) -> None:
    """Nothing became infinite, and what had an extent still has one."""
    if not after.isfinite().all():
        raise ValueError("a coordinate is not finite once scaled: single precision ends at 3.4e38")
    if (before != before[:1]).any() and not (after != after[:1]).any():
        raise ValueError("all points coincide once scaled: single precision ends at 1e-45")


def _given_normals(data: Meshes | Pointclouds) -> Tensor | None:
    if isinstance(data, Pointclouds):
        return data.normals_packed()
    return data.verts_normals_packed() if data.has_verts_normals() else None


def _fitting(sides: Tensor, fit: float | None) -> float:
    if fit is None:
        return 1.0
    longest = float(sides.max())
    if longest == 0.0:
        raise ValueError("all points coincide, so no scale makes them fit")
    return fit / longest


def _write_options(options: Conversion) -> dict[str, Any]:
    given: dict[str, Any] = {"binary": options.binary, "colors_as_uint8": True}
    return given if options.decimals is None else {**given, "decimal_places": options.decimals}


def _write_cloud(cloud: Pointclouds, target: Path, options: Conversion) -> Converted:
    if target.suffix.lower() not in _suffixes(IO().pointcloud_interpreters):
        raise ValueError(f"{target.suffix} files hold faces, not points alone")
    IO().save_pointcloud(cloud, target, **_write_options(options))
    return Converted(target, len(cloud.points_packed()), 0)


def _write_mesh(mesh: Meshes, source: Path, target: Path, options: Conversion) -> Converted:
    suffix = target.suffix.lower()
    mesh.textures = _fitted(mesh, suffix)
    if mesh.has_verts_normals() and suffix in _WITHOUT_NORMALS:
        warnings.warn(f"{suffix} files hold no normals of vertices: they are dropped", stacklevel=3)
    if suffix == ".obj" and isinstance(mesh.textures, TexturesUV):
        _demand_free_companions(source, target, options)
    IO().save_mesh(mesh, target, include_textures=mesh.textures is not None, **_write_options(options))
    return Converted(target, len(mesh.verts_packed()), len(mesh.faces_packed()))


def _demand_free_companions(source: Path, target: Path, options: Conversion) -> None:
    """An OBJ file's material library and image replace nothing that is wanted."""
    beside_source = os.path.realpath(source.parent) == os.path.realpath(target.parent)
    for path in (target.with_suffix(".mtl"), target.with_suffix(".png")):
        _demand_new(path, options)
        if path.exists() and beside_source and source.suffix.lower() in _WITH_COMPANIONS:
            raise FileExistsError(f"{path} may belong to the input {source.name}: choose another name or folder")


def _fitted(mesh: Meshes, suffix: str) -> TexturesBase | None:
    """The texture in a form that the format holds; what is lost is a warning."""
    textures = mesh.textures
    held = _HELD.get(suffix)
    if textures is None or held is None or isinstance(textures, held):
        return textures
    kind = "face colours" if isinstance(textures, TexturesAtlas) else "image"
    if isinstance(textures, TexturesAtlas) and TexturesUV in held:
        return atlas_as_image(textures.atlas_packed())
    if TexturesVertex in held:
        warnings.warn(
            f"{suffix} files hold no {kind}: vertices take the colours, what lies between is lost", stacklevel=4
        )
        return colors_at_verts(mesh)
    warnings.warn(f"{suffix} files hold no colours: they are dropped", stacklevel=4)
    return None
