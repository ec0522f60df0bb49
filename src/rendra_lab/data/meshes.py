"""The meshes that tasks and scripts start from: made here, or read from the user's file."""

import hashlib
import math
import warnings
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rendra.io import IO, load_obj, load_objs_as_meshes
from rendra.io.errors import require_file
from rendra.renderer.mesh.textures import TexturesVertex
from rendra.structures.meshes import Meshes
from rendra.utils.ico_sphere import ico_sphere
from rendra.utils.torus import torus
from rendra_lab.data.kept_tensors import kept_or_made
from rendra_lab.errors import UserError
from rendra_lab.synthesis import cow_arrays
from rendra_lab.synthesis.cow import CoatParameters, CowParameters, TexturedMesh, as_meshes, build_cow, make_cow

Device = torch.device | str
NORMALIZATIONS = ("center", "extent", "max_abs")
_ATLAS_TEXELS = 2**22  # of all faces together
_FACE_TEXELS = 32  # most along one side of a face


def load_mesh(
    name: str = "cow",
    path: str | Path | None = None,
    normalize: str | None = None,
    size: float = 2.0,
    device: Device = "cpu",
    **options: Any,
) -> Meshes:
    """One mesh with a texture: a file if `path` is given, else one of our own.

    Args:
        name: cow, ico_sphere, torus or cube; ignored where there is a path.
        path: an OBJ or PLY file, or whatever else `rendra.io.IO` reads.
        normalize: None leaves the vertices where they are. `center` moves the middle of the bounding box to
            the origin; `extent` also scales the longest side of the box to `size`. `max_abs` subtracts the
            mean of the vertices and scales their largest coordinate to `size` / 2.
        size: of the normalised mesh.
        device: where the mesh goes.
        **options: of our own meshes, ignored where there is a path. cow: seed, texture_size, num_faces, breed,
            build (a mapping of CowParameters' fields), cache (a folder for cows that were made). ico_sphere: level.
            torus: r, R, sides, rings.

    Returns:
        A batch of one mesh; white vertex colours where the file has none. An OBJ file with several images, or with
        materials of plain colours, has a TexturesAtlas: each face in its own material.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: an unknown name, normalisation or option, a malformed file (MeshFormatError) or one without
            faces.
    """
    if normalize not in (None, *NORMALIZATIONS):
        raise UserError(f"mesh.normalize must be null or one of {', '.join(NORMALIZATIONS)}, got {normalize!r}")
    if not size > 0:
        raise UserError(f"mesh.size must be positive, got {size!r}")
    mesh = _make(name, options, device) if path is None else _read(Path(path), device)
    if mesh.textures is None:
        mesh.textures = TexturesVertex([torch.ones_like(mesh.verts_packed())])
    return mesh if normalize is None else _normalized(mesh, normalize, size)


def bounding_sphere(mesh: Meshes) -> tuple[Tensor, float]:
    """The middle (3,) of a mesh's bounding box, and the distance of the farthest vertex from it."""
    verts = mesh.verts_packed().detach()
    centre = (verts.amin(0) + verts.amax(0)) / 2
    return centre, float((verts - centre).norm(dim=1).amax())


def make_cube(device: Device = "cpu") -> Meshes:
    """The cube from -1 to 1, without a texture; every side has its own vertices, so that its edges look sharp."""
    square = torch.tensor([[1.0, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]])  # counter-clockwise from +x
    sides = [square.roll(axis, dims=1) for axis in range(3)]
    sides += [-side.flip(0) for side in sides]
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]]) + 4 * torch.arange(6)[:, None, None]
    return Meshes([torch.cat(sides).to(device)], [faces.reshape(-1, 3).to(device)])


def _read(path: Path, device: Device) -> Meshes:
    require_file(path, "mesh file")
    mesh = _read_obj(path, device) if path.suffix.lower() == ".obj" else IO().load_mesh(path, device=device)
    if not len(mesh.faces_packed()):
        raise UserError(f"{path} holds no faces, so there is nothing to see")
    return mesh


def _read_obj(path: Path, device: Device) -> Meshes:
    """One image as it is, vertex colours as they are, any other materials as an atlas."""
    _, faces, parts = load_obj(path, device=device)
    images, colours = parts.texture_images or {}, parts.material_colors or {}
    bare = len(faces.materials_idx.unique()) > len(images)  # images belong to materials that are in use
    plain = bare and any("diffuse_color" in each for each in colours.values())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # load_obj gave them already
        mesh = load_objs_as_meshes([path], device=device)
        needs_atlas = len(images) > 1 or plain or (images and mesh.textures is None)
        if not needs_atlas or isinstance(mesh.textures, TexturesVertex):
            return mesh
        texels = math.isqrt(_ATLAS_TEXELS // max(1, len(faces.verts_idx))) if images else 1
        texels = min(max(1, texels), _FACE_TEXELS)
        return load_objs_as_meshes([path], device, create_texture_atlas=True, texture_atlas_size=texels)


def _make(name: str, options: Mapping[str, Any], device: Device) -> Meshes:
    if name not in _MAKERS:
        raise UserError(f"there is no mesh {name!r}; there are {', '.join(_MAKERS)}, or give a path")
    try:
        return _MAKERS[name](device=device, **options)
    except TypeError as error:
        raise UserError(f"mesh {name!r} cannot be made with {dict(options)}: {error}") from error


def _cow(
    device: Device,
    seed: int = 0,
    texture_size: int = 512,
    num_faces: int = 9600,
    breed: str = "holstein",
    build: Mapping[str, float] | None = None,
    cache: str | Path | None = None,
) -> Meshes:
    shape, coat = CowParameters(**(build or {})), CoatParameters.of_breed(breed)
    how: dict[str, Any] = {"build": shape, "coat": coat}
    how |= {"seed": seed, "texture_size": texture_size, "num_faces": num_faces}
    if cache is None:
        return make_cow(**how, device=device)

    def made() -> dict[str, Tensor]:
        return {name: torch.from_numpy(array) for name, array in vars(build_cow(**how)).items()}

    kept = kept_or_made(Path(cache) / f"cow_{_fingerprint(how)}.safetensors", "cow", made)
    return as_meshes(TexturedMesh(**{name: tensor.numpy() for name, tensor in kept.items()}), device)


def _fingerprint(how: Mapping[str, Any]) -> str:
    """24 hexadecimal digits that stand for everything that determines a cow, the code that makes it included."""
    versions = [version(package) for package in ("numpy", "scipy", "scikit-image")]
    digest = hashlib.sha256(repr((sorted(how.items()), versions)).encode())
    for source in sorted(Path(cow_arrays.__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:24]


def _ico_sphere(device: Device, level: int = 4) -> Meshes:
    return ico_sphere(level, device)


def _torus(device: Device, r: float = 0.4, R: float = 1.0, sides: int = 32, rings: int = 64) -> Meshes:
    return torus(r, R, sides, rings, device)


_MAKERS: dict[str, Callable[..., Meshes]] = {
    "cow": _cow,
    "ico_sphere": _ico_sphere,
    "torus": _torus,
    "cube": make_cube,
}


def _normalized(mesh: Meshes, how: str, size: float) -> Meshes:
    verts = mesh.verts_packed()
    if how == "max_abs":
        moved = verts - verts.mean(0)
        scale = size / 2 / _positive(moved.abs().amax())
        return mesh.update_padded((moved * scale)[None])
    low, high = verts.amin(0), verts.amax(0)
    moved = verts - (low + high) / 2
    if how == "extent":
        moved = moved * (size / _positive((high - low).amax()))
    return mesh.update_padded(moved[None])


def _positive(extent: Tensor) -> Tensor:
    if not extent > 0:
        raise ValueError("the mesh is a single point, so it cannot be scaled: leave mesh.normalize out")
    return extent
