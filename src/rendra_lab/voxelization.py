"""Meshes of solids as grids of cells, and whether points lie within them.

Solids may overlap and touch: what counts is how often a surface winds around a point. A ray along +z from the point
crosses faces from inside to outside (+1) and from outside to inside (-1); their sum is the winding number. Whether a
ray meets a face is decided edge by edge, the same way for both faces at an edge: no ray slips between two of them,
and crossings of a closed surface cancel exactly.

Letters: V vertices, F faces, P points, S cells along each side.
"""

from __future__ import annotations

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_SLACK = 1e-4  # of a cell's side: what lies in the plane between two cells passes through neither
_BINS = 128  # at most, along x and y, in which faces are looked up
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


def voxels_of(verts: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], side: int) -> Bool[Tensor, "S S S"]:
    """The grid of a mesh over the cube [-1, 1]^3, [z, y, x].

    A cell is filled where its middle is within a solid, or where the surface passes through it: nothing is too thin
    to be seen. Where the surface has holes, what is before or behind all of it along z stays empty. Parts outside of
    the cube are left out.

    Args:
        verts: in the axes of the cube.
        faces: counter-clockwise seen from outside, or all of them clockwise.
        side: S, cells along each side of the cube.

    Raises:
        ValueError: no cells; vertices that are not finite; faces of vertices that are not there.
    """
    if side < 1:
        raise ValueError(f"a grid has at least 1 cell along each side, got {side}")
    corners = (_corners(verts, faces) + 1) * (side / 2)  # in cells
    crossings = np.zeros((side, side, side + 1), np.int32)
    _cross_columns(corners, crossings)
    above = np.cumsum(crossings[:, :, ::-1], axis=2)[:, :, ::-1]  # crossings at or above each middle
    total, winding = above[:, :, :1], above[:, :, 1:]
    filled = np.ascontiguousarray(((winding != 0) & (winding != total)).transpose(2, 0, 1))
    _touch(corners, 0.5 - _SLACK, filled)
    if not filled.any():
        _touch(corners, 0.5 + _SLACK, filled)  # a sheet between two layers of cells
    return torch.from_numpy(filled).to(verts.device)


def windings_at(
    points: Float[Tensor, "P 3"], verts: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Int[Tensor, " P"]:
    """How often the surface winds around each point: 0 outside of closed solids, n within n of them.

    Points on the surface are on either side of it. For faces that are clockwise seen from outside it is negative.

    Raises:
        ValueError: vertices or points that are not finite; faces of vertices that are not there.
    """
    corners, places = _corners(verts, faces), _plain(points, "points")
    windings = np.zeros(len(places), np.int64)
    if len(corners) and len(places):
        low, high = corners[:, :, :2].min((0, 1)), corners[:, :, :2].max((0, 1))
        bins = int(min(_BINS, max(1, round(len(corners) ** 0.5))))
        over = bins / np.maximum(high - low, 1e-12)
        reach = np.stack([corners[:, :, :2].min(1), corners[:, :, :2].max(1)], 1)
        reach = np.clip(np.floor((reach - low) * over), 0, bins - 1).astype(np.int64)
        starts, rows = _binned(reach, bins)
        _wind(places, corners, low, over, starts, rows, windings)
    return torch.from_numpy(windings).to(points.device)


def _plain(places: Tensor, what: str) -> np.ndarray:
    array = places.detach().cpu().double().contiguous().numpy()
    if not np.isfinite(array).all():
        raise ValueError(f"{what} must be finite numbers, got {int((~np.isfinite(array)).sum())} that are not")
    return array


def _corners(verts: Tensor, faces: Tensor) -> np.ndarray:
    """The corners (F, 3, 3) of faces, in double precision."""
    array, rows = _plain(verts, "vertices"), faces.detach().cpu().long().numpy()
    if rows.size and not 0 <= rows.min() <= rows.max() < len(array):
        raise ValueError(f"faces name vertices {rows.min()} to {rows.max()}, but there are {len(array)}")
    return np.ascontiguousarray(array[rows])


@_compiled
def _turn(ax, ay, bx, by, px, py):  # type: ignore[no-untyped-def]
    """What an edge from a to b adds to the winding about p: +-1 where it passes above p, that is at greater y.

    Its line is evaluated from the left end to the right one, whichever way it is run through.
    """
    if (ax <= px) == (bx <= px):
        return 0
    if ax <= px:
        return -1 if (bx - ax) * (py - ay) < (by - ay) * (px - ax) else 0
    return 1 if (ax - bx) * (py - by) < (ay - by) * (px - bx) else 0


@_compiled
def _winding(corner, px, py):  # type: ignore[no-untyped-def]
    """How often a face winds around the line along z through (px, py): +1 where its normal points to greater z."""
    ax, ay, bx, by, cx, cy = (
        corner[0, 0], corner[0, 1], corner[1, 0], corner[1, 1], corner[2, 0], corner[2, 1],
    )  # fmt: skip
    return _turn(ax, ay, bx, by, px, py) + _turn(bx, by, cx, cy, px, py) + _turn(cx, cy, ax, ay, px, py)


@_compiled
def _height(corner, px, py):  # type: ignore[no-untyped-def]
    """The z of a face above (px, py), within that of its corners."""
    ux, uy, uz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    vx, vy, vz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    low = min(corner[0, 2], min(corner[1, 2], corner[2, 2]))
    high = max(corner[0, 2], max(corner[1, 2], corner[2, 2]))
    if z == 0.0:
        return low
    return min(max(corner[0, 2] - (x * (px - corner[0, 0]) + y * (py - corner[0, 1])) / z, low), high)


@_compiled
def _span(corner, axis, side):  # type: ignore[no-untyped-def]
    """The first cell that a face may reach along an axis, and the one behind the last."""
    low = min(corner[0, axis], min(corner[1, axis], corner[2, axis]))
    high = max(corner[0, axis], max(corner[1, axis], corner[2, axis]))
    first = max(np.floor(low - 0.01), 0.0)
    return int(min(first, side)), int(max(min(np.floor(high + 0.01) + 1.0, side), 0.0))


@_compiled
def _cross_columns(corners, crossings):  # type: ignore[no-untyped-def]
    """Signed crossings (y, x, k) of the lines through the middles of cells; the middles of k cells lie below."""
    side = crossings.shape[0]
    for face in range(len(corners)):
        corner = corners[face]
        first_x, last_x = _span(corner, 0, side)
        first_y, last_y = _span(corner, 1, side)
        for row in range(first_y, last_y):
            for column in range(first_x, last_x):
                winding = _winding(corner, column + 0.5, row + 0.5)
                if winding != 0:
                    height = _height(corner, column + 0.5, row + 0.5)
                    below = int(max(0.0, min(float(side), np.ceil(height - 0.5))))
                    crossings[row, column, below] += winding


@_compiled
def _touch(corners, half, filled):  # type: ignore[no-untyped-def]
    """Fills the cells (z, y, x) that faces pass through; cells reach so far from their middles along each axis.

    By separating axes: those of the cell, the face's normal, and what is across to an edge and an axis.
    """
    side = filled.shape[0]
    for face in range(len(corners)):
        corner = corners[face]
        first_x, last_x = _span(corner, 0, side)
        first_y, last_y = _span(corner, 1, side)
        first_z, last_z = _span(corner, 2, side)
        for z in range(first_z, last_z):
            for y in range(first_y, last_y):
                for x in range(first_x, last_x):
                    if not filled[z, y, x] and _meets(corner, x + 0.5, y + 0.5, z + 0.5, half):
                        filled[z, y, x] = True


@_compiled
def _meets(corner, x, y, z, half):  # type: ignore[no-untyped-def]
    """Whether a face passes through the cube of a half side about (x, y, z)."""
    ax, ay, az = corner[0, 0] - x, corner[0, 1] - y, corner[0, 2] - z
    bx, by, bz = corner[1, 0] - x, corner[1, 1] - y, corner[1, 2] - z
    cx, cy, cz = corner[2, 0] - x, corner[2, 1] - y, corner[2, 2] - z
    for low, high in (
        (min(ax, min(bx, cx)), max(ax, max(bx, cx))),
        (min(ay, min(by, cy)), max(ay, max(by, cy))),
        (min(az, min(bz, cz)), max(az, max(bz, cz))),
    ):
        if low > half or high < -half:
            return False
    ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    if abs(nx * ax + ny * ay + nz * az) > half * (abs(nx) + abs(ny) + abs(nz)):
        return False
    for ex, ey, ez in ((ux, uy, uz), (vx - ux, vy - uy, vz - uz), (vx, vy, vz)):
        if (
            _is_apart(ay * ez - az * ey, by * ez - bz * ey, cy * ez - cz * ey, half * (abs(ey) + abs(ez)))
            or _is_apart(az * ex - ax * ez, bz * ex - bx * ez, cz * ex - cx * ez, half * (abs(ez) + abs(ex)))
            or _is_apart(ax * ey - ay * ex, bx * ey - by * ex, cx * ey - cy * ex, half * (abs(ex) + abs(ey)))
        ):
            return False
    return True


@_compiled
def _is_apart(a, b, c, reach):  # type: ignore[no-untyped-def]
    return min(a, min(b, c)) > reach or max(a, max(b, c)) < -reach


@_compiled
def _binned(reach, bins):  # type: ignore[no-untyped-def]
    """Rows of the faces of each bin, bins of a row of them side by side: where each begins, and the rows."""
    starts = np.zeros(bins * bins + 1, np.int64)
    for face in range(len(reach)):
        for row in range(reach[face, 0, 1], reach[face, 1, 1] + 1):
            for column in range(reach[face, 0, 0], reach[face, 1, 0] + 1):
                starts[row * bins + column + 1] += 1
    for index in range(bins * bins):
        starts[index + 1] += starts[index]
    rows, ends = np.empty(starts[-1], np.int64), starts.copy()
    for face in range(len(reach)):
        for row in range(reach[face, 0, 1], reach[face, 1, 1] + 1):
            for column in range(reach[face, 0, 0], reach[face, 1, 0] + 1):
                rows[ends[row * bins + column]] = face
                ends[row * bins + column] += 1
    return starts, rows


@_compiled
def _wind(places, corners, low, over, starts, rows, windings):  # type: ignore[no-untyped-def]
    bins = int(np.sqrt(len(starts) - 1.0) + 0.5)
    for index in range(len(places)):
        x, y, z = places[index, 0], places[index, 1], places[index, 2]
        column, row = np.floor((x - low[0]) * over[0]), np.floor((y - low[1]) * over[1])
        if column < 0 or row < 0 or column > bins or row > bins:
            continue
        cell = int(min(row, bins - 1.0)) * bins + int(min(column, bins - 1.0))
        for place in range(starts[cell], starts[cell + 1]):
            corner = corners[rows[place]]
            winding = _winding(corner, x, y)
            if winding != 0 and _height(corner, x, y) > z:
                windings[index] += winding
