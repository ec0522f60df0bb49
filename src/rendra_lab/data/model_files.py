"""Models of objects from files: their surfaces and filled cells, read once, and placed before cameras.

Letters: N objects, V vertices, F faces, P points, S cells along a side. Cameras: as of `rendra_lab.shape_records`.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import sys
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from rendra.io import load_obj
from rendra.io._source import neighbour
from rendra.io.errors import MeshFormatError
from rendra.ops import sample_points_from_meshes
from rendra.structures import Meshes
from rendra_lab.data import voxel_files
from rendra_lab.data.kept_tensors import Tensors, kept_or_made
from rendra_lab.data.voxel_files import Cells, laid_about, read_binvox, read_voxel_mat
from rendra_lab.errors import UserError
from rendra_lab.settings import Count, Positive, check_numbers
from rendra_lab.shape_records import Shapes
from rendra_lab.voxelization import voxels_of

_MOST_BYTES = 512 << 20
_FARTHEST = 1e6  # coordinate of a vertex
_ASTRAY = 0.1  # of a model's longest side, by which cells may miss its surface


@dataclass(frozen=True)
class ModelPath:
    """Where a model is.

    Attributes:
        mesh: an OBJ file.
        voxels: Pix3D's voxel.mat or a .binvox; None fills cells by the mesh.
        cube: middle x, y, z and side of a voxel.mat's grid, where somebody knows.
    """

    mesh: Path
    voxels: Path | None = None
    cube: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class Model:
    """An object in its own coordinates."""

    verts: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    cells: Cells


class ModelShelf:
    """Reads models, and keeps those that it read last.

    Args:
        cells: S, along a side of their grids.
        kept: how many stay in memory; copies of the shelf begin with none.
        cache: folder for models that were read, which are found there faster; None reads the files each time.

    Raises:
        UserError: numbers that cannot be.
    """

    def __init__(self, cells: Positive = 48, kept: Count = 256, cache: str | Path | None = None) -> None:
        check_numbers("data", Positive, voxels=cells)
        check_numbers("data", Count, kept_models=kept)
        if cells > 256:
            raise UserError(f"data.voxels={cells} along a side of a grid are too many; at most 256")
        self.cells = cells
        self.kept = kept
        self.cache = None if cache is None else Path(cache) / "models"
        self._shelf: OrderedDict[ModelPath, Model] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_shelf": OrderedDict()}

    def model(self, path: ModelPath) -> Model:
        """A model whole.

        Raises:
            UserError: a file that is not there, is broken or holds no surface; it is named.
        """
        found = self._shelf.pop(path, None) or self._fetched(path)
        if self.kept > 0:
            self._shelf[path] = found
            if len(self._shelf) > self.kept:
                self._shelf.popitem(last=False)
        return found

    def shapes(self, paths: Sequence[ModelPath], to_camera: Float[Tensor, "N 4 4"], points: int) -> Shapes:
        """Models before cameras, with points on them that torch's global stream draws.

        Args:
            paths: N models.
            to_camera: columns, float64, rigid: their coordinates to the camera's axes.
            points: P of each.
        """
        models = [self.model(path) for path in paths]
        verts = tuple(_moved(model.verts, pose) for model, pose in zip(models, to_camera, strict=True))
        faces = tuple(model.faces for model in models)
        places, normals = [torch.zeros(0, points, 3)], [torch.zeros(0, points, 3)]
        for each, rows in zip(verts, faces, strict=True):  # not in one: meshes of all sizes
            found = sample_points_from_meshes(Meshes([each], [rows]), points, return_normals=True)
            places.append(found[0])
            normals.append(found[1])
        own = [pose @ model.cells.to_model() for model, pose in zip(models, to_camera, strict=True)]
        side = self.cells
        return Shapes(
            points=torch.cat(places),
            normals=torch.cat(normals),
            voxels=torch.stack([model.cells.filled for model in models])
            if models
            else torch.zeros(0, side, side, side, dtype=torch.bool),
            voxels_to_camera=torch.stack(own).float() if own else torch.zeros(0, 4, 4),
            verts=verts,
            faces=faces,
        )

    def _fetched(self, path: ModelPath) -> Model:
        if self.cache is None:
            return read_model(path, self.cells)
        name = f"model_{self._fingerprint(path)}.safetensors"
        kept = kept_or_made(self.cache / name, "model", lambda: _packed(read_model(path, self.cells)))
        return _unpacked(kept, self.cells)

    def _fingerprint(self, path: ModelPath) -> str:
        """24 hexadecimal digits that stand for the files as they are now, and the code that reads them."""
        files = [path.mesh] if path.voxels is None else [path.mesh, path.voxels]
        try:
            states = [(os.path.abspath(file), (at := file.stat()).st_size, at.st_mtime_ns) for file in files]
        except OSError as error:
            raise UserError(f"there is no file {error.filename}") from error
        code = [inspect.getsource(module) for module in (voxel_files, sys.modules[__name__])]
        return hashlib.sha256(repr((states, path.cube, self.cells, code)).encode()).hexdigest()[:24]


def path_within(folder: Path, name: str, where: str) -> Path:
    """What a file calls a path, within a folder.

    Raises:
        UserError: it leads out of the folder; `where` names who says so.
    """
    try:
        return Path(neighbour(str(folder), name, file=where, line=None))
    except MeshFormatError as error:
        raise UserError(f"{where}: {error.why}: {name!r}; expected a file within {folder}") from error


def read_surface(path: Path) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"]]:
    """Vertices and triangles of an OBJ file; materials are not read.

    Raises:
        UserError: no file, a malformed one, one without faces, or with faces that have no extent.
    """
    if not path.is_file():
        raise UserError(f"there is no file {path}")
    if path.stat().st_size > _MOST_BYTES:
        raise UserError(f"{path} has {path.stat().st_size:,} bytes; at most {_MOST_BYTES:,} are read")
    try:
        verts, faces, _ = load_obj(path, load_textures=False)
    except (MeshFormatError, OSError) as error:
        raise UserError(f"{path} is no model that can be read: {error}") from error
    rows = faces.verts_idx
    if not len(rows):
        raise UserError(f"{path}: the mesh has {len(verts):,} vertices and no faces; expected one face at least")
    if not bool(verts.abs().lt(_FARTHEST).all()):
        raise UserError(f"{path}: a coordinate is {float(verts.abs().max()):g}; expected less than {_FARTHEST:g}")
    used = verts.index_select(0, rows.unique())
    extent = float((used.amax(0) - used.amin(0)).amax())
    a, b, c = verts.double().index_select(0, rows.reshape(-1)).reshape(-1, 3, 3).unbind(1)
    area = float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum()) / 2
    if not area > 1e-12 * extent**2:
        raise UserError(f"{path}: its {len(rows):,} faces have no area; expected a surface")
    return verts, rows


def read_model(path: ModelPath, cells: int) -> Model:
    """A model of files.

    Args:
        path: of them.
        cells: along a side of the grid.

    Raises:
        UserError: what `read_surface`, `read_voxel_mat` or `read_binvox` refuse; cells that miss the surface.
    """
    verts, faces = read_surface(path.mesh)
    used = verts.index_select(0, faces.unique())
    found = _cells_by_mesh(verts, faces, used, cells) if path.voxels is None else _cells_of_file(path, used)
    return Model(verts, faces, found.resized(cells))


def _cells_by_mesh(verts: Tensor, faces: Tensor, used: Tensor, cells: int) -> Cells:
    """Cells over the cube about a model's bounding box."""
    low, high = used.double().amin(0), used.double().amax(0)
    middle, side = (low + high) / 2, float((high - low).amax())
    return Cells(voxels_of(((verts.double() - middle) * (2 / side)).float(), faces, cells), middle, side)


def _cells_of_file(path: ModelPath, used: Tensor) -> Cells:
    assert path.voxels is not None
    if path.voxels.suffix.lower() != ".binvox":
        filled = read_voxel_mat(path.voxels)
        if path.cube is None:
            return laid_about(filled, used)
        found = Cells(filled, torch.tensor(path.cube[:3], dtype=torch.float64), path.cube[3])
    else:
        found = read_binvox(path.voxels)
    expected = laid_about(found.filled, used)
    astray = float((found.middle - expected.middle).abs().amax()) + abs(found.side - expected.side) / 2
    if astray > _ASTRAY * float((used.amax(0) - used.amin(0)).amax()) + 2 * expected.side / len(found.filled):
        raise UserError(
            f"{path.voxels}: its filled cells miss the surface of {path.mesh} by {astray:.3g}; "
            "expected both in one system of coordinates"
        )
    return found


def _moved(verts: Tensor, pose: Tensor) -> Tensor:
    return (verts.double() @ pose[:3, :3].T + pose[:3, 3]).float()


def _packed(model: Model) -> Tensors:
    bits = np.packbits(model.cells.filled.numpy().reshape(-1))
    return {
        "verts": model.verts,
        "faces": model.faces.int(),
        "bits": torch.from_numpy(bits),
        "cube": torch.cat([model.cells.middle, torch.tensor([model.cells.side], dtype=torch.float64)]),
    }


def _unpacked(kept: Tensors, cells: int) -> Model:
    filled = np.unpackbits(kept["bits"].numpy(), count=cells**3).astype(bool).reshape(cells, cells, cells)
    cube = kept["cube"]
    return Model(kept["verts"], kept["faces"].long(), Cells(torch.from_numpy(filled), cube[:3], float(cube[3])))
