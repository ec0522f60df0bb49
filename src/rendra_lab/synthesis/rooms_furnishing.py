"""Where furniture stands in generated rooms: along walls, round tables, before sofas, never before doors."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rendra_lab.synthesis.furniture import Finish, Furniture, draw, draw_finish
from rendra_lab.synthesis.rooms_shell import WALLS, Opening, Placed, ceiling_lamp, hung_picture, rug, wall_frame
from rendra_lab.synthesis.rooms_surfaces import NUM_PAINTINGS, wood_color
from rendra_lab.synthesis.solids import Floats

_RNG = np.random.Generator
_TRIES = 24  # at places for one piece
_DOOR_ROOM = 0.8  # metres before a door where nothing stands
_GAP = 0.04  # metres between pieces at least

Stock = Callable[[str, np.random.Generator, Finish], Furniture]
"""What gives a piece of a name, of some materials."""
Tilted = Callable[[Furniture], Floats]
"""How a piece that does not stand is turned and moved: (4, 4), its lowest point at y = 0."""


@dataclass(frozen=True)
class Lamp:
    """What shines: a place in the room and a warm colour, linear, with its strength."""

    place: tuple[float, float, float]
    color: tuple[float, float, float]


@dataclass(frozen=True)
class Furnishing:
    """All that stands and hangs in a room.

    Attributes:
        placed: it.
        lamps: that shine.
    """

    placed: tuple[Placed, ...]
    lamps: tuple[Lamp, ...]


def furnish(
    extent: tuple[float, float, float], openings: tuple[Opening, ...], rng: np.random.Generator
) -> Furnishing:
    """Furniture of a living room, a bedroom, a dining room or a study, as much as finds a place."""
    room = Furnisher(extent, openings, rng)
    plans = (_living, _bedroom, _dining, _study)
    plans[rng.integers(len(plans))](room)
    for _ in range(int(rng.integers(0, 3))):
        room.in_corner("plant")
    if rng.random() < 0.5:
        room.lit_corner()
    room.hang_pictures(int(rng.integers(1, 6)))
    room.hang_lamp()
    return Furnishing(tuple(room.placed), tuple(room.lamps))


def _living(room: Furnisher) -> None:
    couch = room.against_wall("sofa")
    if couch is not None:
        room.before(couch, "coffee table", room.rng.uniform(0.3, 0.5), with_rug=True)
    room.against_wall("cupboard", topped=("vase", "table lamp"))
    room.some("bookcase", "cupboard", "bookcase")
    for _ in range(int(room.rng.integers(1, 3))):
        room.in_corner("easy chair")


def _bedroom(room: Furnisher) -> None:
    head = room.against_wall("bed")
    if head is not None:
        for side in (-1, 1):
            room.beside(head, "nightstand", side, topped=("table lamp", "vase"))
        if room.rng.random() < 0.6:
            room.lay_rug(head.place[0], head.place[2], head.yaw)
    room.against_wall("wardrobe")
    room.some("cupboard", "desk", "bookcase")
    room.some("easy chair", "chair")


def _dining(room: Furnisher) -> None:
    room.table_with_chairs()
    room.against_wall("cupboard", topped=("vase", "table lamp"))
    room.some("bookcase", "cupboard", "wardrobe")
    room.some("sofa", "easy chair")


def _study(room: Furnisher) -> None:
    place = room.against_wall("desk", topped=("table lamp",))
    if place is not None:
        room.before(place, "office chair", room.rng.uniform(-0.2, 0.1), faces_it=True)
    for _ in range(int(room.rng.integers(1, 4))):
        room.against_wall("bookcase")
    room.some("sofa", "easy chair")
    if room.rng.random() < 0.5:
        width, _, depth = room.extent
        room.lay_rug(width / 2, depth / 2, 0.0)


class Furnisher:
    """A room while it is furnished.

    Args:
        extent: of the room.
        openings: before which nothing stands.
        rng: makes all choices.
        stock: gives a piece of a name, of some materials.
    """

    def __init__(
        self, extent: tuple[float, float, float], openings: tuple[Opening, ...], rng: _RNG, stock: Stock = draw
    ) -> None:
        self.extent, self.openings, self.rng, self.stock = extent, openings, rng, stock
        self.placed: list[Placed] = []
        self.lamps: list[Lamp] = []
        self.finish: Finish = draw_finish(rng)
        self.hung: list[tuple[int, float, float]] = []  # wall, and from where to where along it
        self.taken: list[Floats] = [self._door_way(one) for one in openings if one.kind != "window"]

    def against_wall(self, name: str, topped: tuple[str, ...] = (), tilted: Tilted | None = None) -> Placed | None:
        """Stands a piece at a wall with its back to it; None where there is no place.

        Args:
            name: of the piece.
            topped: things of which one may be put on it.
            tilted: how it leans; None: not at all.
        """
        piece = self.draw(name)
        tilt = None if tilted is None else tilted(piece)
        low, high = Placed.of(piece, (0.0, 0.0, 0.0), tilt=tilt).bounds()
        for _ in range(_TRIES):
            wall = int(self.rng.integers(WALLS))
            origin, yaw, length = wall_frame(wall, self.extent)
            if length < high[0] - low[0] + 0.1:
                continue
            along = self.rng.uniform(0.05 - low[0], length - 0.05 - high[0])
            if self._hides_opening(wall, along + low[0], along + high[0], high[1]):
                continue
            off = 0.03 - low[2]
            x = origin[0] + along * math.cos(yaw) + off * math.sin(yaw)
            z = origin[2] - along * math.sin(yaw) + off * math.cos(yaw)
            if (stands := self._stand(piece, x, z, yaw, tilt=tilt)) is not None:
                self._put_on_top(piece, stands, topped)
                return stands
        return None

    def in_corner(self, name: str) -> Placed | None:
        """Stands a piece somewhere near the walls, looking towards the middle."""
        piece = self.draw(name)
        width, _, depth = self.extent
        for _ in range(_TRIES):
            x, z = self.rng.uniform(0.35, width - 0.35), self.rng.uniform(0.35, depth - 0.35)
            if min(x, z, width - x, depth - z) > 0.9:
                continue
            yaw = math.atan2(width / 2 - x, depth / 2 - z) + self.rng.uniform(-0.4, 0.4)
            if (stands := self._stand(piece, x, z, yaw)) is not None:
                return stands
        return None

    def lay_down(self, name: str, tilted: Tilted) -> Placed | None:
        """Lays a piece on the floor, not next to walls."""
        piece = self.draw(name)
        tilt = tilted(piece)
        width, _, depth = self.extent
        for _ in range(_TRIES):
            x, z = self.rng.uniform(0.5, width - 0.5), self.rng.uniform(0.5, depth - 0.5)
            yaw = self.rng.uniform(-math.pi, math.pi)
            if (lies := self._stand(piece, x, z, yaw, tilt=tilt)) is not None:
                return lies
        return None

    def lay_on(self, carrier: Placed, name: str, tilted: Tilted | None = None) -> Placed | None:
        """Puts a piece anywhere on the top of another one; None where the rest that lies there leaves no place.

        Args:
            carrier: whose first solid is its top.
            name: of the piece.
            tilted: how it lies; None: it stands.
        """
        piece = self.draw(name)
        tilt = None if tilted is None else tilted(piece)
        low, high = carrier.solids[0].bounds()
        for _ in range(_TRIES):
            along, ahead = (self.rng.uniform(0.75 * low[axis], 0.75 * high[axis]) for axis in (0, 2))
            cos, sin = math.cos(carrier.yaw), math.sin(carrier.yaw)
            x, z = carrier.place[0] + along * cos + ahead * sin, carrier.place[2] - along * sin + ahead * cos
            turn = self.rng.uniform(-math.pi, math.pi)
            thing = Placed.of(piece, (float(x), float(high[1]), float(z)), turn, tilt)
            least, most = thing.footprint()
            others = [one.footprint() for one in self.placed if one.place[1] > 0]
            if not any(bool((least < other[1]).all() and (most > other[0]).all()) for other in others):
                self.placed.append(thing)
                return thing
        return None

    def hang(self, name: str, tilted: Tilted) -> Placed | None:
        """Hangs a piece on a wall, at the height of the breast."""
        piece = self.draw(name)
        tilt = tilted(piece)
        low, high = Placed.of(piece, (0.0, 0.0, 0.0), tilt=tilt).bounds()
        for _ in range(_TRIES):
            wall = int(self.rng.integers(WALLS))
            origin, yaw, length = wall_frame(wall, self.extent)
            along, up = self.rng.uniform(0.5, length - 0.5), self.rng.uniform(1.15, 1.6) - float(high[1] - low[1]) / 2
            left, right = along + low[0] - 0.1, along + high[0] + 0.1
            if (
                left < 0
                or right > length
                or self._is_hung(wall, left, right)
                or self._is_behind(wall, left, right, up)
            ):
                continue
            cos, sin = math.cos(yaw), math.sin(yaw)
            off = 0.005 - float(low[2])
            place = (origin[0] + along * cos + off * sin, up, origin[2] - along * sin + off * cos)
            self.hung.append((wall, float(left), float(right)))
            self.placed.append(Placed.of(piece, place, yaw, tilt))
            return self.placed[-1]
        return None

    def lit_corner(self) -> None:
        """Stands a floor lamp that shines."""
        stands = self.in_corner("floor lamp")
        if stands is not None:
            x, _, z = stands.place
            self.lamps.append(Lamp((x, stands.height() + 0.05, z), _warm(self.rng, 0.5)))

    def some(self, *names: str) -> None:
        """One of these, or none, at a wall."""
        if self.rng.random() < 0.8:
            self.against_wall(str(self.rng.choice(names)))

    def before(
        self, other: Placed, name: str, gap: float, faces_it: bool = False, with_rug: bool = False
    ) -> Placed | None:
        """Stands a piece before another one."""
        piece = self.draw(name)
        front = max(float(solid.bounds()[1, 2]) for solid in other.solids)
        ahead = front + gap - float(piece.bounds()[0, 2])
        x = other.place[0] + ahead * math.sin(other.yaw)
        z = other.place[2] + ahead * math.cos(other.yaw)
        if with_rug and self.rng.random() < 0.7:
            self.lay_rug(x, z, other.yaw)
        yaw = other.yaw + (math.pi + self.rng.uniform(-0.7, 0.7) if faces_it else self.rng.uniform(-0.06, 0.06))
        return self._stand(piece, x, z, yaw, close=faces_it)

    def beside(self, other: Placed, name: str, side: int, topped: tuple[str, ...]) -> None:
        """Stands a piece beside another one, back to back with it."""
        piece = self.draw(name)
        bounds = np.stack([solid.bounds() for solid in other.solids])
        low, high = bounds[:, 0].min(0), bounds[:, 1].max(0)
        mine = piece.bounds()
        along = side * ((high[0] - low[0]) / 2 + 0.06 + (mine[1, 0] - mine[0, 0]) / 2)
        back = low[2] - mine[0, 2]
        cos, sin = math.cos(other.yaw), math.sin(other.yaw)
        x, z = other.place[0] + along * cos + back * sin, other.place[2] - along * sin + back * cos
        if (stands := self._stand(piece, float(x), float(z), other.yaw)) is not None:
            self._put_on_top(piece, stands, topped)

    def table_with_chairs(self, empty: float = 0.12) -> None:
        """Stands a table in the middle, chairs about it and perhaps a rug under it; a share of the seats is empty."""
        piece, chair = self.draw("table"), self.draw("chair")
        width, _, depth = self.extent
        turn = math.pi / 2 * int(depth > width)
        x, z = (side / 2 + self.rng.uniform(-0.3, 0.3) for side in (width, depth))
        stands = self._stand(piece, x, z, turn)
        if stands is None:
            return
        self._put_on_top(piece, stands, ("vase",))
        if self.rng.random() < 0.5:
            self.lay_rug(x, z, turn)
        (left, _, back), (right, _, front) = piece.bounds()
        seats = [(share * right, front, math.pi) for share in (-0.5, 0.5)]
        seats += [(share * right, back, 0.0) for share in (-0.5, 0.5)]
        seats += [(left, 0.0, math.pi / 2), (right, 0.0, -math.pi / 2)]
        for along, ahead, yaw in seats:
            if self.rng.random() < empty:
                continue
            out = self.rng.uniform(0.02, 0.35)
            along, ahead = along - out * math.sin(yaw), ahead - out * math.cos(yaw)
            cos, sin = math.cos(turn), math.sin(turn)
            place = x + along * cos + ahead * sin, z - along * sin + ahead * cos
            self._stand(chair, *place, turn + yaw + self.rng.uniform(-0.25, 0.25), close=True)

    def lay_rug(self, x: float, z: float, yaw: float) -> None:
        """Lays a rug about a place, as large as fits."""
        width, _, depth = self.extent
        wide, deep = self.rng.uniform(1.8, 3.0), self.rng.uniform(1.3, 2.2)
        turned = abs(math.sin(yaw)) > 0.7
        across, along = (deep, wide) if turned else (wide, deep)
        across, along = min(across, width - 0.4), min(along, depth - 0.4)
        x = min(max(x, across / 2 + 0.15), width - across / 2 - 0.15)
        z = min(max(z, along / 2 + 0.15), depth - along / 2 - 0.15)
        self.placed.append(Placed((rug((across, along)),), (x, 0.0, z), is_walked_on=True))

    def hang_pictures(self, count: int) -> None:
        """Hangs paintings where walls are free at the height of the eyes."""
        frame = wood_color(self.rng) if self.rng.random() < 0.6 else np.full(3, self.rng.choice([0.1, 0.92]))
        color = (float(frame[0]), float(frame[1]), float(frame[2]))
        for number in range(count):
            wall = int(self.rng.integers(WALLS))
            origin, yaw, length = wall_frame(wall, self.extent)
            wide, tall = self.rng.uniform(0.3, 1.0), self.rng.uniform(0.3, 0.8)
            along, up = self.rng.uniform(0.7, length - 0.7), self.rng.uniform(1.45, 1.7)
            left, right = along - wide / 2 - 0.1, along + wide / 2 + 0.1
            if not self._is_hung(wall, left, right) and not self._is_behind(wall, left, right, up - tall / 2):
                picture = hung_picture((along, up), (wide, tall), number % NUM_PAINTINGS, color)
                self.placed.append(Placed(tuple(picture), origin, yaw))
                self.hung.append((wall, left, right))

    def hang_lamp(self) -> None:
        """Hangs a lamp in the middle of the ceiling; in one of five rooms it is off."""
        width, height, depth = self.extent
        x, z = (side / 2 + self.rng.uniform(-0.2, 0.2) for side in (width, depth))
        kind = str(self.rng.choice(["globe", "cone", "disc"]))
        drop = 0.1 if kind == "disc" else self.rng.uniform(0.4, min(0.7, height - 1.95))
        radius = self.rng.uniform(0.14, 0.24)
        is_on = self.rng.random() < 0.8
        color = (0.95, 0.9, 0.8) if kind == "cone" else (1.0, 0.95, 0.86)
        lamp = ceiling_lamp(drop, radius if kind == "disc" else min(radius, 0.45 * drop), kind, color, 2.2 * is_on)
        self.placed.append(Placed(tuple(lamp), (x, height, z)))
        if is_on:
            self.lamps.append(Lamp((x, height - drop - 0.12, z), _warm(self.rng, 1.0)))

    def draw(self, name: str) -> Furniture:
        """A piece, mostly of the materials of the room."""
        finish = self.finish if self.rng.random() < 0.65 else draw_finish(self.rng)
        return self.stock(name, self.rng, replace(finish, cover_color=draw_finish(self.rng).cover_color))

    def _stand(
        self, piece: Furniture, x: float, z: float, yaw: float, close: bool = False, tilt: Floats | None = None
    ) -> Placed | None:
        """Stands a piece at a place if it is free; chairs may reach under tables."""
        placed = Placed.of(piece, (float(x), 0.0, float(z)), yaw, tilt)
        (left, back), (right, front) = placed.footprint()
        width, _, depth = self.extent
        if left < 0.02 or back < 0.02 or right > width - 0.02 or front > depth - 0.02:
            return None
        shrink = 0.3 * min(right - left, front - back) if close else -_GAP
        low, high = np.array([left, back]) + shrink, np.array([right, front]) - shrink
        if any(bool((low < other[1]).all() and (high > other[0]).all()) for other in self.taken):
            return None
        self.taken.append(placed.footprint())
        self.placed.append(placed)
        return placed

    def _put_on_top(self, piece: Furniture, stands: Placed, names: tuple[str, ...]) -> None:
        """Puts at most one of these things on a piece."""
        if not names or self.rng.random() < 0.3:
            return
        name = str(self.rng.choice(names))
        low, high = piece.bounds()
        along = self.rng.uniform(-0.3, 0.3) * float(high[0] - low[0])
        x = stands.place[0] + along * math.cos(stands.yaw)
        z = stands.place[2] - along * math.sin(stands.yaw)
        top = max(float(solid.bounds()[1, 1]) for solid in stands.solids[:1]) if piece.kind != "desk" else high[1]
        thing = Placed.of(self.draw(name), (x, float(top), z), stands.yaw)
        self.placed.append(thing)
        if name == "table lamp":
            self.lamps.append(Lamp((x, thing.height() + 0.04, z), _warm(self.rng, 0.2)))

    def _door_way(self, door: Opening) -> Floats:
        """Where nothing stands before a door: least x and z and greatest x and z."""
        origin, yaw, _ = wall_frame(door.wall, self.extent)
        cos, sin = math.cos(yaw), math.sin(yaw)
        corners = np.array([[x, z] for x in (door.left, door.right) for z in (0.0, _DOOR_ROOM)])
        turned = corners @ np.array([[cos, -sin], [sin, cos]]) + (origin[0], origin[2])
        return np.stack([turned.min(0), turned.max(0)]).astype(np.float32)

    def _hides_opening(self, wall: int, left: float, right: float, top: float) -> bool:
        """Whether what stands at a wall would stand before a window that it is higher than."""
        return any(
            one.wall == wall and left < one.right + 0.1 and right > one.left - 0.1 and top > one.low + 0.05
            for one in self.openings
        )

    def _is_hung(self, wall: int, left: float, right: float) -> bool:
        """Whether something hangs at a stretch of a wall."""
        return any(one == wall and left < end and right > start for one, start, end in self.hung)

    def _is_behind(self, wall: int, left: float, right: float, low: float) -> bool:
        """Whether a stretch of a wall above a height is covered: by an opening, or by what stands before it."""
        if self._hides_opening(wall, left - 0.3, right + 0.3, 10.0):
            return True
        origin, yaw, _ = wall_frame(wall, self.extent)
        cos, sin = math.cos(yaw), math.sin(yaw)
        for placed in self.placed:
            if placed.height() < low:
                continue
            corners = placed.footprint() - np.array([origin[0], origin[2]])
            grid = np.array([[x, z] for x in corners[:, 0] for z in corners[:, 1]])
            along, off = grid @ (cos, -sin), grid @ (sin, cos)
            if off.min() < 0.7 and along.min() < right and along.max() > left:
                return True
        return False


def _warm(rng: _RNG, strength: float) -> tuple[float, float, float]:
    """The light of a lamp."""
    yellow = rng.uniform(0.0, 0.35)
    return strength, strength * (1 - 0.4 * yellow), strength * (1 - yellow)
