"""Furniture of the nine classes of Pix3D, built of parameters: no two pieces that are drawn are alike.

Every piece stands on the floor at y = 0 over the origin, y up, and faces +z: its back is towards the wall. Metres.
A piece is a list of closed solids, each of one material and colour.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from rendra.renderer import TexturesVertex
from rendra.structures import Meshes
from rendra_lab.synthesis.rooms_surfaces import hue_color
from rendra_lab.synthesis.solids import (
    Color,
    Floats,
    Solid,
    box,
    cylinder,
    ellipsoid,
    lathe,
    rounded_box,
    weld,
)

CLASSES = ("bed", "bookcase", "chair", "desk", "misc", "sofa", "table", "tool", "wardrobe")

_CELL = 0.3  # metres between corners at which light is known
_RNG = np.random.Generator


@dataclass(frozen=True)
class Finish:
    """Materials and colours (sRGB) of a piece.

    Attributes:
        body: material of what carries: wood, plain (lacquer) or metal.
        color: of it.
        accent: of fronts, tops and the like.
        cover: material of what one sits or lies on: fabric or leather.
        cover_color: of it.
        pillow: colour of cushions that lie about.
    """

    body: str = "wood"
    color: Color = (0.66, 0.46, 0.28)
    accent: Color = (0.66, 0.46, 0.28)
    cover: str = "fabric"
    cover_color: Color = (0.55, 0.55, 0.6)
    pillow: Color = (0.8, 0.75, 0.6)


@dataclass(frozen=True)
class Furniture:
    """One piece.

    Attributes:
        name: what it is: table, armchair, floor lamp.
        kind: which of CLASSES.
        solids: of which it consists.
        model: of whose shape it is, where shapes come from a collection.
    """

    name: str
    kind: str
    solids: tuple[Solid, ...]
    model: str = ""

    def bounds(self) -> Floats:
        """The least and the greatest coordinates: (2, 3)."""
        corners = np.concatenate([solid.bounds() for solid in self.solids])
        return np.stack([corners.min(0), corners.max(0)])

    def meshes(self, device: torch.device | str = "cpu") -> Meshes:
        """A batch of one mesh, each solid closed and coloured at its vertices (sRGB)."""
        verts, faces, colors = (torch.from_numpy(array).to(device) for array in weld(self.solids))
        return Meshes([verts], [faces], TexturesVertex([colors]))


def table(size: tuple[float, float, float], finish: Finish, legs: str = "posts", thick: float = 0.035) -> Furniture:
    """A table.

    Args:
        size: width, height and depth.
        finish: materials.
        legs: posts, slim (metal), panels at both ends, or pedestal, which has a round top.
        thick: of the top.
    """
    width, height, depth = size
    under = height - thick
    if legs == "pedestal":
        radius = min(width, depth) / 2
        foot = [(0, 0), (0.55 * radius, 0), (0.5 * radius, 0.03), (0.05, 0.07), (0.04, 0.5 * under), (0.07, under)]
        solids = [
            lathe([(0, 0), (radius, 0), (radius, thick), (0, thick)], (0, under, 0), "wood", finish.accent, 24),
            lathe([*foot, (0, under)], (0, 0, 0), finish.body, finish.color),
        ]
        return Furniture("table", "table", tuple(solids))
    solids = [box((width, thick, depth), (0, under + thick / 2, 0), finish.body, finish.accent, cell=0.16)]
    if legs == "panels":
        solids += [
            box(
                (0.04, under, 0.9 * depth),
                (side * (width / 2 - 0.08), under / 2, 0),
                finish.body,
                finish.color,
                _CELL,
            )
            for side in (-1, 1)
        ]
        solids.append(box((width - 0.2, 0.25 * under, 0.03), (0, 0.7 * under, 0), finish.body, finish.color, _CELL))
        return Furniture("table", "table", tuple(solids))
    post = 0.03 if legs == "slim" else 0.065
    material, color = ("metal", (0.16, 0.16, 0.17)) if legs == "slim" else (finish.body, finish.color)
    solids += _posts((width - 0.06, depth - 0.06), (0, under), post, material, color)
    if legs == "posts":
        solids += _apron((width - 0.14, depth - 0.14), under - 0.045, 0.09, finish)
    return Furniture("table", "table", tuple(solids))


def desk(size: tuple[float, float, float], finish: Finish, drawers: int = 3, side: int = 1) -> Furniture:
    """A desk with drawers under one end.

    Args:
        size: width, height and depth.
        finish: materials.
        drawers: how many; 0 has legs at both ends.
        side: 1 has them at +x, -1 at -x.
    """
    width, height, depth = size
    under, block = height - 0.03, min(0.42, 0.35 * width)
    solids = [
        box((width, 0.03, depth), (0, height - 0.015, 0), finish.body, finish.accent, cell=0.16),
        box(
            (width - 0.1, 0.3 * height, 0.02), (0, 0.75 * height, 0.05 - depth / 2), finish.body, finish.color, _CELL
        ),
    ]
    if drawers:
        middle = side * (width / 2 - block / 2 - 0.02)
        solids += _drawers((block, under - 0.06, depth - 0.06), (middle, 0.06, 0), drawers, finish)
    ends = (-side,) if drawers else (-1, 1)
    solids += [
        box((0.035, under, depth - 0.06), (end * (width / 2 - 0.04), under / 2, 0), finish.body, finish.color, _CELL)
        for end in ends
    ]
    return Furniture("desk", "desk", tuple(solids))


def chair(
    size: tuple[float, float, float], finish: Finish, back: str = "slats", arms: bool = False, seat: float = 0.45
) -> Furniture:
    """A chair on four legs.

    Args:
        size: width, height of the back, and depth.
        finish: materials.
        back: slats, panel, rails, or cover, which is upholstered.
        arms: whether there are armrests.
        seat: height of the seat.
    """
    width, height, depth = size
    post = 0.038
    solids = _posts((width - 0.02, depth - 0.02), (0, seat - 0.02), post, finish.body, finish.color)
    solids += _apron((width - 0.06, depth - 0.06), seat - 0.05, 0.05, finish)
    if back == "cover":
        solids.append(
            rounded_box((width, 0.08, depth), (0, seat, 0), 0.035, finish.cover, finish.cover_color, puff=0.015)
        )
    else:
        solids.append(box((width, 0.028, depth), (0, seat, 0), finish.body, finish.accent, _CELL))
    rise = height - seat
    upright = _chair_back((width, rise, 0.03), back, finish)
    solids += [solid.turned("x", -0.16).moved(0, seat, 0.03 - depth / 2) for solid in upright]
    if arms:
        for end in (-1, 1):
            x = end * (width / 2 - 0.02)
            solids.append(box((0.045, 0.03, 0.8 * depth), (x, seat + 0.22, 0), finish.body, finish.color))
            solids.append(box((0.035, 0.22, 0.035), (x, seat + 0.11, 0.3 * depth), finish.body, finish.color))
    return Furniture("armchair" if arms else "chair", "chair", tuple(solids))


def office_chair(size: tuple[float, float, float], finish: Finish) -> Furniture:
    """A chair on one leg with five feet; width, height and depth."""
    width, height, depth = size
    black = (0.1, 0.1, 0.11)
    solids = [cylinder(0.03, 0.36, (0, 0.08, 0), "metal", (0.35, 0.35, 0.37))]
    for foot in range(5):
        arm = box((0.05, 0.04, 0.3), (0, 0.09, 0.15), "metal", black)
        wheel = ellipsoid((0.03, 0.03, 0.03), (0, 0.03, 0.28), "metal", black, segments=8)
        solids += [part.turned("y", foot * 2 * math.pi / 5) for part in (arm, wheel)]
    solids.append(rounded_box((width, 0.09, depth), (0, 0.47, 0), 0.04, finish.cover, finish.cover_color, puff=0.02))
    rise = height - 0.58
    back = rounded_box((0.9 * width, rise, 0.07), (0, rise / 2, 0), 0.03, finish.cover, finish.cover_color)
    solids.append(back.turned("x", -0.12).moved(0, 0.57, 0.02 - depth / 2))
    solids.append(box((0.06, 0.3, 0.02), (0, 0.55, -depth / 2), "metal", black))
    return Furniture("office chair", "chair", tuple(solids))


def sofa(
    size: tuple[float, float, float], finish: Finish, seats: int = 3, arm: float = 0.18, pillows: Sequence[float] = ()
) -> Furniture:
    """A sofa, or with one seat an armchair.

    Args:
        size: width, height of the back, and depth.
        finish: materials.
        seats: cushions side by side.
        arm: thickness of the armrests.
        pillows: where cushions lie, from -1 at the left end of the seat to 1.
    """
    width, height, depth = size
    cover, color = finish.cover, finish.cover_color
    inside, base, seat = width - 2 * arm, 0.26, 0.43
    solids = [
        rounded_box((width - 0.06, base - 0.08, depth - 0.05), (0, base / 2 + 0.05, 0), 0.03, cover, color),
        rounded_box((width - 0.04, height - 0.1, 0.2), (0, height / 2 + 0.04, 0.1 - depth / 2), 0.06, cover, color),
    ]
    for end in (-1, 1):
        x = end * (width - arm) / 2
        solids.append(rounded_box((arm, 0.5, depth - 0.04), (x, 0.34, 0), 0.06, cover, color))
    each = inside / seats
    for number in range(seats):
        x = (number - (seats - 1) / 2) * each
        solids.append(
            rounded_box((each - 0.01, 0.18, depth - 0.22), (x, seat - 0.09, 0.1), 0.05, cover, color, puff=0.025)
        )
        rest = rounded_box((each - 0.02, height - seat, 0.17), (0, (height - seat) / 2, 0), 0.06, cover, color)
        solids.append(rest.turned("x", -0.2).moved(x, seat - 0.02, 0.28 - depth / 2))
    for place in pillows:
        pillow = rounded_box((0.42, 0.42, 0.13), (0, 0.2, 0), 0.06, "fabric", finish.pillow)
        solids.append(pillow.turned("x", -0.35).moved(0.8 * place * inside / 2, seat, 0.42 - depth / 2))
    solids += _posts((width - 0.16, depth - 0.14), (0, 0.12), 0.05, finish.body, finish.color)
    return Furniture("sofa" if seats > 1 else "easy chair", "sofa", tuple(solids))


def bed(size: tuple[float, float, float], finish: Finish, pillows: int = 2, footboard: bool = False) -> Furniture:
    """A bed with its head at the wall.

    Args:
        size: width, height of the head, and length.
        finish: materials; the cover is the blanket's.
        pillows: side by side.
        footboard: whether there is a board at the foot.
    """
    width, height, length = size
    frame, linen = 0.3, (0.92, 0.91, 0.88)
    back, front = -length / 2, length / 2
    solids = [
        box((width, height, 0.06), (0, height / 2, back + 0.03), finish.body, finish.accent, 0.25),
        box((0.04, 0.2, length), (-width / 2 + 0.02, frame - 0.1, 0), finish.body, finish.color, _CELL),
        box((0.04, 0.2, length), (width / 2 - 0.02, frame - 0.1, 0), finish.body, finish.color, _CELL),
        box(
            (width, 0.35 if footboard else 0.2, 0.04),
            (0, frame - (0.025 if footboard else 0.1), front - 0.02),
            finish.body,
            finish.color,
            _CELL,
        ),
        *_posts((width, length), (0, frame - 0.1), 0.07, finish.body, finish.color),
        rounded_box((width - 0.1, 0.22, length - 0.12), (0, frame + 0.07, 0), 0.06, "fabric", linen),
    ]
    blanket = 0.68 * length
    solids.append(
        rounded_box(
            (width + 0.02, 0.24, blanket), (0, frame + 0.1, front - 0.04 - blanket / 2), 0.07, "fabric",
            finish.cover_color, puff=0.03,
        )
    )  # fmt: skip
    fold = (width - 0.02, 0.07, 0.28)
    solids.append(rounded_box(fold, (0, frame + 0.215, front - blanket + 0.08), 0.03, "fabric", linen, puff=0.01))
    each = (width - 0.2) / pillows
    for number in range(pillows):
        x = (number - (pillows - 1) / 2) * each
        pillow = rounded_box((min(0.7, each - 0.05), 0.15, 0.42), (0, 0, 0), 0.07, "fabric", finish.pillow, puff=0.03)
        solids.append(pillow.turned("x", 0.25).moved(x, frame + 0.27, back + 0.32))
    return Furniture("bed", "bed", tuple(solids))


def bookcase(size: tuple[float, float, float], finish: Finish, shelves: int, rng: np.random.Generator) -> Furniture:
    """An open bookcase with books, and now and then something else.

    Args:
        size: width, height and depth.
        finish: materials.
        shelves: compartments above each other.
        rng: chooses the books.
    """
    width, height, depth = size
    board, foot = 0.025, 0.06
    solids = [
        box((board, height, depth), (end * (width - board) / 2, height / 2, 0), finish.body, finish.color, _CELL)
        for end in (-1, 1)
    ]
    solids.append(
        box((width - board, height, 0.012), (0, height / 2, 0.006 - depth / 2), finish.body, finish.accent, _CELL)
    )
    gap = (height - foot - board) / shelves
    for level in range(shelves + 1):
        y = foot + level * gap + board / 2
        solids.append(
            box((width - 2 * board, board, depth - 0.012), (0, y, 0.006), finish.body, finish.color, _CELL, grain=0)
        )
        if level < shelves:
            solids += _books((width - 2 * board - 0.02, gap - board, depth), y + board / 2, rng)
    return Furniture("bookcase", "bookcase", tuple(solids))


def wardrobe(
    size: tuple[float, float, float], finish: Finish, doors: int = 2, panels: int = 1, name: str = "wardrobe"
) -> Furniture:
    """A wardrobe.

    Args:
        size: width, height and depth.
        finish: materials; fronts have the accent's colour.
        doors: side by side.
        panels: set into each door above each other; 0 has plain doors.
        name: what it is called.
    """
    width, height, depth = size
    plinth = 0.08
    front, body = depth / 2, (width, height - plinth, depth - 0.025)
    solids = [
        box(body, (0, (height + plinth) / 2, -0.0125), finish.body, finish.color, 0.35),
        box((width - 0.06, plinth, depth - 0.08), (0, plinth / 2, -0.02), finish.body, finish.color, _CELL),
        box((width + 0.04, 0.04, depth + 0.02), (0, height + 0.02, 0), finish.body, finish.color, _CELL),
    ]
    each = width / doors
    for number in range(doors):
        x = (number - (doors - 1) / 2) * each
        solids += _door(
            (each - 0.012, height - plinth - 0.03), (x, plinth + 0.015, front), panels, finish, number % 2
        )
    return Furniture(name, "wardrobe", tuple(solids))


def cupboard(size: tuple[float, float, float], finish: Finish, columns: int, drawers: int) -> Furniture:
    """A low cupboard: a sideboard, a chest of drawers or a nightstand.

    Args:
        size: width, height and depth.
        finish: materials.
        columns: side by side.
        drawers: in every other column, above each other; doors are in the rest.
    """
    width, height, depth = size
    foot = min(0.14, 0.2 * height)
    body = height - foot - 0.025
    top = box((width + 0.02, 0.025, depth + 0.01), (0, height - 0.0125, 0), finish.body, finish.color, 0.2)
    solids = [top, *_posts((width - 0.06, depth - 0.06), (0, foot), 0.04, finish.body, finish.color)]
    each = width / columns
    for column in range(columns):
        x = (column - (columns - 1) / 2) * each
        if column % 2 == 0:
            solids += _drawers((each, body, depth), (x, foot, 0), drawers, finish)
        else:
            solids.append(
                box((each, body, depth - 0.02), (x, foot + body / 2, -0.01), finish.body, finish.color, _CELL)
            )
            solids += _door((each - 0.012, body - 0.02), (x, foot + 0.01, depth / 2), 0, finish, 0)
    return Furniture("nightstand" if columns == 1 and width < 0.6 else "cupboard", "misc", tuple(solids))


def floor_lamp(height: float, shade_radius: float, shade_color: Color, glow: float = 1.2) -> Furniture:
    """A lamp on a pole with a shade that shines; `glow` as of solids."""
    shade_height = 0.9 * shade_radius
    solids = (
        cylinder(0.13, 0.025, (0, 0, 0), "metal", (0.2, 0.2, 0.2), 16),
        cylinder(0.012, height - shade_height, (0, 0.02, 0), "metal", (0.25, 0.25, 0.25), 8),
        _shade(shade_radius, shade_height, height - shade_height, shade_color, glow),
    )
    return Furniture("floor lamp", "misc", solids)


def table_lamp(height: float, color: Color, shade_color: Color, glow: float = 1.2) -> Furniture:
    """A lamp with a turned foot; `glow` as of solids."""
    shade = 0.4 * height
    profile = [(0, 0), (0.28 * height, 0), (0.26 * height, 0.03), (0.1 * height, 0.1 * height)]
    profile += [(0.17 * height, 0.3 * height), (0.03, 0.5 * height), (0.01, 0.7 * height), (0, 0.7 * height)]
    foot = lathe(profile, (0, 0, 0), "plain", color)
    return Furniture("table lamp", "misc", (foot, _shade(0.34 * height, shade, height - shade, shade_color, glow)))


def plant(height: float, pot: Color, leaves: int, rng: np.random.Generator) -> Furniture:
    """A plant in a pot.

    Args:
        height: to the highest leaf.
        pot: its colour.
        leaves: how many.
        rng: bends them.
    """
    rim = 0.12 + 0.05 * height
    profile = [(0, 0), (0.7 * rim, 0), (rim, 1.5 * rim), (0.88 * rim, 1.5 * rim), (0.86 * rim, 1.35 * rim)]
    solids = [lathe([*profile, (0, 1.35 * rim)], (0, 0, 0), "plain", pot)]
    green = np.array(hue_color(rng, 0.3, 0.5)) * (0.6, 1.0, 0.5)
    stem = height - 1.35 * rim
    solids.append(cylinder(0.012, 0.85 * stem, (0, 1.3 * rim, 0), "wood", (0.4, 0.33, 0.2), 6))
    for number in range(leaves):
        share = (number + 0.5) / leaves
        length = (0.3 + 0.25 * rng.random()) * (0.25 + 0.35 * height) * (1.1 - 0.4 * share)
        leaf = ellipsoid(
            (0.32 * length, 0.006, length), (0, 0, length), "leaf", as_color(green * rng.uniform(0.7, 1.3)), 8
        )
        leaf = leaf.turned("x", -rng.uniform(0.1, 0.5) - 0.7 * share).turned(
            "y", 2.4 * number + rng.uniform(-0.3, 0.3)
        )
        solids.append(replace(leaf.moved(0, 1.35 * rim + stem * (0.15 + 0.6 * share), 0), casts=number % 3 == 0))
    return Furniture("plant", "misc", tuple(solids))


def vase(height: float, color: Color) -> Furniture:
    """A vase."""
    profile = [(0, 0), (0.2, 0), (0.34, 0.35), (0.3, 0.6), (0.13, 0.85), (0.18, 1), (0.15, 1), (0.1, 0.85), (0, 0.8)]
    return Furniture(
        "vase", "misc", (lathe([(r * height, y * height) for r, y in profile], (0, 0, 0), "plain", color),)
    )


def hammer(length: float, finish: Finish) -> Furniture:
    """A hammer that stands on the end of its handle."""
    head = 0.3 * length
    steel = (0.5, 0.51, 0.54)
    solids = (
        lathe([(0, 0), (0.05 * length, 0), (0.035 * length, 0.5 * length), (0.04 * length, length), (0, length)],
              (0, 0, 0), "wood", finish.color, 10),
        box((0.1 * length, 0.1 * length, head), (0, 0.93 * length, 0), "metal", steel),
        cylinder(0.06 * length, 0.06 * length, (0, 0, 0), "metal", steel).turned("x", math.pi / 2)
        .moved(0, 0.93 * length, head / 2),
    )  # fmt: skip
    return Furniture("hammer", "tool", solids)


def screwdriver(length: float, color: Color) -> Furniture:
    """A screwdriver that stands on its handle."""
    grip = 0.4 * length
    handle = [(0, 0), (0.05, 0), (0.065, 0.05), (0.06, 0.3), (0.035, 0.38), (0, 0.4)]
    solids = (
        lathe([(r * length, y * length) for r, y in handle], (0, 0, 0), "plain", color, 10),
        cylinder(0.016 * length, length - grip, (0, grip - 0.01 * length, 0), "metal", (0.6, 0.61, 0.63), 8),
    )
    return Furniture("screwdriver", "tool", solids)


def broom(height: float, width: float, finish: Finish) -> Furniture:
    """A broom that stands on its bristles."""
    solids = (
        box((width, 0.1, 0.05), (0, 0.05, 0), "fabric", (0.62, 0.5, 0.3)),
        box((width + 0.01, 0.04, 0.06), (0, 0.12, 0), "wood", finish.color),
        cylinder(0.013, height - 0.13, (0, 0.13, 0), "wood", finish.accent, 8),
    )
    return Furniture("broom", "tool", solids)


def as_color(values: Iterable[float]) -> Color:
    """Three numbers as a colour, within [0, 1]."""
    red, green, blue = (float(min(max(value, 0.0), 1.0)) for value in values)
    return red, green, blue


def _posts(
    spread: tuple[float, float], heights: tuple[float, float], thick: float, surface: str, color: Color
) -> list[Solid]:
    """Four legs under the corners of a rectangle."""
    low, high = heights
    x, z = spread[0] / 2 - thick / 2, spread[1] / 2 - thick / 2
    size = (thick, high - low, thick)
    return [box(size, (i * x, (low + high) / 2, k * z), surface, color, 0.4) for i in (-1, 1) for k in (-1, 1)]


def _apron(spread: tuple[float, float], y: float, tall: float, finish: Finish) -> list[Solid]:
    """Boards between the legs, under what they carry."""
    x, z = spread[0] / 2, spread[1] / 2
    long = [box((2 * x, tall, 0.02), (0, y, end * z), finish.body, finish.color, 0.5) for end in (-1, 1)]
    return long + [box((0.02, tall, 2 * z), (end * x, y, 0), finish.body, finish.color, 0.5) for end in (-1, 1)]


def _chair_back(size: tuple[float, float, float], kind: str, finish: Finish) -> list[Solid]:
    """A back that stands on y = 0, upright."""
    width, height, thick = size
    if kind == "cover":
        return [rounded_box((width, height, 0.07), (0, height / 2, 0), 0.03, finish.cover, finish.cover_color)]
    frame = [
        box((0.035, height, thick), (end * (width / 2 - 0.018), height / 2, 0), finish.body, finish.color, _CELL)
        for end in (-1, 1)
    ]
    if kind == "panel":
        return [
            *frame,
            box((width - 0.07, 0.6 * height, 0.015), (0, 0.65 * height, 0), finish.body, finish.accent, _CELL),
        ]
    top = box((width, 0.07, thick), (0, height - 0.035, 0), finish.body, finish.accent)
    if kind == "rails":
        rails = [
            box((width - 0.06, 0.05, 0.015), (0, share * height, 0), finish.body, finish.accent)
            for share in (0.35, 0.6)
        ]
        return [*frame, top, *rails]
    slats = [
        box((0.03, height - 0.1, 0.015), (x * (width / 2 - 0.08), height / 2, 0), finish.body, finish.accent)
        for x in (-0.75, -0.25, 0.25, 0.75)
    ]
    return [*frame, top, *slats]


def _drawers(
    size: tuple[float, float, float], place: tuple[float, float, float], count: int, finish: Finish
) -> list[Solid]:
    """A block that stands at a place, with fronts and knobs."""
    width, height, depth = size
    x, y, z = place
    front = z + depth / 2
    solids = [box((width, height, depth - 0.02), (x, y + height / 2, z - 0.01), finish.body, finish.color, _CELL)]
    each = height / count
    for number in range(count):
        middle = y + (number + 0.5) * each
        panel = (width - 0.025, each - 0.018, 0.02)
        solids.append(box(panel, (x, middle, front - 0.01), finish.body, finish.accent, _CELL, grain=0))
        knob = box((0.1, 0.014, 0.025), (x, middle + 0.2 * each, front + 0.01), "metal", (0.4, 0.39, 0.36))
        solids.append(replace(knob, casts=False))
    return solids


def _door(
    size: tuple[float, float], place: tuple[float, float, float], panels: int, finish: Finish, hand: int
) -> list[Solid]:
    """A front that stands at a place, its face there, with raised panels and a handle at one side."""
    width, height = size
    x, y, front = place
    solids = [box((width, height, 0.02), (x, y + height / 2, front - 0.01), finish.body, finish.accent, _CELL)]
    for number in range(panels):
        tall = (height - 0.08) / panels - 0.08
        middle = y + 0.08 + tall / 2 + number * (tall + 0.08)
        frame = box((width - 0.14, tall, 0.012), (x, middle, front + 0.006), finish.body, finish.color, _CELL)
        inset = box((width - 0.2, tall - 0.06, 0.008), (x, middle, front + 0.016), finish.body, finish.accent, _CELL)
        solids += [replace(frame, casts=False), replace(inset, casts=False)]
    side = (width / 2 - 0.045) * (1 if hand == 0 else -1)
    handle = box((0.018, min(0.18, 0.3 * height), 0.03), (x + side, y + 0.52 * height, front + 0.03), "metal",
                 (0.45, 0.44, 0.42))  # fmt: skip
    return [*solids, replace(handle, casts=False)]


def _books(size: tuple[float, float, float], floor: float, rng: _RNG) -> list[Solid]:
    """A row of books on a shelf, with gaps; sometimes a vase in place of some."""
    width, height, depth = size
    x, solids = -width / 2, []
    tall = rng.uniform(0.6, 0.85) * height
    while x < width / 2 - 0.06:
        if rng.random() < 0.06:
            x += rng.uniform(0.06, 0.25)
            continue
        thick = float(min(rng.uniform(0.02, 0.055), width / 2 - x))
        high, deep = tall * rng.uniform(0.72, 1.12), rng.uniform(0.55, 0.8) * depth
        color = as_color(hue_color(rng, rng.uniform(0.1, 0.8), rng.uniform(0.2, 0.95)))
        back = 0.015 - depth / 2
        book = box((thick - 0.001, high, deep), (x + thick / 2, floor + high / 2, back + deep / 2), "spine", color)
        across = (book.points[:, 0] - x) / thick
        up = (book.points[:, 1] - floor) / high
        solids.append(replace(book, uvs=np.stack([across, up], 1).astype(np.float32), casts=False))
        x += thick
    return solids


def _shade(radius: float, height: float, low: float, color: Color, glow: float) -> Solid:
    """A lampshade, closed below and above."""
    profile = [(0, 0.02), (0.95 * radius, 0), (radius, 0), (0.7 * radius, height), (0, height - 0.02)]
    return replace(lathe(profile, (0, low, 0), "fabric", color), glow=glow, casts=False)
