"""Coloured solids on a plane, such as those of CLEVR: cubes, balls and cylinders, of rubber and metal, in two sizes.

After Johnson et al., "CLEVR: A Diagnostic Dataset for Compositional Language and Elementary Visual Reasoning",
CVPR 2017, arXiv:1612.06890; no asset of theirs is used. The world is GIRAFFE's: z up, the camera on a sphere about
the middle at azimuth 0, on the side of +x.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
import torch

from rendra_lab.errors import UserError
from rendra_lab.settings import Amount, Fraction, Range, check_numbers
from rendra_lab.synthesis.object_pictures import ObjectPictures
from rendra_lab.synthesis.traced_solids import Floats, Stage, shown_shares, solid, to_linear, trace

SHAPES = ("cube", "ball", "cylinder")  # by the tracer's numbers
COLORS: Mapping[str, tuple[int, int, int]] = {  # sRGB, CLEVR's
    "gray": (87, 87, 87),
    "red": (173, 35, 35),
    "blue": (42, 75, 215),
    "green": (29, 105, 20),
    "brown": (129, 74, 25),
    "purple": (129, 38, 192),
    "cyan": (41, 208, 208),
    "yellow": (255, 238, 51),
}
MATERIALS = ("rubber", "metal")
SIZES = ("small", "large")

_EDITION = 1  # of this world: another number, other pictures of the same seed
_RADIUS = 2.732  # of the camera's sphere
_CUBE = 1 / math.sqrt(2)  # half of a cube's side, of its size: turned, it takes no more room than the others
_TINTS = [to_linear(np.array(color) / 255) for color in COLORS.values()]
_LAMPS = np.array([[0.78, 3.30, 2.12], [2.84, -1.64, 2.29], [-1.83, 0.81, 3.46]])  # key, fill, back
_POWERS = (14.5, 3.2, 1.8)
_LAMP_JITTER = 0.5  # along each axis
_LAMP_SIDE = 0.3  # half of it
_PATIENCE = 200  # layouts that are drawn before a world is too crowded
_PLACES = 60  # of a solid, before the layout is begun anew
_COARSE = 64  # pixels a side, by which what can be seen is counted

_Field = Annotated[float, Range(1, 150)]
_Samples = Annotated[int, Range(1, 16)]


@dataclass(frozen=True)
class Thing:
    """One solid on the plane."""

    shape: int  # of SHAPES
    color: int  # of COLORS
    material: int  # of MATERIALS
    size: int  # of SIZES
    place: tuple[float, float]
    turn: float  # radians about z

    @property
    def kind(self) -> int:
        """What it is, as one number."""
        return ((self.shape * len(COLORS) + self.color) * len(MATERIALS) + self.material) * len(SIZES) + self.size


def name_of(kind: int) -> str:
    """What a kind is called: "large cyan metal ball".

    Raises:
        ValueError: no such kind.
    """
    if not 0 <= kind < len(SHAPES) * len(COLORS) * len(MATERIALS) * len(SIZES):
        raise ValueError(f"there are 96 kinds of solids, got number {kind}")
    rest, size = divmod(kind, len(SIZES))
    rest, material = divmod(rest, len(MATERIALS))
    shape, color = divmod(rest, len(COLORS))
    return f"{SIZES[size]} {list(COLORS)[color]} {MATERIALS[material]} {SHAPES[shape]}"


class ClevrLike:
    """Scenes of some solids that do not touch, under three lamps, on a grey plane; a seed is a scene.

    Args:
        objects: the fewest and the most solids of a scene; each number is as likely.
        sizes: half of the width of small and large balls and cylinders; cubes are as wide from corner to corner.
        reach: solids' middles lie within +- of it along x and y.
        gap: least distance between the circles that solids take.
        camera_v: range of the camera's height: the polar angle is arccos(1 - 2 v).
        fov_deg: field of view.
        samples: along each side of a pixel.
        least_shown: share of the picture that every solid takes at least.

    Raises:
        UserError: settings that cannot be.
    """

    def __init__(
        self,
        objects: Sequence[int] = (2, 5),
        sizes: Sequence[float] = (0.1, 0.1665),
        reach: Amount = 0.42,
        gap: Amount = 0.04,
        camera_v: Sequence[float] = (0.3, 0.36),
        fov_deg: _Field = 28.0,
        samples: _Samples = 4,
        least_shown: Fraction = 0.004,
    ) -> None:
        _demand_range("objects", objects, 1, 8, whole=True)
        _demand_range("sizes", sizes, 0.01, 1)
        _demand_range("camera_v", camera_v, 0.01, 0.5)
        check_numbers("data.world", Amount, reach=reach, gap=gap)
        check_numbers("data.world", _Field, fov_deg=fov_deg)
        check_numbers("data.world", _Samples, samples=samples)
        check_numbers("data.world", Fraction, least_shown=least_shown)
        self.objects = (objects[0], objects[1])
        self.sizes = (sizes[0], sizes[1])
        self.reach = reach
        self.gap = gap
        self.camera_v = (camera_v[0], camera_v[1])
        self.fov_deg = fov_deg
        self.samples = samples
        self.least_shown = least_shown

    def settings(self) -> tuple[object, ...]:
        """All but seed and size that determines a picture."""
        places = (self.objects, self.sizes, self.reach, self.gap, self.least_shown)
        return (_EDITION, *places, self.camera_v, self.fov_deg, self.samples)

    def pictures(self, seeds: Sequence[int], side: int) -> ObjectPictures:
        """One picture for each seed.

        Raises:
            UserError: solids that find no room where all of them can be seen.
        """
        with ThreadPoolExecutor(max_workers=torch.get_num_threads()) as pool:
            drawn = list(pool.map(lambda seed: self._picture(seed, side), seeds))
        most = self.objects[1]
        kinds = torch.full((len(drawn), most), -1)
        for row, (things, _, _) in enumerate(drawn):
            kinds[row, : len(things)] = torch.tensor([thing.kind for thing in things])
        pictures = np.array([rgb for _, rgb, _ in drawn], np.uint8).reshape(-1, 3, side, side)
        owners = np.array([owner for _, _, owner in drawn], np.uint8).reshape(-1, side, side)
        nowhere = torch.full((len(drawn), most), math.nan)  # a solid of these has no front
        return ObjectPictures(torch.from_numpy(pictures), torch.from_numpy(owners), nowhere, kinds)

    def scene(self, seed: int) -> tuple[list[Thing], Stage]:
        """What a seed's scene is made of.

        Raises:
            UserError: solids that find no room where all of them can be seen.
        """
        generator = np.random.default_rng(seed)
        stage = self._stage(generator)
        count = int(generator.integers(self.objects[0], self.objects[1] + 1))
        for _ in range(_PATIENCE):
            things = self._layout(count, generator)
            if things and shown_shares(self._solids(things), stage, _COARSE).min() >= self.least_shown:
                return things, stage
        raise UserError(
            f"{count} solids find no room where all of them are seen: data.world.reach={self.reach:g} must be more, "
            f"or data.world.sizes={list(self.sizes)} or data.world.least_shown={self.least_shown:g} less"
        )

    def _picture(self, seed: int, side: int) -> tuple[list[Thing], npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
        things, stage = self.scene(seed)
        return things, *trace(self._solids(things), stage, side, self.samples)

    def _layout(self, count: int, generator: np.random.Generator) -> list[Thing]:
        """Solids that do not touch; none where the last ones found no room."""
        things: list[Thing] = []
        for _ in range(count):
            limits = (len(SHAPES), len(COLORS), len(MATERIALS), len(SIZES))
            shape, color, material, size = (int(generator.integers(limit)) for limit in limits)
            for x, y in generator.uniform(-self.reach, self.reach, (_PLACES, 2)).tolist():
                if all(self._is_clear(size, (x, y), other) for other in things):
                    turn = float(generator.uniform(0, 2 * math.pi))
                    things.append(Thing(shape, color, material, size, (x, y), turn))
                    break
            else:
                return []
        return things

    def _is_clear(self, size: int, place: tuple[float, float], other: Thing) -> bool:
        return math.dist(place, other.place) >= self.sizes[size] + self.sizes[other.size] + self.gap

    def _solids(self, things: Sequence[Thing]) -> Floats:
        rows = []
        for thing in things:
            half = self.sizes[thing.size] * (_CUBE if SHAPES[thing.shape] == "cube" else 1)
            tint = _TINTS[thing.color]
            color = (float(tint[0]), float(tint[1]), float(tint[2]))
            rows.append(
                solid(thing.shape, thing.place, half, thing.turn, color, MATERIALS[thing.material] == "metal")
            )
        return np.stack(rows)

    def _stage(self, generator: np.random.Generator) -> Stage:
        shade, warmth = generator.uniform(0.30, 0.42), generator.uniform(-0.015, 0.015)
        far = shade * generator.uniform(0.55, 0.9)
        return Stage(
            camera_to_world=camera_at(generator.uniform(*self.camera_v)),
            fov_deg=self.fov_deg,
            floor=(shade + warmth, shade, shade - warmth),
            backdrop=(far + warmth, far, far - warmth),
            lamps=_LAMPS + generator.uniform(-_LAMP_JITTER, _LAMP_JITTER, (3, 3)),
            powers=_POWERS,
            lamp_side=_LAMP_SIDE,
        )


def camera_at(v: float) -> npt.NDArray[np.float64]:
    """GIRAFFE's camera at azimuth 0 as camera-to-world (4, 4), columns: it looks along its -z at the middle.

    Args:
        v: of its height; the polar angle is arccos(1 - 2 v).
    """
    polar = math.acos(1 - 2 * v)
    back = np.array([math.sin(polar), 0, math.cos(polar)])
    right = np.array([0.0, 1, 0])
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, _RADIUS * back], axis=1)
    return matrix


def _demand_range(name: str, given: Sequence[float], least: float, most: float, whole: bool = False) -> None:
    """Refuse all but two numbers, the lower one first."""
    kind = int if whole else (int, float)
    fits = len(given) == 2 and all(isinstance(each, kind) and least <= each <= most for each in given)
    if not fits or given[0] > given[1]:
        wanted = "whole numbers" if whole else "numbers"
        raise UserError(
            f"data.world.{name} must be two {wanted} from {least:g} to {most:g}, the lower one first, "
            f"got {list(given)}"
        )
