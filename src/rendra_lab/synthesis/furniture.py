"""Furniture that is drawn at random: no two pieces are alike. The pieces themselves are of furniture_pieces.py."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rendra_lab.synthesis.furniture_pieces import (
    CLASSES,
    Finish,
    Furniture,
    as_color,
    bed,
    bookcase,
    broom,
    chair,
    cupboard,
    desk,
    floor_lamp,
    hammer,
    office_chair,
    plant,
    screwdriver,
    sofa,
    table,
    table_lamp,
    vase,
    wardrobe,
)
from rendra_lab.synthesis.rooms_surfaces import hue_color, wood_color
from rendra_lab.synthesis.solids import Color

__all__ = ["CLASSES", "NAMES", "Finish", "Furniture", "draw", "draw_finish"]

_RNG = np.random.Generator


def draw_finish(rng: np.random.Generator) -> Finish:
    """Materials that go together."""
    wood = as_color(wood_color(rng))
    kind = rng.random()
    white = as_color(0.93 - rng.uniform(0, 0.06, 3))
    body, color = (
        ("wood", wood) if kind < 0.65 else ("plain", white) if kind < 0.88 else ("plain", (0.12, 0.12, 0.13))
    )
    accent = color if rng.random() < 0.6 else as_color(wood_color(rng)) if kind > 0.65 else white
    return Finish(
        body=body,
        color=color,
        accent=accent,
        cover="fabric" if rng.random() < 0.75 else "leather",
        cover_color=as_color(hue_color(rng, 0.05 + 0.5 * rng.random() ** 1.5, rng.uniform(0.25, 0.85))),
        pillow=as_color(hue_color(rng, rng.uniform(0.1, 0.8), rng.uniform(0.4, 0.95))),
    )


def draw(name: str, rng: np.random.Generator, finish: Finish | None = None) -> Furniture:
    """A piece of proportions that nobody chose.

    Args:
        name: one of NAMES.
        rng: makes all choices.
        finish: materials; None draws them too.

    Raises:
        ValueError: a name of nothing that is made here.
    """
    if name not in _DRAWN:
        raise ValueError(f"no furniture is called {name!r}; there are: {', '.join(NAMES)}")
    return _DRAWN[name](rng, draw_finish(rng) if finish is None else finish)


def _draw_table(rng: _RNG, finish: Finish) -> Furniture:
    legs = str(rng.choice(["posts", "posts", "slim", "panels", "pedestal"]))
    width = rng.uniform(0.9, 1.3) if legs == "pedestal" else rng.uniform(1.1, 2.0)
    return table((width, rng.uniform(0.71, 0.77), rng.uniform(0.75, 1.0)), finish, legs, rng.uniform(0.02, 0.05))


def _draw_coffee_table(rng: _RNG, finish: Finish) -> Furniture:
    legs = str(rng.choice(["posts", "slim", "panels", "pedestal"]))
    low = table((rng.uniform(0.8, 1.2), rng.uniform(0.35, 0.48), rng.uniform(0.5, 0.7)), finish, legs)
    return replace(low, name="coffee table")


def _draw_desk(rng: _RNG, finish: Finish) -> Furniture:
    size = (rng.uniform(1.1, 1.7), rng.uniform(0.72, 0.77), rng.uniform(0.55, 0.8))
    return desk(size, finish, int(rng.choice([0, 2, 3, 4])), int(rng.choice([-1, 1])))


def _draw_chair(rng: _RNG, finish: Finish) -> Furniture:
    size = (rng.uniform(0.4, 0.5), rng.uniform(0.82, 1.05), rng.uniform(0.4, 0.48))
    return chair(size, finish, str(rng.choice(["slats", "panel", "rails", "cover"])), bool(rng.random() < 0.2))


def _draw_office_chair(rng: _RNG, finish: Finish) -> Furniture:
    return office_chair((rng.uniform(0.46, 0.54), rng.uniform(0.95, 1.2), rng.uniform(0.44, 0.52)), finish)


def _draw_sofa(rng: _RNG, finish: Finish) -> Furniture:
    seats = int(rng.choice([2, 3, 3]))
    arm = rng.uniform(0.13, 0.24)
    size = (2 * arm + seats * rng.uniform(0.58, 0.72), rng.uniform(0.75, 0.95), rng.uniform(0.82, 1.0))
    places = [place for place in (-0.8, 0.75, 0.3) if rng.random() < 0.5]
    return sofa(size, finish, seats, arm, places)


def _draw_easy_chair(rng: _RNG, finish: Finish) -> Furniture:
    arm = rng.uniform(0.11, 0.18)
    size = (2 * arm + rng.uniform(0.55, 0.65), rng.uniform(0.78, 1.0), rng.uniform(0.75, 0.9))
    return sofa(size, finish, 1, arm)


def _draw_bed(rng: _RNG, finish: Finish) -> Furniture:
    double = rng.random() < 0.7
    width = rng.uniform(1.4, 1.85) if double else rng.uniform(0.9, 1.1)
    size = (width, rng.uniform(0.75, 1.25), rng.uniform(2.0, 2.15))
    return bed(size, finish, 2 if double else 1, bool(rng.random() < 0.3))


def _draw_bookcase(rng: _RNG, finish: Finish) -> Furniture:
    height = rng.uniform(0.9, 2.2)
    size = (rng.uniform(0.7, 1.3), height, rng.uniform(0.25, 0.34))
    return bookcase(size, finish, max(2, round(height / rng.uniform(0.32, 0.42))), rng)


def _draw_wardrobe(rng: _RNG, finish: Finish) -> Furniture:
    doors = int(rng.choice([2, 2, 3, 4]))
    size = (doors * rng.uniform(0.42, 0.55), rng.uniform(1.8, 2.15), rng.uniform(0.52, 0.62))
    return wardrobe(size, finish, doors, int(rng.choice([0, 1, 2, 3])))


def _draw_cupboard(rng: _RNG, finish: Finish) -> Furniture:
    columns = int(rng.choice([2, 3]))
    size = (columns * rng.uniform(0.4, 0.55), rng.uniform(0.55, 0.95), rng.uniform(0.36, 0.48))
    return cupboard(size, finish, columns, int(rng.choice([2, 3, 4])))


def _draw_nightstand(rng: _RNG, finish: Finish) -> Furniture:
    size = (rng.uniform(0.38, 0.5), rng.uniform(0.45, 0.62), rng.uniform(0.36, 0.42))
    return cupboard(size, finish, 1, int(rng.choice([1, 2, 3])))


def _warm(rng: _RNG) -> Color:
    return as_color((0.98, rng.uniform(0.86, 0.95), rng.uniform(0.66, 0.86)))


def _draw_floor_lamp(rng: _RNG, finish: Finish) -> Furniture:
    return floor_lamp(rng.uniform(1.4, 1.75), rng.uniform(0.18, 0.28), _warm(rng))


def _draw_table_lamp(rng: _RNG, finish: Finish) -> Furniture:
    return table_lamp(rng.uniform(0.35, 0.55), finish.pillow, _warm(rng))


def _draw_plant(rng: _RNG, finish: Finish) -> Furniture:
    return plant(rng.uniform(0.6, 1.6), finish.pillow, int(rng.integers(9, 22)), rng)


def _draw_hammer(rng: _RNG, finish: Finish) -> Furniture:
    return hammer(rng.uniform(0.25, 0.4), finish)


def _draw_screwdriver(rng: _RNG, finish: Finish) -> Furniture:
    return screwdriver(rng.uniform(0.15, 0.3), finish.pillow)


def _draw_broom(rng: _RNG, finish: Finish) -> Furniture:
    return broom(rng.uniform(1.2, 1.5), rng.uniform(0.25, 0.4), finish)


def _draw_vase(rng: _RNG, finish: Finish) -> Furniture:
    return vase(rng.uniform(0.18, 0.4), finish.pillow)


_DRAWN: dict[str, Callable[[_RNG, Finish], Furniture]] = {
    "table": _draw_table,
    "coffee table": _draw_coffee_table,
    "desk": _draw_desk,
    "chair": _draw_chair,
    "office chair": _draw_office_chair,
    "sofa": _draw_sofa,
    "easy chair": _draw_easy_chair,
    "bed": _draw_bed,
    "bookcase": _draw_bookcase,
    "wardrobe": _draw_wardrobe,
    "cupboard": _draw_cupboard,
    "nightstand": _draw_nightstand,
    "floor lamp": _draw_floor_lamp,
    "table lamp": _draw_table_lamp,
    "plant": _draw_plant,
    "vase": _draw_vase,
    "hammer": _draw_hammer,
    "screwdriver": _draw_screwdriver,
    "broom": _draw_broom,
}
NAMES = tuple(_DRAWN)
