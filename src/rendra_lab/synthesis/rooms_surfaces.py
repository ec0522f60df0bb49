"""What floors, walls, furniture and pictures of generated rooms are made of: painted anew for every room.

All pictures are (S, S, 3) sRGB, first row at the top, and repeat without seams but for those that hang on walls.
Materials that furniture is tinted with are about white. One side of a picture is `TILE_M` metres of the surface.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from rendra_lab.synthesis.backgrounds import draw_background
from rendra_lab.synthesis.solids import Color, Floats
from rendra_lab.synthesis.surface_pictures import GAMMA
from rendra_lab.synthesis.texture_pyramid import TexturePyramid

SIDE = 256
NUM_PAINTINGS = 3
# metres that a side of the picture covers; 1 where corners hold shares of the picture
TILE_M = {
    "floor": 2.0,
    "wall": 1.6,
    "dado": 1.0,
    "ceiling": 2.0,
    "wood": 0.9,
    "fabric": 0.35,
    "leather": 0.5,
    "plain": 0.8,
    "metal": 0.5,
    "leaf": 0.3,
    "spine": 1.0,
    "paper": 0.2,
    "rug": 1.0,
    "outside": 1.0,
    **{f"painting{number}": 1.0 for number in range(NUM_PAINTINGS)},
}
SURFACES = tuple(TILE_M)
_RNG = np.random.Generator
_Values = npt.NDArray[np.floating[Any]]


def paint_surfaces(rng: np.random.Generator) -> TexturePyramid:
    """Linear colours of all materials of one room, in the order of SURFACES."""
    painters: dict[str, Callable[[_RNG], _Values]] = {
        "floor": _floor,
        "wall": _wall,
        "dado": _boarding,
        "ceiling": lambda rng: _tinted(_plaster(rng, 0.015), 0.5 + 0.5 * _pale(rng, 0.88)),
        "wood": _wood,
        "fabric": _fabric,
        "leather": lambda rng: _grey(0.9 + 0.05 * _noise(rng, "fine") + 0.05 * _noise(rng, "rough")),
        "plain": lambda rng: _grey(0.96 + 0.012 * _noise(rng, "cloud") + 0.008 * _noise(rng, "fine")),
        "metal": lambda rng: _grey(0.9 + 0.05 * _noise(rng, "grain")),
        "leaf": _leaf,
        "spine": _spine,
        "paper": lambda rng: _grey(0.9 + 0.06 * _noise(rng, "grain").T),
        "rug": _rug,
        "outside": _outside,
    }
    pictures = [painters.get(name, _painting)(rng) for name in SURFACES]
    linear = torch.from_numpy(np.clip(np.stack(pictures), 0, 1).astype(np.float32)).pow(GAMMA)
    return TexturePyramid(linear)


def linear_color(color: Color | _Values) -> Tensor:
    """An sRGB colour (3,) without its gamma."""
    return torch.as_tensor(np.array(color, np.float32)).pow(GAMMA)


@lru_cache(maxsize=1)
def _noises() -> dict[str, _Values]:
    """Fields (S, S) of mean 0 and deviation 1 that repeat: clouds, roughness, dust, and grain along the rows."""
    rng = np.random.default_rng(20)
    y, x = np.fft.fftfreq(SIDE)[:, None] * SIDE, np.fft.rfftfreq(SIDE)[None] * SIDE
    far = np.sqrt(x**2 + y**2)
    long = np.sqrt((x / 9) ** 2 + y**2)
    across = np.sqrt(x**2 + (y / 3) ** 2)
    strengths = {
        "cloud": (far + 1.0) ** -2.2,
        "rough": (far + 3.0) ** -1.3,
        "fine": (far + 30.0) ** -0.6,
        "dust": np.exp(-(((far - 60) / 25) ** 2)),
        "grain": (1.5 + np.sqrt((6 * x) ** 2 + y**2)) ** -1.25,
        "knots": (1.0 + long) ** -2.5,
        "pile": (across + 20.0) ** -0.8,
    }
    fields = {}
    for name, strength in strengths.items():
        strength[0, 0] = 0
        wave = rng.standard_normal((2, *strength.shape))
        field = np.fft.irfft2((wave[0] + 1j * wave[1]) * strength, (SIDE, SIDE))
        fields[name] = ((field - field.mean()) / field.std()).astype(np.float32)
    return fields


def _noise(rng: _RNG, kind: str) -> _Values:
    """One of the fields, shifted and mirrored at random."""
    field = _noises()[kind]
    field = np.roll(field, tuple(rng.integers(0, SIDE, 2)), (0, 1))
    mirrored: _Values = field[:: 1 if rng.random() < 0.5 else -1, :: 1 if rng.random() < 0.5 else -1]
    return mirrored


def _grey(values: _Values) -> _Values:
    return np.repeat(values[..., None], 3, -1)


def _tinted(values: _Values, color: _Values) -> _Values:
    return values[..., None] * color


def _rows_columns() -> tuple[_Values, _Values]:
    """Middles of texels (S, 1) and (1, S), from 0 to 1."""
    middles = ((np.arange(SIDE) + 0.5) / SIDE).astype(np.float32)
    return middles[:, None], middles[None]


def _pale(rng: _RNG, light: float = 0.85) -> _Values:
    """A light colour with a little of some hue."""
    return np.clip(light + rng.uniform(-0.035, 0.035, 3), 0, 1).astype(np.float32)


def hue_color(rng: np.random.Generator, saturation: float, value: float) -> Floats:
    """A colour (3,): of a warm hue in half of all cases, often of a blue or a green one, sometimes of any."""
    middle, spread = _HUES[rng.choice(len(_HUES), p=(0.5, 0.2, 0.13, 0.17))]
    phase = middle + spread * rng.standard_normal() + np.array([0, 2, 4]) * math.pi / 3
    color: Floats = np.clip(value * (1 - saturation * (0.5 - 0.5 * np.cos(phase))), 0, 1).astype(np.float32)
    return color


_HUES = ((-0.6, 0.55), (2.2, 0.4), (-1.9, 0.35), (0.0, 3.0))  # of red: middle and spread, radians


def _paint_color(rng: _RNG) -> _Values:
    """What people paint walls with: mostly whites and greys, sometimes a colour."""
    kind = rng.random()
    if kind < 0.4:
        return _pale(rng, rng.uniform(0.78, 0.93))
    return hue_color(rng, rng.uniform(0.12, 0.5 if kind > 0.75 else 0.25), rng.uniform(0.55, 0.92))


def _plaster(rng: _RNG, strength: float) -> _Values:
    return 1 + strength * (_noise(rng, "cloud") + _noise(rng, "rough") + 0.5 * _noise(rng, "fine"))


WOODS = (
    (0.78, 0.6, 0.4),
    (0.66, 0.46, 0.28),
    (0.5, 0.32, 0.2),
    (0.36, 0.22, 0.14),
    (0.86, 0.74, 0.56),
    (0.58, 0.3, 0.18),
    (0.55, 0.5, 0.45),
    (0.27, 0.21, 0.18),
)


def wood_color(rng: np.random.Generator) -> Floats:
    """The colour (3,) of some wood."""
    tone = np.array(WOODS[rng.integers(len(WOODS))]) * rng.uniform(0.88, 1.12)
    return np.clip(tone + rng.uniform(-0.03, 0.03, 3), 0.05, 1).astype(np.float32)


def _floor(rng: _RNG) -> _Values:
    kinds = (_planks, _planks, _parquet, _tiles, _tiles, _carpet)
    return kinds[rng.integers(len(kinds))](rng)


def _planks(rng: _RNG) -> _Values:
    """Boards of two metres' length, with ends at random, dark gaps and a grain of their own."""
    count = int(rng.choice([10, 14, 18, 24]))
    rows, columns = _rows_columns()
    board = np.floor(rows * count).astype(np.int64)
    ends = rng.random(count)[board]
    piece = np.floor((columns + ends) * 2).astype(np.int64) % 2
    tone = rng.normal(0, rng.uniform(0.03, 0.1), (count, 2))[board, piece]
    grain = _noise(rng, "grain")
    shift = rng.integers(0, SIDE, count)[board[:, 0]]
    grain = np.take_along_axis(grain, (np.arange(SIDE)[None] + shift[:, None]) % SIDE, 1)
    gap_px = 1.2 / SIDE
    gap = (np.abs((rows * count + 0.5) % 1 - 0.5) / count < gap_px) | (
        np.abs(((columns + ends) * 2 + 0.5) % 1 - 0.5) / 2 < gap_px
    )
    light = (1 + tone + 0.06 * grain + 0.02 * _noise(rng, "knots").T) * np.where(gap, 0.55, 1.0)
    return _tinted(light, wood_color(rng))


def _parquet(rng: _RNG) -> _Values:
    """Squares of five strips, which lie along and across by turns."""
    squares, strips = int(rng.choice([4, 6])), 5
    rows, columns = _rows_columns()
    turned = (np.floor(rows * squares) + np.floor(columns * squares)) % 2 > 0
    y, x = np.broadcast_arrays(rows * squares, columns * squares)
    across, along = np.where(turned, x, y), np.where(turned, y, x)
    strip = np.floor(across * strips).astype(np.int64)
    tones = rng.normal(0, 0.07, (squares * strips, squares))
    grain = np.where(turned, _noise(rng, "grain").T, _noise(rng, "grain"))
    in_strip = np.abs((across * strips + 0.5) % 1 - 0.5) / strips
    gap = np.minimum(in_strip, np.abs((along + 0.5) % 1 - 0.5)) / squares < 0.8 / SIDE
    light = 1 + tones[strip, np.floor(along).astype(np.int64)] + 0.05 * grain
    return _tinted(light * np.where(gap, 0.65, 1.0), wood_color(rng))


def _tiles(rng: _RNG) -> _Values:
    """Square tiles with joints, of one colour or of two by turns."""
    count = int(rng.choice([4, 6, 8]))
    rows, columns = _rows_columns()
    row, column = (np.floor(side * count).astype(np.int64) for side in (rows, columns))
    tone = rng.normal(0, 0.035, (count, count))[row, column]
    vein = np.abs(_noise(rng, "cloud") + 0.4 * _noise(rng, "rough"))
    light = 1 + tone + 0.02 * _noise(rng, "fine") - rng.uniform(0, 0.12) * np.exp(-6 * vein)
    first = _paint_color(rng) * rng.uniform(0.6, 1)
    second = first if rng.random() < 0.55 else first * rng.uniform(0.3, 0.75)
    color = np.where(((row + column) % 2 == 0)[..., None], first, second)
    edge = np.minimum(np.abs((rows * count + 0.5) % 1 - 0.5), np.abs((columns * count + 0.5) % 1 - 0.5)) / count
    joint = _grey(np.full((SIDE, SIDE), rng.uniform(0.35, 0.75)) * (1 + 0.05 * _noise(rng, "fine")))
    return np.where((edge < 1.3 / SIDE)[..., None], joint, light[..., None] * color)


def _carpet(rng: _RNG) -> _Values:
    color = hue_color(rng, rng.uniform(0.05, 0.45), rng.uniform(0.4, 0.8))
    return _tinted(1 + 0.1 * _noise(rng, "pile") + 0.05 * _noise(rng, "cloud") + 0.06 * _noise(rng, "dust"), color)


def _wall(rng: _RNG) -> _Values:
    kinds = (_paint, _paint, _stripes, _damask, _damask, _boarding, _bricks)
    return kinds[rng.integers(len(kinds))](rng)


def _paint(rng: _RNG) -> _Values:
    return _tinted(_plaster(rng, rng.uniform(0.01, 0.03)), _paint_color(rng))


def _stripes(rng: _RNG) -> _Values:
    """Wallpaper with stripes of two widths."""
    _, columns = _rows_columns()
    count = int(rng.choice([6, 8, 12]))
    phase = columns * count % 1
    wide = phase < rng.uniform(0.3, 0.6)
    thin = np.abs(phase - 0.8) < 0.04
    color = _paint_color(rng)
    other = np.clip(color * rng.uniform(0.78, 0.95) + rng.uniform(-0.05, 0.05, 3), 0, 1)
    base = np.where(wide[..., None], other, color) * np.where(thin, 0.8, 1.0)[..., None]
    return base * _plaster(rng, 0.012)[..., None]


def _damask(rng: _RNG) -> _Values:
    """Wallpaper with a motif in staggered rows."""
    rows, columns = _rows_columns()
    count = int(rng.choice([6, 8, 10, 14]))
    y = rows * count
    x = columns * count + 0.5 * (np.floor(y) % 2)
    u, v = x % 1 - 0.5, y % 1 - 0.5
    angle, far = np.arctan2(v, u), np.hypot(u, v * rng.uniform(0.8, 1.2))
    petals = int(rng.integers(3, 8))
    shape = far - rng.uniform(0.16, 0.24) * (1 + rng.uniform(0.2, 0.6) * np.cos(petals * angle))
    motif = 1 / (1 + np.exp(60 * shape)) - 0.7 / (1 + np.exp(90 * (far - 0.07)))
    color = _paint_color(rng)
    other = np.clip(color * rng.uniform(0.75, 0.95) + rng.uniform(-0.07, 0.07, 3), 0, 1)
    return (color + motif[..., None] * (other - color)) * _plaster(rng, 0.012)[..., None]


def _boarding(rng: _RNG) -> _Values:
    """Upright boards with grooves, painted or of wood."""
    _, columns = _rows_columns()
    count = int(rng.choice([8, 10, 16]))
    phase = columns * count % 1
    groove = 1 - 0.35 * np.exp(-(((phase - 0.04) / 0.03) ** 2)) + 0.06 * np.exp(-(((phase - 0.12) / 0.03) ** 2))
    tone = rng.normal(0, 0.02, count)[np.floor(columns * count).astype(np.int64)]
    if rng.random() < 0.4:
        light = (1 + 2 * tone + 0.06 * _noise(rng, "grain").T) * groove
        return _tinted(light, wood_color(rng))
    return _tinted((_plaster(rng, 0.01) + tone) * groove, _paint_color(rng))


def _bricks(rng: _RNG) -> _Values:
    """Bricks in running bond, bare or painted."""
    rows, columns = _rows_columns()
    courses, length = 20, 6
    y = rows * courses
    x = columns * length + 0.5 * (np.floor(y) % 2)
    row, column = np.floor(y).astype(np.int64), np.floor(x).astype(np.int64) % length
    tone = rng.normal(0, 1, (courses, length))[row, column]
    edge = np.minimum(np.abs((y + 0.5) % 1 - 0.5) / courses, np.abs((x + 0.5) % 1 - 0.5) / length)
    joint = (edge < 1.4 / SIDE)[..., None]
    rough = 0.05 * _noise(rng, "fine") + 0.05 * _noise(rng, "rough")
    if rng.random() < 0.5:
        color = _pale(rng, rng.uniform(0.75, 0.9))
        return np.where(joint, 0.82, 1.0) * (1 + 0.025 * tone + 0.5 * rough)[..., None] * color
    color = np.array([0.62, 0.35, 0.26]) * rng.uniform(0.8, 1.15)
    mortar = _grey(0.68 + rough)
    return np.where(joint, mortar, (1 + 0.11 * tone + rough)[..., None] * color)


def _wood(rng: _RNG) -> _Values:
    """Grain along the first coordinate, about white."""
    knots = _noise(rng, "knots").T
    rings: _Values = np.sin(9 * knots + 1.5 * _noise(rng, "grain"))
    return _grey(0.88 + 0.07 * _noise(rng, "grain") + 0.035 * rings)


def _fabric(rng: _RNG) -> _Values:
    """A weave, plain, striped or checked."""
    rows, columns = _rows_columns()
    weave = 0.04 * np.sin(2 * math.pi * 64 * rows) * np.sin(2 * math.pi * 64 * columns)
    light: _Values = 0.9 + weave + 0.05 * _noise(rng, "pile") + 0.03 * _noise(rng, "cloud")
    kind = rng.random()
    if kind < 0.3:
        count = int(rng.choice([2, 3, 5]))
        wide = columns * count % 1 < rng.uniform(0.2, 0.5)
        band: _Values = (1 - rng.uniform(0.1, 0.4) * wide).astype(np.float32)
        light = light * (band if kind < 0.18 else band * band.T)
    return _grey(light)


def _leaf(rng: _RNG) -> _Values:
    _, columns = _rows_columns()
    vein = 1 - 0.2 * np.abs(np.sin(2 * math.pi * 4 * columns)) ** 8
    return _grey(vein * (0.85 + 0.08 * _noise(rng, "rough")))


def _spine(rng: _RNG) -> _Values:
    """The backs of books: bands at the ends and a title, in shares of the height."""
    rows, columns = _rows_columns()
    band = (np.abs(rows - 0.08) < 0.015) | (np.abs(rows - 0.9) < 0.02)
    title = (rows > 0.22) & (rows < 0.6) & (np.abs(columns % 1 - 0.5) < 0.22) & (np.sin(rows * 190) > -0.2)
    return _grey(np.where(band | title, 1.0, 0.72) + 0.03 * _noise(rng, "fine"))


def _rug(rng: _RNG) -> _Values:
    """Borders within borders about a field with a motif."""
    rows, columns = _rows_columns()
    x, y = np.abs(2 * columns - 1), np.abs(2 * rows - 1)
    inward = 1 - np.maximum(x, y)
    colors = np.stack([hue_color(rng, rng.uniform(0.1, 0.5), rng.uniform(0.3, 0.85)) for _ in range(4)])
    kind, steps = rng.random(), int(rng.choice([5, 7, 9]))
    if kind < 0.4:
        field = np.floor(steps * (x + y)).astype(np.int64) % 2
    elif kind < 0.7:
        field = (np.sin(math.pi * steps * x) * np.sin(math.pi * steps * y) > 0.2).astype(np.int64)
    else:
        field = np.tile(np.floor(2 * steps * columns).astype(np.int64) % 2, (SIDE, 1))
    border = np.select([inward < 0.04, inward < 0.12, inward < 0.15], [2, 3, 2], -1)
    zigzag = (inward >= 0.04) & (inward < 0.12) & (np.sin(60 * (x - y)) > 0.3)
    index = np.where(border >= 0, border, field)
    pile = 1 + 0.1 * _noise(rng, "pile") + 0.05 * _noise(rng, "cloud")
    return np.where(zigzag[..., None], colors[0], colors[index]) * pile[..., None]


def _painting(rng: _RNG) -> _Values:
    """Something to hang on a wall, often with a white margin."""
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    picture = draw_background((SIDE, SIDE), generator).numpy().astype(np.float32)
    picture = 0.5 + 1.2 * (picture - 0.5)
    rows, columns = _rows_columns()
    if rng.random() < 0.5:
        margin = rng.uniform(0.08, 0.18)
        inward = np.minimum(np.minimum(rows, 1 - rows), np.minimum(columns, 1 - columns))
        picture = np.where((inward < margin)[..., None], np.float32(0.93), picture)
    return picture


def _outside(rng: _RNG) -> _Values:
    """What windows show: sky, trees or houses, and ground."""
    rows, columns = _rows_columns()
    sky = np.array([0.75, 0.87, 1.0]) + rows[..., None] * np.array([0.22, 0.12, 0.0])
    clouds = np.clip(_noise(rng, "cloud") - 0.2, 0, 1)[..., None]
    picture = sky + 0.25 * clouds * (1 - sky)
    heights = _noise(rng, "rough")[:1]
    skyline = rng.uniform(0.45, 0.75) + 0.06 * _noise(rng, "cloud")[:1] + 0.03 * heights
    green = hue_color(rng, 0.2, 0.6) * np.array([0.75, 1.0, 0.6])
    trees = (0.85 + 0.25 * _noise(rng, "rough") + 0.1 * _noise(rng, "fine"))[..., None] * green
    picture = np.where((rows > skyline)[..., None], trees, picture)
    if rng.random() < 0.5:
        left = rng.uniform(0, 0.6)
        house = (columns > left) & (columns < left + rng.uniform(0.25, 0.5)) & (rows > rng.uniform(0.3, 0.5))
        pane = (columns * 14 % 1 < 0.45) & (rows * 9 % 1 < 0.5)
        wall = np.where(pane[..., None], 0.4, 1.0) * _pale(rng, 0.8)
        picture = np.where(house[..., None], wall, picture)
    ground = (0.8 + 0.08 * _noise(rng, "rough"))[..., None] * green * rng.uniform(0.8, 1.3)
    return np.where((rows > 0.88)[..., None], ground, picture)
