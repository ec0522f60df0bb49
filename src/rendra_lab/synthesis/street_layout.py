"""Where everything stands in a street, different for each seed. Places: x to the right, y up, z forwards, metres."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from rendra_lab.synthesis import street_parts as parts
from rendra_lab.synthesis.painted_faces import PaintedFaces, wall
from rendra_lab.synthesis.street_textures import FACADES, TEXTURE, Rng, RoadMarks
from rendra_lab.synthesis.sunlit_scenes import ContactShade

KERB_M = 0.13
_BEGIN, _END = -14.0, 120.0  # z of the street
_FAR = 600.0
_CELL = 0.25  # of the contact shade, metres
_CONTACT_X, _CONTACT_Z = (-16.0, 16.0), (-6.0, 70.0)
_CAR_GAP = 0.25  # between a parked car and the kerb


@dataclass
class Street:
    """A street and the lane that is free to drive in.

    Attributes:
        faces: everything in it.
        contact: where the ground sees little sky.
        marks: of the road.
        lane: x of the middle of the lane.
        spare: how far to the sides of it a camera may be.
    """

    faces: PaintedFaces
    contact: ContactShade
    marks: RoadMarks
    lane: float
    spare: float


@dataclass
class _Side:
    """One side of the street: -1 to the left, 1 to the right."""

    sign: float
    kerb: float  # x, as all of these without the sign
    facade: float
    parks: bool
    trees: float  # chance of one every few metres
    gaps: float  # chance of one between houses
    floors: tuple[int, int]
    depth: float  # of gardens before the houses
    houses: bool


@dataclass
class _Site:
    """What has been built so far."""

    parts: list[PaintedFaces] = field(default_factory=list)
    footprints: list[tuple[float, float, float, float, float]] = field(default_factory=list)

    def add(self, part: PaintedFaces) -> None:
        self.parts.append(part)

    def stand(self, part: PaintedFaces, x: tuple[float, float], z: tuple[float, float], hides: float) -> None:
        """Adds what hides a share of the sky from the ground on a rectangle."""
        self.parts.append(part)
        self.footprints.append((min(x), max(x), z[0], z[1], hides))


def build_street(rng: Rng, clear: float) -> Street:
    """A street whose right lane is free from its beginning to `clear` metres."""
    lane_width = rng.uniform(2.9, 3.5)
    parks = rng.random(2) < 0.72
    free = rng.uniform(0.2, 1.2, 2)
    half_width = lane_width + float(np.mean(np.where(parks, 2.1, free)))
    centre = float(np.where(parks, 2.1, free) @ [0.5, -0.5])  # of the lanes: away from the side with more cars
    sides = [_side(rng, sign, half_width, bool(park)) for sign, park in zip((-1.0, 1.0), parks, strict=True)]
    marks = _marks(rng, centre, lane_width, half_width)
    site = _Site()
    _lay_ground(site, marks, sides)
    for side in sides:
        _build_side(rng, site, side)
        if side.parks:
            _park(rng, site, side)
    _close_end(rng, site, sides)
    lane = centre + lane_width / 2
    if rng.random() < 0.4:
        _stop(rng, site, lane, clear + rng.uniform(7, 30), 0.0)
    if rng.random() < 0.35:
        _stop(rng, site, centre - lane_width / 2, rng.uniform(12, 45), np.pi)
    return Street(PaintedFaces.joined(site.parts), _contact(site), marks, lane, (lane_width - 2.0) / 2)


def _marks(rng: Rng, centre: float, lane_width: float, half_width: float) -> RoadMarks:
    style = rng.random()
    edges = tuple(centre + sign * (lane_width - 0.1) for sign in (-1, 1)) if rng.random() < 0.4 else ()
    if style < 0.55:
        return RoadMarks(half_width, (centre,), edges)
    return RoadMarks(half_width, (), (centre, *edges)) if style < 0.7 else RoadMarks(half_width, (), edges)


def _side(rng: Rng, sign: float, kerb: float, parks: bool) -> _Side:
    """City, suburb or park."""
    kind = rng.choice(3, p=[0.45, 0.4, 0.15])
    pavement = rng.uniform(1.6, 3.4)
    garden = (0.0, rng.uniform(2.5, 6.0), rng.uniform(1.0, 3.0))[kind]
    return _Side(
        sign=sign,
        kerb=kerb,
        facade=kerb + pavement + garden,
        parks=parks,
        trees=(rng.uniform(0, 0.45), rng.uniform(0.1, 0.6), 0.9)[kind],
        gaps=(0.12, 0.75, 1.0)[kind],
        floors=((3, 6), (1, 4), (1, 3))[kind],
        depth=garden,
        houses=kind < 2,
    )


def _lay_ground(site: _Site, marks: RoadMarks, sides: list[_Side]) -> None:
    half = marks.half_width
    corners = [(-half, 0.0, _BEGIN), (half, 0.0, _BEGIN), (half, 0.0, _END), (-half, 0.0, _END)]
    v = [(z - _BEGIN) / marks.period for _, _, z in corners]
    site.add(parts.quads([corners], list(zip((0, 1, 1, 0), v, strict=True)), TEXTURE["asphalt"]))
    # what shows where a ray slips between two triangles
    site.add(parts.ground_strip((-_FAR, _FAR), -0.05, (_BEGIN, _FAR), "verge", 9.0))
    for side in sides:
        s = side.sign
        edge = side.facade - side.depth
        site.add(wall((s * side.kerb, _BEGIN), (s * side.kerb, _END), (0, KERB_M), TEXTURE["kerb"], (1.2, 0.3)))
        inner, yard = side.kerb + 0.22, "grass" if side.depth > 0 else "pavement"
        site.add(parts.ground_strip(_ordered(s * side.kerb, s * inner), KERB_M, (_BEGIN, _END), "kerb", 1.0))
        site.add(parts.ground_strip(_ordered(s * inner, s * edge), KERB_M, (_BEGIN, _END), "pavement", 2.4))
        site.add(parts.ground_strip(_ordered(s * edge, s * (edge + 60)), KERB_M, (_BEGIN, _END), yard, 3.0))
        site.add(parts.ground_strip(_ordered(s * (edge + 60), s * _FAR), KERB_M, (_BEGIN, _END), "grass", 9.0))
    site.add(wall((-half, _END), (half, _END), (0, KERB_M), TEXTURE["kerb"], (1.2, 0.3)))
    site.add(parts.ground_strip((-_FAR, _FAR), KERB_M, (_END, _FAR), "grass", 9.0))


def _build_side(rng: Rng, site: _Site, side: _Side) -> None:
    if side.houses:
        _build_houses(rng, site, side, side.facade, _BEGIN)
    _build_houses(rng, site, side, side.facade + 24, 20.0)  # seen through the gaps
    if side.depth > 0:
        _enclose(rng, site, side)
    _furnish(rng, site, side)
    if not side.houses:
        for _ in range(22):
            x, z = side.facade + rng.uniform(1, 16), rng.uniform(4, _END)
            _plant(rng, site, side.sign * x, z, rng.uniform(7, 13))


def _build_houses(rng: Rng, site: _Site, side: _Side, facade: float, begin: float) -> None:
    z = begin + rng.uniform(-6, 0)
    street_kind = int(rng.integers(FACADES))
    color = parts.wall_color(rng)
    while z < _END:
        if rng.random() < 0.8:
            street_kind, color = int(rng.integers(FACADES)), parts.wall_color(rng)
        length = rng.uniform(7, 16)
        back = facade + rng.uniform(8, 13)
        step = 0.0 if rng.random() < 0.5 else rng.uniform(0, 0.8)
        roof = ("flat", "gable", "gable", "across")[rng.integers(4)]
        plan = parts.HousePlan(
            side.sign * (facade + step), side.sign * back, (z, z + length), int(rng.integers(*side.floors)),
            street_kind, color, roof,
        )  # fmt: skip
        house = parts.house(rng, plan).placed((0, KERB_M, 0))
        site.stand(house, (plan.front, plan.back), plan.z, 0.75)
        z += length
        if rng.random() < side.gaps:
            gap = rng.uniform(2.5, 8.0)
            if rng.random() < 0.6:
                _plant(rng, site, side.sign * (facade + rng.uniform(2, 6)), z + gap / 2, rng.uniform(4, 8))
            elif gap > 3:
                garage = parts.box(
                    _corner(side.sign, facade + 5, facade + 9, z + 0.2, 0)[0],
                    _corner(side.sign, facade + 5, facade + 9, z + gap - 0.2, 2.6)[1],
                    TEXTURE["fence"], 2.0, color,
                )  # fmt: skip
                site.add(garage)
            z += gap


def _corner(sign: float, x0: float, x1: float, z: float, y: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    low, high = _ordered(sign * x0, sign * x1)
    return (low, y, z), (high, y, z)


def _enclose(rng: Rng, site: _Site, side: _Side) -> None:
    """Hedges, fences and bushes where gardens meet the pavement."""
    x = side.facade - side.depth + 0.4
    z = _BEGIN
    while z < 90:
        length = rng.uniform(5, 14)
        kind = rng.random()
        reach = (z, z + length - rng.uniform(0.8, 2.5))
        if kind < 0.4:
            height = rng.uniform(0.7, 1.9)
            thick = _ordered(side.sign * (x - 0.35), side.sign * (x + 0.35))
            site.stand(parts.hedge(rng, thick, reach, height).placed((0, KERB_M, 0)), thick, reach, 0.7)
        elif kind < 0.75:
            tint = parts.wall_color(rng)
            site.add(parts.boards(side.sign * x, reach, rng.uniform(0.6, 1.6), tint).placed((0, KERB_M, 0)))
        else:
            for _ in range(rng.integers(1, 4)):
                at = (side.sign * (x + rng.uniform(0, 1)), KERB_M, rng.uniform(*reach))
                site.add(parts.bush(rng, rng.uniform(0.4, 0.9)).placed(at))
        z += length


def _furnish(rng: Rng, site: _Site, side: _Side) -> None:
    """Trees, lamps and signs along the kerb."""
    x = side.sign * (side.kerb + 0.55)
    z = _BEGIN + rng.uniform(0, 6)
    spacing = rng.uniform(6, 10)
    while z < 100:
        if rng.random() < side.trees and z > 3:
            _plant(rng, site, x + side.sign * 0.25, z, rng.uniform(4.5, 9.5))
        z += spacing * rng.uniform(0.8, 1.3)
    height, reach = rng.uniform(4.5, 8), -side.sign * rng.uniform(0.6, 1.8)
    every = rng.uniform(18, 30)
    for k in range(6):
        at = (x, KERB_M, k * every + rng.uniform(2, 12))
        site.add(parts.lamp(rng, height, reach).placed(at))
    for _ in range(rng.integers(1, 5)):
        at = (x + side.sign * 0.1, KERB_M, rng.uniform(9, 60))
        site.add(parts.sign_post(rng, rng.uniform(2.1, 2.7)).placed(at, rng.uniform(-0.2, 0.2)))


def _plant(rng: Rng, site: _Site, x: float, z: float, height: float) -> None:
    tree = parts.tree(rng, max(height, 5.0), is_near=abs(x) < 12 and z < 22).placed(
        (x, KERB_M - 0.03, z), rng.uniform(0, 6)
    )
    site.stand(tree, (x - 0.5, x + 0.5), (z - 0.5, z + 0.5), 0.35)


def _park(rng: Rng, site: _Site, side: _Side) -> None:
    x = side.sign * (side.kerb - _CAR_GAP - parts.CAR_WIDTH / 2)
    density = rng.uniform(0.35, 0.95)
    z = -7.0 + rng.uniform(0, 5)
    while z < 75:
        if rng.random() < density:
            z += _stop(rng, site, x + rng.normal(0, 0.06), z, 0.0 if side.sign > 0 else np.pi, is_rear=True)
            z += rng.uniform(0.6, 1.6)
        else:
            z += rng.uniform(2, 7)


def _stop(rng: Rng, site: _Site, x: float, z: float, turn: float, is_rear: bool = False) -> float:
    """Puts a car at x, its middle (or its nearer end) at z; returns its length."""
    body, length = parts.car(rng)
    z = z + length / 2 if is_rear else z
    half = parts.CAR_WIDTH / 2
    placed = body.placed((x, 0, z), turn + rng.normal(0, 0.015))
    site.stand(placed, (x - half, x + half), (z - length / 2, z + length / 2), 0.95)
    return length


def _close_end(rng: Rng, site: _Site, sides: list[_Side]) -> None:
    """Houses and trees across the end of the street."""
    x = -75.0
    while x < 75:
        width = rng.uniform(9, 18)
        plan = parts.HousePlan(
            0.0, 10.0, (0.0, width), int(rng.integers(2, 6)), int(rng.integers(FACADES)), parts.wall_color(rng),
            "gable",
        )  # fmt: skip
        # its front, to -x, comes to look at -z
        house = parts.house(rng, plan).placed((x + width, KERB_M, _END + 18), np.pi / 2 + np.pi)
        site.add(house)
        x += width + (rng.uniform(0, 6) if rng.random() < 0.4 else 0)
    for _ in range(14):
        _plant(rng, site, rng.uniform(-50, 50), _END + rng.uniform(4, 14), rng.uniform(6, 12))


def _contact(site: _Site) -> ContactShade:
    """Footprints, blurred: what hides the sky from the ground beside it."""
    columns, rows = (round((high - low) / _CELL) for low, high in (_CONTACT_X, _CONTACT_Z))
    hidden = np.zeros((rows, columns), np.float32)
    for x0, x1, z0, z1, hides in site.footprints:
        i0, i1 = (round((x - _CONTACT_X[0]) / _CELL) for x in (x0, x1))
        j0, j1 = (round((z - _CONTACT_Z[0]) / _CELL) for z in (z0, z1))
        cells = hidden[max(j0, 0) : max(j1, 0), max(i0, 0) : max(i1, 0)]
        np.maximum(cells, hides, out=cells)
    near = ndimage.gaussian_filter(hidden, 0.3 / _CELL, mode="nearest")
    far = ndimage.gaussian_filter(hidden, 1.2 / _CELL, mode="nearest")
    return ContactShade(1 - 0.55 * near - 0.4 * far, (_CONTACT_X[0], _CONTACT_Z[0]), _CELL)


def _ordered(a: float, b: float) -> tuple[float, float]:
    return (a, b) if a < b else (b, a)
