"""Cubes, balls and cylinders on a plane, traced ray by ray: shapes without facets, soft shadows, metal that mirrors.

The plane is z = 0, z is up; a camera looks along its own -z. Colours are linear. What is far on the plane fades into
a backdrop. Lamps are squares, white, and weaken with the square of the distance.
Letters: M solids, S x S pixels; K samples along each side of a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

CUBE, BALL, CYLINDER = 0, 1, 2
LAMPS = 3

# columns of solids, and rows of a stage
_SHAPE, _PLACE, _COS, _SIN, _HALF, _REACH, _COLOR, _METAL, _COLUMNS = 0, 1, 4, 5, 6, 7, 8, 11, 12
_AXES, _EYE, _FLOOR, _BACKDROP, _LAMP, _POWERS, _LENS, _ROWS = 0, 3, 4, 5, 6, 9, 10, 11

_ZERO, _HALF_ONE, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_FAR = np.float32(1e9)
_LIFT = np.float32(2e-4)  # of rays off the surface that they leave
_FLAT = np.float32(1e-12)  # directions as near to a plane's as that never meet it
_AMBIENT = np.float32(0.18)  # light from all sides, from above
_BOUNCED = np.float32(0.55)  # share of it that comes from below
_NEAR_FADE, _FAR_FADE = np.float32(1.0), np.float32(4.0)  # from the middle, where the plane fades
_SHEEN, _GLOSS = np.float32(0.10), np.float32(0.9)  # of lamps on rubber, and on metal
_MATTE = np.float32(0.22)  # share of a metal's look that is its plain colour
_GOLDEN, _PLASTIC = np.float32(0.6180339887), np.float32(0.7548776662)  # steps that fill the unit interval evenly

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Stage:
    """All of a scene but its solids.

    Attributes:
        camera_to_world: (4, 4) columns.
        fov_deg: field of view across the picture.
        floor: linear colour of the plane.
        backdrop: linear colour of what is behind all.
        lamps: (3, 3) where they stand.
        powers: of the lamps, light at a distance of 1.
        lamp_side: half of a lamp's side.
    """

    camera_to_world: npt.NDArray[np.float64]
    fov_deg: float
    floor: tuple[float, float, float]
    backdrop: tuple[float, float, float]
    lamps: npt.NDArray[np.float64]
    powers: tuple[float, float, float]
    lamp_side: float

    def packed(self) -> Floats:
        """Rows of three, as the tracer reads them."""
        rows = np.zeros((_ROWS, 3), np.float32)
        rows[_AXES:_FLOOR] = self.camera_to_world[:3].T  # axes x, y, z, and the eye
        rows[_FLOOR], rows[_BACKDROP] = self.floor, self.backdrop
        rows[_LAMP:_POWERS] = self.lamps
        rows[_POWERS] = self.powers
        rows[_LENS, :2] = math.tan(math.radians(self.fov_deg) / 2), self.lamp_side
        return rows


def solid(
    shape: int, place: tuple[float, float], half: float, turn: float, color: tuple[float, float, float], metal: bool
) -> Floats:
    """One solid that stands on the plane: a row of what `trace` draws.

    Args:
        shape: CUBE, BALL or CYLINDER.
        place: x and y of its middle.
        half: of a cube's side, of a cylinder's height and width, of a ball's width.
        turn: radians about z.
        color: linear.
        metal: mirrors; else it is rubber.
    """
    reach = half * (math.sqrt(3), 1.0, math.sqrt(2))[shape]  # from its middle to its farthest point
    columns = (shape, *place, half, math.cos(turn), math.sin(turn), half, reach**2, *color, metal)
    return np.array(columns, np.float32)


def trace(
    solids: Floats, stage: Stage, side: int, samples: int
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """A picture (3, S, S), sRGB, and the solid that each of its pixels shows (S, S), from 1; 0: none.

    A pixel shows the solid, or none, that most of its samples meet.

    Args:
        solids: (M, 12) rows of `solid`; up to 254.
        stage: the rest.
        side: S.
        samples: K.

    Raises:
        ValueError: other solids, or less than one pixel or sample.
    """
    _demand(solids, side, samples)
    colors, owners = np.empty((3, side, side), np.float32), np.empty((side, side), np.uint8)
    _trace(solids, stage.packed(), samples, colors, owners)
    return to_srgb(colors), owners


def shown_shares(solids: Floats, stage: Stage, side: int) -> npt.NDArray[np.float64]:
    """The share (M,) of a picture that each solid takes, by its S x S pixels' middles.

    Raises:
        ValueError: other solids, or less than one pixel.
    """
    _demand(solids, side, 1)
    counts = np.zeros(len(solids), np.int64)
    _count(solids, stage.packed(), side, counts)
    return counts / side**2


def to_linear(srgb: npt.ArrayLike) -> Floats:
    """Linear colours of sRGB, both in [0, 1] (IEC 61966-2-1)."""
    values = np.asarray(srgb, np.float64)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(np.float32)


def to_srgb(linear: Floats) -> npt.NDArray[np.uint8]:
    """sRGB, 0 to 255, of linear colours; what is brighter than 1 is white."""
    values = linear.clip(0, 1)
    curved = np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055)
    return (curved * 255).round().astype(np.uint8)


def _demand(solids: Floats, side: int, samples: int) -> None:
    if solids.ndim != 2 or solids.shape[1] != _COLUMNS or solids.dtype != np.float32 or len(solids) > 254:
        raise ValueError(f"solids are up to 254 rows of `solid`, got {solids.dtype} of shape {solids.shape}")
    if side < 1 or samples < 1:
        raise ValueError(f"a picture has at least one pixel and one sample a side, got {side} and {samples}")


@_compiled
def _trace(solids, stage, samples, colors, owners):  # type: ignore[no-untyped-def]
    side = owners.shape[0]
    eye = _row(stage, _EYE)
    share = _ONE / np.float32(samples * samples)
    votes = np.zeros(len(solids) + 1, np.int64)
    for row in range(side):
        for column in range(side):
            votes[:] = 0
            red = green = blue = _ZERO
            dither = _scrambled(row, column)
            for number in range(samples * samples):
                down, right = number // samples, number % samples
                ray = _ray(stage, row * samples + down, column * samples + right, side * samples)
                which, distance = _nearest(solids, eye, ray)
                votes[which + 1] += 1
                u = _fraction(dither + np.float32(number) * _GOLDEN)
                v = _fraction(_TWO * dither + np.float32(number) * _PLASTIC)
                color = _seen(solids, stage, eye, ray, which, distance, u, v)
                red, green, blue = red + color[0], green + color[1], blue + color[2]
            colors[0, row, column] = red * share
            colors[1, row, column] = green * share
            colors[2, row, column] = blue * share
            owners[row, column] = np.argmax(votes)


@_compiled
def _count(solids, stage, side, counts):  # type: ignore[no-untyped-def]
    eye = _row(stage, _EYE)
    for row in range(side):
        for column in range(side):
            which, _ = _nearest(solids, eye, _ray(stage, row, column, side))
            if which >= 0:
                counts[which] += 1


@_compiled
def _seen(solids, stage, eye, ray, which, distance, u, v):  # type: ignore[no-untyped-def]
    """Linear colour along a ray whose nearest solid is known; lamps are sampled at u, v."""
    if which < 0:
        return _ground(solids, stage, eye, ray, u, v, True)
    place = _along(eye, ray, distance)
    normal = _normal(solids, which, place)
    color = (solids[which, _COLOR], solids[which, _COLOR + 1], solids[which, _COLOR + 2])
    matte, shine = _light(solids, stage, place, normal, ray, which, u, v, True)
    if solids[which, _METAL] == _ZERO:
        return _mixed(color, matte, _SHEEN * shine)
    start = _along(place, normal, _LIFT)
    mirror = _mirrored(ray, normal)
    other, far = _nearest(solids, start, mirror)
    if other < 0:
        image = _ground(solids, stage, start, mirror, u, v, False)
    else:
        there = _along(start, mirror, far)
        lit, _ = _light(solids, stage, there, _normal(solids, other, there), mirror, other, u, v, False)
        image = _mixed((solids[other, _COLOR], solids[other, _COLOR + 1], solids[other, _COLOR + 2]), lit, _ZERO)
    facing = _ONE + _dot(ray, normal)  # 0 seen from straight above, 1 at the rim, which mirrors without colour
    rim = facing * facing * facing * facing * facing
    metal = (
        color[0] + (_ONE - color[0]) * rim,
        color[1] + (_ONE - color[1]) * rim,
        color[2] + (_ONE - color[2]) * rim,
    )
    plain = _mixed(color, _MATTE * matte, _ZERO)
    bright = _TWO * (_ONE - _MATTE)
    return (
        plain[0] + metal[0] * (bright * image[0] + _GLOSS * shine),
        plain[1] + metal[1] * (bright * image[1] + _GLOSS * shine),
        plain[2] + metal[2] * (bright * image[2] + _GLOSS * shine),
    )


@_compiled
def _ground(solids, stage, start, ray, u, v, shadows):  # type: ignore[no-untyped-def]
    """The plane, and the backdrop into which it fades."""
    backdrop = _row(stage, _BACKDROP)
    if ray[2] > -_FLAT:
        glow = _ONE + max(ray[2], _ZERO)  # what metal mirrors of the room above
        return (backdrop[0] * glow, backdrop[1] * glow, backdrop[2] * glow)
    place = _along(start, ray, -start[2] / ray[2])
    away = math.sqrt(place[0] * place[0] + place[1] * place[1])
    fade = min(max((away - _NEAR_FADE) / (_FAR_FADE - _NEAR_FADE), _ZERO), _ONE)
    fade = fade * fade * (np.float32(3) - _TWO * fade)
    if fade >= _ONE:
        return backdrop
    light, _ = _light(solids, stage, place, (_ZERO, _ZERO, _ONE), ray, -1, u, v, shadows)
    floor = _row(stage, _FLOOR)
    light = light * (_ONE - fade)
    return (
        floor[0] * light + backdrop[0] * fade,
        floor[1] * light + backdrop[1] * fade,
        floor[2] * light + backdrop[2] * fade,
    )


@_compiled
def _light(solids, stage, place, normal, ray, mine, u, v, shadows):  # type: ignore[no-untyped-def]
    """Light that a surface gets, and how much of the lamps it shows.

    A lamp's light comes from its middle, which leaves no grain where nothing is in the way; its shadow from u, v.
    """
    start = _along(place, normal, _LIFT)
    lamp_side = stage[_LENS, 1]
    mirror = _mirrored(ray, normal)
    matte = _all_around(solids, place, normal, mine)
    shine = _ZERO
    for lamp in range(LAMPS):
        lamp_middle = _row(stage, _LAMP + lamp)
        towards, length = _direction(place, lamp_middle)
        slant = _dot(towards, normal)
        if slant <= _ZERO:
            continue
        if shadows:
            across = math.sqrt(lamp_middle[0] * lamp_middle[0] + lamp_middle[1] * lamp_middle[1])
            sideways = (_fraction(u + _GOLDEN * np.float32(lamp)) - _HALF_ONE) * _TWO * lamp_side / across
            up = (_fraction(v + _PLASTIC * np.float32(lamp)) - _HALF_ONE) * _TWO * lamp_side
            spot = _along(lamp_middle, (-lamp_middle[1], lamp_middle[0], _ZERO), sideways)
            way, far = _direction(start, (spot[0], spot[1], spot[2] + up))
            if _blocked(solids, start, way, far):
                continue
        power = stage[_POWERS, lamp] / (length * length)
        matte += power * slant
        gloss = max(_dot(mirror, towards), _ZERO)
        gloss = gloss * gloss * gloss * gloss
        gloss = gloss * gloss * gloss * gloss  # to the 16th
        shine += power * gloss
    return matte, shine


@_compiled
def _all_around(solids, place, normal, mine):  # type: ignore[no-untyped-def]
    """Light from all sides, less what other solids keep away, which are taken for balls (cosine law, exact)."""
    light = _AMBIENT * (_BOUNCED + (_ONE - _BOUNCED) * (normal[2] + _ONE) * _HALF_ONE)
    for i in range(len(solids)):
        if i != mine:
            x = solids[i, _PLACE] - place[0]
            y = solids[i, _PLACE + 1] - place[1]
            z = solids[i, _PLACE + 2] - place[2]
            squared = x * x + y * y + z * z
            slant = (x * normal[0] + y * normal[1] + z * normal[2]) / math.sqrt(squared)
            width = solids[i, _HALF] * solids[i, _HALF] / squared
            light *= _ONE - min(max(slant * width, _ZERO), np.float32(0.95))
    return light


@_compiled
def _nearest(solids, start, ray):  # type: ignore[no-untyped-def]
    """The solid that a ray meets first, and how far away; -1: none."""
    which, nearest = -1, _FAR
    for i in range(len(solids)):
        distance = _distance(solids, i, start, ray)
        if distance < nearest:
            which, nearest = i, distance
    return which, nearest


@_compiled
def _blocked(solids, start, ray, far):  # type: ignore[no-untyped-def]
    blocked = False
    for i in range(len(solids)):
        blocked = blocked or _distance(solids, i, start, ray) < far
    return blocked


@_compiled
def _distance(solids, i, start, ray):  # type: ignore[no-untyped-def]
    """Along a ray of length 1 from outside of a solid to it; _FAR where it misses."""
    x, y, z = start[0] - solids[i, _PLACE], start[1] - solids[i, _PLACE + 1], start[2] - solids[i, _PLACE + 2]
    ahead = -(x * ray[0] + y * ray[1] + z * ray[2])
    beyond = x * x + y * y + z * z - solids[i, _REACH]
    within = ahead * ahead - beyond
    if within < _ZERO or (beyond > _ZERO and ahead < _ZERO):
        return _FAR
    if solids[i, _SHAPE] == BALL:
        return ahead - math.sqrt(within) if beyond > _ZERO else _FAR
    cos, sin, half = solids[i, _COS], solids[i, _SIN], solids[i, _HALF]
    own = (cos * x + sin * y, cos * y - sin * x, z)
    way = (cos * ray[0] + sin * ray[1], cos * ray[1] - sin * ray[0], ray[2])
    enters, leaves = _slab(own[2], way[2], half, -_FAR, _FAR)
    if solids[i, _SHAPE] == CUBE:
        enters, leaves = _slab(own[0], way[0], half, enters, leaves)
        enters, leaves = _slab(own[1], way[1], half, enters, leaves)
    else:
        enters, leaves = _tube(own, way, half, enters, leaves)
    return enters if leaves > enters and enters > _ZERO else _FAR


@_compiled
def _slab(start, way, half, enters, leaves):  # type: ignore[no-untyped-def]
    """What is left of a stretch of a ray between two planes."""
    if abs(way) < _FLAT:
        return (enters, leaves) if abs(start) < half else (_FAR, -_FAR)
    one, other = (-half - start) / way, (half - start) / way
    return max(enters, min(one, other)), min(leaves, max(one, other))


@_compiled
def _tube(start, way, half, enters, leaves):  # type: ignore[no-untyped-def]
    """What is left of a stretch of a ray within an endless tube about z."""
    a = way[0] * way[0] + way[1] * way[1]
    c = start[0] * start[0] + start[1] * start[1] - half * half
    if a < _FLAT:
        return (enters, leaves) if c < _ZERO else (_FAR, -_FAR)
    b = start[0] * way[0] + start[1] * way[1]
    root = b * b - a * c
    if root < _ZERO:
        return _FAR, -_FAR
    root = math.sqrt(root)
    return max(enters, (-b - root) / a), min(leaves, (-b + root) / a)


@_compiled
def _normal(solids, i, place):  # type: ignore[no-untyped-def]
    """Outwards, of length 1, at a place on a solid's surface."""
    half = solids[i, _HALF]
    x, y = place[0] - solids[i, _PLACE], place[1] - solids[i, _PLACE + 1]
    z = (place[2] - solids[i, _PLACE + 2]) / half
    if solids[i, _SHAPE] == BALL:
        return (x / half, y / half, z)
    if solids[i, _SHAPE] == CYLINDER:
        around = math.sqrt(x * x + y * y)
        if abs(z) * half > around:
            return (_ZERO, _ZERO, math.copysign(_ONE, z))
        return (x / around, y / around, _ZERO)
    cos, sin = solids[i, _COS], solids[i, _SIN]
    p, q = (cos * x + sin * y) / half, (cos * y - sin * x) / half
    if abs(z) >= abs(p) and abs(z) >= abs(q):
        return (_ZERO, _ZERO, math.copysign(_ONE, z))
    if abs(p) >= abs(q):
        sign = math.copysign(_ONE, p)
        return (cos * sign, sin * sign, _ZERO)
    sign = math.copysign(_ONE, q)
    return (-sin * sign, cos * sign, _ZERO)


@_compiled
def _ray(stage, row, column, side):  # type: ignore[no-untyped-def]
    """Direction, of length 1, through the middle of a pixel."""
    pixel = _TWO / np.float32(side)
    x = ((np.float32(column) + _HALF_ONE) * pixel - _ONE) * stage[_LENS, 0]
    y = (_ONE - (np.float32(row) + _HALF_ONE) * pixel) * stage[_LENS, 0]
    length = math.sqrt(x * x + y * y + _ONE)
    return (
        (x * stage[0, 0] + y * stage[1, 0] - stage[2, 0]) / length,
        (x * stage[0, 1] + y * stage[1, 1] - stage[2, 1]) / length,
        (x * stage[0, 2] + y * stage[1, 2] - stage[2, 2]) / length,
    )


@_compiled
def _row(table, i):  # type: ignore[no-untyped-def]
    return (table[i, 0], table[i, 1], table[i, 2])


@_compiled
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_compiled
def _along(start, way, length):  # type: ignore[no-untyped-def]
    return (start[0] + way[0] * length, start[1] + way[1] * length, start[2] + way[2] * length)


@_compiled
def _direction(start, end):  # type: ignore[no-untyped-def]
    """The way from a place to another, of length 1, and how long it is."""
    x, y, z = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    length = math.sqrt(x * x + y * y + z * z)
    return (x / length, y / length, z / length), length


@_compiled
def _mirrored(ray, normal):  # type: ignore[no-untyped-def]
    return _along(ray, normal, -_TWO * _dot(ray, normal))


@_compiled
def _mixed(color, light, white):  # type: ignore[no-untyped-def]
    return (color[0] * light + white, color[1] * light + white, color[2] * light + white)


@_compiled
def _fraction(x):  # type: ignore[no-untyped-def]
    return x - np.floor(x)  # math.floor would be a whole number, and the rest float64


@_compiled
def _scrambled(row, column):  # type: ignore[no-untyped-def]
    """A number of [0, 1) for each pixel, such that neighbours' differ (Jimenez, SIGGRAPH 2014, gradient noise)."""
    inner = np.float32(0.06711056) * np.float32(row) + np.float32(0.00583715) * np.float32(column)
    return _fraction(np.float32(52.9829189) * _fraction(inner))
