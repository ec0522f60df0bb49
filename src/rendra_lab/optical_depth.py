"""How deep a point lies in the matter of a radiance field: what light from outside still reaches it.

The depth of a point is the least optical depth of any path that leads to it from outside,

    tau(x) = min over paths of the integral of sigma along the path,    |grad tau| = sigma,    tau = 0 outside,

and exp(-tau) is the share of light that comes through. Straight into a body the clearest path runs along the normal,
so a level of exp(-tau) is where so much of the light of a ray that meets the surface head-on is left, however dense
the field is behind it. Hollows that no light enters are deep, not empty.

Photographs fix outlines: where half of the light of a ray that grazes a body is stopped. Such a ray stays long in the
soft skin of a fitted body, so that one that comes head-on has most of its light left as deep as that. How much, the
field itself says: `silhouette_level`. For a hard surface all levels are in one place.

The eikonal equation is solved with Godunov's upwind differences (Rouy & Tourin, "A viscosity solutions approach to
shape-from-shading", 1992) on a coarse lattice, then on finer ones near the surface alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.networks.radiance import RadianceScene

COARSEST = 80  # cells along the longest side, at most, of the lattice that is filled everywhere
_POINTS_AT_ONCE = 1 << 17
_DEEPEST = 7.0  # optical depth at which a path is followed no further
_CORE = 0.5  # of light: what nowhere stops more is haze, no body
_HAZE = 1.0  # optical depth: matter of which the whole box would be no deeper is no body
_LEVELS = (0.3, 0.99)  # of light, that a silhouette may ask for
_FAINT = 0.1  # of the wanted depth: matter of a cell that may be more, seen closely

_CORNERS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))  # of a tetrahedron

Density = Callable[[Tensor], Tensor]


def density_of(scene: RadianceScene, step: float, spread: float = 0.0) -> Density:
    """The density (M,), 1/length, about points (M, 3): of matter as opaque as a step of the scene.

    It is 0 out of the box, and in haze: where a box full of such matter would let 1 / e of the light through.

    Args:
        scene: to ask.
        step: thickness by which the scene is asked for opacities, in world units.
        spread: the density is the mean over four points around, so far from each coordinate, world units. Fields
            that are finer than the lattice show pits and grains between its points otherwise.
    """
    low, high = scene.box
    haze = _HAZE / float((high - low).amax())
    around = low.new_tensor(_CORNERS) * spread if spread > 0 else torch.zeros_like(low)[None]

    def density(points: Tensor) -> Tensor:
        found = points.new_zeros(len(points))
        inside = ((points >= low) & (points <= high)).all(1).nonzero()[:, 0]
        for rows in inside.split(_POINTS_AT_ONCE // len(around)):
            spots = (points.index_select(0, rows) + around[:, None]).clamp(low, high).view(-1, 3)
            opacity = scene.opacity_at(spots, step).to(points.dtype).view(len(around), -1).nan_to_num(0.0).mean(0)
            sigma = -torch.log1p(-opacity.clamp(0, 1 - 1e-7)) / step
            found[rows] = torch.where(sigma < haze, 0, sigma)
        return found

    return density


@dataclass(frozen=True)
class Lattice:
    """Points in space at equal distances.

    Attributes:
        low: (3,) the first point.
        spacing: distance of neighbours, world units.
        shape: number of points along x, y and z.
    """

    low: Tensor
    spacing: float
    shape: tuple[int, int, int]

    @staticmethod
    def around(box: Tensor, spacing: float) -> Lattice:
        """One whose outermost points all lie outside a box (2, 3)."""
        cells = ((box[1] - box[0]) / spacing - 1e-4).ceil().clamp_min(1) + 2
        low = box.mean(0) - cells / 2 * spacing
        width, height, depth = (int(count) + 1 for count in cells.tolist())
        return Lattice(low, spacing, (width, height, depth))

    @property
    def strides(self) -> tuple[int, int, int]:
        """How far neighbours along x, y and z are apart in a flat list of the points."""
        return self.shape[1] * self.shape[2], self.shape[2], 1

    def finer(self) -> Lattice:
        """The lattice with a point between each two."""
        width, height, depth = (2 * count - 1 for count in self.shape)
        return Lattice(self.low, self.spacing / 2, (width, height, depth))

    def points(self, index: Tensor) -> Tensor:
        """Where points stand, given by their numbers (M,) in the flat list: (M, 3)."""
        along_x, along_y, _ = self.strides
        places = torch.stack([index // along_x, index // along_y % self.shape[1], index % self.shape[2]], 1)
        return self.low + places.to(self.low.dtype) * self.spacing

    def nearest(self, points: Tensor) -> Tensor:
        """The numbers (M',) of the lattice's points nearest to points (M, 3), of those that lie within it."""
        places = ((points - self.low) / self.spacing).round().long()
        size = torch.tensor(self.shape, device=points.device)
        places = places[((places >= 0) & (places < size)).all(1)]
        return (places * torch.tensor(self.strides, device=points.device)).sum(1)

    def rim(self) -> Tensor:
        """Which points are outermost: (x, y, z) bool."""
        outer = torch.ones(self.shape, dtype=torch.bool, device=self.low.device)
        outer[1:-1, 1:-1, 1:-1] = False
        return outer


@dataclass(frozen=True)
class LightFromOutside:
    """The share of light from outside that comes through to the points of a lattice.

    Attributes:
        lattice: the points.
        light: (x, y, z) in [0, 1]; right near the core's level, elsewhere on the right side of it.
        level: in (0, 1), of the surface.
    """

    lattice: Lattice
    light: Tensor
    level: float

    @property
    def core(self) -> float:
        """The level of what is surely a body: half, or that of the surface if that is less."""
        return min(self.level, _CORE)


@torch.no_grad()
def light_from_outside(
    density: Density, box: Tensor, resolution: int, level: float | None = None, viewpoints: Tensor | None = None
) -> LightFromOutside:
    """Solves for the light on a lattice of `resolution` cells along the longest side of a box, exactly near a level.

    Args:
        density: 1/length of points (M, 3), see `density_of`.
        box: (2, 3) around all matter.
        resolution: cells along its longest side.
        level: the share of light, in (0, 1), near which the answer has to be right; None: see `silhouette_level`.
        viewpoints: (P, 3) further places that light comes from, such as cameras within the box.
    """
    spacing = float((box[1] - box[0]).amax()) / resolution
    halvings = max(0, math.ceil(math.log2(resolution / COARSEST)))
    lattice = Lattice.around(box, spacing * 2**halvings)
    depth = torch.full(lattice.shape, torch.inf, device=box.device)
    rows = (~lattice.rim()).flatten().nonzero()[:, 0]
    matter = _solve(density, lattice, depth, rows, viewpoints)
    if level is None:
        level = silhouette_level(depth, matter)
    wanted = -math.log(min(level, _CORE))
    for _ in range(halvings):
        marked = _near_surface(depth, matter > _FAINT * wanted, wanted)
        lattice, depth, rows = _divide(lattice, depth, marked, wanted)
        matter = _solve(density, lattice, depth, rows, viewpoints)
    return LightFromOutside(lattice, torch.exp(-depth), level)


def silhouette_level(depth: Tensor, matter: Tensor) -> float:
    """The level at which a surface has the outline that the field shows, in area, seen along x, y and z from afar.

    The field covers a pixel where it stops more than half of the light there; the surface of a level does where any
    point on the ray has less light than it. As many pixels are covered either way.

    Args:
        depth: (x, y, z) optical depth of a lattice's points.
        matter: (x, y, z) the part of it between neighbours.
    """
    light = torch.exp(-(depth - matter / 2).clamp_min(0))  # a point's own matter is half behind it
    covered = torch.cat([(matter.sum(axis) > math.log(2)).flatten() for axis in range(3)])
    least = torch.cat([light.amin(axis).flatten() for axis in range(3)]).sort().values
    count = int(covered.sum())
    if count == 0:
        return 0.5
    return float(least[count - 1 : count + 1].mean().clamp(*_LEVELS))


def _solve(density: Density, lattice: Lattice, depth: Tensor, rows: Tensor, viewpoints: Tensor | None) -> Tensor:
    """Finds the depth (x, y, z) of the points in `rows`, in place, from the others, which are known.

    Returns:
        The optical depth of the matter between neighbours, 0 at the points that are known: (x, y, z).
    """
    depth[lattice.rim()] = 0
    flat = depth.view(-1)
    if viewpoints is not None:
        flat[lattice.nearest(viewpoints.to(flat))] = 0
    matter = density(lattice.points(rows)) * lattice.spacing
    _relax(flat, lattice.strides, rows, matter, _DEEPEST)
    return torch.zeros_like(flat).index_copy(0, rows, matter).view_as(depth)


def _relax(flat: Tensor, strides: tuple[int, int, int], rows: Tensor, matter: Tensor, deepest: float) -> None:
    """Lowers depths until none changes; only points beside a change are looked at again."""
    number = torch.full_like(flat, -1, dtype=torch.int32)
    number[rows] = torch.arange(len(rows), dtype=torch.int32, device=rows.device)
    beside = torch.tensor([offset * sign for offset in strides for sign in (1, -1)], device=rows.device)
    upwind = [torch.minimum(flat[rows - offset], flat[rows + offset]) for offset in strides]
    moving = torch.stack(upwind).amin(0).isfinite().nonzero()[:, 0]
    while len(moving):
        places = rows[moving]
        upwind = [torch.minimum(flat[places - offset], flat[places + offset]) for offset in strides]
        found = _godunov(torch.stack(upwind), matter[moving])
        lower = found < flat[places] - 1e-4
        places = places[lower]
        flat[places] = found[lower]
        spreading = places[found[lower] < deepest]
        touched = number[(spreading[:, None] + beside).view(-1)].long()
        again = torch.zeros(len(rows), dtype=torch.bool, device=rows.device)
        again[touched[touched >= 0]] = True
        moving = again.nonzero()[:, 0]


def _godunov(upwind: Tensor, matter: Tensor) -> Tensor:
    """The depth whose upwind differences from (3, M) neighbours have the length `matter` (M,)."""
    a, b, c = upwind.sort(0).values
    one = a + matter
    two = (a + b + (2 * matter**2 - (b - a) ** 2).clamp_min(0).sqrt()) / 2
    total = a + b + c
    three = (total + (total**2 - 3 * (a**2 + b**2 + c**2 - matter**2)).clamp_min(0).sqrt()) / 3
    return torch.where(one <= b, one, torch.where(two <= c, two, three))


def _near_surface(depth: Tensor, faint: Tensor, wanted: float) -> Tensor:
    """Which points are so near the wanted depth, or to matter seen too coarsely, that more is needed: (x, y, z)."""
    deep = (depth > wanted).to(torch.float32)[None, None]
    mixed = F.max_pool3d(deep, 3, 1, 1) != -F.max_pool3d(-deep, 3, 1, 1)
    return mixed[0, 0] | (faint & (depth <= wanted))


def _divide(lattice: Lattice, depth: Tensor, marked: Tensor, wanted: float) -> tuple[Lattice, Tensor, Tensor]:
    """The finer lattice, its depths where they are known, infinite elsewhere, and the rows of the unknown ones."""
    finer = lattice.finer()
    light = torch.exp(-depth)
    known = -torch.log(_between(light, finer.shape))
    known[known > wanted] = torch.inf
    open_ = (_between(marked.to(light.dtype), finer.shape) > 0) & ~finer.rim()
    known[open_] = torch.inf
    return finer, known, open_.view(-1).nonzero()[:, 0]


def _between(values: Tensor, shape: tuple[int, int, int]) -> Tensor:
    return F.interpolate(values[None, None], shape, mode="trilinear", align_corners=True)[0, 0]
