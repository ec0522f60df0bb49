"""Textures of streets, drawn anew for each: asphalt, pavements, walls with windows, leaves, cars.

A texture is (H, W, 4): colours as square roots of reflectances, and how much of each a surface's tint multiplies.
Row 0 is the upper edge of what stands, and the nearest of what lies.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Rng = np.random.Generator

SIDE = 128
FACADES = 5  # kinds of houses in a street
_FIXED = ("plain", "asphalt", "verge", "pavement", "kerb", "grass", "leaves", "leaves_2", "hedge", "bark", "roof",
          "roof_2", "fence", "car_side", "van_side", "car_front", "car_rear", "glass", "wheel", "sign", "sign_2",
          "metal")  # fmt: skip
NAMES = (*_FIXED, *(f"{part}_{i}" for i in range(FACADES) for part in ("upper", "lower", "blank")))
TEXTURE = {name: number for number, name in enumerate(NAMES)}


@dataclass(frozen=True)
class RoadMarks:
    """What is painted on a road, over `span` metres of width and `period` of length.

    Attributes:
        half_width: of the carriageway between the kerbs.
        dashes: x of broken lines.
        lines: x of unbroken lines.
        period: of the broken lines, metres.
    """

    half_width: float
    dashes: tuple[float, ...]
    lines: tuple[float, ...]
    period: float = 12.0


def draw_textures(rng: Rng, marks: RoadMarks) -> Array:
    """All textures of a street: (len(NAMES), SIDE, SIDE, 4) in the order of NAMES."""
    made = {
        "plain": _opaque(0.9 + 0.02 * noise(rng, 1.0), 1.0),
        "asphalt": asphalt(rng, marks),
        "verge": asphalt(rng, RoadMarks(marks.half_width, (), ())),
        "pavement": pavement(rng),
        "kerb": _opaque(_joints(0.72 + 0.05 * noise(rng, 0.6), 1, 4, 0.2), 0.0),
        "grass": grass(rng),
        "leaves": leaves(rng, 0.8),
        "leaves_2": leaves(rng, 1.1),
        "hedge": leaves(rng, 0.7),
        "bark": _opaque(0.4 + 0.09 * noise(rng, 0.7, (1.0, 6.0)), 1.0),
        "roof": tiles(rng, 8, 10),
        "roof_2": tiles(rng, 5, 14),
        "fence": fence(rng),
        "car_side": car_side(rng, van=False),
        "van_side": car_side(rng, van=True),
        "car_front": car_end(rng, rear=False),
        "car_rear": car_end(rng, rear=True),
        "glass": glass(rng),
        "wheel": wheel(),
        "sign": sign(rng),
        "sign_2": sign(rng),
        "metal": _opaque(0.55 + 0.03 * noise(rng, 1.0), 0.5),
    }
    for i in range(FACADES):
        made[f"upper_{i}"], made[f"lower_{i}"], made[f"blank_{i}"] = facade(rng)
    return np.stack([made[name] for name in NAMES]).clip(0, 1)


def noise(rng: Rng, roughness: float, stretch: tuple[float, float] = (1.0, 1.0)) -> Array:
    """Random values (SIDE, SIDE) that repeat seamlessly, of mean 0 and deviation 1.

    Args:
        rng: makes the choices.
        roughness: 0 is white noise, 1 rough clouds, 2 soft hills.
        stretch: across and down, how many times longer its grains are along the other axis.
    """
    spectrum = np.fft.rfft2(rng.standard_normal((SIDE, SIDE), np.float32))
    field = np.fft.irfft2(spectrum * _falloff(roughness, stretch), (SIDE, SIDE)).astype(np.float32)
    return field / field.std()


@functools.lru_cache(32)
def _falloff(roughness: float, stretch: tuple[float, float]) -> npt.NDArray[np.float64]:
    down, across = np.fft.fftfreq(SIDE)[:, None] * stretch[1], np.fft.rfftfreq(SIDE)[None] * stretch[0]
    squared = across**2 + down**2
    squared[0, 0] = 1.0
    falloff = squared ** (-roughness / 2)
    falloff[0, 0] = 0.0
    return falloff


@functools.lru_cache(1)
def _grid() -> tuple[Array, Array]:
    """Places (SIDE, SIDE) across and down, 0 to 1, of the middles of texels."""
    middles = (np.arange(SIDE, dtype=np.float32) + 0.5) / SIDE
    across, down = np.meshgrid(middles, middles)
    return across, down


def _opaque(grey: Array, tinted: float | Array, color: Sequence[float] = (1.0, 1.0, 1.0)) -> Array:
    """A texture of one colour in many shades (H, W)."""
    rgb = grey[..., None] * np.asarray(color, np.float32)
    return np.concatenate([rgb, np.broadcast_to(np.float32(tinted), grey.shape)[..., None]], -1).astype(np.float32)


def _joints(grey: Array, columns: int, rows: int, depth: float, width: float = 0.012, bond: bool = False) -> Array:
    """Darkened where slabs or bricks meet; each other row of a bond is shifted by half a brick."""
    across, down = _grid()
    row = np.floor(down * rows)
    shift = 0.5 * (row % 2) if bond else 0.0
    along, high = (across * columns + shift) % 1, (down * rows) % 1
    near = np.minimum(np.minimum(along, 1 - along) / columns, np.minimum(high, 1 - high) / rows)
    return (grey * (1 - depth * (near < width))).astype(np.float32)


def _cells(rng: Rng, columns: int, rows: int, deviation: float, bond: bool = False) -> Array:
    """A random value (SIDE, SIDE) for each slab or brick."""
    across, down = _grid()
    row = np.floor(down * rows).astype(int)
    column = np.floor(across * columns + (0.5 * (row % 2) if bond else 0)).astype(int) % columns
    return rng.normal(0, deviation, (rows, columns)).astype(np.float32)[row, column]


def asphalt(rng: Rng, marks: RoadMarks) -> Array:
    """The carriageway across its width, with patches, seams, worn tracks and white lines."""
    across, down = _grid()
    x, z = (2 * across - 1) * marks.half_width, down * marks.period
    grey = rng.uniform(0.36, 0.5) + 0.035 * noise(rng, 0.3) + 0.03 * noise(rng, 1.3)
    grey += 0.03 * noise(rng, 1.2, (1.0, 12.0)) * rng.uniform(0.2, 1)
    for _ in range(rng.integers(0, 4)):
        left, first = rng.uniform(-1, 0.6) * marks.half_width, rng.uniform(0, marks.period - 3)
        patch = (x > left) & (x < left + rng.uniform(0.6, 2)) & (z > first) & (z < first + rng.uniform(0.8, 3))
        grey = np.where(patch, grey * rng.uniform(0.75, 1.15), grey)
    grey *= 1 - 0.12 * np.exp(-((marks.half_width - np.abs(x)) ** 2) / 0.05)
    half = rng.uniform(0.06, 0.09)
    painted = np.zeros_like(grey, bool)
    for place in marks.lines:
        painted |= np.abs(x - place) < half
    for place in marks.dashes:
        painted |= (np.abs(x - place) < half) & ((z % (marks.period / 2)) < marks.period / 4)
    worn = (noise(rng, 0.7) > rng.uniform(1.0, 2.5)) & painted
    grey = np.where(painted & ~worn, 0.88 + 0.03 * noise(rng, 0.5), grey)
    return _opaque(grey, 0.0, (1.0, 0.99, rng.uniform(0.95, 1.03)))


def pavement(rng: Rng) -> Array:
    """Slabs, cobbles or asphalt."""
    grey = rng.uniform(0.55, 0.75) + 0.03 * noise(rng, 0.4) + 0.03 * noise(rng, 1.4)
    columns, rows = [(4, 4), (8, 8), (6, 12), (1, 1)][rng.integers(4)]
    if columns > 1:
        grey = _joints(grey + _cells(rng, columns, rows, 0.03, bond=True), columns, rows, 0.22, 0.01, bond=True)
    return _opaque(grey, 0.0, (1.0, rng.uniform(0.94, 1.0), rng.uniform(0.86, 0.98)))


def grass(rng: Rng) -> Array:
    """A lawn with dry spots."""
    blades, spots = noise(rng, 0.3), noise(rng, 1.4)
    green = np.array([rng.uniform(0.32, 0.45), rng.uniform(0.45, 0.56), rng.uniform(0.2, 0.28)], np.float32)
    rgb = green * (1 + 0.16 * blades + 0.1 * spots)[..., None]
    rgb[..., 0] += 0.04 * spots.clip(0)
    return np.concatenate([rgb, np.zeros((SIDE, SIDE, 1))], -1).astype(np.float32)


def leaves(rng: Rng, grain: float) -> Array:
    """Light and dark clumps of leaves, coloured by the tint."""
    grey = 0.62 + 0.17 * noise(rng, grain) + 0.06 * noise(rng, 0.3)
    return _opaque(grey.clip(0.12, 1.1), 1.0)


def tiles(rng: Rng, columns: int, rows: int) -> Array:
    """Rows of roof tiles, each with its shadow."""
    _, down = _grid()
    high = (down * rows) % 1
    grey = 0.75 + _cells(rng, columns, rows, 0.06, bond=True) + 0.04 * noise(rng, 0.6) - 0.18 * high
    return _opaque(_joints(grey, columns, rows, 0.3, 0.008, bond=True), 1.0)


def fence(rng: Rng) -> Array:
    """Boards, or a wall of stones."""
    columns, rows, bond = [(12, 1, False), (5, 7, True)][rng.integers(2)]
    grey = 0.75 + _cells(rng, columns, rows, 0.06, bond) + 0.05 * noise(rng, 0.6, (4.0, 1.0))
    return _opaque(_joints(grey, columns, rows, 0.45, 0.008, bond), 1.0)


def glass(rng: Rng) -> Array:
    """Windscreens: sky above, dark inside below."""
    _, down = _grid()
    grey = 0.5 - 0.32 * down + 0.015 * noise(rng, 1.8)
    return _opaque(grey, 0.0, (0.9, 0.98, 1.08))


def _paint(texture: Array, x: tuple[float, float], y: tuple[float, float], color: npt.ArrayLike,
           tinted: float = 0.0) -> None:  # fmt: skip
    """Fill a rectangle, in shares of the sides."""
    x0, x1, y0, y1 = (round(float(share) * SIDE) for share in (*x, *y))
    texture[max(y0, 0) : y1, max(x0, 0) : x1, :3] = color
    texture[max(y0, 0) : y1, max(x0, 0) : x1, 3] = tinted


def car_side(rng: Rng, van: bool) -> Array:
    """From the rear at the left to the front at the right, 1.6 m high (2.1 m of a van): windows, doors, arches."""
    across, down = _grid()
    grey = 0.97 - 0.1 * down + 0.01 * noise(rng, 1.0)
    texture = _opaque(grey, 1.0)
    sill = 0.8
    _paint(texture, (0, 1), (sill, 1.0), (0.16, 0.16, 0.17))
    dark = (0.2, 0.22, 0.25)
    windows = [(0.52, 0.64), (0.66, 0.76)] if van else [(0.1, 0.22), (0.245, 0.43), (0.455, 0.68)]
    for window in windows:
        _paint(texture, window, (0.1, 0.36) if van else (0.1, 0.38), dark)
        _paint(texture, window, (0.1, 0.2), (0.36, 0.4, 0.45))
    for seam in (0.44, 0.68, 0.24):
        texture[round(0.38 * SIDE) : round(sill * SIDE), round(seam * SIDE), :3] *= 0.55
    for handle in (0.27, 0.47):
        _paint(texture, (handle, handle + 0.04), (0.45, 0.475), (0.15, 0.15, 0.15))
    texture[round(0.6 * SIDE) : round(0.63 * SIDE), :, :3] *= 0.85
    _paint(texture, (0.0, 0.02), (0.42, 0.56), (0.7, 0.1, 0.08))
    _paint(texture, (0.975, 1.0), (0.5, 0.6), (0.9, 0.9, 0.85))
    for centre in (0.2, 0.81):
        arch = ((across - centre) / 0.088) ** 2 + ((down - 0.81) / 0.25) ** 2 < 1
        texture[arch] = (0.06, 0.06, 0.06, 0.0)
    return texture


def car_end(rng: Rng, rear: bool) -> Array:
    """Rear with red lamps, or front with a grille; a plate in the middle; from below the window to the bumper."""
    texture = _opaque(0.95 - 0.06 * _grid()[1], 1.0)
    lamp = (0.72, 0.08, 0.06) if rear else (0.93, 0.93, 0.9)
    low = rng.uniform(0.3, 0.42)
    width = rng.uniform(0.16, 0.24)
    for x in ((0.03, 0.03 + width), (0.97 - width, 0.97)):
        _paint(texture, x, (low - 0.2, low), lamp)
        _paint(texture, (x[0], x[0] + 0.02), (low - 0.2, low), (0.3, 0.1, 0.1))
    if not rear:
        _paint(texture, (0.3, 0.7), (low - 0.14, low), (0.13, 0.13, 0.14))
    _paint(texture, (0.0, 1.0), (0.6, 0.62), (0.3, 0.3, 0.3), 0.5)
    _paint(texture, (0.35, 0.65), (0.46, 0.56), (0.9, 0.9, 0.86))
    for x in np.linspace(0.38, 0.6, 6):
        _paint(texture, (x, x + 0.02), (0.48, 0.54), (0.15, 0.15, 0.2))
    _paint(texture, (0.0, 1.0), (0.84, 1.0), (0.13, 0.13, 0.13))
    return texture


def wheel() -> Array:
    """A tyre about a rim with spokes."""
    across, down = _grid()
    x, y = across - 0.5, down - 0.5
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    rim = np.where(np.sin(5 * angle) > -0.2, 0.66, 0.3)
    grey = np.where(radius < 0.32, rim, 0.14)
    return _opaque(np.where(radius < 0.07, 0.5, grey).astype(np.float32), 0.0)


def sign(rng: Rng) -> Array:
    """A plate with a rim and something on it, in a colour of its own."""
    color = [(0.8, 0.1, 0.1), (0.1, 0.25, 0.7), (0.95, 0.95, 0.9), (0.9, 0.75, 0.1)][rng.integers(4)]
    inner = (0.95, 0.95, 0.95) if rng.random() < 0.6 else (0.1, 0.2, 0.6)
    texture = _opaque(np.ones((SIDE, SIDE), np.float32), 0.0, color)
    _paint(texture, (0.14, 0.86), (0.14, 0.86), inner)
    for _ in range(rng.integers(1, 4)):
        x, y = rng.uniform(0.2, 0.5, 2)
        _paint(texture, (x, x + 0.3), (y, y + rng.uniform(0.08, 0.3)), (0.1, 0.1, 0.12))
    return texture


@dataclass(frozen=True)
class _Style:
    """How a kind of house looks."""

    frame: tuple[float, float, float]
    width: float  # of a window, in bays
    top: float
    bottom: float  # of a window, in floors from above
    panes: int
    shutter: tuple[float, float, float] | None
    surround: float  # grey of what frames the window
    shop: bool


def facade(rng: Rng) -> tuple[Array, Array, Array]:
    """Textures of a house, two bays wide and a floor high: an upper floor, the ground floor, and a blank wall."""
    blank = _wall(rng)
    colors = [(0.92, 0.92, 0.9), (0.3, 0.22, 0.17), (0.2, 0.22, 0.25), (0.75, 0.72, 0.66)]
    shutters = [(0.2, 0.38, 0.3), (0.45, 0.2, 0.15), (0.35, 0.42, 0.55), (0.85, 0.83, 0.78)]
    style = _Style(
        frame=colors[rng.integers(4)],
        width=rng.uniform(0.3, 0.52),
        top=rng.uniform(0.12, 0.24),
        bottom=rng.uniform(0.66, 0.8),
        panes=int(rng.integers(1, 4)),
        shutter=shutters[rng.integers(4)] if rng.random() < 0.35 else None,
        surround=rng.uniform(0.7, 1.0),
        shop=rng.random() < 0.4,
    )
    upper, lower = blank.copy(), blank.copy()
    for bay in (0.25, 0.75):
        _window(rng, upper, bay, style)
    band = round(rng.uniform(0.02, 0.06) * SIDE)
    upper[-band:, :, :3] *= rng.uniform(0.75, 1.15)
    lower[: band // 2 + 1, :, :3] *= 0.75
    if style.shop:
        _shop(rng, lower)
    else:
        _window(rng, lower, 0.25, style)
        _door(rng, lower, 0.75)
    _paint(lower, (0, 1), (0.93, 1.0), [rng.uniform(0.35, 0.6)] * 3)
    return upper, lower, blank


def _wall(rng: Rng) -> Array:
    kind = rng.integers(4)
    grain = 0.03 * noise(rng, 0.5) + 0.04 * noise(rng, 1.5, (1.0, 2.0))
    if kind == 0:  # bricks
        grey = _joints(0.72 + _cells(rng, 16, 32, 0.07, bond=True) + grain, 16, 32, -0.22, 0.004, bond=True)
    elif kind == 1:  # blocks of stone
        grey = _joints(0.85 + _cells(rng, 6, 8, 0.05, bond=True) + grain, 6, 8, 0.22, 0.006, bond=True)
    elif kind == 2:  # boards
        grey = _joints(0.88 + _cells(rng, 1, 16, 0.03) + grain, 1, 16, 0.25, 0.006)
    else:  # plaster
        grey = 0.9 + grain
    return _opaque(grey, 1.0)


def _window(rng: Rng, texture: Array, middle: float, style: _Style) -> None:
    half = style.width / 4
    left, right, top, bottom = middle - half, middle + half, style.top, style.bottom
    _paint(texture, (left - 0.03, right + 0.03), (top - 0.05, bottom + 0.04), [style.surround] * 3, 0.5)
    if style.shutter:
        for x in ((left - half * 0.9 - 0.01, left - 0.01), (right + 0.01, right + half * 0.9 + 0.01)):
            _paint(texture, x, (top, bottom), style.shutter)
            rows = slice(round(top * SIDE), round(bottom * SIDE), 3)
            texture[rows, round(x[0] * SIDE) : round(x[1] * SIDE), :3] *= 0.8
    _paint(texture, (left, right), (top, bottom), style.frame)
    panes = np.linspace(left, right, style.panes + 1)
    cross = rng.uniform(0.25, 0.6)
    for x0, x1 in itertools.pairwise(panes.tolist()):
        for y0, y1 in ((top, top + cross * (bottom - top)), (top + cross * (bottom - top), bottom)):
            _pane(rng, texture, (x0 + 0.012, x1 - 0.012), (y0 + 0.02, y1 - 0.02))
    _paint(texture, (left, right), (top, top + 0.02), (0.12, 0.12, 0.13))  # shade of the lintel
    _paint(texture, (left - 0.035, right + 0.035), (bottom + 0.01, bottom + 0.04), (0.8, 0.79, 0.76))


def _pane(rng: Rng, texture: Array, x: tuple[float, float], y: tuple[float, float]) -> None:
    """Glass that shows sky, a curtain or nothing."""
    x0, x1, y0, y1 = (round(share * SIDE) for share in (*x, *y))
    if x1 <= x0 or y1 <= y0:
        return
    dark, light = rng.uniform(0.1, 0.25), rng.uniform(0.3, 0.55)
    shade = np.linspace(light, dark, y1 - y0, dtype=np.float32)[:, None, None]
    texture[y0:y1, x0:x1, :3] = shade * np.array([0.93, 1.0, 1.06], np.float32)
    texture[y0:y1, x0:x1, 3] = 0
    if rng.random() < 0.35:
        hung = y0 + round(rng.uniform(0.2, 1.0) * (y1 - y0))
        texture[y0:hung, x0:x1, :3] = rng.uniform(0.5, 0.85) * np.array([1.0, 0.98, 0.92], np.float32)


def _door(rng: Rng, texture: Array, middle: float) -> None:
    color = rng.uniform(0.15, 0.55) + rng.uniform(-0.1, 0.15, 3)
    _paint(texture, (middle - 0.12, middle + 0.12), (0.12, 0.97), (0.82, 0.8, 0.76))
    _paint(texture, (middle - 0.095, middle + 0.095), (0.16, 0.97), color)
    for y in ((0.42, 0.64), (0.7, 0.9)):
        for x in ((middle - 0.075, middle - 0.01), (middle + 0.01, middle + 0.075)):
            _paint(texture, x, y, 0.8 * color)
    _pane(rng, texture, (middle - 0.085, middle + 0.085), (0.19, 0.36))


def _shop(rng: Rng, texture: Array) -> None:
    """A window front under a board with letters."""
    board = rng.uniform(0.15, 0.8) + rng.uniform(-0.15, 0.2, 3)
    ink = rng.uniform(0.7, 1.0, 3) if board.mean() < 0.5 else rng.uniform(0.05, 0.3, 3)
    _paint(texture, (0.04, 0.96), (0.06, 0.24), board)
    for x in np.arange(0.12, 0.8, 0.055):
        if rng.random() < 0.8:
            _paint(texture, (x, x + 0.035), (0.1 + rng.uniform(0, 0.03), 0.2), ink)
    _paint(texture, (0.06, 0.94), (0.27, 0.94), 0.5 * board)
    for x in ((0.08, 0.38), (0.4, 0.66), (0.72, 0.92)):
        _pane(rng, texture, x, (0.3, 0.82 if x[0] < 0.7 else 0.97))
        for _ in range(4):
            left, high = rng.uniform(x[0], x[1] - 0.05), rng.uniform(0.5, 0.76)
            _paint(texture, (left, left + 0.04), (high, 0.8), rng.uniform(0.2, 0.9, 3))
