"""Light that reaches the surfaces of a room: from lamps and windows past what stands in the way, and from all sides.

What keeps light away is taken for boxes, which stand in groups that are turned about the y axis. A box hides nothing
from a point within it. Metres, y up. Letters: C corners, L lights, B boxes, G groups.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from rendra_lab.synthesis.solids import Floats

_LIFT = np.float32(0.01)  # metres that corners are lifted off their surface, so that it does not hide them
_NEARBY = np.float32(0.9)  # metres within which surfaces darken each other
_UPWARDS = np.float32(0.35)  # share of its light that a lamp's shade lets through to what is above it
_SOFT = np.float32(0.15)  # added to squared distances: lamps are no points
_DARKEST = np.float32(0.85)  # share of the light from all sides that what touches a point takes
_BURIED = np.float32(0.3)  # share of it that is left to a wall or floor within furniture
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
_ZERO, _ONE, _TINY = np.float32(0), np.float32(1), np.float32(1e-6)


@dataclass(frozen=True)
class Blockers:
    """Groups of boxes that keep light and people away.

    Attributes:
        boxes: (B, 6) least and greatest coordinates in the axes of their group.
        first: (G + 1,) first box of each group.
        bounds: (G, 6) of all boxes of a group.
        frames: (G, 5) cosine and sine of the angle by which a group is turned, from z to x, and where it stands.
    """

    boxes: Floats
    first: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    bounds: Floats
    frames: Floats

    @classmethod
    def of(cls, groups: Sequence[tuple[Floats, float, tuple[float, float, float]]]) -> Blockers:
        """Of groups of boxes (B, 6), each with its angle and its place."""
        counts = np.array([0, *(len(boxes) for boxes, _, _ in groups)])
        stacked = [np.concatenate([boxes[:, :3].min(0), boxes[:, 3:].max(0)]) for boxes, _, _ in groups]
        frames = [(math.cos(yaw), math.sin(yaw), *place) for _, yaw, place in groups]
        return cls(
            boxes=np.concatenate([np.zeros((0, 6)), *(boxes for boxes, _, _ in groups)]).astype(np.float32),
            first=counts.cumsum().astype(np.int64),
            bounds=np.array(stacked, np.float32).reshape(-1, 6),
            frames=np.array(frames, np.float32).reshape(-1, 5),
        )

    def hold(self, points: Floats, margin: float = 0.0) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Whether points (N, 3) lie in a box, or nearer to it than a margin along each of its axes: (N,)."""
        held = np.zeros(len(points), np.bool_)
        for (cos, sin, *place), first, last in zip(self.frames, self.first[:-1], self.first[1:], strict=True):
            x, y, z = (points - np.array(place, np.float32)).T
            own = np.stack([cos * x - sin * z, y, sin * x + cos * z], 1)[:, None]
            boxes = self.boxes[first:last]
            is_in = (own > boxes[:, :3] - margin) & (own < boxes[:, 3:] + margin)
            held |= np.any(is_in.all(-1), axis=1)
        return held


@dataclass(frozen=True)
class Lights:
    """Small lights.

    Attributes:
        places: (L, 3).
        colors: (L, 3) intensity: of a lamp to all sides, of a window straight ahead.
        normals: (L, 3) where a window looks; zero for a lamp.
    """

    places: Floats
    colors: Floats
    normals: Floats


def bake(points: Floats, normals: Floats, lights: Lights, blockers: Blockers) -> Floats:
    """Irradiance (C, 3) of corners (C, 3) by all lights, shadows included; normals have unit length."""
    direct = np.empty_like(points)
    parts = (blockers.boxes, blockers.first, blockers.bounds, blockers.frames)
    _light(points, normals, (lights.places, lights.colors, lights.normals), parts, direct)
    return direct


def openness(
    points: Floats, normals: Floats, num_shell: int, room: tuple[float, float, float], blockers: Blockers
) -> Floats:
    """The share (C,) of the light from all sides that is left by what is near: walls, and boxes that stand about.

    Args:
        points: (C, 3).
        normals: (C, 3), of unit length.
        num_shell: the first so many belong to floor, ceiling and walls: within a box they are in the dark.
        room: extent of the room, from the origin.
        blockers: what stands about.
    """
    share = np.empty(len(points), np.float32)
    parts = (blockers.boxes, blockers.first, blockers.bounds, blockers.frames)
    _open(points, normals, np.array(room, np.float32), _directions(), parts, share)
    share[:num_shell][blockers.hold((points + _LIFT * normals)[:num_shell])] = _BURIED
    return share


def _directions() -> Floats:
    """Fourteen directions (14, 3): along the axes and the diagonals, turned so that no edge is met exactly."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / math.sqrt(3)
    cos, sin = math.cos(0.3), math.sin(0.3)
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    tip = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    return np.ascontiguousarray(np.concatenate([axes, signs]) @ turn @ tip, np.float32)


@_compiled
def _own(frame, x, y, z):  # type: ignore[no-untyped-def]
    """A vector of the room in the axes of a group."""
    return frame[0] * x - frame[1] * z, y, frame[1] * x + frame[0] * z


@_compiled
def _over(value):  # type: ignore[no-untyped-def]
    """1 / value, finite."""
    return _ONE / (value if abs(value) > _TINY else _TINY)


@_compiled
def _crossed(box, x, y, z, over_x, over_y, over_z):  # type: ignore[no-untyped-def]
    """When a ray enters a box and when it leaves it, in units of its way."""
    near, far = (box[0] - x) * over_x, (box[3] - x) * over_x
    entry, leave = min(near, far), max(near, far)
    near, far = (box[1] - y) * over_y, (box[4] - y) * over_y
    entry, leave = max(entry, min(near, far)), min(leave, max(near, far))
    near, far = (box[2] - z) * over_z, (box[5] - z) * over_z
    return max(entry, min(near, far)), min(leave, max(near, far))


@_compiled
def _entry(x, y, z, way_x, way_y, way_z, first_hit, parts):  # type: ignore[no-untyped-def]
    """When a ray first enters a box, at most `_ONE`; where any hit will do, when it enters one of them."""
    boxes, first, bounds, frames = parts
    nearest = _ONE
    for group in range(len(frames)):
        frame = frames[group]
        own_x, own_y, own_z = _own(frame, x - frame[2], y - frame[3], z - frame[4])
        to_x, to_y, to_z = _own(frame, way_x, way_y, way_z)
        over_x, over_y, over_z = _over(to_x), _over(to_y), _over(to_z)
        entry, leave = _crossed(bounds[group], own_x, own_y, own_z, over_x, over_y, over_z)
        if entry >= leave or leave <= _ZERO or entry >= nearest:
            continue
        for row in range(first[group], first[group + 1]):
            entry, leave = _crossed(boxes[row], own_x, own_y, own_z, over_x, over_y, over_z)
            if entry > _ZERO and entry < leave and entry < nearest:
                nearest = entry
                if not first_hit:
                    return nearest
    return nearest


@_compiled
def _light(points, normals, lights, parts, direct):  # type: ignore[no-untyped-def]
    places, colors, aheads = lights
    for corner in range(len(points)):
        nx, ny, nz = normals[corner, 0], normals[corner, 1], normals[corner, 2]
        x, y, z = points[corner, 0] + _LIFT * nx, points[corner, 1] + _LIFT * ny, points[corner, 2] + _LIFT * nz
        red, green, blue = _ZERO, _ZERO, _ZERO
        for light in range(len(places)):
            wx, wy, wz = places[light, 0] - x, places[light, 1] - y, places[light, 2] - z
            squared = wx * wx + wy * wy + wz * wz + _TINY
            strength = (wx * nx + wy * ny + wz * nz) / np.sqrt(squared)
            ax, ay, az = aheads[light, 0], aheads[light, 1], aheads[light, 2]
            if ax != _ZERO or ay != _ZERO or az != _ZERO:
                strength *= max(_ZERO, -(wx * ax + wy * ay + wz * az) / np.sqrt(squared))
            elif wy < _ZERO:
                strength *= _UPWARDS
            if strength > _ZERO and _entry(x, y, z, wx, wy, wz, False, parts) >= _ONE:
                strength /= squared + _SOFT
                red += strength * colors[light, 0]
                green += strength * colors[light, 1]
                blue += strength * colors[light, 2]
        direct[corner, 0], direct[corner, 1], direct[corner, 2] = red, green, blue


@_compiled
def _open(points, normals, room, directions, parts, share):  # type: ignore[no-untyped-def]
    for corner in range(len(points)):
        nx, ny, nz = normals[corner, 0], normals[corner, 1], normals[corner, 2]
        x, y, z = points[corner, 0] + _LIFT * nx, points[corner, 1] + _LIFT * ny, points[corner, 2] + _LIFT * nz
        hidden, whole = _ZERO, _TINY
        for number in range(len(directions)):
            dx, dy, dz = directions[number, 0], directions[number, 1], directions[number, 2]
            weight = dx * nx + dy * ny + dz * nz
            if weight <= _ZERO:
                continue
            leave_x = max(-x / dx, (room[0] - x) / dx)
            leave_y = max(-y / dy, (room[1] - y) / dy)
            leave_z = max(-z / dz, (room[2] - z) / dz)
            leave = max(_ZERO, min(leave_x, min(leave_y, leave_z)) / _NEARBY)
            entry = _entry(x, y, z, _NEARBY * dx, _NEARBY * dy, _NEARBY * dz, True, parts)
            hidden += weight * (_ONE - min(entry, min(leave, _ONE)))
            whole += weight
        share[corner] = _ONE - _DARKEST * hidden / whole
