"""The shells of generated rooms: floor, ceiling and walls with windows, doors, skirting and what hangs on them.

A room reaches from the origin to its extent, y up, metres. Walls are numbered round the room, 0 at z = 0, 1 at the
greatest x. Each is built in axes of its own: x along it, y up, z into the room; it begins at the origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rendra_lab.synthesis.furniture_pieces import Furniture
from rendra_lab.synthesis.rooms_surfaces import NUM_PAINTINGS, wood_color
from rendra_lab.synthesis.solids import (
    Color,
    Floats,
    Solid,
    box,
    cylinder,
    ellipsoid,
    grid_lines,
    lathe,
    rotation,
    sheet,
)

WALLS = 4
_FLOOR_CELL, _WALL_CELL, _CEILING_CELL = 0.17, 0.24, 0.4  # metres between corners at which light is known
_WHITE: Color = (0.93, 0.92, 0.9)
_METAL: Color = (0.55, 0.54, 0.52)
_RNG = np.random.Generator


@dataclass(frozen=True)
class Opening:
    """A window, a door or an open doorway.

    Attributes:
        wall: in which it is.
        kind: window, door or doorway.
        left: where it begins along the wall.
        right: where it ends.
        low: height of its sill.
        high: of its lintel.
        deep: how far the wall reaches outwards.
        beyond: how far one sees behind an open doorway.
    """

    wall: int
    kind: str
    left: float
    right: float
    low: float
    high: float
    deep: float
    beyond: float = 0.0


@dataclass(frozen=True)
class Placed:
    """Solids that stand together, in axes of their own.

    Attributes:
        solids: of which they consist.
        place: of their origin in the room.
        yaw: by which they are turned, from z to x, radians.
        is_walked_on: a rug, which one can stand upon.
        piece: what the solids are, in axes of its own; None for what is no furniture.
        tilt: by which the piece is turned and moved before all else: (4, 4), for columns; None: it stands upright.
    """

    solids: tuple[Solid, ...]
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    is_walked_on: bool = False
    piece: Furniture | None = None
    tilt: Floats | None = None

    @classmethod
    def of(
        cls, piece: Furniture, place: tuple[float, float, float], yaw: float = 0.0, tilt: Floats | None = None
    ) -> Placed:
        """A piece at a place."""
        solids = piece.solids if tilt is None else tuple(solid.posed(tilt) for solid in piece.solids)
        return cls(solids, place, yaw, piece=piece, tilt=tilt)

    def in_room(self) -> list[Solid]:
        """The solids in the axes of the room."""
        return [solid.turned("y", self.yaw).moved(*self.place) for solid in self.solids]

    def to_room(self) -> Floats:
        """From the axes of the piece to those of the room: (4, 4), for columns."""
        matrix = np.eye(4, dtype=np.float32)
        matrix[:3, :3] = rotation("y", self.yaw)
        matrix[:3, 3] = self.place
        return matrix if self.tilt is None else (matrix @ self.tilt).astype(np.float32)

    def bounds(self) -> Floats:
        """The least and the greatest coordinates in the axes of the solids: (2, 3)."""
        bounds = np.stack([solid.bounds() for solid in self.solids])
        return np.stack([bounds[:, 0].min(0), bounds[:, 1].max(0)])

    def footprint(self) -> Floats:
        """Least x and z and greatest x and z: (2, 2)."""
        (left, _, back), (right, _, front) = self.bounds()
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        corners = np.array([[x, z] for x in (left, right) for z in (back, front)])
        turned = corners @ np.array([[cos, -sin], [sin, cos]]) + (self.place[0], self.place[2])
        return np.stack([turned.min(0), turned.max(0)]).astype(np.float32)

    def height(self) -> float:
        """Of its highest point above the floor."""
        return self.place[1] + max(float(solid.bounds()[1, 1]) for solid in self.solids)


@dataclass(frozen=True)
class Style:
    """What the carpenter brought.

    Attributes:
        trim: colour of skirting, frames and doors.
        trim_surface: its material.
        dado: height of the boarding of the walls; 0 for none.
        cornice: height of the moulding under the ceiling; 0 for none.
        curtains: colour; None for none.
    """

    trim: Color
    trim_surface: str
    dado: float
    cornice: float
    curtains: Color | None


def draw_style(rng: np.random.Generator) -> Style:
    """Some style."""
    is_wooden = rng.random() < 0.3
    trim = tuple(float(value) for value in wood_color(rng)) if is_wooden else _WHITE
    cloth = tuple(float(value) for value in 0.95 - rng.uniform(0, 0.45) * rng.random(3))
    return Style(
        trim=(trim[0], trim[1], trim[2]),
        trim_surface="wood" if is_wooden else "plain",
        dado=rng.uniform(0.8, 1.1) if rng.random() < 0.25 else 0.0,
        cornice=rng.uniform(0.05, 0.12) if rng.random() < 0.5 else 0.0,
        curtains=(cloth[0], cloth[1], cloth[2]) if rng.random() < 0.6 else None,
    )


def wall_frame(wall: int, extent: tuple[float, float, float]) -> tuple[tuple[float, float, float], float, float]:
    """Where the foot of a wall begins, by how much its axes are turned, and its length."""
    width, _, depth = extent
    origin = ((0.0, 0.0, 0.0), (width, 0.0, 0.0), (width, 0.0, depth), (0.0, 0.0, depth))[wall]
    return origin, -wall * math.pi / 2, (width, depth)[wall % 2]


def draw_openings(extent: tuple[float, float, float], rng: np.random.Generator) -> tuple[Opening, ...]:
    """A door or a doorway, and one to three windows, in walls of their own or side by side."""
    height = extent[1]
    order = rng.permutation(WALLS)
    openings = [_draw_door(int(order[0]), extent, rng)]
    for wall in order[1 : 2 + int(rng.random() < 0.35)]:
        length = wall_frame(int(wall), extent)[2]
        sill = 0.05 if rng.random() < 0.12 else rng.uniform(0.75, 1.0)
        high = min(height - 0.2, sill + rng.uniform(1.2, 1.5) if sill > 0.5 else 2.15)
        count = 2 if length > 3.6 and rng.random() < 0.6 else 1
        each = length / count
        width = min(rng.uniform(0.9, 2.0), each - 0.7)
        deep = rng.uniform(0.12, 0.3)
        for number in range(count):
            left = (number + 0.5) * each - width / 2
            openings.append(Opening(int(wall), "window", left, left + width, sill, high, deep))
    return tuple(openings)


def _draw_door(wall: int, extent: tuple[float, float, float], rng: _RNG) -> Opening:
    length = wall_frame(wall, extent)[2]
    width = rng.uniform(0.8, 0.95)
    is_open = rng.random() < 0.45
    width *= 1.6 if is_open and rng.random() < 0.4 else 1
    left = rng.uniform(0.35, length - width - 0.35)
    beyond = rng.uniform(1.2, 3.2) if is_open else 0.0
    kind = "doorway" if is_open else "door"
    return Opening(wall, kind, left, left + width, 0.0, min(extent[1] - 0.2, 2.05), 0.12, beyond)


def floor_and_ceiling(extent: tuple[float, float, float], along_z: bool) -> list[Solid]:
    """Both, the boards of the floor along z or along x."""
    width, height, depth = extent
    x, z = (grid_lines(0.0, side, _FLOOR_CELL) for side in (width, depth))
    white = (1.0, 1.0, 1.0)
    if along_z:
        floor = sheet((0, 0, 0), (0, 0, 1), (1, 0, 0), (z, x), "floor", white)
    else:
        floor = sheet((0, 0, depth), (1, 0, 0), (0, 0, -1), (x, z), "floor", white)
    lines = tuple(grid_lines(0.0, side, _CEILING_CELL) for side in (width, depth))
    return [floor, sheet((0, height, 0), (1, 0, 0), (0, 0, 1), (lines[0], lines[1]), "ceiling", white)]


def build_wall(
    wall: int, extent: tuple[float, float, float], openings: tuple[Opening, ...], style: Style
) -> tuple[Placed, Placed]:
    """A wall: its surface, and what is built into it and hangs before its windows."""
    origin, yaw, length = wall_frame(wall, extent)
    mine = [opening for opening in openings if opening.wall == wall]
    surface = _surface(length, extent[1], mine, style)
    fixtures = _mouldings(length, extent[1], mine, style)
    for opening in mine:
        fixtures += _window(opening, style) if opening.kind == "window" else _door(opening, extent[1], style)
    return Placed(tuple(surface), origin, yaw), Placed(tuple(fixtures), origin, yaw)


def _surface(length: float, height: float, openings: list[Opening], style: Style) -> list[Solid]:
    holes = [(one.left, one.right, one.low, one.high) for one in openings]
    sides = [side for one in openings for side in (one.left, one.right)]
    stops = [stop for one in openings for stop in (one.low, one.high)]
    x = grid_lines(0.0, length, _WALL_CELL, sides)
    bands = [("dado", 0.0, style.dado), ("wall", style.dado, height)] if style.dado else [("wall", 0.0, height)]
    return [
        sheet((0, 0, 0), (1, 0, 0), (0, 1, 0), (x, grid_lines(low, high, _WALL_CELL, stops)), name, (1, 1, 1), holes)
        for name, low, high in bands
    ]


def _mouldings(length: float, height: float, openings: list[Opening], style: Style) -> list[Solid]:
    """Skirting, the rail of the dado, and the cornice."""
    bands = [(0.0, 0.09, 0.016)]
    if style.dado:
        bands.append((style.dado - 0.02, style.dado + 0.03, 0.025))
    if style.cornice:
        bands.append((height - style.cornice, height, style.cornice))
    solids = []
    for low, high, deep in bands:
        for left, right in _free(length, [one for one in openings if one.low < high and one.high > low]):
            size = (right - left, high - low, deep)
            center = ((left + right) / 2, (low + high) / 2, deep / 2)
            bar = box(size, center, style.trim_surface, style.trim, cell=0.5, grain=0)
            solids.append(replace(bar, casts=False))
    return solids


def _free(length: float, openings: list[Opening]) -> list[tuple[float, float]]:
    """The stretches of a wall without openings and their frames."""
    stops, start = [], 0.0
    for one in sorted(openings, key=lambda one: one.left):
        stops.append((start, one.left - 0.06))
        start = one.right + 0.06
    return [(low, high) for low, high in [*stops, (start, length)] if high - low > 0.02]


def _reveal(opening: Opening, color: Color, glow: float) -> list[Solid]:
    """The thickness of the wall, round the opening; a window's is lit from outside."""
    left, right, low, high, deep = opening.left, opening.right, opening.low, opening.high, opening.deep
    tall, wide, thick = ([0.0, end] for end in (high - low, right - left, deep))
    sides = [
        sheet((left, low, 0), (0, 0, -1), (0, 1, 0), (thick, tall), "plain", color),
        sheet((right, low, -deep), (0, 0, 1), (0, 1, 0), (thick, tall), "plain", color),
        sheet((left, high, -deep), (1, 0, 0), (0, 0, 1), (wide, thick), "plain", color),
    ]
    surface = "plain" if opening.kind == "window" else "floor"
    sides.append(sheet((left, low, -deep), (0, 0, 1), (1, 0, 0), (thick, wide), surface, color))
    shares = (0.85, 0.95, 0.7, 1.0)
    return [replace(side, glow=glow * share) for side, share in zip(sides, shares, strict=True)]


def _casing(opening: Opening, style: Style, sill: bool) -> list[Solid]:
    """Boards round an opening, on the wall."""
    left, right, low, high = opening.left, opening.right, opening.low, opening.high
    wide, thick = 0.06, 0.02
    bars = [
        ((wide, high - low + wide, thick), (x, (high + low + wide) / 2, thick / 2))
        for x in (left - wide / 2, right + wide / 2)
    ]
    bars.append(((right - left, wide, thick), ((left + right) / 2, high + wide / 2, thick / 2)))
    if sill:
        bars.append(((right - left + 0.2, 0.035, 0.1), ((left + right) / 2, low - 0.018, 0.04)))
    return [replace(box(size, center, style.trim_surface, style.trim, 0.5), casts=False) for size, center in bars]


def _window(opening: Opening, style: Style) -> list[Solid]:
    left, right, low, high, deep = opening.left, opening.right, opening.low, opening.high, opening.deep
    wide, tall = right - left, high - low
    pane = sheet((left, low, -deep), (1, 0, 0), (0, 1, 0), ([0.0, wide], [0.0, tall]), "outside", (1, 1, 1))
    aspect = min(1.0, wide / tall)
    shift = (opening.wall * 0.3 + left) % max(1 - aspect, 1e-3)  # two windows do not show the same
    uvs = pane.uvs / np.array([wide / aspect, tall], np.float32) + np.array([shift, 0], np.float32)
    solids = [replace(pane, uvs=uvs.astype(np.float32), glow=1.9), *_reveal(opening, _WHITE, 1.0)]
    solids += _casing(opening, style, sill=low > 0.3)
    bars = [((wide, 0.055, 0.05), ((left + right) / 2, y, 0.03 - deep)) for y in (low + 0.027, high - 0.027)]
    columns = 2 if wide > 0.8 else 1
    bars += [
        ((0.055, tall, 0.05), (left + 0.027 + share * (wide - 0.055), (low + high) / 2, 0.03 - deep))
        for share in np.linspace(0, 1, columns + 1)
    ]
    if style.trim_surface == "wood" or opening.wall % 2:
        bars.append(((wide, 0.035, 0.04), ((left + right) / 2, low + 0.68 * tall, 0.03 - deep)))
    solids += [replace(box(size, at, style.trim_surface, style.trim), glow=0.75) for size, at in bars]
    if style.curtains is not None:
        solids += _curtains(opening, style.curtains)
    return solids


def _curtains(opening: Opening, color: Color) -> list[Solid]:
    """Two lengths of cloth in folds beside a window, on a rod."""
    high, low = opening.high + 0.12, 0.04
    rod = cylinder(0.012, opening.right - opening.left + 0.6, (0, 0, 0), "metal", _METAL, 8).turned("z", -math.pi / 2)
    solids = [replace(rod.moved(opening.left - 0.3, high, 0.09), casts=False)]
    for start in (opening.left - 0.27, opening.right - 0.13):
        lines = grid_lines(0.0, 0.4, 0.0125), grid_lines(0.0, high - low, 0.4)
        cloth = sheet((start, low, 0.09), (1, 0, 0), (0, 1, 0), lines, "fabric", color)
        phase = cloth.uvs[:, 0] * 2 * math.pi / 0.1
        points, normals = cloth.points.copy(), cloth.normals.copy()
        points[:, 2] += 0.03 * np.sin(phase)
        normals[:, 0] = -0.03 * 2 * math.pi / 0.1 * np.cos(phase)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        solids.append(replace(cloth, points=points, normals=normals.astype(np.float32)))
    return solids


def _door(opening: Opening, height: float, style: Style) -> list[Solid]:
    """A closed door, or an open doorway and what lies behind."""
    solids = _casing(opening, style, sill=False)
    if opening.kind == "doorway":
        return [*solids, *_reveal(opening, style.trim, 0.55), *_beyond(opening, height)]
    left, right, high, deep = opening.left, opening.right, opening.high, opening.deep
    wide, middle = right - left, (left + right) / 2
    solids += _reveal(opening, style.trim, 0.0)
    solids.append(
        box((wide, high, 0.04), (middle, high / 2, 0.02 - deep), style.trim_surface, style.trim, 0.25, grain=1)
    )
    face = 0.04 - deep
    for low, tall in ((0.15, 0.65), (0.95, high - 1.1)):
        for side in (-1, 1):
            center = (middle + side * wide * 0.22, low + tall / 2, face)
            frame = box((0.36 * wide, tall, 0.016), center, style.trim_surface, style.trim, 0.4, grain=1)
            inset = box((0.26 * wide, tall - 0.08, 0.03), center, style.trim_surface, style.trim, 0.4, grain=1)
            darker = (0.82 * style.trim[0], 0.82 * style.trim[1], 0.82 * style.trim[2])
            solids += [replace(frame, casts=False, color=darker), replace(inset, casts=False)]
    knob = ellipsoid((0.03, 0.03, 0.03), (right - 0.08, 1.0, face + 0.04), "metal", _METAL, 8)
    return [*solids, replace(knob, casts=False)]


def _beyond(opening: Opening, height: float) -> list[Solid]:
    """A corridor behind a doorway, with light of its own."""
    left, right, back = opening.left - 1.1, opening.right + 1.1, -opening.deep - opening.beyond
    wide, deep = right - left, opening.beyond
    x, y, z = (grid_lines(0.0, end, 1.0) for end in (wide, height, deep))
    pale = (0.86, 0.84, 0.8)
    parts = (
        (sheet((left, 0, back), (1, 0, 0), (0, 1, 0), (x, y), "ceiling", pale), 0.62),
        (sheet((left, 0, -opening.deep), (0, 0, -1), (0, 1, 0), (z, y), "ceiling", pale), 0.5),
        (sheet((right, 0, back), (0, 0, 1), (0, 1, 0), (z, y), "ceiling", pale), 0.75),
        (sheet((left, height, back), (1, 0, 0), (0, 0, 1), (x, z), "ceiling", pale), 0.66),
        (sheet((left, 0, back), (0, 0, 1), (1, 0, 0), (z, x), "floor", (1.0, 1.0, 1.0)), 0.55),
    )
    return [replace(part, glow=glow) for part, glow in parts]


def hung_picture(center: tuple[float, float], size: tuple[float, float], number: int, frame: Color) -> list[Solid]:
    """A painting in its frame, in the axes of a wall.

    Args:
        center: along the wall and above the floor.
        size: width and height.
        number: of the painting, from 0.
        frame: colour.
    """
    x, y = center
    wide, tall = size
    edge = 0.035
    bars = [((wide + 2 * edge, edge, 0.03), (x, y + side * (tall + edge) / 2, 0.015)) for side in (-1, 1)]
    bars += [((edge, tall, 0.03), (x + side * (wide + edge) / 2, y, 0.015)) for side in (-1, 1)]
    solids = [replace(box(extent, at, "wood", frame), casts=False) for extent, at in bars]
    lines = grid_lines(0.0, wide, 0.5), grid_lines(0.0, tall, 0.5)
    name = f"painting{number % NUM_PAINTINGS}"
    canvas = sheet((x - wide / 2, y - tall / 2, 0.012), (1, 0, 0), (0, 1, 0), lines, name, (1, 1, 1))
    uvs = (canvas.uvs / np.array([wide, tall], np.float32)) * 0.98 + 0.01
    return [*solids, replace(canvas, uvs=uvs.astype(np.float32))]


def ceiling_lamp(drop: float, radius: float, kind: str, color: Color, glow: float) -> list[Solid]:
    """A lamp under the ceiling, whose origin is where it hangs.

    Args:
        drop: how far its lower end hangs down.
        radius: of the shade.
        kind: globe, cone or disc.
        color: of the shade.
        glow: as of solids.
    """
    if kind == "disc":
        disc = [(0, -0.1), (0.8 * radius, -0.09), (radius, -0.04), (radius, 0), (0, 0)]
        return [replace(lathe(disc, (0, 0, 0), "plain", color, 20), glow=glow, casts=False)]
    tall = radius * (2 if kind == "globe" else 0.8)
    cord = cylinder(0.008, max(0.02, drop - tall), (0, -drop + tall, 0), "metal", (0.2, 0.2, 0.2), 6)
    if kind == "globe":
        shade = ellipsoid((radius, radius, radius), (0, radius - drop, 0), "plain", color, 16)
    else:
        cone = [(0, 0.02), (0.96 * radius, 0), (radius, 0), (0.35 * radius, tall), (0, tall)]
        shade = lathe(cone, (0, -drop, 0), "fabric", color, 20)
    return [replace(cord, casts=False), replace(shade, glow=glow, casts=False)]


def rug(size: tuple[float, float]) -> Solid:
    """A rug of a width and a depth, on the floor about the origin."""
    wide, deep = size
    thin = box((wide, 0.012, deep), (0, 0.006, 0), "rug", (1.0, 1.0, 1.0), cell=0.17)
    uvs = thin.points[:, [0, 2]] / np.array([wide, deep], np.float32) * 0.98 + 0.5
    return replace(thin, uvs=uvs.astype(np.float32), casts=False)
