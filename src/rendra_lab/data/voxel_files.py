"""Filled cells of objects from files: Pix3D's voxel.mat and ShapeNet's model.binvox.

Letters: V cells along each side of a grid, which fills a cube. Grids are indexed [z, y, x] by the model's own axes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.data.matlab_files import read_matlab
from rendra_lab.errors import UserError

_MOST_CELLS = 512  # along a side
_MOST_BYTES = 256 << 20
_MOST_HEADER = 4096
_NUMBER = rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_BINVOX = re.compile(
    rb"#binvox 1\s+dim\s+(\d{1,6})\s+(\d{1,6})\s+(\d{1,6})\s+"
    rb"translate\s+(N)\s+(N)\s+(N)\s+scale\s+(N)\s+data\n".replace(b"N", _NUMBER)
)


@dataclass(frozen=True)
class Cells:
    """A grid and where it lies."""

    filled: Bool[Tensor, "V V V"]
    middle: Float[Tensor, " 3"]  # of its cube, in the model's coordinates
    side: float  # of its cube

    def to_model(self) -> Float[Tensor, "4 4"]:
        """Columns, float64: a point (x, y, z, 1) of the cube [-1, 1]^3 to the model's coordinates."""
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3] *= self.side / 2
        matrix[:3, 3] = self.middle
        return matrix

    def resized(self, cells: int) -> Cells:
        """The same with another number of cells: one is filled where any that it overlaps is."""
        if cells == len(self.filled):
            return self
        pooled = F.adaptive_max_pool3d(self.filled[None].float(), cells)[0] > 0
        return Cells(pooled, self.middle, self.side)


def read_voxel_mat(path: Path) -> Bool[Tensor, "V V V"]:
    """The grid of Pix3D's voxel.mat, whose axes are the model's x, -z and y.

    Raises:
        UserError: no such file, no cube of whole numbers in it, or an empty one.
    """
    expected = "'voxel' as an array (V, V, V) of 0 and 1"
    grid = read_matlab(path, "voxel", expected, _MOST_CELLS**3)
    if grid.ndim != 3 or len(set(grid.shape)) != 1:
        raise UserError(f"{path}: 'voxel' has the shape {grid.shape}; expected {expected}")
    if not np.isin(grid, (0, 1)).all():
        raise UserError(f"{path}: 'voxel' holds {grid[~np.isin(grid, (0, 1))][0]:g}; expected {expected}")
    filled = np.ascontiguousarray((grid > 0)[:, ::-1].transpose(1, 2, 0))
    return _demand_filled(torch.from_numpy(filled), path)


def read_binvox(path: Path) -> Cells:
    """Cells of a .binvox, where its header says that they lie.

    Patrick Min's format: runs of a value and a count in bytes, y fastest, then z, then x.

    Raises:
        UserError: no such file, another format, no cube, another number of cells than declared, or none filled.
    """
    if not path.is_file():
        raise UserError(f"there is no file {path}")
    if path.stat().st_size > _MOST_BYTES:
        raise UserError(f"{path} has {path.stat().st_size:,} bytes; at most {_MOST_BYTES:,} are read")
    data = path.read_bytes()
    header = _BINVOX.match(data[:_MOST_HEADER])
    if header is None:
        raise UserError(f"{path} is no binvox file: expected '#binvox 1' and lines of dim, translate, scale and data")
    *dims, x, y, z, scale = (float(word) for word in header.groups())
    cells = int(dims[0])
    if len(set(dims)) != 1 or not 1 <= cells <= _MOST_CELLS:
        shown = " x ".join(f"{side:g}" for side in dims)
        raise UserError(f"{path} has {shown} cells; expected a cube of 1 to {_MOST_CELLS} along each side")
    numbers = torch.tensor([x, y, z, scale], dtype=torch.float64)
    if not bool(numbers.abs().lt(1e9).all()) or not scale > 1e-9:
        raise UserError(f"{path}: translate is {x:g} {y:g} {z:g} and scale {scale:g}; expected a cube of some size")
    runs = np.frombuffer(data[header.end() :], np.uint8)
    values, counts = runs[: len(runs) // 2 * 2 : 2], runs[1::2]
    if len(runs) % 2 or int(counts.sum(dtype=np.int64)) != cells**3 or (values > 1).any():
        raise UserError(f"{path}: its runs are not of {cells} x {cells} x {cells} values 0 and 1")
    grid = np.repeat(values > 0, counts).reshape(cells, cells, cells)  # x, z, y
    filled = torch.from_numpy(np.ascontiguousarray(grid.transpose(1, 2, 0)))
    return Cells(_demand_filled(filled, path), numbers[:3] + scale / 2, scale)


def laid_about(filled: Bool[Tensor, "V V V"], verts: Float[Tensor, "N 3"]) -> Cells:
    """A grid, laid so that its filled cells are about a surface: with one middle, and one longest side.

    Args:
        filled: with a filled cell at least.
        verts: the surface's, of some extent.
    """
    low, high = verts.double().amin(0), verts.double().amax(0)
    rows = [filled.any(2).any(1), filled.any(2).any(0), filled.any(1).any(0)][::-1]  # x, y, z
    first = torch.stack([row.nonzero()[0, 0] for row in rows]).double()
    last = torch.stack([row.nonzero()[-1, 0] for row in rows]).double() + 1
    cell = float((high - low).amax() / (last - first).amax())
    middle = (low + high) / 2 - cell * ((first + last) / 2 - len(filled) / 2)
    return Cells(filled, middle, cell * len(filled))


def _demand_filled(filled: Tensor, path: Path) -> Tensor:
    if not bool(filled.any()):
        raise UserError(f"{path}: none of its {filled.numel():,} cells is filled")
    return filled
