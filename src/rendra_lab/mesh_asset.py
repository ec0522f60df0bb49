"""A mesh or point cloud file as read, with everything that a report about it wants to know."""

import warnings
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from rendra.io import IO, load_obj
from rendra.io.errors import require_file
from rendra.renderer.mesh.textures import TexturesUV
from rendra.structures import Meshes, Pointclouds


@dataclass(frozen=True)
class Material:
    """A material of the file.

    Attributes:
        name: as the file has it; "" where the format has none.
        color: diffuse RGB in [0, 1], or None.
        image: RGB (H, W, 3) in [0, 1], or None.
        faces: the numbers of the faces that have it; None for all.
    """

    name: str
    color: tuple[float, ...] | None = None
    image: Tensor | None = None
    faces: Tensor | None = None


@dataclass(frozen=True)
class Asset:
    """A file as read: a batch of one mesh, or of one cloud.

    Attributes:
        path: of the file.
        mesh: None for a cloud.
        cloud: None for a mesh.
        materials: of the mesh.
        uvs: texture coordinates (T, 2), or None.
        faces_uvs: rows of `uvs` at the corners of each face (F, 3), or None.
        normals_at_corners: unit or not, (F, 3, 3), NaN where the file gives none; None where they are the
            mesh's own or absent.
        notes: warnings of the reader.
    """

    path: Path
    mesh: Meshes | None = None
    cloud: Pointclouds | None = None
    materials: tuple[Material, ...] = ()
    uvs: Tensor | None = None
    faces_uvs: Tensor | None = None
    normals_at_corners: Tensor | None = None
    notes: tuple[str, ...] = ()


def read_asset(path: str | Path) -> Asset:
    """Read any file that `rendra.io.IO` reads; a mesh file without faces is a cloud.

    Raises:
        OSError: there is no such file, or it cannot be read.
        ValueError: no format has its suffix, it holds nothing, or it is malformed (MeshFormatError).
    """
    path = Path(path)
    require_file(path)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        asset = _read_obj(path) if path.suffix.lower() == ".obj" else _read_other(path)
    if asset.mesh is None and not (asset.cloud is not None and len(asset.cloud.points_packed())):
        raise ValueError(f"{path} holds neither faces nor points")
    notes = tuple(dict.fromkeys(" ".join(str(each.message).split()) for each in caught))
    return Asset(**{**vars(asset), "notes": notes})


def _read_obj(path: Path) -> Asset:
    verts, faces, parts = load_obj(path)
    if not len(faces.verts_idx):
        return Asset(path, cloud=IO().load_pointcloud(path))
    colors, images = parts.material_colors or {}, parts.texture_images or {}
    # materials count in the order of their names; where some are not in the library the numbers say nothing
    counted = int(faces.materials_idx.amax()) < len(colors)
    materials = tuple(
        Material(
            name,
            tuple(color["diffuse_color"].tolist()) if "diffuse_color" in color else None,
            images.get(name),
            (faces.materials_idx == number).nonzero()[:, 0] if counted else None,
        )
        for number, (name, color) in enumerate(colors.items())
    )
    corners = None
    if parts.normals is not None and (faces.normals_idx >= 0).any():
        missing = (faces.normals_idx < 0)[..., None]
        corners = parts.normals[faces.normals_idx.clamp_min(0)].masked_fill(missing, torch.nan)
    uvs = parts.verts_uvs
    faces_uvs = None if uvs is None else faces.textures_idx
    return Asset(path, Meshes([verts], [faces.verts_idx]), None, materials, uvs, faces_uvs, corners)


def _read_other(path: Path) -> Asset:
    mesh = IO().load_geometry(path)
    if isinstance(mesh, Pointclouds):
        return Asset(path, cloud=mesh)
    textures = mesh.textures
    if not isinstance(textures, TexturesUV):
        return Asset(path, mesh)
    maps, ids = textures.maps_list()[0], textures.maps_ids_list()
    faces_uvs, uvs = textures.faces_uvs_list()[0], textures.verts_uvs_list()[0]
    if ids is None:
        return Asset(path, mesh, None, (Material("", image=maps),), uvs, faces_uvs)
    users = [(ids[0] == number).nonzero()[:, 0] for number in range(len(maps))]
    materials = tuple(Material("", image=image, faces=faces) for image, faces in zip(maps, users, strict=True))
    return Asset(path, mesh, None, materials, uvs, faces_uvs)
