"""Pictures of single pieces of furniture, as R2N2's of ShapeNet: from a little above, on a plain ground.

Choy et al., "3D-R2N2", ECCV 2016, and Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, whose camera it is.
The diagonal of the box about a piece has the length 1, and the camera looks at the middle of that box.
Axes of cameras are OpenCV's: x right, y down, z forwards. Pieces: y up, metres. Letters: V views, H x W pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn import functional as F

from rendra.structures import Meshes
from rendra_lab.records import TensorRecord
from rendra_lab.synthesis.baked_light import Blockers, Lights, bake, openness
from rendra_lab.synthesis.furniture import CLASSES, NAMES, Furniture, draw
from rendra_lab.synthesis.lit_solids import lit_surfaces
from rendra_lab.synthesis.rooms import look
from rendra_lab.synthesis.rooms_surfaces import hue_color, linear_color, paint_surfaces
from rendra_lab.synthesis.solid_shapes import SolidShape, shape_of
from rendra_lab.synthesis.solids import Floats, Solid, weld
from rendra_lab.synthesis.surface_pictures import LitSurfaces, shade, to_bytes
from rendra_lab.synthesis.texture_pyramid import TexturePyramid

EDITION = 2  # of the pictures and shapes; another one makes all cached ones anew
FOCAL = 2.1875  # in halves of the picture's height: 35 mm before a sensor of 32 mm, as in R2N2's Blender
DEPTH_RANGE = (0.8, 2.25)  # of pieces whose boxes have a diagonal of 1, at the distances below

_DISTANCE = (1.3, 1.75)  # as R2N2's, but for those so near that pieces leave the picture
_ELEVATION_DEG = (25.0, 30.0)
# degrees that the camera is turned away from the front at most: from behind these are boxes like any other
_TURN_DEG = {"bookcase": 70.0, "wardrobe": 70.0, "cupboard": 70.0, "nightstand": 70.0, "desk": 110.0}
_SIDE = 2  # samples of a pixel along each of its sides
_PALETTES = 4  # sets of painted materials
_LIT_M = 2.0  # diagonal of pieces while they are lit: shadows are as sharp in all of them
_STUDIO_M = 20.0  # of the studio's sides: its walls are far away
_WHITE = 0.5  # share of the pieces that stand before white
_EXPOSURE = (0.5, 0.7)  # mean light on a piece of middling lightness
_MIDDLING, _ADAPTED = 0.25, 0.35  # reflectance, and the power of its inverse that light follows, as cameras do
_RNG = np.random.Generator


@dataclass(frozen=True)
class FurnitureViews(TensorRecord):
    """One piece, its shape, and V pictures of it."""

    rgb: UInt8[Tensor, "V 3 H W"]  # sRGB
    intrinsics: Float[Tensor, "3 3"]  # pixels, of all views
    own_to_camera: Float[Tensor, "V 4 4"]  # columns; the axes of the piece, metres, to the camera's of unit diagonals
    label: Int[Tensor, ""]  # row of furniture.CLASSES
    shape: SolidShape  # in the axes of the piece


class FurnitureStudio:
    """Takes pictures of pieces that nobody has seen before; the same seed, the same piece and pictures.

    Args:
        size: H and W of the pictures.
        cells: along each side of the grids of shapes.
        points: on the surface of each shape.
    """

    def __init__(self, size: tuple[int, int], cells: int, points: int) -> None:
        self.size = size
        self.cells = cells
        self.points = points
        self._palettes: dict[int, TexturePyramid] = {}

    def piece(self, seed: int, kind: str) -> Furniture:
        """The piece of a seed.

        Args:
            seed: of all that is drawn.
            kind: of furniture.CLASSES.

        Raises:
            ValueError: a class of nothing.
        """
        if kind not in CLASSES:
            raise ValueError(f"no furniture is of the class {kind!r}; there are: {', '.join(CLASSES)}")
        rng = np.random.default_rng([seed, 1])
        return draw(str(rng.choice(names_of(kind))), rng)

    @torch.no_grad()
    def views(self, seed: int, kind: str, count: int) -> FurnitureViews:
        """The piece of a seed from V sides, in a light and before a ground of its own.

        Args:
            seed: of all that is drawn; a smaller count takes the first of the same views.
            kind: of furniture.CLASSES.
            count: V.
        """
        piece = self.piece(seed, kind)
        low, high = piece.bounds().astype(np.float64)
        to_unit = torch.eye(4, dtype=torch.float64) / float(np.linalg.norm(high - low))
        to_unit[:3, 3] = -to_unit[0, 0] * torch.from_numpy((low + high) / 2)
        to_unit[3, 3] = 1
        rng, eyes = np.random.default_rng([seed, 2]), np.random.default_rng([seed, 3])
        surfaces = _lit(piece, to_unit, rng)
        pictures = self._palette(int(rng.integers(_PALETTES)))
        ground = _ground(self.size, rng)
        poses = [_pose(eyes, _TURN_DEG.get(piece.name, 180.0)) for _ in range(count)]
        rgb = [self._picture(surfaces, pictures, pose, ground) for pose in poses]
        verts, faces, _ = weld(piece.solids)
        generator = torch.Generator().manual_seed(seed)
        return FurnitureViews(
            rgb=torch.stack(rgb) if rgb else torch.zeros((0, 3, *self.size), dtype=torch.uint8),
            intrinsics=self.intrinsics(),
            own_to_camera=torch.stack([(pose.double() @ to_unit).float() for pose in poses])
            if poses
            else torch.zeros(0, 4, 4),
            label=torch.tensor(CLASSES.index(kind)),
            shape=shape_of(torch.from_numpy(verts), torch.from_numpy(faces), self.cells, self.points, generator),
        )

    def intrinsics(self) -> Float[Tensor, "3 3"]:
        """Of all pictures, pixels."""
        height, width = self.size
        focal = FOCAL * height / 2
        return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])

    def _picture(self, surfaces: LitSurfaces, pictures: TexturePyramid, pose: Tensor, ground: Tensor) -> Tensor:
        """Before a ground (3, H, W), sRGB."""
        fine = (_SIDE * self.size[0], _SIDE * self.size[1])
        samples = torch.tensor([_SIDE, _SIDE, 1.0])[:, None] * self.intrinsics()
        shown = shade(surfaces, pictures, Meshes([surfaces.verts], [surfaces.faces]), samples, pose, fine)
        seen = F.avg_pool2d(torch.cat([shown, (shown > 0).any(0, keepdim=True).float()])[None], _SIDE)[0]
        return to_bytes(seen[:3] + (1 - seen[3:]) * ground)

    def clear(self) -> None:
        """Forgets the painted materials, 17 MiB a set; they are painted anew when they are needed."""
        self._palettes.clear()

    def _palette(self, number: int) -> TexturePyramid:
        if number not in self._palettes:
            self._palettes[number] = paint_surfaces(np.random.default_rng([number, 4]))
        return self._palettes[number]


@lru_cache(maxsize=len(CLASSES))
def names_of(kind: str) -> tuple[str, ...]:
    """What a class of furniture.CLASSES consists of, of furniture.NAMES."""
    return tuple(name for name in NAMES if draw(name, np.random.default_rng(0)).kind == kind)


def _pose(rng: _RNG, turn_deg: float) -> Tensor:
    """World to camera (4, 4) of an eye about the origin, turned away from the front, +z, by so much at most."""
    yaw = math.pi + math.radians(rng.uniform(-turn_deg, turn_deg))
    pitch = -math.radians(rng.uniform(*_ELEVATION_DEG))
    distance = rng.uniform(*_DISTANCE)
    forward = (math.sin(yaw) * math.cos(pitch), math.sin(pitch), math.cos(yaw) * math.cos(pitch))
    return look(np.array([-distance * way for way in forward], np.float32), yaw, pitch, 0.0)


def _lit(piece: Furniture, to_unit: Tensor, rng: _RNG) -> LitSurfaces:
    """The piece about the origin, of unit diagonal, in the light of three lamps and pale walls."""
    stand = (_STUDIO_M / 2, 0.0, _STUDIO_M / 2)
    size = _LIT_M * float(to_unit[0, 0])
    low, high = piece.bounds()
    middle = (low + high) / 2
    solids = [_scaled(solid, size, (middle[0], low[1], middle[2]), stand) for solid in piece.solids]
    boxes = [solid.bounds().reshape(-1) for solid in solids if solid.casts and not solid.glow]
    blockers = Blockers.of([(np.stack(boxes), 0.0, (0.0, 0.0, 0.0))] if boxes else [])
    points, normals = (np.concatenate([getattr(solid, name) for solid in solids]) for name in ("points", "normals"))
    direct = bake(points, normals, _lamps(stand, rng), blockers)
    around = openness(points, normals, 0, (_STUDIO_M,) * 3, blockers)
    light = direct / direct.mean() + around[:, None] * np.float32(rng.uniform(0.8, 1.4))
    counts = [len(solid.points) for solid in solids]
    reflected = np.average([float(linear_color(solid.color).mean()) for solid in solids], weights=counts)
    adapted = np.clip((_MIDDLING / max(reflected, 1e-3)) ** _ADAPTED, 0.8, 1.8)
    light *= np.float32(rng.uniform(*_EXPOSURE) * adapted / light.mean())
    glow = np.repeat(np.array([solid.glow for solid in solids], np.float32), counts)
    surfaces = lit_surfaces(solids, np.where(glow[:, None] > 0, glow[:, None], light).astype(np.float32))
    center = torch.tensor([stand[0], size * float(high[1] - low[1]) / 2, stand[2]])
    return replace(surfaces, verts=(surfaces.verts - center) / _LIT_M, scale=surfaces.scale * _LIT_M)


def _scaled(solid: Solid, size: float, foot: tuple[float, float, float], stand: tuple[float, float, float]) -> Solid:
    """A solid made larger or smaller, its piece moved by its foot to a stand."""
    points = (solid.points - np.array(foot, np.float32)) * np.float32(size) + np.array(stand, np.float32)
    return replace(solid, points=points.astype(np.float32))


def _lamps(stand: tuple[float, float, float], rng: _RNG) -> Lights:
    """A large lamp above one side, a weaker one at the other, and a weak one between: four small ones each."""
    places, colors = [], []
    turn = rng.uniform(-math.pi, math.pi)
    for off, height, strength in ((0.0, rng.uniform(3.0, 5.0), 1.0), (2.2, 2.5, 0.45), (-2.0, 3.0, 0.3)):
        angle = turn + off + rng.uniform(-0.3, 0.3)
        warm = rng.uniform(-0.05, 0.05)
        for x, z in ((0.25, 0.1), (-0.1, 0.25), (-0.25, -0.1), (0.1, -0.25)):
            place: Floats = np.array([3.5 * math.sin(angle) + x, height, 3.5 * math.cos(angle) + z], np.float32)
            places.append(place + np.array(stand, np.float32))
            colors.append(np.array([1 + warm, 1.0, 1 - warm], np.float32) * np.float32(strength))
    return Lights(np.stack(places), np.stack(colors), np.zeros((len(places), 3), np.float32))


def _ground(size: tuple[int, int], rng: _RNG) -> Tensor:
    """White, or a colour that pales a little from one edge to the other: (3, H, W), sRGB."""
    is_white = rng.random() < _WHITE
    color = np.ones(3) if is_white else hue_color(rng, 0.5 * rng.random() ** 2, rng.uniform(0.45, 0.98))
    tilt = rng.uniform(-0.12, 0.12, 2)
    y, x = (torch.linspace(-1, 1, side) for side in size)
    slope = 1 + 0.5 * (float(tilt[0]) * y[:, None] + float(tilt[1]) * x)
    return (
        (torch.from_numpy(color.astype(np.float32))[:, None, None] * (1 if is_white else slope))
        .expand(3, *size)
        .clamp(0, 1)
    )
