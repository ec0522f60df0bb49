"""From meshes, clouds and cameras to what the viewer's program reads.

Letters: V verts, F faces, P points, T texture coordinates, N cameras.
"""

import os
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rendra.io._carried_colors import atlas_as_image, colors_at_verts
from rendra.io.conversion import NORMALS_LOST, read_geometry
from rendra.io.obj_io import load_obj
from rendra.renderer.cameras import CamerasBase
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesUV, TexturesVertex
from rendra.structures import Meshes, Pointclouds
from rendra_lab.viewer.packing import (
    packed_array,
    packed_colors,
    packed_image,
    packed_indices,
    packed_normals,
    packed_positions,
)
from rendra_lab.viewer.thinning import chosen_points, merged_neighbours

Shape = str | os.PathLike[str] | Meshes | Pointclouds | CamerasBase
_PACKERS = {
    "uvs": lambda uvs: packed_array(uvs.astype(np.float32)),
    "colors": packed_colors,
    "normals": packed_normals,
}
_FRUSTUM_OF_SCENE = 0.06  # depth of a camera's pyramid, in diagonals of what there is beside cameras


@dataclass(frozen=True)
class Limits:
    """What a page takes.

    Attributes:
        faces: of one mesh; larger ones are drawn coarser.
        points: of one cloud; of larger ones a part is drawn.
    """

    faces: int = 1_000_000
    points: int = 2_000_000


def scene_payload(
    items: Iterable[tuple[str, Shape]], *, up: str = "y", limits: Limits | None = None
) -> dict[str, Any]:
    """Pack shapes for `RendraViewer.mount`.

    Args:
        items: names, and what they name: a file that `rendra.io.IO` reads, Meshes, Pointclouds, or cameras. Every
            mesh or cloud of a batch is an item; cameras are drawn as pyramids.
        up: the axis that points up at first, "y" or "z".
        limits: how much of a shape is sent; whoever looks is told what is missing.

    Returns:
        {"version", "up", "items"}, all of it numbers, text and lists.

    Raises:
        OSError: a file cannot be read.
        ValueError: an unknown kind of shape or suffix, or a malformed file (MeshFormatError).
    """
    if up not in ("y", "z"):
        raise ValueError(f"up is {up!r}; expected 'y' or 'z'")
    limits = limits or Limits()
    packed: list[dict[str, Any]] = []
    cameras: list[tuple[str, CamerasBase]] = []
    for name, shape in items:
        if isinstance(shape, CamerasBase):
            cameras.append((name, shape))
        elif isinstance(shape, Meshes | Pointclouds):
            packed.extend(_batch_items(name, shape, limits))
        elif isinstance(shape, str | os.PathLike):
            packed.append(_file_item(name, Path(shape), limits))
        else:
            kind = type(shape).__name__
            raise ValueError(f"{name}: a shape to view is a file, Meshes, Pointclouds or cameras, not {kind}")
    diagonal = _diagonal(packed)
    packed.extend({"name": name, **_camera_item(shape, diagonal)} for name, shape in cameras)
    return {"version": 1, "up": up, "items": packed}


def _batch_items(name: str, batch: Meshes | Pointclouds, limits: Limits) -> list[dict[str, Any]]:
    """An item for each of a batch, numbered where there are several."""
    if len(batch) == 1:
        return [{"name": name, **_item(batch, limits)}]
    return [{"name": f"{name} {i}", **_item(batch[i], limits)} for i in range(len(batch))]


def _file_item(name: str, path: Path, limits: Limits) -> dict[str, Any]:
    """What a file holds, with what its reader has to say among the notes."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        shape = read_geometry(path)
    notes = list(dict.fromkeys(" ".join(str(each.message).split()) for each in caught))
    corners = None
    if NORMALS_LOST in notes:  # a vertex of a sharp edge has several: here every corner may have its own
        notes.remove(NORMALS_LOST)
        corners = _corner_normals(path)
    item = _item(shape, limits, corners)
    return {"name": name, **item, "notes": notes + item["notes"]}


def _corner_normals(path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """The normals (M, 3) of an OBJ file, and which of them the corners of its faces have (F, 3); None for gaps."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _, faces, parts = load_obj(path, load_textures=False)
    if parts.normals is None or bool((faces.normals_idx < 0).any()):
        return None
    return _numbers(parts.normals), faces.normals_idx.numpy()


def _item(
    shape: Meshes | Pointclouds, limits: Limits, corner_normals: tuple[np.ndarray, np.ndarray] | None = None
) -> dict[str, Any]:
    """A batch of one."""
    return _mesh_item(shape, limits, corner_normals) if isinstance(shape, Meshes) else _cloud_item(shape, limits)


def _numbers(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().cpu().numpy()


def _mesh_item(mesh: Meshes, limits: Limits, corner_normals: tuple[np.ndarray, np.ndarray] | None) -> dict[str, Any]:
    verts, faces = _numbers(mesh.verts_packed()), mesh.faces_packed().cpu().numpy()
    counts = {"verts": len(verts), "faces": len(faces)}
    notes: list[str] = []
    whole = np.isfinite(verts).all(axis=1)
    kept = whole[faces].all(axis=1).nonzero()[0]
    if len(kept) < len(faces):
        notes.append(f"{len(faces) - len(kept):,} faces are left out: their corners are not finite")
    large = len(kept) > limits.faces
    textures = _drawable(mesh, notes, large)
    values: dict[str, np.ndarray] = {}
    if isinstance(textures, TexturesVertex) and (colors := _rgb(textures.verts_features_packed(), notes)) is not None:
        values["colors"] = colors
    verts, faces = np.where(whole[:, None], verts, 0.0), faces[kept]
    if large:
        verts, faces, values = merged_neighbours(verts, faces, values, limits.faces)
        notes.append(f"drawn with {len(faces):,} of {counts['faces']:,} faces: neighbouring vertices are merged")
    elif mesh.has_given_normals:
        values["normals"] = _numbers(mesh.verts_normals_packed())
    # values that belong to corners of faces, not to vertices: a table and the row that each corner has
    tables: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    if isinstance(textures, TexturesUV):
        tables["uvs"] = _numbers(textures.verts_uvs_list()[0]), textures.faces_uvs_list()[0].cpu().numpy()[kept]
    if corner_normals is not None and not large:
        tables["normals"] = corner_normals[0], corner_normals[1][kept]
    verts, faces, values = _split(verts, faces, values, tables)
    texture = _texture(textures, values) if isinstance(textures, TexturesUV) else {}
    return {
        "kind": "mesh",
        "counts": counts,
        "notes": notes,
        **_bounds(verts, faces),
        "positions": packed_positions(verts),
        "faces": packed_indices(faces, len(verts)),
        **{name: _PACKERS[name](array) for name, array in values.items()},
        **texture,
    }


def _drawable(mesh: Meshes, notes: list[str], large: bool) -> TexturesVertex | TexturesUV | None:
    """The mesh's texture as one image, or as colours of vertices where it has several or must be made coarser."""
    textures = mesh.textures
    if textures is None or not len(mesh.faces_packed()):
        return None
    if isinstance(textures, TexturesAtlas) and not large:
        if textures.atlas_packed().shape[1] > 1:
            notes.append("every face is drawn in its mean colour")
        image = atlas_as_image(textures.atlas_packed())
        image.sampling_mode = "nearest"  # a texel is a face: its neighbours must not shine through
        return image
    if isinstance(textures, TexturesVertex) or (
        isinstance(textures, TexturesUV) and not textures.multi_map and not large
    ):
        return textures
    notes.append("the texture is drawn as colours of vertices")
    return colors_at_verts(mesh)


def _split(
    verts: np.ndarray,
    faces: np.ndarray,
    values: dict[str, np.ndarray],
    tables: dict[str, tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """A mesh whose vertices carry all values: one for every combination that corners of faces have.

    Args:
        verts: (V, 3).
        faces: (F, 3) rows of `verts`.
        values: by name, of the vertices (V, C).
        tables: by name, rows (M, C) and which of them each corner has (F, 3).
    """
    if not tables:
        return verts, faces, values
    keys = faces.astype(np.int64)
    for table, rows in tables.values():
        keys = keys * len(table) + rows
    unique, corners = np.unique(keys.reshape(-1), return_inverse=True)
    found = {}
    for name, (table, _) in reversed(tables.items()):
        found[name] = table[unique % len(table)]
        unique = unique // len(table)
    return verts[unique], corners.reshape(-1, 3), {name: array[unique] for name, array in values.items()} | found


def _texture(textures: TexturesUV, values: dict[str, np.ndarray]) -> dict[str, Any]:
    """The image and how it is read; `values["uvs"]` become what WebGL means by texture coordinates."""
    image = _three_channels(_numbers(textures.maps_list()[0]))
    data, (width, height) = packed_image(image)
    values["uvs"] = np.nan_to_num(values["uvs"])
    if textures.align_corners:  # 0 and 1 are the centres of the outermost texels, in WebGL their outer edges
        size = np.array([width, height])
        values["uvs"] = (values["uvs"] * (size - 1) + 0.5) / size
    return {
        "texture": {
            "image": data,
            "repeat": "mirror" if textures.padding_mode == "reflection" else "edge",
            "nearest": textures.sampling_mode == "nearest",
        }
    }


def _cloud_item(cloud: Pointclouds, limits: Limits) -> dict[str, Any]:
    """A batch of one cloud."""
    points, notes = _numbers(cloud.points_packed()), list[str]()
    counts = {"points": len(points)}
    chosen = np.isfinite(points).all(axis=1).nonzero()[0]
    if len(chosen) < len(points):
        notes.append(f"{len(points) - len(chosen):,} points are left out: they are not finite")
    if len(chosen) > limits.points:
        chosen = chosen[chosen_points(len(chosen), limits.points)]
        notes.append(f"drawn with {len(chosen):,} of {len(points):,} points, chosen at random")
    features, normals = cloud.features_packed(), cloud.normals_packed()
    colors = None if features is None else _rgb(features, notes)
    points = points[chosen]
    return {"kind": "points", "counts": counts, "notes": notes, **_bounds(points)} | {
        "positions": packed_positions(points),
        **({} if normals is None else {"normals": packed_normals(_numbers(normals)[chosen])}),
        **({} if colors is None else {"colors": packed_colors(colors[chosen])}),
    }


def _camera_item(cameras: CamerasBase, diagonal: float) -> dict[str, Any]:
    """A pyramid for every camera: its centre and the corners of its image, with a flag on top."""
    cameras = cameras.cpu()
    centers = cameras.get_camera_center().detach()
    depth = _FRUSTUM_OF_SCENE * (diagonal or float(torch.linalg.norm(_box_sides(centers))) or 1.0)
    sides = _image_sides(cameras, len(centers))  # (N, 2)
    square = centers.new_tensor([[1, 1], [-1, 1], [-1, -1], [1, -1], [0, 1.35]])
    xy = sides[:, None] * square
    corners = cameras.unproject_points(torch.cat([xy, torch.full_like(xy[..., :1], depth)], dim=-1), from_ndc=True)
    points = torch.cat([centers[:, None], corners.detach()], dim=1)  # (N, 6, 3)
    edges = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1], [1, 5], [5, 2]])
    lines = (edges + 6 * np.arange(len(points))[:, None, None]).reshape(-1, 2)
    flat = _numbers(points).reshape(-1, 3)
    return {
        "kind": "lines",
        "counts": {"cameras": len(points)},
        "notes": [],
        **_bounds(flat),
        "positions": packed_positions(flat),
        "lines": packed_indices(lines, len(flat)),
    }


def _box_sides(points: Tensor) -> Tensor:
    """The sides (3,) of the bounding box of points (P, 3); zeros if there is none."""
    return points.amax(dim=0) - points.amin(dim=0) if len(points) else points.new_zeros(3)


def _image_sides(cameras: CamerasBase, count: int) -> Tensor:
    """Half the width and half the height of every camera's image in NDC, whose short side is 1. (N, 2)"""
    size = cameras.get_image_size()
    if size is None:
        return torch.ones(count, 2)
    wide = torch.as_tensor(size).float().expand(count, 2).flip(1)  # given as height, width
    return wide / wide.amin(dim=1, keepdim=True)


def _rgb(features: Tensor, notes: list[str]) -> np.ndarray | None:
    """(P, 3) colours of features (P, C): their first three channels, or one as grey."""
    channels = features.shape[-1]
    if channels == 0 or channels == 2:
        notes.append(f"features of {channels} channels are no colours")
        return None
    return _three_channels(_numbers(features))


def _three_channels(colors: np.ndarray) -> np.ndarray:
    return np.repeat(colors[..., :1], 3, axis=-1) if colors.shape[-1] < 3 else colors[..., :3]


def _bounds(points: np.ndarray, faces: np.ndarray | None = None) -> dict[str, Any]:
    """The box of what is drawn, of a mesh the corners of its faces, and how far from the box's middle it reaches."""
    used = points if faces is None else points[np.unique(faces)]
    if not len(used):
        return {"bounds": None, "reach": 0.0}
    low, high = used.min(axis=0).astype(np.float64), used.max(axis=0).astype(np.float64)
    reach = np.linalg.norm(used - (low + high) / 2.0, axis=1).max()
    return {"bounds": [low.tolist(), high.tolist()], "reach": float(reach)}


def _diagonal(items: list[dict[str, Any]]) -> float:
    """Of the box around all items; 0 where there is nothing."""
    boxes = np.array([item["bounds"] for item in items if item["bounds"]], dtype=np.float64).reshape(-1, 2, 3)
    return float(np.linalg.norm(boxes[:, 1].max(axis=0) - boxes[:, 0].min(axis=0))) if len(boxes) else 0.0
