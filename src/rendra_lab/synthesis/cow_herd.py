"""A herd: cows of many builds, and coats that no two of them share.

A cow's own axes: x forwards, y to its left, z up, about the middle of its box. Colours are sRGB in [0, 1].
Letters: V vertices, F faces.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from rendra.structures import Meshes
from rendra_lab.records import TensorRecord
from rendra_lab.synthesis.cow_anatomy import Anatomy, CowParameters
from rendra_lab.synthesis.cow_coat import Coat, CoatParameters
from rendra_lab.synthesis.signed_distance import Array

EDITION = 1  # of the animals and their coats
BUILDS = 12  # cows that differ in more than length, width and height

_PAINTS = ("base", "patch", "muzzle", "horn", "hoof")
_STRETCH = 0.08  # of a cow along each of its axes
_WAVES = 48  # plane waves that a pattern is the sum of
_TO_OWN = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # of the anatomy's axes
_RNG = np.random.Generator
_Color = tuple[float, float, float]


@dataclass(frozen=True)
class Cow(TensorRecord):
    """A cow without a coat, standing; the longest half side of its box is 1."""

    verts: Float[Tensor, "V 3"]
    normals: Float[Tensor, "V 3"]  # outwards, of length 1
    faces: Int[Tensor, "F 3"]
    fixed: Float[Tensor, "V 3"]  # colours that no coat changes: of eyes
    paints: Float[Tensor, "V 5 3"]  # by which base, patch, muzzle, horn and hoof add to that
    half_sides: Float[Tensor, " 3"]  # of its box


@dataclass(frozen=True)
class Look:
    """What a coat is made of: colours, and where the hair has which.

    Attributes:
        base: colour of the hair where the pattern is 0.
        patch: where it is 1, of the ears, and about the eyes.
        pattern: patches, plain, belted or white_faced.
        coverage: share of the body in patches, least and most.
        size: of patches, in halves of the cow's length, least and most.
    """

    base: _Color
    patch: _Color
    pattern: str = "plain"
    coverage: tuple[float, float] = (0.3, 0.6)
    size: tuple[float, float] = (0.3, 0.55)


_CREAM = (0.95, 0.92, 0.86)
COATS = {
    "black_pied": Look(_CREAM, (0.12, 0.105, 0.10), "patches"),
    "red_pied": Look(_CREAM, (0.54, 0.25, 0.12), "patches"),
    "golden_pied": Look((0.97, 0.94, 0.88), (0.80, 0.52, 0.25), "patches"),
    "brown": Look((0.37, 0.21, 0.12), (0.27, 0.15, 0.09)),
    "red": Look((0.57, 0.25, 0.11), (0.46, 0.19, 0.08)),
    "black": Look((0.14, 0.12, 0.12), (0.09, 0.08, 0.08)),
    "white": Look((0.94, 0.92, 0.87), (0.86, 0.83, 0.77)),
    "dun": Look((0.77, 0.58, 0.36), (0.64, 0.46, 0.27)),
    "grey": Look((0.55, 0.56, 0.58), (0.40, 0.41, 0.43)),
    "belted": Look(_CREAM, (0.16, 0.12, 0.11), "belted"),
    "white_faced": Look(_CREAM, (0.53, 0.23, 0.11), "white_faced"),
    "speckled": Look((0.90, 0.88, 0.85), (0.22, 0.18, 0.17), "patches", (0.25, 0.5), (0.09, 0.15)),
}


@dataclass(frozen=True)
class PaintedCow(TensorRecord):
    """A cow in its coat."""

    cow: Cow
    colors: Float[Tensor, "V 3"]
    hair: Float[Tensor, "2 3"]  # its two colours


def build_cow(number: int, num_faces: int) -> Cow:
    """The cow of one of the builds; takes a second.

    Args:
        number: of the build; 0 is the standard animal.
        num_faces: at most, from 2,000 to 60,000.
    """
    anatomy = Anatomy(CowParameters() if number == 0 else CowParameters.random(number))
    points, faces = anatomy.mesh(num_faces)
    fixed, paints = _paints(anatomy, points)
    turned = points @ _TO_OWN.T
    low, high = turned.min(0), turned.max(0)
    verts = torch.from_numpy((turned - (low + high) / 2) * (2 / (high - low).max())).float()
    rows = torch.from_numpy(faces)
    normals = Meshes([verts], [rows]).verts_normals_packed()
    return Cow(verts, normals, rows, fixed, paints, verts.amax(0))


def stretched(cow: Cow, rng: _RNG) -> Cow:
    """The cow, some percent longer, wider or higher."""
    factors = torch.from_numpy(rng.uniform(1 - _STRETCH, 1 + _STRETCH, 3)).float()
    factors = factors / (cow.half_sides * factors).max()
    normals = F.normalize(cow.normals / factors, dim=1)
    return replace(cow, verts=cow.verts * factors, normals=normals, half_sides=cow.half_sides * factors)


def painted(cow: Cow, coat: str, rng: _RNG) -> PaintedCow:
    """The cow in a coat of a kind, whose colours and pattern are its own.

    Args:
        cow: in any build.
        coat: one of COATS.
        rng: makes all choices.
    """
    look = COATS[coat]
    shade = rng.uniform(0.82, 1.2)
    base, patch = (_varied(color, shade, rng) for color in (look.base, look.patch))
    muzzle = _varied((0.93, 0.66, 0.61) if rng.random() < 0.6 else (0.30, 0.24, 0.23), 1.0, rng)
    horn, hoof = _varied((0.88, 0.79, 0.62), 1.0, rng), _varied((0.25, 0.21, 0.19), 1.0, rng)
    colors = torch.from_numpy(np.stack([base, patch, muzzle, horn, hoof])).float()
    in_patch = _pattern(cow.verts, look, rng)[:, None, None] * cow.paints[:, :1]
    paints = torch.cat([cow.paints[:, :1] - in_patch, cow.paints[:, 1:2] + in_patch, cow.paints[:, 2:]], 1)
    return PaintedCow(cow, (cow.fixed + (paints * colors).sum(1)).clamp(0, 1), colors[:2])


def _paints(anatomy: Anatomy, points: Array) -> tuple[Tensor, Tensor]:
    """Colours (V, 3) that stay, and shares (V, 5, 3) of paints: the coat's colours are linear in its paints."""

    def seen(paint: str | None) -> Array:
        base, patch, muzzle, horn, hoof = ((float(paint == name),) * 3 for name in _PAINTS)
        return Coat(anatomy, CoatParameters(base, patch, muzzle, horn, hoof, coverage=0.0), 0, points)(points)

    fixed = seen(None)
    shares = np.stack([seen(paint) - fixed for paint in _PAINTS], 1)
    return torch.from_numpy(fixed).float(), torch.from_numpy(shares).float()


def _varied(color: _Color, shade: float, rng: _RNG) -> Array:
    """Nearly the colour: brighter or darker, and of another hue by a little. Cream keeps its brightness."""
    hue, saturation, value = colorsys.rgb_to_hsv(*color)
    shade = shade if value < 0.85 else 1 - 0.25 * abs(shade - 1)
    value = min(value * shade + float(rng.uniform(-0.02, 0.02)), 1.0)
    saturation = min(saturation * float(rng.uniform(0.85, 1.2)), 1.0)
    return np.array(colorsys.hsv_to_rgb((hue + float(rng.uniform(-0.015, 0.015))) % 1, saturation, max(value, 0.02)))


def _pattern(points: Tensor, look: Look, rng: _RNG) -> Tensor:
    """How much of its second colour hair has (V,)."""
    size = float(rng.uniform(*look.size))
    field = _noise(points, size, rng)
    x, z = points[:, 0], points[:, 2]
    if look.pattern == "patches":
        level = torch.quantile(field, 1 - float(rng.uniform(*look.coverage)))
        return _step((field - level) * size)
    if look.pattern == "belted":
        middle, half = rng.uniform(-0.25, -0.05), rng.uniform(0.14, 0.24)
        return _step((x - float(middle)).abs() - float(half) + 0.03 * field)
    if look.pattern == "white_faced":
        face = 0.62 + 0.03 * field - x
        belly = z + 0.28 - 0.06 * field
        return _step(torch.minimum(face, belly))
    return (0.35 * field).clamp(0, 0.7)


def _step(distance: Tensor) -> Tensor:
    """0 below 0 and 1 above, with a soft border."""
    return torch.sigmoid(distance / 0.02)


def _noise(points: Tensor, size: float, rng: _RNG) -> Tensor:
    """A random field (V,) on points, of standard deviation near 1 and of one typical length."""
    waves = rng.normal(size=(_WAVES, 3))
    waves *= np.pi / size * rng.normal(1.0, 0.22, (_WAVES, 1)) / np.linalg.norm(waves, axis=1, keepdims=True)
    phases = rng.uniform(0, 2 * np.pi, _WAVES)
    angles = points @ torch.from_numpy(waves).float().T + torch.from_numpy(phases).float()
    return angles.cos().sum(1) * (2 / _WAVES) ** 0.5
