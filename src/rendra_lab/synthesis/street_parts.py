"""What stands in a street: cars, trees, lamps, signs, hedges, houses.

Places: x to the right, y up, z forwards, metres.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass

import numpy as np

from rendra.utils import ico_sphere
from rendra_lab.synthesis.painted_faces import (
    WHITE,
    Array,
    Color,
    PaintedFaces,
    box,
    box_mapped,
    flat,
    quads,
    triangles,
    tube,
    wall,
)
from rendra_lab.synthesis.street_textures import TEXTURE, Rng

CAR_WIDTH = 1.78
_PAINTS: tuple[Color, ...] = (
    (0.95, 0.95, 0.95), (0.75, 0.77, 0.79), (0.45, 0.46, 0.48), (0.17, 0.17, 0.19), (0.68, 0.12, 0.12),
    (0.15, 0.25, 0.55), (0.3, 0.5, 0.72), (0.2, 0.38, 0.27), (0.85, 0.68, 0.2), (0.5, 0.33, 0.22), (0.85, 0.42, 0.15),
    (0.55, 0.6, 0.55),
)  # fmt: skip
_GREENS: tuple[Color, ...] = (
    (0.5, 0.62, 0.27),
    (0.4, 0.55, 0.25),
    (0.33, 0.5, 0.3),
    (0.58, 0.6, 0.28),
    (0.68, 0.52, 0.25),
)
_WALLS: tuple[Color, ...] = (
    (0.9, 0.89, 0.86), (0.85, 0.78, 0.62), (0.68, 0.4, 0.32), (0.75, 0.6, 0.45), (0.62, 0.63, 0.65),
    (0.85, 0.68, 0.4), (0.6, 0.7, 0.72), (0.8, 0.55, 0.48), (0.55, 0.45, 0.38), (0.7, 0.75, 0.6),
)  # fmt: skip


@dataclass(frozen=True)
class _CarKind:
    """The outline of a car from the side: (share of the length from the rear, height), from bumper to bumper.

    `surfaces` are the textures of its strips between them.
    """

    length: float
    outline: tuple[tuple[float, float], ...]
    surfaces: tuple[str, ...]
    belt: float = 0.95
    side: str = "car_side"
    side_height: float = 1.6


_NOSE = ("plain", "glass", "plain", "car_front", "plain")
_HATCHBACK = _CarKind(
    3.9,
    (
        (0, 0.3),
        (0, 0.6),
        (0.01, 0.98),
        (0.1, 1.4),
        (0.3, 1.47),
        (0.52, 1.42),
        (0.7, 1.0),
        (0.95, 0.82),
        (1, 0.62),
        (1, 0.3),
    ),
    ("plain", "car_rear", "glass", "plain", *_NOSE),
)
_SALOON = _CarKind(
    4.6,
    (
        (0, 0.3),
        (0, 0.6),
        (0.01, 0.96),
        (0.16, 1.0),
        (0.3, 1.4),
        (0.42, 1.44),
        (0.55, 1.4),
        (0.71, 0.98),
        (0.96, 0.8),
        (1, 0.6),
        (1, 0.3),
    ),
    ("plain", "car_rear", "plain", "glass", "plain", *_NOSE),
)
_ESTATE = _CarKind(
    4.6,
    (
        (0, 0.3),
        (0, 0.6),
        (0.01, 1.0),
        (0.07, 1.5),
        (0.4, 1.58),
        (0.56, 1.52),
        (0.71, 1.05),
        (0.96, 0.92),
        (1, 0.66),
        (1, 0.3),
    ),
    ("plain", "car_rear", "glass", "plain", *_NOSE),
)
_VAN = _CarKind(
    5.0,
    (
        (0, 0.3),
        (0, 0.7),
        (0, 1.25),
        (0.02, 2.02),
        (0.5, 2.1),
        (0.7, 2.0),
        (0.86, 1.25),
        (0.98, 1.02),
        (1, 0.7),
        (1, 0.3),
    ),
    ("plain", "car_rear", "glass", "plain", *_NOSE),
    belt=1.25,
    side="van_side",
    side_height=2.1,
)
_CAR_KINDS = (_HATCHBACK, _HATCHBACK, _SALOON, _SALOON, _ESTATE, _VAN)


def car(rng: Rng) -> tuple[PaintedFaces, float]:
    """A car about (0, 0, 0) that looks along z, and its length."""
    number = int(rng.integers(len(_CAR_KINDS)))
    paint = _PAINTS[rng.integers(len(_PAINTS))]
    shade = float(rng.uniform(0.9, 1.05))
    painted = _car(number).tinted((paint[0] * shade, paint[1] * shade, paint[2] * shade))
    return painted, _CAR_KINDS[number].length


@functools.lru_cache(len(_CAR_KINDS))
def _car(number: int) -> PaintedFaces:
    kind = _CAR_KINDS[number]
    z = [(share - 0.5) * kind.length for share, _ in kind.outline]
    y = [height for _, height in kind.outline]
    half = [CAR_WIDTH / 2 * (1 - 0.2 * max(0.0, height - kind.belt) / (1.5 - kind.belt + 0.4)) for height in y]
    parts = []
    for i, surface in enumerate(kind.surfaces):
        corners = [(-half[i + 1], y[i + 1], z[i + 1]), (half[i + 1], y[i + 1], z[i + 1]),
                   (half[i], y[i], z[i]), (-half[i], y[i], z[i])]  # fmt: skip
        if i > len(kind.surfaces) / 2:  # downwards: the upper edge comes first
            corners = corners[2:] + corners[:2]
        parts.append(quads([corners], [(0, 0), (1, 0), (1, 1), (0, 1)], TEXTURE[surface]))
    for sign in (-1.0, 1.0):
        parts.append(_car_side(kind, z, y, half, sign))
        parts += [_wheel(sign * (CAR_WIDTH / 2 - 0.02), (share - 0.5) * kind.length, sign) for share in (0.2, 0.81)]
    return PaintedFaces.joined(parts)


def _car_side(kind: _CarKind, z: list[float], y: list[float], half: list[float], sign: float) -> PaintedFaces:
    """Doors up to the belt, windows above it, column by column between the points of the outline."""
    corners: list[list[tuple[float, float, float]]] = []
    x = sign * CAR_WIDTH / 2
    for i, j in itertools.pairwise(range(len(z))):
        if z[j] - z[i] < 1e-6:
            continue
        low_i, low_j = min(y[i], kind.belt), min(y[j], kind.belt)
        corners.append([(x, low_i, z[i]), (x, low_j, z[j]), (x, 0.3, z[j]), (x, 0.3, z[i])])
        if max(y[i], y[j]) > kind.belt:
            top = [(sign * half[k], max(y[k], low), z[k]) for k, low in ((i, low_i), (j, low_j))]
            corners.append([top[0], top[1], (x, low_j, z[j]), (x, low_i, z[i])])
    places = np.asarray(corners, np.float32)
    uv = np.stack([places[..., 2] / kind.length + 0.5, 1 - places[..., 1] / kind.side_height], -1)
    uv = uv.clip(0.004, 0.996)  # a repeating texture would bring the bumper over the roof
    return quads(places, uv, TEXTURE[kind.side])


def _wheel(x: float, z: float, sign: float) -> PaintedFaces:
    radius, width, sides = 0.31, 0.2, 12
    angle = 2 * np.pi * np.arange(sides + 1) / sides
    ring = np.stack([np.full(sides + 1, x), radius * (1 + np.cos(angle)), z + radius * np.sin(angle)], -1)
    middle = np.broadcast_to([x, radius, z], (sides, 3))
    disc = np.stack([middle, ring[:-1], ring[1:]], 1)
    uv = 0.5 + 0.49 * np.stack([disc[..., 2] - z, disc[..., 1] - radius], -1) / radius
    inner = ring - np.array([sign * width, 0, 0])
    tread = np.stack([ring[:-1], ring[1:], inner[1:], inner[:-1]], 1)
    dark = quads(tread, [(0.02, 0.02)] * 4, TEXTURE["wheel"])
    return PaintedFaces.joined([triangles(disc, uv, TEXTURE["wheel"]), dark])


@functools.lru_cache(2)
def _sphere(level: int) -> tuple[Array, np.ndarray]:
    """Vertices (V, 3) on the unit sphere, and triangles (F, 3)."""
    mesh = ico_sphere(level)
    return mesh.verts_packed().numpy(), mesh.faces_packed().numpy()


def _clump(rng: Rng, middle: Array, radii: Array, texture: int, tint: Color, level: int = 2) -> PaintedFaces:
    """A lump of leaves, uneven, lit as if it were round."""
    verts, faces = _sphere(level)
    waves = rng.normal(0, 2.5, (6, 3)).astype(np.float32)
    uneven = 1 + 0.05 * np.sin(verts @ waves.T + rng.uniform(0, 6, 6)).sum(1) + rng.normal(0, 0.05, len(verts))
    corners = (middle + radii * verts * uneven[:, None]).astype(np.float32)[faces]
    outwards = corners.mean(1) - middle
    return box_mapped(corners, texture, 1.6, tint, outwards / np.linalg.norm(outwards, axis=1, keepdims=True))


def _loose_leaves(rng: Rng, middle: Array, radii: Array, count: int, size: float, texture: int, tint: Color
                  ) -> PaintedFaces:  # fmt: skip
    """Triangles that break the outline of a crown."""
    outwards = rng.normal(size=(count, 3)).astype(np.float32)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    centre = middle + radii * outwards * rng.uniform(0.85, 1.12, (count, 1)).astype(np.float32)
    corners = centre[:, None] + rng.normal(0, size / 2, (count, 3, 3)).astype(np.float32)
    return box_mapped(corners.astype(np.float32), texture, 1.6, tint, outwards)


def tree(rng: Rng, height: float, is_near: bool = True) -> PaintedFaces:
    """A broad-leaved tree about (0, 0, 0), its leaves well above whoever passes; of fewer triangles if not near."""
    tint = _varied(rng, _GREENS[rng.integers(len(_GREENS))], 0.06)
    texture = TEXTURE[("leaves", "leaves_2")[rng.integers(2)]]
    fork = max(height * rng.uniform(0.28, 0.42), 2.5)
    radius = 0.035 * height * rng.uniform(0.6, 1.0)
    bark = _varied(rng, (0.75, 0.65, 0.55), 0.08)
    parts = [tube((0, 0, 0), (0, fork * 1.3, 0), (radius, 0.7 * radius), TEXTURE["bark"], bark)]
    spread, leaf = height * rng.uniform(0.2, 0.3), (0.09 if is_near else 0.14) * height**0.7
    middle = np.array([0, (fork + height) / 2, 0], np.float32)
    radii = np.array([spread, (height - fork) / 2, spread], np.float32)
    for _ in range(rng.integers(3, 6)):
        direction = rng.normal(size=3).astype(np.float32)
        away = direction / np.linalg.norm(direction) * rng.uniform(0.25, 0.5)
        centre, size = middle + radii * away, radii * rng.uniform(0.5, 0.75)
        shade = _varied(rng, tint, 0.03)
        parts.append(_clump(rng, centre, size, texture, shade, 2 if is_near else 1))
        parts.append(_loose_leaves(rng, centre, size, 70 if is_near else 20, leaf, texture, shade))
        parts.append(tube((0, fork, 0), centre, (0.5 * radius, 0.2 * radius), TEXTURE["bark"], bark, 4))
    return PaintedFaces.joined(parts)


def bush(rng: Rng, radius: float) -> PaintedFaces:
    """A bush about (0, 0, 0)."""
    tint = _varied(rng, _GREENS[rng.integers(len(_GREENS))], 0.06)
    middle, radii = np.array([0, 0.7 * radius, 0], np.float32), np.array([1, 0.8, 1], np.float32) * radius
    lump = _clump(rng, middle, radii, TEXTURE["hedge"], tint)
    return PaintedFaces.joined([lump, _loose_leaves(rng, middle, radii, 60, 0.25 * radius, TEXTURE["hedge"], tint)])


def hedge(rng: Rng, x: tuple[float, float], z: tuple[float, float], height: float) -> PaintedFaces:
    """A clipped hedge along z, its surface a little uneven."""
    steps = max(2, round((z[1] - z[0]) / 0.8))
    at = np.linspace(z[0], z[1], steps + 1)
    outline = [(x[0], 0.0), (x[0], 0.55 * height), (x[0], height), (x[1], height), (x[1], 0.55 * height), (x[1], 0.0)]
    rings = np.array([[(px, py, pz) for px, py in outline] for pz in at], np.float32)
    rings[:, 1:-1] += rng.normal(0, 0.05, rings[:, 1:-1].shape)
    sides = np.stack([rings[:-1, :-1], rings[1:, :-1], rings[1:, 1:], rings[:-1, 1:]], 2).reshape(-1, 4, 3)
    halves = sides[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    ends = [[ring[i] for i in (0, a, a + 1)] for ring in (rings[0], rings[-1]) for a in range(1, 5)]
    tint = _varied(rng, _GREENS[rng.integers(3)], 0.05)
    return box_mapped(np.concatenate([halves, np.array(ends)]), TEXTURE["hedge"], 1.2, tint)


def lamp(rng: Rng, height: float, reach: float) -> PaintedFaces:
    """A lamp post at (0, 0, 0) whose arm reaches along x."""
    tint = _varied(rng, ((0.8, 0.8, 0.8), (0.35, 0.4, 0.38))[rng.integers(2)], 0.05)
    metal = TEXTURE["metal"]
    side = 1.0 if reach > 0 else -1.0
    x0, x1 = sorted((reach - side * 0.35, reach + side * 0.3))
    return PaintedFaces.joined([
        tube((0, 0, 0), (0, 1.0, 0), (0.1, 0.09), metal, tint),
        tube((0, 1.0, 0), (0, height, 0), (0.07, 0.05), metal, tint),
        tube((0, height, 0), (reach, height + 0.25, 0), (0.05, 0.04), metal, tint),
        box((x0, height + 0.17, -0.12), (x1, height + 0.32, 0.12), metal, 1.0, tint, floor=True),
    ])  # fmt: skip


def sign_post(rng: Rng, height: float) -> PaintedFaces:
    """A traffic sign at (0, 0, 0) that is read by whoever comes along z."""
    texture = TEXTURE[("sign", "sign_2")[rng.integers(2)]]
    post = tube((0, 0, 0.03), (0, height + 0.3, 0.03), (0.035, 0.035), TEXTURE["metal"], WHITE)
    sides, first = ((16, 0.0), (3, np.pi / 2), (4, np.pi / 4), (8, np.pi / 8))[rng.integers(4)]
    angle = first + 2 * np.pi * np.arange(sides + 1) / sides
    radius = 0.38
    rim = np.stack([radius * np.cos(angle), height + radius * np.sin(angle), 0 * angle], -1)
    plate = np.stack([np.broadcast_to([0, height, 0], (sides, 3)), rim[:-1], rim[1:]], 1)
    uv = 0.5 + 0.48 * (plate[..., :2] - [0, height]) / radius * [1, -1]
    return PaintedFaces.joined([post, triangles(plate, uv, texture)])


@dataclass(frozen=True)
class HousePlan:
    """Of a house by the side of the street.

    Attributes:
        front: x of its facade.
        back: x of its other side.
        z: from and to.
        floors: at least 1.
        kind: number of its facade's textures.
        color: of its walls.
        roof: flat, gable (ridge along the street) or across.
    """

    front: float
    back: float
    z: tuple[float, float]
    floors: int
    kind: int
    color: Color
    roof: str


FLOOR_M = 3.1
_BAYS_M = 5.6  # two bays


def house(rng: Rng, plan: HousePlan) -> PaintedFaces:
    """A house with windows on all sides but those towards its neighbours, roof, chimney, and what hangs before it."""
    z0, z1 = plan.z
    ground, top = FLOOR_M + 0.2, FLOOR_M * plan.floors + 0.4
    tile = ((z1 - z0) / max(1, round((z1 - z0) / _BAYS_M)), FLOOR_M)
    names = [TEXTURE[f"{part}_{plan.kind}"] for part in ("upper", "lower", "blank")]
    upper, lower, blank = names
    front, back = plan.front, plan.back
    parts = [wall((front, z0), (front, z1), (0, ground), lower, (tile[0], ground), plan.color)]
    if plan.floors > 1:
        above = (tile[0], (top - ground) / (plan.floors - 1))
        parts.append(wall((front, z0), (front, z1), (ground, top), upper, above, plan.color))
    parts += [wall((front, z), (back, z), (0, top), blank, (_BAYS_M, FLOOR_M), plan.color) for z in plan.z]
    parts.append(wall((back, z0), (back, z1), (0, top), upper, (tile[0], top / plan.floors), plan.color))
    parts.append(_roof(rng, plan, top, blank))
    parts.append(_before(rng, plan, ground, top, upper))
    return PaintedFaces.joined(parts)


def _roof(rng: Rng, plan: HousePlan, top: float, blank: int) -> PaintedFaces:
    texture = TEXTURE[("roof", "roof_2")[rng.integers(2)]]
    tint = _varied(rng, ((0.62, 0.3, 0.22), (0.4, 0.32, 0.3), (0.36, 0.38, 0.42))[rng.integers(3)], 0.05)
    (z0, z1), front, back = plan.z, plan.front, plan.back
    out = 1.0 if back > front else -1.0
    if plan.roof == "flat":
        x0, x1 = sorted((front - 0.18 * out, back))
        edge = box((x0, top - 0.25, z0), (x1, top + 0.35, z1), TEXTURE["plain"], 3.0, _varied(rng, (0.7,) * 3, 0.1),
                   floor=True)  # fmt: skip
        return PaintedFaces.joined([edge, _chimney(rng, plan, top)])
    eaves = 0.35
    middle_x, middle_z = (front + back) / 2, (z0 + z1) / 2
    half = abs(back - front) / 2 if plan.roof == "gable" else (z1 - z0) / 2
    ridge = top + half * rng.uniform(0.6, 1.0)
    drop = eaves * (ridge - top) / half
    if plan.roof == "gable":
        ends = [(middle_x, ridge, z0), (middle_x, ridge, z1)]
        eaves_lines = [[(x, top - drop, z0), (x, top - drop, z1)] for x in (front - out * eaves, back + out * eaves)]
        gables = [[(front, top, z), (back, top, z), (middle_x, ridge, z)] for z in (z0, z1)]
    else:
        ends = [(front - out * eaves, ridge, middle_z), (back, ridge, middle_z)]
        eaves_lines = [
            [(front - out * eaves, top - drop, z), (back, top - drop, z)] for z in (z0 - eaves, z1 + eaves)
        ]
        gables = [[(x, top, z0), (x, top, z1), (x, ridge, middle_z)] for x in (front, back)]
    long = float(np.linalg.norm(np.subtract(ends[1], ends[0]))) / 3
    slopes = [[ends[0], ends[1], line[1], line[0]] for line in eaves_lines]
    roof = quads(slopes, [(0, 0), (long, 0), (long, half / 2), (0, half / 2)], texture, tint)
    sides = box_mapped(np.asarray(gables, np.float32), blank, FLOOR_M, plan.color)
    return PaintedFaces.joined([roof, sides, _chimney(rng, plan, ridge - 0.4)])


def _chimney(rng: Rng, plan: HousePlan, top: float) -> PaintedFaces:
    x, z = (plan.front + plan.back) / 2, rng.uniform(plan.z[0] + 0.5, plan.z[1] - 1.0)
    return box((x - 0.35, top - 1.5, z), (x + 0.35, top + 1.1, z + 0.6), TEXTURE["fence"], 1.0, (0.65, 0.4, 0.33))


def _before(rng: Rng, plan: HousePlan, ground: float, top: float, upper: int) -> PaintedFaces:
    """A cornice, and perhaps a bay window, balconies or an awning."""
    (z0, z1), front = plan.z, plan.front
    out = -1.0 if plan.back > front else 1.0

    def block(
        depth: float, y: tuple[float, float], z: tuple[float, float], texture: int, color: Color
    ) -> PaintedFaces:
        x0, x1 = sorted((front, front + out * depth))
        return box((x0, y[0], z[0]), (x1, y[1], z[1]), texture, 2.8, color, floor=True)

    pale = _varied(rng, (0.8, 0.78, 0.75), 0.025)
    parts = [block(0.12, (ground - 0.1, ground + 0.08), (z0, z1), TEXTURE["plain"], pale)]
    choice = rng.random()
    if choice < 0.25 and plan.floors > 1 and z1 - z0 > 5:
        z = rng.uniform(z0 + 0.5, z1 - 3.4)
        parts.append(block(0.9, (ground - 0.2, top - 0.3), (z, z + 2.8), upper, plan.color))
    elif choice < 0.55 and plan.floors > 1:
        for floor in range(1, plan.floors):
            z, y = rng.uniform(z0 + 0.3, max(z0 + 0.4, z1 - 3.2)), FLOOR_M * floor + 0.25
            parts.append(block(1.0, (y, y + 0.15), (z, min(z + 2.9, z1)), TEXTURE["plain"], pale))
            parts.append(
                block(1.03, (y + 0.15, y + 1.0), (z, min(z + 2.9, z1)), TEXTURE["fence"], (0.35, 0.36, 0.38))
            )
    elif choice < 0.8:
        z, color = rng.uniform(z0, max(z0 + 0.1, z1 - 4)), tuple(rng.uniform(0.2, 0.9, 3).tolist())
        end = min(z + rng.uniform(2.5, 4), z1)
        low, high = front + out * 1.3, front + out * 0.02
        slope = [(high, 3.0, z), (high, 3.0, end), (low, 2.45, end), (low, 2.45, z)]
        parts.append(quads([slope], [(0, 0), (1, 0), (1, 1), (0, 1)], TEXTURE["plain"], color))
        parts.append(wall((low, z), (low, end), (2.2, 2.45), TEXTURE["plain"], (2.0, 2.0), color))
    return PaintedFaces.joined(parts)


def boards(x: float, z: tuple[float, float], height: float, tint: Color) -> PaintedFaces:
    """A fence or a garden wall along z."""
    return box((x - 0.08, 0.0, z[0]), (x + 0.08, height, z[1]), TEXTURE["fence"], 1.6, tint)


def ground_strip(x: tuple[float, float], y: float, z: tuple[float, float], texture: str, tile: float) -> PaintedFaces:
    """A strip of ground."""
    return flat(x, y, z, TEXTURE[texture], (tile, tile))


def _varied(rng: Rng, color: Color, deviation: float) -> Color:
    """A colour near this one."""
    r, g, b = (np.asarray(color) + rng.normal(0, deviation, 3)).clip(0.05, 1).tolist()
    return r, g, b


def wall_color(rng: Rng) -> Color:
    """What houses are painted with: white, cream, brick, and sometimes something brighter."""
    return _varied(rng, _WALLS[rng.integers(len(_WALLS))], 0.04)
