"""Places that photographs are taken at: a plane to stand on, something behind it, and the sky.

World: x and y on the ground, z up; who looks stands at x > 0, what is behind lies at x < 0. Colours here are linear
but where they are drawn. Letter: R rays.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.records import TensorRecord
from rendra_lab.synthesis.surface_pictures import GAMMA

EDITION = 2  # of the places

_TILE, _TILES = 256, 8  # cells along a side of a tile of noise, and how many there are
_FINE_UNTIL = 8.0  # away: from there on less than half of the grain is seen
_RNG = np.random.Generator
_Color = npt.NDArray[np.float64]
_Pair = tuple[float, float]


@dataclass(frozen=True)
class Surface:
    """What a plane looks like.

    Attributes:
        colors: (2, 3) sRGB, mixed by coarse noise.
        contrast: of that noise; 0 is the mean of both colours.
        period: length after which coarse noise repeats itself, along and across.
        grain: relative strength of fine noise.
        grain_period: length after which that repeats itself.
        boards: length and width of planks, bricks or tiles; inf has no joints along that axis.
        joint: how much darker the joints between them are.
    """

    colors: _Color
    contrast: float = 1.0
    period: _Pair = (2.0, 2.0)
    grain: float = 0.1
    grain_period: _Pair = (0.5, 0.5)
    boards: _Pair = (np.inf, np.inf)
    joint: float = 0.0


@dataclass(frozen=True)
class Backdrop:
    """A place.

    Attributes:
        ground: to stand on.
        wall: behind it: boards, a hedge, hills.
        distance: of the wall from the world's middle.
        height: of the wall above the ground.
        ragged: how much that varies, and the length of that.
        turn: of the wall about up, radians.
        grain_turn: of the ground's noise.
        seamless: from 0 to 1, the wall is lit as the ground is: a sheet of paper.
        sky: (2, 3) sRGB at the horizon and above.
        clouds: how white the sky is in places.
        haze: of things as far away as this a third of the colour is left.
        tiles: two tiles of noise.
        shift: (4,) of the noise, in tiles.
    """

    ground: Surface
    wall: Surface
    distance: float
    height: float
    ragged: _Pair
    turn: float
    grain_turn: float
    seamless: float
    sky: _Color
    clouds: float
    haze: float
    tiles: tuple[int, int]
    shift: _Color


@dataclass(frozen=True)
class Sights(TensorRecord):
    """What rays meet first."""

    albedo: Float[Tensor, "R 3"]
    normal: Float[Tensor, "R 3"]  # of length 1; of a sheet of paper up, wherever it is
    glow: Float[Tensor, "R 3"]  # of the sky and the haze: added to what is lit
    place: Float[Tensor, "R 3"]  # in the world
    on_ground: Bool[Tensor, " R"]


def draw_backdrop(rng: _RNG) -> Backdrop:
    """One of many places: meadows, fields, yards, studios, painted cloth."""
    kinds: tuple[Callable[[_RNG], Backdrop], ...] = (_meadow, _field, _yard, _studio, _cloth)
    return kinds[int(rng.choice(len(kinds), p=(0.36, 0.16, 0.24, 0.14, 0.1)))](rng)


def sights(backdrop: Backdrop, eye: Float[Tensor, " 3"], rays: Float[Tensor, "R 3"], floor: float) -> Sights:
    """What rays of any length meet.

    Args:
        backdrop: the place.
        eye: before the wall and above the ground.
        rays: from there on.
        floor: z of the ground.
    """
    normal, along = _wall_axes(backdrop)
    to_ground = _distance((floor - eye[2]).expand(len(rays)), rays[:, 2])
    to_wall = _distance((-backdrop.distance - normal @ eye).expand(len(rays)), rays @ normal)
    at_wall = eye + to_wall.clamp_max(1e4)[:, None] * rays
    u, height = at_wall @ along, at_wall[:, 2] - floor
    on_wall = (to_wall < to_ground) & (height < _top(backdrop, u))
    on_ground = to_ground < to_wall  # a plain beyond the wall would stand above it: there the sky begins
    far = torch.where(on_wall, to_wall, to_ground).clamp_max(1e4)
    place = eye + far[:, None] * rays
    albedo = torch.zeros_like(rays)
    on_plane = place[:, :2] @ _turn(backdrop.grain_turn)
    for number, (surface, where, flat) in enumerate(
        ((backdrop.wall, on_wall, torch.stack([u, height], 1)), (backdrop.ground, on_ground, on_plane))
    ):
        rows = where.nonzero()[:, 0]
        fading = 1 / (1 + (far[rows] / _FINE_UNTIL).square())
        albedo[rows] = _albedo(surface, flat.index_select(0, rows), fading, backdrop, number)
    left = torch.exp(-(far - eye.norm()).clamp_min(0) / backdrop.haze)[:, None]
    left = torch.where((on_wall | on_ground)[:, None], left, 0.0)
    facing = F.normalize(torch.lerp(normal, normal.new_tensor([0.0, 0.0, 1.0]), backdrop.seamless), dim=0)
    up = torch.tensor([0.0, 0.0, 1.0])
    return Sights(
        albedo=albedo * left,
        normal=torch.where(on_wall[:, None], facing, up),
        glow=_sky(backdrop, rays) * (1 - left),
        place=place,
        on_ground=on_ground,
    )


def _distance(by: Tensor, a_unit: Tensor) -> Tensor:
    """How often a ray goes on until it has come so far (R,); inf where it never will."""
    often = by / torch.where(a_unit.abs() < 1e-9, 1e-9, a_unit)
    return torch.where(often > 0, often, torch.inf)


def _wall_axes(backdrop: Backdrop) -> tuple[Tensor, Tensor]:
    """Towards who looks, and along the wall."""
    axes = F.pad(_turn(backdrop.turn), (0, 1))
    return axes[0], axes[1]


def _turn(radians: float) -> Tensor:
    """Rows: x and y turned about z."""
    cos, sin = float(np.cos(radians)), float(np.sin(radians))
    return torch.tensor([[cos, sin], [-sin, cos]])


def _top(backdrop: Backdrop, u: Tensor) -> Tensor:
    strength, period = backdrop.ragged
    if not strength:
        return torch.full_like(u, backdrop.height)
    places = torch.stack([u / period + float(backdrop.shift[0]), torch.full_like(u, 0.5)], 1)
    return backdrop.height + strength * _noise(places, backdrop.tiles[0])


def _albedo(surface: Surface, places: Tensor, fading: Tensor, backdrop: Backdrop, which: int) -> Tensor:
    """Colours (R, 3) at places (R, 2) of a plane, whose grain is fading (R,) with distance."""
    shift = torch.from_numpy(backdrop.shift).float()
    coarse = _noise(places / torch.tensor(surface.period) + shift[:2], backdrop.tiles[which])
    fine = _noise(places / torch.tensor(surface.grain_period) + shift[2:], backdrop.tiles[1 - which])
    first, second = linear(surface.colors)
    mixed = torch.lerp(first, second, (0.5 + 0.4 * surface.contrast * coarse).clamp(0, 1)[:, None])
    shade = (1 + surface.grain * fading * fine).clamp(0.2, 1.8)
    return (mixed * (shade * _joints(surface, places))[:, None]).clamp(0, 0.95)


def _joints(surface: Surface, places: Tensor) -> Tensor:
    """How bright boards (R,) are: each a little otherwise, and dark at their edges."""
    if not surface.joint:
        return places.new_ones(len(places))
    shade = places.new_ones(len(places))
    for axis in (0, 1):
        width = surface.boards[axis]
        if np.isfinite(width):
            across = places[:, axis] / width
            edge = (across - across.floor() - 0.5).abs()
            own = ((across.floor() * 12.9898).sin() * 43758.5453).frac().abs()
            shade = shade * (1 - surface.joint * ((edge - 0.4) / 0.08).clamp(0, 1)) * (0.9 + 0.2 * own)
    return shade


def _sky(backdrop: Backdrop, rays: Tensor) -> Tensor:
    """Its light (R, 3)."""
    way = F.normalize(rays, dim=1)
    low, high = linear(backdrop.sky)
    color = torch.lerp(low, high, (way[:, 2] / 0.2).clamp(0, 1)[:, None])
    if not backdrop.clouds:
        return color
    places = way[:, 1:] * torch.tensor([1.2, 3.0]) + torch.from_numpy(backdrop.shift[:2]).float()
    white = (backdrop.clouds * _noise(places, backdrop.tiles[0])).clamp(0, 1)
    return torch.lerp(color, torch.full((3,), 0.95), white[:, None])


def linear(colors: _Color) -> Tensor:
    """Linear colours of sRGB."""
    return torch.from_numpy(np.asarray(colors, np.float32) ** np.float32(GAMMA))


def _noise(places: Tensor, tile: int) -> Tensor:
    """Noise (R,) of standard deviation 1 at places (R, 2), which repeats itself after 1."""
    grid = (2 * (places - places.floor()) - 1)[None, None]
    return F.grid_sample(_tiles()[None, tile : tile + 1], grid, align_corners=True, padding_mode="border")[0, 0, 0]


@lru_cache(maxsize=1)
def _tiles() -> Tensor:
    """Noise that halves in strength as its length halves, and fits on to itself: (_TILES, _TILE + 1, _TILE + 1)."""
    rng = np.random.default_rng(41)
    way = np.fft.fftfreq(_TILE) * _TILE
    wave = np.hypot(way[:, None], way[None])
    strength = np.where((wave > 0) & (wave < _TILE / 4), np.maximum(wave, 2.0) ** -1.6, 0.0)
    spectrum = np.fft.fft2(rng.normal(size=(_TILES, _TILE, _TILE))) * strength
    noise = np.fft.ifft2(spectrum).real
    noise /= noise.std((1, 2), keepdims=True)
    return torch.from_numpy(np.pad(noise, ((0, 0), (0, 1), (0, 1)), mode="wrap")).float()


def _hsv(rng: _RNG, hue: _Pair, saturation: _Pair, value: _Pair) -> _Color:
    h, s, v = (float(rng.uniform(*span)) for span in (hue, saturation, value))
    return np.array(colorsys.hsv_to_rgb(h % 1, s, v))


def _two(color: _Color, rng: _RNG, apart: float = 0.18) -> _Color:
    """A colour and one that is a little darker or brighter: (2, 3)."""
    other = color * float(rng.uniform(1 - apart, 1 + apart)) + rng.uniform(-0.03, 0.03, 3)
    return np.clip(np.stack([color, other]), 0.02, 0.98)


def _place(ground: Surface, wall: Surface, distance: float, height: float, rng: _RNG) -> Backdrop:
    """In clear air and fine weather, with a straight wall."""
    blue = _hsv(rng, (0.54, 0.62), (0.15, 0.5), (0.75, 0.97))
    pale = np.clip(blue + (1 - blue) * rng.uniform(0.4, 0.9), 0, 0.97)
    one, other = (int(number) for number in rng.choice(_TILES, 2, replace=False))
    return Backdrop(
        ground=ground,
        wall=wall,
        distance=distance,
        height=height,
        ragged=(0.0, 1.0),
        turn=float(rng.uniform(-0.12, 0.12)),
        grain_turn=float(rng.uniform(0.3, 1.27)),  # never along the view: repetition would show
        seamless=0.0,
        sky=np.stack([pale, blue]),
        clouds=float(rng.choice([0.0, 0.5, 0.9])),
        haze=30.0,
        tiles=(one, other),
        shift=rng.uniform(0, 1, 4),
    )


def _grass(rng: _RNG) -> Surface:
    color = _hsv(rng, (0.19, 0.33), (0.3, 0.62), (0.3, 0.66))
    length = float(rng.uniform(1.2, 3.5))
    grain = float(rng.uniform(0.08, 0.25))
    return Surface(_two(color, rng, 0.3), 1.2, (length, length), grain, (0.6, 0.6))


def _behind(place: Backdrop, rng: _RNG) -> Backdrop:
    """A place outdoors before hills or before a hedge."""
    if rng.random() < 0.5:
        hill = _hsv(rng, (0.22, 0.5), (0.15, 0.5), (0.35, 0.7))
        wall = Surface(_two(hill, rng), 1.0, (6.0, 3.0), 0.1, (2.0, 1.0))
        ragged = (float(rng.uniform(0.1, 0.4)), float(rng.uniform(10, 20)))
        return replace(
            place,
            wall=wall,
            distance=float(rng.uniform(4, 9)),
            height=float(rng.uniform(0.1, 0.9)),
            ragged=ragged,
            haze=float(rng.uniform(12, 40)),
        )
    leaves = _hsv(rng, (0.24, 0.38), (0.3, 0.6), (0.16, 0.42))
    wall = Surface(_two(leaves, rng, 0.4), 1.5, (1.5, 1.5), 0.35, (0.5, 0.5))
    ragged = (float(rng.uniform(0.03, 0.1)), float(rng.uniform(1.5, 4)))
    distance, height = float(rng.uniform(1.0, 3.0)), float(rng.uniform(0.35, 1.2))
    return replace(place, wall=wall, distance=distance, height=height, ragged=ragged)


def _meadow(rng: _RNG) -> Backdrop:
    ground = _grass(rng)
    return _behind(_place(ground, ground, 1.0, 1.0, rng), rng)


def _field(rng: _RNG) -> Backdrop:
    spans: tuple[tuple[_Pair, _Pair, _Pair], ...] = (
        ((0.09, 0.14), (0.3, 0.6), (0.6, 0.9)),  # straw and sand
        ((0.04, 0.09), (0.3, 0.55), (0.28, 0.5)),  # earth
        ((0.5, 0.65), (0.0, 0.08), (0.8, 0.95)),  # snow
    )
    color = _hsv(rng, *spans[int(rng.choice(len(spans), p=(0.5, 0.3, 0.2)))])
    length = float(rng.uniform(1.0, 3.0))
    ground = Surface(_two(color, rng), 1.0, (length, length), float(rng.uniform(0.05, 0.2)), (0.5, 0.5))
    return _behind(_place(ground, ground, 1.0, 1.0, rng), rng)


def _yard(rng: _RNG) -> Backdrop:
    """Before a barn."""
    grounds: tuple[tuple[_Pair, _Pair, _Pair], ...] = (
        ((0.09, 0.14), (0.3, 0.5), (0.55, 0.85)),
        ((0.05, 0.1), (0.25, 0.45), (0.3, 0.55)),
        ((0.0, 1.0), (0.0, 0.08), (0.45, 0.75)),
        ((0.2, 0.32), (0.3, 0.6), (0.3, 0.6)),
    )
    ground = Surface(_two(_hsv(rng, *grounds[int(rng.integers(len(grounds)))]), rng), grain=0.15)
    distance = float(rng.uniform(0.75, 1.9))
    return _place(ground, _barn(rng), distance, 4.0, rng)


def _barn(rng: _RNG) -> Surface:
    """Its wall: upright or lying planks, bricks, or plaster."""
    paints: tuple[tuple[_Pair, _Pair, _Pair], ...] = (
        ((0.05, 0.1), (0.3, 0.6), (0.25, 0.6)),  # wood
        ((-0.02, 0.02), (0.5, 0.75), (0.35, 0.6)),  # red paint
        ((0.5, 0.65), (0.15, 0.45), (0.3, 0.75)),  # blue paint
        ((0.0, 1.0), (0.0, 0.08), (0.45, 0.95)),  # whitewash, stone
        ((0.1, 0.16), (0.2, 0.5), (0.7, 0.92)),  # ochre
    )
    colors = _two(_hsv(rng, *paints[int(rng.integers(len(paints)))]), rng)
    wide = float(rng.uniform(0.09, 0.2))
    joint = float(rng.uniform(0.25, 0.6))
    kinds = (
        Surface(colors, 0.7, (0.8, 4.0), 0.12, (0.15, 1.5), (wide, np.inf), joint),
        Surface(colors, 0.7, (4.0, 0.8), 0.12, (1.5, 0.15), (np.inf, wide), joint),
        Surface(colors, 1.0, (2.0, 2.0), 0.12, (0.6, 0.6), (2 * wide, wide), 0.6 * joint),
        Surface(colors, 1.0, (3.0, 3.0), 0.06, (0.8, 0.8)),
    )
    return kinds[int(rng.integers(len(kinds)))]


def _studio(rng: _RNG) -> Backdrop:
    """Before a sheet of paper that bends from the floor to the wall."""
    color = _hsv(rng, (0.0, 1.0), (0.0, 0.4), (0.3, 0.95))
    sheet = Surface(_two(color, rng, 0.08), 0.8, (6.0, 6.0), 0.0)
    place = _place(sheet, sheet, float(rng.uniform(0.7, 1.5)), 9.0, rng)
    return replace(place, turn=0.0, seamless=float(rng.uniform(0.75, 0.95)))


def _cloth(rng: _RNG) -> Backdrop:
    """Before something painted in two colours and out of focus."""
    one = _hsv(rng, (0.0, 1.0), (0.05, 0.45), (0.25, 0.9))
    other = _hsv(rng, (0.0, 1.0), (0.05, 0.45), (0.25, 0.9))
    length = float(rng.uniform(2.0, 4.0))
    cloth = Surface(np.stack([one, (one + other) / 2]), 1.0, (length, length), 0.04, (1.0, 1.0))
    wall = replace(cloth, colors=np.stack([one, other]))
    return replace(_place(cloth, wall, float(rng.uniform(0.7, 1.5)), 9.0, rng), seamless=float(rng.uniform(0.3, 0.9)))
