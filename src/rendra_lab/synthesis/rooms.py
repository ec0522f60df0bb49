"""Generated rooms, seen by someone who stands in them: no two seeds show the same one.

Rooms: y up, metres, from the origin to the room's extent. Axes of cameras are OpenCV's: x right, y down, z forwards.
Letters: V views, C corners.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from rendra_lab.errors import UserError
from rendra_lab.settings import Range, check_numbers
from rendra_lab.synthesis.baked_light import Blockers, Lights, bake, openness
from rendra_lab.synthesis.lit_solids import lit_surfaces
from rendra_lab.synthesis.posed_views import PosedViews
from rendra_lab.synthesis.rooms_furnishing import Furnishing, Lamp, furnish
from rendra_lab.synthesis.rooms_shell import (
    WALLS,
    Opening,
    Placed,
    build_wall,
    draw_openings,
    draw_style,
    floor_and_ceiling,
    wall_frame,
)
from rendra_lab.synthesis.rooms_surfaces import paint_surfaces
from rendra_lab.synthesis.solids import Floats, Solid
from rendra_lab.synthesis.surface_pictures import LitSurfaces, picture_views
from rendra_lab.synthesis.texture_pyramid import TexturePyramid

EDITION = 1  # of the rooms; another one makes all cached pictures anew
CLEARANCE_M = 0.22  # from any eye to furniture and walls
_EYE_M = (1.2, 1.7)
_PITCH_SHARE, _ROLL_SHARE = 0.5, 0.2  # of the turns: heads are mostly turned about the vertical
_PLACES = 256  # that are tried for the eye
_MOVES = 64  # that are tried for each view
_RNG = np.random.Generator

Furnish = Callable[[tuple[float, float, float], tuple[Opening, ...], np.random.Generator], Furnishing]
"""What furnishes a room of an extent with its openings."""

Degrees = Annotated[float, Range(0, 45)]
Metres = Annotated[float, Range(0, 1)]
FieldOfView = Annotated[float, Range(20, 140)]


@dataclass(frozen=True)
class Room:
    """A room that is ready to be looked at.

    Attributes:
        extent: width, height and depth.
        placed: all that stands and hangs in it, its walls' fixtures last.
        obstacles: the boxes about all of it.
        surfaces: its triangles and their light.
        pictures: of its materials.
        owners: (F,) rows of what is placed to which triangles belong; -1 for floor, ceiling and walls.
    """

    extent: tuple[float, float, float]
    placed: tuple[Placed, ...]
    obstacles: Blockers
    surfaces: LitSurfaces
    pictures: TexturePyramid
    owners: Tensor


class RoomWorld:
    """Living rooms, bedrooms, dining rooms and studies without end; a `World` of views.

    Args:
        hfov_deg: horizontal field of view; Matterport's and Replica's pictures have 90.
        max_turn_deg: by how much two views of a place differ at most about the vertical; half of it in pitch.
        max_move_m: by how much two views of a place differ at most along each axis.

    Raises:
        UserError: a setting that is out of range.
    """

    def __init__(self, hfov_deg: FieldOfView = 90.0, max_turn_deg: Degrees = 10.0, max_move_m: Metres = 0.3) -> None:
        check_numbers("data.world", FieldOfView, hfov_deg=hfov_deg)
        check_numbers("data.world", Degrees, max_turn_deg=max_turn_deg)
        check_numbers("data.world", Metres, max_move_m=max_move_m)
        self.hfov_deg = hfov_deg
        self.max_turn_deg = max_turn_deg
        self.max_move_m = max_move_m

    def settings(self) -> tuple[object, ...]:
        """What determines the pictures besides seeds."""
        return "rooms", EDITION, float(self.hfov_deg), float(self.max_turn_deg), float(self.max_move_m)

    def views(self, seed: int, count: int, size: tuple[int, int]) -> PosedViews:
        """Views of the room of a seed, from about one place.

        Raises:
            UserError: no views, or no pixels.
        """
        if count < 1 or min(size) < 1:
            raise UserError(f"views of a room need a count and a size of at least 1, got {count} of {size}")
        room = build_room(seed)
        poses = self.poses(room, seed, count)
        focal = size[1] / 2 / math.tan(math.radians(self.hfov_deg) / 2)
        matrix = torch.tensor([[focal, 0, size[1] / 2], [0, focal, size[0] / 2], [0, 0, 1]])
        return picture_views(room.surfaces, room.pictures, matrix.repeat(count, 1, 1), poses, size)

    def poses(self, room: Room, seed: int, count: int) -> Tensor:
        """World to camera (V, 4, 4) of views in a room, which is that of the seed."""
        rng = np.random.default_rng([seed, 2])
        eye, heading = _stand_somewhere(room, rng)
        turn, move = math.radians(self.max_turn_deg) / 2, self.max_move_m / 2
        pitch = math.radians(rng.uniform(-14, 3))
        poses = []
        for _ in range(count):
            place = eye + _free_move(room, eye, move, rng)
            yaw, tip, roll = rng.uniform(-turn, turn, 3)
            poses.append(look(place, heading + yaw, pitch + _PITCH_SHARE * tip, _ROLL_SHARE * roll))
        return torch.stack(poses)


def build_room(seed: int, furnisher: Furnish = furnish) -> Room:
    """The room of a seed: its walls, its furniture and its light.

    Args:
        seed: of all of it.
        furnisher: says what stands and hangs where, and which lamps shine.
    """
    rng = np.random.default_rng([seed, 1])
    extent = (rng.uniform(3.0, 6.0), rng.uniform(2.4, 3.0), rng.uniform(3.0, 6.0))
    style, openings = draw_style(rng), draw_openings(extent, rng)
    furnishing = furnisher(extent, openings, rng)
    walls = [build_wall(wall, extent, openings, style) for wall in range(WALLS)]
    surroundings = [Placed(tuple(floor_and_ceiling(extent, bool(rng.random() < 0.5)))), *(one for one, _ in walls)]
    placed = (*furnishing.placed, *(fixtures for _, fixtures in walls))
    blockers = _boxes(placed, lambda solid: solid.casts and not solid.glow)
    shell = [solid for one in surroundings for solid in one.in_room()]
    things = [solid for one in placed for solid in one.in_room()]
    surfaces = _lit(shell, things, extent, _lights(extent, openings, furnishing.lamps, rng), blockers, rng)
    obstacles = _boxes(placed, lambda solid: True)
    return Room(extent, placed, obstacles, surfaces, paint_surfaces(rng), _owners(shell, placed))


def _owners(shell: list[Solid], placed: Sequence[Placed]) -> Tensor:
    """Rows of what is placed (F,) to which the triangles of shell and things belong."""
    none = sum(len(solid.faces) for solid in shell)
    counts = [none, *(sum(len(solid.faces) for solid in one.solids) for one in placed)]
    return torch.from_numpy(np.repeat(np.arange(-1, len(placed)), counts))


def _boxes(placed: Sequence[Placed], which: Callable[[Solid], bool]) -> Blockers:
    """The boxes about some of the solids."""
    groups = []
    for one in placed:
        boxes = [solid.bounds().reshape(-1) for solid in one.solids if which(solid)]
        if boxes:
            groups.append((np.stack(boxes), one.yaw, one.place))
    return Blockers.of(groups)


def _lights(
    extent: tuple[float, float, float], openings: Sequence[Opening], lamps: Sequence[Lamp], rng: _RNG
) -> Lights:
    """Lamps as four lights each, windows as six."""
    places, colors, normals = [], [], []
    bright = rng.uniform(1.0, 2.5)
    sky = np.array([0.88, 0.95, 1.0]) if rng.random() < 0.6 else np.array([1.0, 0.94, 0.85])
    for lamp in lamps:
        for off in ((0.12, 0, 0.07), (-0.12, 0, -0.07), (-0.07, 0, 0.12), (0.07, 0, -0.12)):
            places.append(np.array(lamp.place) + off)
            colors.append(np.array(lamp.color) * bright / 4)
            normals.append(np.zeros(3))
    daylight = rng.uniform(0.8, 3.0)
    for one in openings:
        if one.kind != "window":
            continue
        origin, yaw, _ = wall_frame(one.wall, extent)
        cos, sin = math.cos(yaw), math.sin(yaw)
        area = (one.right - one.left) * (one.high - one.low)
        for across in (1 / 6, 1 / 2, 5 / 6):
            for up in (0.25, 0.75):
                along = one.left + across * (one.right - one.left)
                y = one.low + up * (one.high - one.low)
                spot = (origin[0] + along * cos + 0.02 * sin, y, origin[2] - along * sin + 0.02 * cos)
                places.append(np.array(spot))
                colors.append(sky * daylight * area / 6)
                normals.append(np.array([sin, 0, cos]))
    stacked = [np.array(part, np.float32).reshape(-1, 3) for part in (places, colors, normals)]
    return Lights(*stacked)


def _lit(
    shell: list[Solid],
    things: list[Solid],
    extent: tuple[float, float, float],
    lights: Lights,
    blockers: Blockers,
    rng: _RNG,
) -> LitSurfaces:
    """The triangles of a room and the light that reaches their corners."""
    solids = [*shell, *things]
    points, normals = (np.concatenate([getattr(solid, name) for solid in solids]) for name in ("points", "normals"))
    glow = np.repeat(np.array([solid.glow for solid in solids], np.float32), [len(solid.points) for solid in solids])
    num_shell = sum(len(solid.points) for solid in shell)
    return lit_surfaces(solids, _baked(points, normals, glow, num_shell, extent, lights, blockers, rng))


def _baked(
    points: Floats,
    normals: Floats,
    glow: Floats,
    num_shell: int,
    extent: tuple[float, float, float],
    lights: Lights,
    blockers: Blockers,
    rng: _RNG,
) -> Floats:
    """Light (C, 3) of corners, scaled so that walls and floor are lit well on average; glowing ones shine."""
    direct = bake(points, normals, lights, blockers)
    around = openness(points, normals, num_shell, extent, blockers)
    mean = direct[:num_shell].mean(0)
    # what walls and floor send back, half of it coloured by the lights
    bounced = (0.5 * mean + 0.5 * mean.mean()) * np.float32(rng.uniform(0.4, 0.85))
    whole = direct + around[:, None] * bounced
    whole *= np.float32(rng.uniform(0.55, 0.85)) / whole[:num_shell].mean()
    return np.where(glow[:, None] > 0, glow[:, None], whole)


def has_clearance(room: Room, places: Floats, margin: float = CLEARANCE_M) -> npt.NDArray[np.bool_]:
    """Whether places (N, 3) lie in the room, away from walls and furniture by a margin along each axis: (N,)."""
    inside = ((places > margin) & (places < np.array(room.extent) - margin)).all(1)
    return inside & ~room.obstacles.hold(places, margin)


def _stand_somewhere(room: Room, rng: _RNG) -> tuple[Floats, float]:
    """An eye (3,) where someone can stand, and the heading towards something at some distance."""
    width, _, depth = room.extent
    eyes = rng.uniform((0.4, _EYE_M[0], 0.4), (width - 0.4, _EYE_M[1], depth - 0.4), (_PLACES, 3)).astype(np.float32)
    free = has_clearance(room, eyes)
    walkable = free.copy()
    for one in room.placed:
        if not one.is_walked_on and one.place[1] == 0:
            low, high = one.footprint() + np.array([[-0.05], [0.05]])
            walkable &= ~((eyes[:, [0, 2]] > low) & (eyes[:, [0, 2]] < high)).all(1)
    eye = eyes[int((walkable if walkable.any() else free).argmax())]
    away = rng.uniform((0.3, 0.3), (width - 0.3, depth - 0.3), (32, 2)) - eye[[0, 2]]
    far = np.hypot(away[:, 0], away[:, 1])
    x, z = away[int((far > 0.45 * max(width, depth)).argmax())]
    return eye, math.atan2(x, z)


def _free_move(room: Room, eye: Floats, most: float, rng: _RNG) -> Floats:
    """A move (3,) of the eye to where it has its clearance; none where there is no such place."""
    moves = rng.uniform(-most, most, (_MOVES, 3)).astype(np.float32)
    moves[-1] = 0
    return moves[int(has_clearance(room, eye + moves).argmax())]


def look(eye: Floats, yaw: float, pitch: float, roll: float) -> Tensor:
    """World to camera (4, 4): heading from z to x, pitch upwards, roll about the line of sight; radians."""
    forward = torch.tensor(
        [math.sin(yaw) * math.cos(pitch), math.sin(pitch), math.cos(yaw) * math.cos(pitch)], dtype=torch.float64
    )
    right = torch.tensor([-math.cos(yaw), 0.0, math.sin(yaw)], dtype=torch.float64)
    down = torch.linalg.cross(forward, right)
    cos, sin = math.cos(roll), math.sin(roll)
    rows = torch.stack([cos * right + sin * down, cos * down - sin * right, forward])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rows
    pose[:3, 3] = -rows @ torch.from_numpy(eye).double()
    return pose.float()
