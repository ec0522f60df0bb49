"""Rooms furnished so that furniture of wanted classes stands in them: tools lie about, lean and hang."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from rendra_lab.synthesis.furniture import CLASSES, Furniture
from rendra_lab.synthesis.rooms_furnishing import Furnisher, Furnishing, Stock
from rendra_lab.synthesis.rooms_shell import Opening, Placed
from rendra_lab.synthesis.solids import Floats, rotation

_LARGE_FIRST = ("bed", "wardrobe", "sofa", "bookcase", "table", "desk", "chair", "misc", "tool")
_CARRIERS = ("table", "coffee table", "desk", "cupboard", "nightstand")
_LONG_TOOLS, _SHORT_TOOLS = ("broom",), ("hammer", "screwdriver")
_LAMP_CHANCE = 0.85  # that the ceiling has one


def stage(
    extent: tuple[float, float, float],
    openings: tuple[Opening, ...],
    rng: np.random.Generator,
    *,
    wanted: Sequence[str],
    stock: Stock,
) -> Furnishing:
    """Furniture of wanted classes, as far as it finds places, and a little of others.

    Args:
        extent: of the room.
        openings: before which nothing stands.
        rng: makes all choices.
        wanted: names of CLASSES.
        stock: gives pieces.
    """
    room = Furnisher(extent, openings, rng, stock)
    for kind in _LARGE_FIRST:
        for _ in range(list(wanted).count(kind)):
            _STAGED[kind](room)
    for kind in rng.choice([kind for kind in CLASSES if kind not in wanted] or CLASSES, int(rng.integers(1, 4))):
        _STAGED[str(kind)](room)
    if rng.random() < 0.35:
        room.lay_rug(extent[0] / 2, extent[2] / 2, 0.0)
    room.hang_pictures(int(rng.integers(0, 4)))
    if rng.random() < _LAMP_CHANCE:
        room.hang_lamp()
    return Furnishing(tuple(room.placed), tuple(room.lamps))


def lying(piece: Furniture) -> Floats:
    """On its side, its height along x."""
    return _lowest_at_floor(piece, rotation("z", -math.pi / 2))


def leaning(piece: Furniture) -> Floats:
    """With its head towards the wall behind it."""
    return _lowest_at_floor(piece, rotation("x", -0.17))


def hanging(piece: Furniture) -> Floats:
    """Flat on a wall, upside down: by its lower end."""
    return _lowest_at_floor(piece, rotation("z", math.pi) @ rotation("y", math.pi / 2))


def _lowest_at_floor(piece: Furniture, turn: Floats) -> Floats:
    """A turn as a matrix (4, 4) that leaves the turned piece over the origin, its lowest point at y = 0."""
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3] = turn
    low, high = Placed.of(piece, (0.0, 0.0, 0.0), tilt=matrix).bounds()
    matrix[:3, 3] = (-(low[0] + high[0]) / 2, -low[1], -(low[2] + high[2]) / 2)
    return matrix


def _bed(room: Furnisher) -> None:
    head = room.against_wall("bed")
    if head is not None and room.rng.random() < 0.5:
        room.beside(head, "nightstand", int(room.rng.choice([-1, 1])), topped=("table lamp", "vase"))


def _sofa(room: Furnisher) -> None:
    if room.rng.random() < 0.35:
        room.in_corner("easy chair")
    else:
        room.against_wall("sofa")


def _bookcase(room: Furnisher) -> None:
    room.against_wall("bookcase")


def _wardrobe(room: Furnisher) -> None:
    room.against_wall("wardrobe")


def _table(room: Furnisher) -> None:
    couch = next((one for one in room.placed if one.piece is not None and one.piece.name == "sofa"), None)
    if couch is not None and room.rng.random() < 0.5:
        room.before(couch, "coffee table", room.rng.uniform(0.3, 0.6), with_rug=True)
    else:
        room.table_with_chairs(empty=0.75)


def _desk(room: Furnisher) -> None:
    place = room.against_wall("desk", topped=("table lamp",))
    if place is not None and room.rng.random() < 0.5:
        room.before(place, "office chair", room.rng.uniform(0.0, 0.3), faces_it=True)


def _chair(room: Furnisher) -> None:
    room.in_corner(str(room.rng.choice(["chair", "chair", "office chair"])))


def _misc(room: Furnisher) -> None:
    kind = room.rng.random()
    if kind < 0.3:
        room.in_corner("plant")
    elif kind < 0.55:
        room.lit_corner()
    elif kind < 0.85 and (carrier := _carrier(room)) is not None:
        room.lay_on(carrier, str(room.rng.choice(["vase", "table lamp"])))
    else:
        room.against_wall("cupboard", topped=("vase", "table lamp"))


def _tool(room: Furnisher) -> None:
    rng = room.rng
    way = rng.random()
    if way < 0.25:
        room.against_wall(str(rng.choice(_LONG_TOOLS)), tilted=leaning)
    elif way < 0.4:
        room.hang(str(rng.choice(_SHORT_TOOLS)), hanging)
    elif way < 0.55:
        room.lay_down(str(rng.choice(_SHORT_TOOLS)), lying)
    elif (carrier := _carrier(room)) is not None:
        room.lay_on(carrier, str(rng.choice(_SHORT_TOOLS)), lying)


def _carrier(room: Furnisher) -> Placed | None:
    """Something that stands there and on which things can lie; a new one where there is none."""
    there = [one for one in room.placed if one.piece is not None and one.piece.name in _CARRIERS]
    if there:
        return there[int(room.rng.integers(len(there)))]
    return room.against_wall(str(room.rng.choice(_CARRIERS)))


_STAGED: Mapping[str, Callable[[Furnisher], None]] = {
    "bed": _bed,
    "bookcase": _bookcase,
    "chair": _chair,
    "desk": _desk,
    "misc": _misc,
    "sofa": _sofa,
    "table": _table,
    "tool": _tool,
    "wardrobe": _wardrobe,
}
