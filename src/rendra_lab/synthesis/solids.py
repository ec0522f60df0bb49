"""Solids of which generated rooms and furniture are put together: boxes, cushions, turned and round parts, sheets.

A solid is a list of corners, each with its normal and its place on the material; neighbouring flat sides have corners
of their own. `weld` merges them to a closed mesh. Metres, y up. Letters: C corners, F faces.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Indices = npt.NDArray[np.int64]
Color = tuple[float, float, float]
Triple = tuple[float, float, float]

_WELD_M = 1e-5  # corners nearer than this are one vertex


@dataclass(frozen=True)
class Solid:
    """One piece of one material.

    Attributes:
        points: (C, 3) corners.
        normals: (C, 3) unit normals, outwards.
        uvs: (C, 2) places on the material: metres, or shares of a picture.
        faces: (F, 3) rows of the corners, counter-clockwise seen from outside.
        surface: name of the material.
        color: sRGB in [0, 1], by which the material is multiplied.
        glow: radiance of what shines by itself, 1 for a white wall in full light; 0 for all else.
        casts: whether it keeps light from others.
    """

    points: Floats
    normals: Floats
    uvs: Floats
    faces: Indices
    surface: str
    color: Color
    glow: float = 0.0
    casts: bool = True

    def moved(self, x: float, y: float, z: float) -> Solid:
        """The same elsewhere."""
        return replace(self, points=self.points + np.array([x, y, z], np.float32))

    def turned(self, axis: str, angle: float) -> Solid:
        """The same, turned about the x, y or z axis through the origin; radians, y to z, z to x, x to y."""
        matrix = rotation(axis, angle).T
        return replace(self, points=self.points @ matrix, normals=self.normals @ matrix)

    def posed(self, matrix: Floats) -> Solid:
        """The same, turned and moved by a rigid matrix (4, 4), for columns."""
        turn = matrix[:3, :3].T
        return replace(self, points=self.points @ turn + matrix[:3, 3], normals=self.normals @ turn)

    def bounds(self) -> Floats:
        """The least and the greatest coordinates: (2, 3)."""
        return np.stack([self.points.min(0), self.points.max(0)])


def rotation(axis: str, angle: float) -> Floats:
    """A rotation matrix (3, 3), for columns, about the x, y or z axis; radians."""
    first = ("xyz".index(axis) + 1) % 3
    second = (first + 1) % 3
    matrix = np.eye(3, dtype=np.float32)
    matrix[first, first] = matrix[second, second] = math.cos(angle)
    matrix[second, first], matrix[first, second] = math.sin(angle), -math.sin(angle)
    return matrix


def weld(solids: Iterable[Solid]) -> tuple[Floats, Indices, Floats]:
    """Vertices (V, 3), faces (F, 3) and colours of the vertices (V, 3), each solid closed in itself."""
    verts, faces, colors, count = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.int64)], [], 0
    for solid in solids:
        keys = np.round(solid.points / _WELD_M).astype(np.int64)
        _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        corners = inverse.reshape(-1)[solid.faces]
        is_flat = (corners != np.roll(corners, 1, axis=1)).all(1)
        verts.append(solid.points[first])
        faces.append(corners[is_flat] + count)
        colors.append(np.tile(np.array(solid.color, np.float32), (len(first), 1)))
        count += len(first)
    return np.concatenate(verts), np.concatenate(faces), np.concatenate([verts[0], *colors])


def box(
    size: Triple, center: Triple, surface: str, color: Color, cell: float = math.inf, grain: int | None = None
) -> Solid:
    """A box with flat sides.

    Args:
        size: along x, y and z.
        center: of it.
        surface: its material.
        color: of it.
        cell: the largest side of the quadrilaterals into which its sides are cut.
        grain: axis along which the material's first coordinate runs; None for the longest.
    """
    half: Floats = np.array(size, np.float32) / np.float32(2)
    cells = tuple(max(1, min(64, math.ceil(side / cell - 1e-4))) for side in size)
    along = int(np.argmax(half)) if grain is None else grain
    points, normals, faces, sides = _box_lattice(cells)
    points = (points * half).astype(np.float32)
    shift = (abs(center[0]) + 3.7 * abs(center[1]) + 7.3 * abs(center[2])) % 1.0  # two boards differ
    return Solid(
        points=points + np.array(center, np.float32),
        normals=normals,
        uvs=_side_uvs(points + half, sides, along) + np.float32(shift),
        faces=faces,
        surface=surface,
        color=color,
    )


def rounded_box(size: Triple, center: Triple, radius: float, surface: str, color: Color, puff: float = 0.0) -> Solid:
    """A box with round edges, as cushions and mattresses are.

    Args:
        size: along x, y and z.
        center: of it.
        radius: of the edges; less where half of the size is less.
        surface: its material.
        color: of it.
        puff: how much the middle of top and bottom swells, metres.
    """
    half: Floats = np.array(size, np.float32) / np.float32(2)
    radius = min(radius, 0.999 * float(half.min()))
    inner = half - np.float32(radius)
    unit, _, faces, sides = _box_lattice((6, 6, 6))
    points = _bent_lattice(unit, half, radius)
    core = np.clip(points, -inner, inner)
    away = points - core
    normals = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    round_points = core + np.float32(radius) * normals
    round_points[:, 1] += puff * unit[:, 1] * (1 - unit[:, 0] ** 2) * (1 - unit[:, 2] ** 2)
    uvs = _side_uvs(points + half, sides, int(np.argmax(half)))
    return Solid(round_points + np.array(center, np.float32), normals, uvs, faces, surface, color)


def lathe(
    profile: Sequence[tuple[float, float]], center: Triple, surface: str, color: Color, segments: int = 16
) -> Solid:
    """What a turner makes: a profile turned about the y axis, with edges at the corners of the profile.

    Args:
        profile: radius and height from the lower end to the upper one; radius 0 at both for a closed solid.
        center: where height 0 of the axis stands.
        surface: its material.
        color: of it.
        segments: round the axis.
    """
    turns = np.linspace(0, 2 * math.pi, segments + 1, dtype=np.float32)
    circle = np.stack([np.sin(turns), np.zeros_like(turns), np.cos(turns)], 1)
    circle[-1] = circle[0]
    ends = np.array(profile, np.float32)
    step = np.diff(ends, axis=0)
    slope = np.stack([step[:, 1], -step[:, 0]], 1) / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(step, axis=1))]).astype(np.float32)
    rows = np.stack([np.arange(len(step)), np.arange(1, len(ends))], 1)  # two rings of corners for each step
    radius, height = ends[rows][..., 0], ends[rows][..., 1]
    points = circle * radius[..., None, None] + np.array([0, 1, 0], np.float32) * height[..., None, None]
    normals = circle * slope[:, None, None, :1] + np.array([0, 1, 0], np.float32) * slope[:, None, None, 1:]
    around = turns * ends[:, 0].max()
    uvs = np.stack(np.broadcast_arrays(length[rows][..., None], around), -1)
    corner = np.arange(points[..., 0].size).reshape(len(step), 2, segments + 1)
    quads = np.stack([corner[:, 0, :-1], corner[:, 0, 1:], corner[:, 1, 1:], corner[:, 1, :-1]], -1).reshape(-1, 4)
    normals = np.broadcast_to(normals, points.shape).reshape(-1, 3)
    return Solid(
        points.reshape(-1, 3) + np.array(center, np.float32),
        normals.astype(np.float32),
        uvs.reshape(-1, 2).astype(np.float32),
        _triangles(quads),
        surface,
        color,
    )


def cylinder(radius: float, height: float, center: Triple, surface: str, color: Color, segments: int = 12) -> Solid:
    """An upright cylinder with its lower end at the centre."""
    return lathe([(0, 0), (radius, 0), (radius, height), (0, height)], center, surface, color, segments)


def ellipsoid(radii: Triple, center: Triple, surface: str, color: Color, segments: int = 10) -> Solid:
    """An ellipsoid with its axes along the coordinates."""
    rows = max(4, segments // 2)
    tilt = np.linspace(0, math.pi, rows + 1)
    profile = [(math.sin(t) if 0 < i < rows else 0.0, -math.cos(t)) for i, t in enumerate(tilt)]
    ball = lathe(profile, (0, 0, 0), surface, color, segments)
    scale = np.array(radii, np.float32)
    length = np.maximum(np.linalg.norm(ball.points, axis=1, keepdims=True), 1e-9)
    normals = ball.points / length / scale
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return replace(
        ball,
        points=ball.points * scale + np.array(center, np.float32),
        normals=normals,
        uvs=ball.uvs * float(max(radii)),
    )


def sheet(
    origin: Triple,
    across: Triple,
    up: Triple,
    lines: tuple[Sequence[float], Sequence[float]],
    surface: str,
    color: Color,
    openings: Sequence[tuple[float, float, float, float]] = (),
) -> Solid:
    """A flat, open, rectangular grid with rectangular openings: walls, floors, panes.

    Args:
        origin: a corner of it.
        across: unit vector of the first coordinate.
        up: unit vector of the second one; across x up is the side that it shows.
        lines: rising coordinates of the grid's lines along both; lines at the edges of the openings among them.
        surface: its material.
        color: of it.
        openings: least and greatest first coordinate, least and greatest second one; nothing is there.
    """
    s, t = (np.array(line, np.float32) for line in lines)
    grid = np.stack(np.meshgrid(s, t, indexing="ij"), -1)
    x, y = np.array(across, np.float32), np.array(up, np.float32)
    points = np.array(origin, np.float32) + grid[..., :1] * x + grid[..., 1:] * y
    normal = np.cross(x, y)
    middle = (grid[:-1, :-1] + grid[1:, 1:]) / 2
    is_there = np.ones(middle.shape[:2], bool)
    for left, right, low, high in openings:
        inside = (middle[..., 0] > left) & (middle[..., 0] < right) & (middle[..., 1] > low) & (middle[..., 1] < high)
        is_there &= ~inside
    row = np.arange(grid[..., 0].size).reshape(grid.shape[:2])
    quads = np.stack([row[:-1, :-1], row[1:, :-1], row[1:, 1:], row[:-1, 1:]], -1)[is_there]
    normals = np.tile(normal.astype(np.float32), (row.size, 1))
    return Solid(points.reshape(-1, 3), normals, grid.reshape(-1, 2), _triangles(quads), surface, color, casts=False)


def grid_lines(least: float, greatest: float, cell: float, also: Sequence[float] = ()) -> list[float]:
    """Rising lines from least to greatest, no farther apart than a cell, with some others among them."""
    stops = sorted({least, greatest, *(line for line in also if least < line < greatest)})
    lines = [least]
    for low, high in itertools.pairwise(stops):
        count = max(1, math.ceil((high - low) / cell - 1e-4))
        lines += [low + (high - low) * step / count for step in range(1, count + 1)]
    return lines


@lru_cache(maxsize=256)
def _box_lattice(cells: tuple[int, int, int]) -> tuple[Floats, Floats, Indices, npt.NDArray[np.int64]]:
    """Corners and normals (C, 3) of the cube from -1 to 1, faces (F, 3) and the axis of each corner's side (C,)."""
    points, normals, faces, axes, count = [], [], [], [], 0
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            u, v = (np.linspace(-1, 1, cells[side] + 1) for side in (first, second))
            grid = np.stack(np.meshgrid(u, v, indexing="ij"), -1)
            side_points = np.empty((*grid.shape[:2], 3))
            side_points[..., first], side_points[..., second], side_points[..., axis] = (
                grid[..., 0],
                grid[..., 1],
                sign,
            )
            row = np.arange(grid[..., 0].size).reshape(grid.shape[:2]) + count
            quads = np.stack([row[:-1, :-1], row[1:, :-1], row[1:, 1:], row[:-1, 1:]], -1).reshape(-1, 4)
            faces.append(_triangles(quads if sign > 0 else quads[:, ::-1]))
            points.append(side_points.reshape(-1, 3))
            normals.append(np.tile(sign * np.eye(3)[axis], (row.size, 1)))
            axes.append(np.full(row.size, axis))
            count += row.size
    return (
        np.concatenate(points).astype(np.float32),
        np.concatenate(normals).astype(np.float32),
        np.concatenate(faces),
        np.concatenate(axes),
    )


def _bent_lattice(unit: Floats, half: Floats, radius: float) -> Floats:
    """The lattice of 6 cells a side, with lines where the round edges begin and two within each of them."""
    steps = np.arange(7)
    lines = np.stack([np.interp(steps, (0, 1, 2, 3, 4, 5, 6), _edge_lines(side, radius)) for side in half])
    index = np.rint((unit + 1) * 3).astype(np.int64)
    return np.stack([lines[axis][index[:, axis]] for axis in range(3)], 1).astype(np.float32)


def _edge_lines(half: float, radius: float) -> list[float]:
    return [-half, -half + 0.45 * radius, -half + radius, 0.0, half - radius, half - 0.45 * radius, half]


def _side_uvs(points: Floats, axes: npt.NDArray[np.int64], along: int) -> Floats:
    """Places on flat sides: the first coordinate runs along an axis wherever the side has it."""
    uvs = np.empty((len(points), 2), np.float32)
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        if second == along:
            first, second = second, first
        rows = axes == axis
        uvs[rows] = points[rows][:, [first, second]] + np.float32(0.37 * axis)
    return uvs


def _triangles(quads: Indices) -> Indices:
    """Two faces for each four corners."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int64)
