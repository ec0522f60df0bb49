"""Photographs of cows that nobody took: one cow each, of any coat and heading, on meadows, in yards and studios.

World: x and y on the ground, z up. The camera stands at x > 0 and looks at the world's middle; the middle of the box
about the cow lies at z = 0, and the ground below its hooves. Lengths have no unit. Colours inside are linear.
Letters: S x S pixels of a picture, R samples of it, V vertices.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from rendra.renderer import Fragments, MeshRasterizer, PerspectiveCameras, RasterizationSettings
from rendra.structures import Meshes
from rendra_lab.records import TensorRecord
from rendra_lab.synthesis import backdrops, cow_herd
from rendra_lab.synthesis.backdrops import Backdrop, Sights, draw_backdrop, linear, sights
from rendra_lab.synthesis.cow_herd import BUILDS, COATS, Cow, PaintedCow, build_cow, painted, stretched
from rendra_lab.synthesis.object_pictures import ObjectPictures
from rendra_lab.synthesis.surface_pictures import to_bytes, toned

EDITION = 2  # of the pictures; another one makes all cached ones anew
DISTANCE = 2.732  # of the camera, from the world's middle
FOV_DEG = 20.0
POLAR = (0.33, 0.45)  # v, least and most: the camera's polar angle is arccos(1 - 2 v)
HALF_LENGTH = (0.17, 0.23)  # of the longest side of the box about a cow, least and most
SPREAD = 0.2  # x and y of the middle of that box, at most

_HALF_WIDTH = math.tan(math.radians(FOV_DEG) / 2)  # of what is seen, at a distance of 1
_SIDE = 2  # samples of a pixel along each of its sides
_FACES_AT_64 = 3000  # of a cow in pictures of 64 x 64
_MOST_FACES = 9000
_APART = 0.33  # of the colours of hair and of what is behind it, sRGB
_TRIES = 12  # at most, of finding a place where a cow stands out
_RNG = np.random.Generator


@dataclass(frozen=True)
class _Camera(TensorRecord):
    """Where it stands, and its axes."""

    eye: Float[Tensor, " 3"]
    axes: Float[Tensor, "3 3"]  # columns: right, up, back

    def rays(self, side: int) -> Float[Tensor, "R 3"]:
        """Through the middles of side x side samples, row by row, one long along the axis."""
        return _rays(side) @ self.axes.T

    def rasterizer(self, side: int) -> MeshRasterizer:
        """Of side x side samples; rendra's axes are x left, y up, z forwards."""
        turn = self.axes * torch.tensor([-1.0, 1.0, -1.0])
        cameras = PerspectiveCameras(1 / _HALF_WIDTH, R=turn[None], T=-(self.eye @ turn)[None])
        return MeshRasterizer(cameras, RasterizationSettings(image_size=side))


@dataclass(frozen=True)
class _Light(TensorRecord):
    """A sun, and light from everywhere."""

    towards: Float[Tensor, " 3"]  # the sun, of length 1
    sun: Float[Tensor, " 3"]
    sky: Float[Tensor, " 3"]
    softness: float  # width of the borders of shadows

    def on(self, normals: Tensor, bounced: Tensor) -> Tensor:
        """That reaches surfaces (R, 3) from the sun, the sky, and the ground."""
        up = 0.5 + 0.5 * normals[:, 2:]
        return self.sun * (normals @ self.towards).clamp_min(0)[:, None] + self.sky * up + bounced * (1 - up)


class CowWorld:
    """Photographs of cows."""

    def settings(self) -> tuple[object, ...]:
        """All but seed and size that determines a picture."""
        return (EDITION, cow_herd.EDITION, backdrops.EDITION)

    @torch.no_grad()
    def pictures(self, seeds: Sequence[int], side: int) -> ObjectPictures:
        """A photograph for each seed.

        Args:
            seeds: of all choices.
            side: S.
        """
        with _one_thread():
            shots = [_photograph(np.random.default_rng(seed), side) for seed in seeds]
        return ObjectPictures(
            rgb=torch.stack([shot.rgb for shot in shots]) if shots else torch.zeros(0, 3, side, side).byte(),
            owners=torch.stack([shot.owners for shot in shots]) if shots else torch.zeros(0, side, side).byte(),
            heading=torch.tensor([[shot.heading] for shot in shots]).reshape(-1, 1),
            kind=torch.tensor([[shot.coat] for shot in shots], dtype=torch.long).reshape(-1, 1),
        )


@dataclass(frozen=True)
class _Shot:
    rgb: Tensor  # (3, S, S) bytes
    owners: Tensor  # (S, S) bytes
    heading: float
    coat: int


def _photograph(rng: _RNG, side: int) -> _Shot:
    """One cow and where it stands."""
    coat = int(rng.integers(len(COATS)))
    cow = painted(stretched(_cow(int(rng.integers(BUILDS)), _faces(side)), rng), list(COATS)[coat], rng)
    place = _fitting_place(cow, rng)
    heading = float(rng.uniform(0, 2 * math.pi))
    size = float(rng.uniform(*HALF_LENGTH))
    x, y = rng.uniform(-SPREAD, SPREAD, 2).tolist()
    turn = torch.tensor([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
    middle = torch.tensor([x, y, 0.0])
    picture, covered = _picture(cow, size, turn, middle, place, rng, side)
    return _Shot(to_bytes(picture), (covered >= 0.5).byte(), heading, coat)


def _picture(
    cow: PaintedCow, size: float, turn: Tensor, middle: Tensor, place: Backdrop, rng: _RNG, side: int
) -> tuple[Tensor, Tensor]:
    """Colours (3, S, S), sRGB, and how much of each pixel is cow (S, S)."""
    camera, light = _camera(rng), _light(rng)
    verts, normals = (_turned(points, turn) for points in (cow.cow.verts, cow.cow.normals))
    verts = size * verts + middle
    floor = float(verts[:, 2].min())
    fine = side * _SIDE
    fallen = verts - light.towards * ((verts[:, 2:] - floor) / light.towards[2])
    fragments = camera.rasterizer(fine)(Meshes([verts, fallen], [cow.cow.faces] * 2))
    shadow = _softened(fragments.pix_to_face[1:, ..., 0] >= 0, light.softness)
    seen = sights(place, camera.eye, camera.rays(fine), floor)
    near = _nearness(seen.place, cow.cow, size, turn, middle)
    radiance = _lit(seen, light, shadow, near)
    bounced = linear(place.ground.colors).mean(0) * 0.5
    up = ((verts[:, 2:] - floor) / (2 * size)).clamp(0, 1)
    below = 0.55 + 0.45 * (up / 0.4).clamp(0, 1)  # between its legs a cow is in its own shadow
    colors = cow.colors.pow(2.2) * light.on(normals, bounced) * below
    hit, shown = _seen_cow(fragments, cow.cow.faces, colors)
    radiance[hit] = shown
    covered = torch.zeros(fine * fine)
    covered[hit] = 1
    samples = torch.cat([toned(radiance), covered[:, None]], 1).T.reshape(1, 4, fine, fine)
    pixels = F.avg_pool2d(samples, _SIDE)[0]
    return pixels[:3], pixels[3]


def _turned(points: Tensor, turn: Tensor) -> Tensor:
    return torch.cat([points[:, :2] @ turn.T, points[:, 2:]], 1)


def _lit(seen: Sights, light: _Light, shadow: Tensor, near: Tensor) -> Tensor:
    """The light (R, 3) that comes from a place, in the shadow of what stands there."""
    direct = light.sun * (seen.normal @ light.towards).clamp_min(0)[:, None]
    around = light.sky * (0.5 + 0.5 * seen.normal[:, 2:])
    on_ground = seen.on_ground.to(shadow)
    open_to_sun, open_to_sky = 1 - on_ground * shadow, 1 - on_ground * near
    return seen.albedo * (direct * open_to_sun[:, None] + around * open_to_sky[:, None]) + seen.glow


def _softened(dark: Tensor, softness: float) -> Tensor:
    """How much of the sun a cow takes from what samples show (R,), of those (1, R/S, R/S) that it takes it from."""
    share = F.avg_pool2d(dark[None].float(), _SIDE)
    reach = max(1, round(softness * share.shape[-1] / 2))
    for _ in range(2):
        share = F.avg_pool2d(share, 2 * reach + 1, stride=1, padding=reach)
    return F.interpolate(share, scale_factor=_SIDE, mode="bilinear").flatten()


def _nearness(places: Tensor, cow: Cow, size: float, turn: Tensor, middle: Tensor) -> Tensor:
    """How much of the sky a cow hides from places of the ground (R,)."""
    own = (places[:, :2] - middle[:2]) @ turn / (size * cow.half_sides[:2])
    return 0.65 * torch.exp(-1.6 * own.square().sum(1))


def _seen_cow(fragments: Fragments, faces: Tensor, colors: Tensor) -> tuple[Tensor, Tensor]:
    """Samples of the first picture that show the cow, and its colours there."""
    face = fragments.pix_to_face[0].flatten()
    hit = (face >= 0).nonzero()[:, 0]
    corners = colors.index_select(0, faces.index_select(0, face[hit]).flatten()).reshape(-1, 3, 3)
    weights = fragments.bary_coords[0].reshape(-1, 3).index_select(0, hit)
    return hit, (weights[..., None] * corners).sum(1)


def _camera(rng: _RNG) -> _Camera:
    """Looks at the world's middle from x > 0."""
    cos = 1 - 2 * float(rng.uniform(*POLAR))
    sin = math.sqrt(1 - cos * cos)
    back = torch.tensor([sin, 0.0, cos])
    axes = torch.stack([torch.tensor([0.0, 1.0, 0.0]), torch.tensor([-cos, 0.0, sin]), back], 1)
    return _Camera(DISTANCE * back, axes)


def _light(rng: _RNG) -> _Light:
    """High, before or beside what is looked at."""
    height, side = math.radians(rng.uniform(48, 78)), math.radians(rng.uniform(-80, 80))
    towards = (math.cos(height) * math.cos(side), math.cos(height) * math.sin(side), math.sin(height))
    clear, warm = rng.uniform(0.35, 0.95), rng.uniform(-0.04, 0.08)
    return _Light(
        towards=torch.tensor(towards),
        sun=float(clear) * torch.tensor([1 + warm, 1.0, 1 - warm]),
        sky=float(1.05 - 0.65 * clear) * torch.tensor([1 - warm / 2, 1.0, 1 + warm / 2]),
        softness=float(rng.uniform(0.03, 0.08)),
    )


def _fitting_place(cow: PaintedCow, rng: _RNG) -> Backdrop:
    """One where the cow stands out; the best one, where none is good enough."""
    best: tuple[float, Backdrop] | None = None
    for _ in range(_TRIES):
        place = draw_backdrop(rng)
        behind = np.stack([place.ground.colors.mean(0), place.wall.colors.mean(0)])
        apart = np.linalg.norm(cow.hair.numpy()[:, None] - behind, axis=-1).max(0).min()
        if best is None or apart > best[0]:
            best = (float(apart), place)
        if apart > _APART:
            break
    assert best is not None
    return best[1]


def _faces(side: int) -> int:
    """Of a cow, for pictures of a side."""
    return min(_MOST_FACES, max(_FACES_AT_64, _FACES_AT_64 * side // 64))


@lru_cache(maxsize=4)
def _rays(side: int) -> Tensor:
    """Through the middles of samples (R, 3), in the camera's axes."""
    across = (2 * (torch.arange(side) + 0.5) / side - 1) * _HALF_WIDTH
    y, x = torch.meshgrid(-across, across, indexing="ij")
    return torch.stack([x, y, -torch.ones_like(x)], -1).reshape(-1, 3)


@contextmanager
def _one_thread() -> Iterator[None]:
    """For what is so small that threads wait for each other longer than they work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@lru_cache(maxsize=BUILDS)
def _cow(number: int, num_faces: int) -> Cow:
    return build_cow(number, num_faces)
