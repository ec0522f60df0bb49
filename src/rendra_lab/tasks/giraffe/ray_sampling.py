"""Where along its rays a scene is looked at, and what its densities there let through.

Letters: R rays of all pictures, T boxes of all scenes, L pieces of rays with K samples each.
A depth is measured along the view; lengths are those of the world.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.settings import Amount, Positive, Size
from rendra_lab.tasks.giraffe.camera_sampler import Rays
from rendra_lab.tasks.giraffe.composition import clear, per_density, seen, walled
from rendra_lab.tasks.giraffe.records import Boxes

_TINY = 1e-20  # part of a direction along an axis that counts as none


class OwnRays(NamedTuple):
    """Rays in the spaces of boxes, and where they pass through."""

    origins: Float[Tensor, "T 3"]
    directions: Float[Tensor, "T P 3"]  # the depth at a point is the same as in the world
    enter: Float[Tensor, "T P"]  # depths; not before leave: the box is missed
    leave: Float[Tensor, "T P"]


class Pieces(NamedTuple):
    """Pieces of rays within things, or through the background."""

    ray: Int[Tensor, " L"]  # b P + p
    thing: Int[Tensor, " L"]  # b N + n; of the background b
    depths: Float[Tensor, "L K"]
    lengths: Float[Tensor, "L K"]  # of the world that each sample stands for
    inside: Bool[Tensor, "L K"]  # whether it is in the thing's box; those that are come first
    slot: Int[Tensor, "L K"]  # which of its ray's samples: things at one depth may share one


class Samples(NamedTuple):
    """All that is looked at."""

    objects: Pieces
    background: Pieces  # one for each ray, in the rays' order


class Sampling(ABC):
    """Chooses samples, and weighs them by what is in front of them.

    Args:
        padding: boxes are looked into so far beyond their sides, in their own units.
    """

    padding: float

    @abstractmethod
    def samples(self, rays: Rays, own: OwnRays, exists: Tensor, noise: torch.Generator | None) -> Samples:
        """Samples of rays; with noise their depths are random within their strata.

        Args:
            rays: of B pictures.
            own: the same in B N boxes.
            exists: bool (B, N); nothing looks into a box that does not.
            noise: where to draw from.
        """

    @abstractmethod
    def clear(self, samples: Samples, objects: Tensor, background: Tensor) -> Tensor:
        """How much passes what is in front of each sample (R, Kb) of the background; arguments as of `weights`."""

    @abstractmethod
    def weights(self, samples: Samples, objects: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
        """How much each sample is seen, (L, K) of the objects' and (R, Kb) of the background's.

        The sum over a ray is at most 1. Densities are not negative.
        """

    @abstractmethod
    def alone(self, pieces: Pieces, densities: Tensor) -> Tensor:
        """Opacity (L,) of objects' pieces with nothing else in the world."""


class DenseSampling(Sampling):
    """The same depths for everything, as in the published code; where several things are, densities are summed.

    A box is evaluated only where these depths are within it: elsewhere its density is 0 anyway.

    Args:
        count: strata.
        near, far: depths of the first and the last.
        padding: see Sampling.
        last_length: of the last sample, length units; published: 1e10, which is a wall where a density is above 0,
            and a hole where none is. None: a wall everywhere, and the background's.

    Raises:
        UserError: numbers that cannot be.
    """

    def __init__(
        self,
        count: Positive = 64,
        near: Size = 0.5,
        far: Size = 6.0,
        padding: Amount = 0.1,
        last_length: Size | None = None,
    ) -> None:
        if count < 2 or not 0 < near < far:
            raise UserError(
                f"sampling needs two strata or more and near below far, got count={count}, near={near}, far={far}"
            )
        self.count, self.near, self.far, self.padding, self.last_length = count, near, far, padding, last_length

    def samples(self, rays: Rays, own: OwnRays, exists: Tensor, noise: torch.Generator | None) -> Samples:
        """See Sampling."""
        batch, pixels = rays.directions.shape[:2]
        depths = self._depths(batch * pixels, rays.directions, noise)
        stretch = rays.directions.flatten(0, 1).norm(dim=-1, keepdim=True)
        lengths = depths.diff(dim=1) * stretch
        last = self.last_length if self.last_length is not None else 0.0  # a wall needs no length
        lengths = torch.cat([lengths, torch.full_like(stretch, last) * stretch], 1)
        slots = torch.arange(self.count, device=depths.device).expand_as(depths)
        every = torch.arange(batch * pixels, device=depths.device)
        background = Pieces(every, every // pixels, depths, lengths, torch.ones_like(slots, dtype=torch.bool), slots)
        thing, ray, enter, leave = _hits(own, exists)
        first = (depths.index_select(0, ray) < enter[:, None]).sum(1)
        behind = (depths.index_select(0, ray) <= leave[:, None]).sum(1)
        most = int((behind - first).max()) if len(ray) else 0
        slot = first[:, None] + torch.arange(most, device=ray.device)
        inside = slot < behind[:, None]
        slot = slot.clamp_max(self.count - 1)
        flat = (ray[:, None] * self.count + slot).flatten()
        depth, length = (each.flatten().index_select(0, flat).view_as(slot) for each in (depths, lengths))
        return Samples(Pieces(ray, thing, depth, length, inside, slot), background)

    def weights(self, samples: Samples, objects: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
        """See Sampling: a sample's weight is divided among the things there as their densities are."""
        total = self._total(samples, objects, background)
        thickness = total * samples.background.lengths
        weights = seen(thickness if self.last_length is not None else walled(thickness))
        share = per_density(weights, total)
        of_background = background * share
        if self.last_length is None:
            share = F.pad(share[:, :-1], (0, 1))
            of_background = torch.cat([of_background[:, :-1], weights[:, -1:]], 1)
        return objects * share.flatten().index_select(0, self._flat(samples.objects)).view_as(objects), of_background

    def clear(self, samples: Samples, objects: Tensor, background: Tensor) -> Tensor:
        """See Sampling."""
        return clear(self._total(samples, objects, background) * samples.background.lengths)

    def alone(self, pieces: Pieces, densities: Tensor) -> Tensor:
        """See Sampling; the last stratum has no length then, as in the published code."""
        last = pieces.slot == self.count - 1
        return -torch.expm1(-(densities * pieces.lengths).masked_fill(last, 0.0).sum(1))

    def _total(self, samples: Samples, objects: Tensor, background: Tensor) -> Tensor:
        """Densities (R, K) of all things together."""
        total = background.flatten().index_add(0, self._flat(samples.objects), objects.flatten())
        return total.view_as(background)

    def _flat(self, pieces: Pieces) -> Tensor:
        return (pieces.ray[:, None] * self.count + pieces.slot).flatten()

    def _depths(self, rays: int, like: Tensor, noise: torch.Generator | None) -> Tensor:
        depths = torch.linspace(self.near, self.far, self.count, device=like.device, dtype=like.dtype)
        if noise is None:
            return depths.expand(rays, -1)
        middles = (depths[1:] + depths[:-1]) / 2
        low, high = torch.cat([depths[:1], middles]), torch.cat([middles, depths[-1:]])
        return low + (high - low) * _uniform((rays, self.count), noise, like)


class BoxSampling(Sampling):
    """A few depths in each box that a ray passes through, and a few in the background, each with its own length.

    What a ray meets at different depths hides what is behind it: the transmittance in front of a sample is
    exp(-sum of density times length) over all samples before it, whosever they are. Rays that miss a box cost
    nothing. The background's last sample is a wall.

    Args:
        in_box: samples between where a ray enters and leaves a box.
        in_background: samples of each ray.
        near, far: depths between which the background is.
        padding: see Sampling.
        shaken_background: depths in the background are random in training, too: what is finer than their distance
            is averaged away then.

    Raises:
        UserError: numbers that cannot be.
    """

    def __init__(
        self,
        in_box: Positive = 12,
        in_background: Positive = 6,
        near: Amount = 0.5,
        far: Size = 6.0,
        padding: Amount = 0.1,
        shaken_background: bool = False,
    ) -> None:
        if in_box < 1 or in_background < 1 or not 0 <= near < far:
            raise UserError(
                f"sampling needs a sample or more of each and near below far, got in_box={in_box}, "
                f"in_background={in_background}, near={near}, far={far}"
            )
        self.in_box, self.in_background, self.near, self.far, self.padding = in_box, in_background, near, far, padding
        self.shaken_background = shaken_background

    def samples(self, rays: Rays, own: OwnRays, exists: Tensor, noise: torch.Generator | None) -> Samples:
        """See Sampling."""
        batch, pixels = rays.directions.shape[:2]
        stretch = rays.directions.flatten(0, 1).norm(dim=-1)
        every = torch.arange(batch * pixels, device=stretch.device)
        background = self._pieces(
            every, every // pixels, torch.full_like(stretch, self.near), torch.full_like(stretch, self.far),
            stretch, self.in_background, 0, noise if self.shaken_background else None,
        )  # fmt: skip
        thing, ray, enter, leave = _hits(own, exists)
        first = self.in_background + thing % exists.shape[1] * self.in_box
        objects = self._pieces(
            ray, thing, enter, leave, stretch.index_select(0, ray), self.in_box, first[:, None], noise
        )
        return Samples(objects, background)

    def weights(self, samples: Samples, objects: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
        """See Sampling."""
        return self._in_order(samples, objects, background, seen)

    def clear(self, samples: Samples, objects: Tensor, background: Tensor) -> Tensor:
        """See Sampling."""
        return self._in_order(samples, objects, background, clear)[1]

    def _in_order(
        self, samples: Samples, objects: Tensor, background: Tensor, ask: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor]:
        """What is said of the thickness of all samples of a ray (R, S), the nearest first: (L, K) and (R, Kb)."""
        near, far = samples.objects, samples.background
        thickness = walled(background * far.lengths)
        if not near.slot.numel():
            return objects, ask(thickness)
        slots = int(near.slot.max()) + 1
        flat, extra = (near.ray[:, None] * slots + near.slot).flatten(), slots - self.in_background
        thickness = F.pad(thickness, (0, extra)).flatten().index_add(0, flat, (objects * near.lengths).flatten())
        depths = F.pad(far.depths, (0, extra), value=math.inf).flatten().index_copy(0, flat, near.depths.flatten())
        order = depths.view(-1, slots).sort(dim=1, stable=True).indices
        said = ask(thickness.view(-1, slots).gather(1, order))
        said = torch.zeros_like(said).scatter(1, order, said)
        return said.flatten().index_select(0, flat).view_as(objects), said[:, : self.in_background]

    def alone(self, pieces: Pieces, densities: Tensor) -> Tensor:
        """See Sampling."""
        return -torch.expm1(-(densities * pieces.lengths).sum(1))

    def _pieces(
        self,
        ray: Tensor,
        thing: Tensor,
        low: Tensor,
        high: Tensor,
        stretch: Tensor,
        count: int,
        first_slot: Tensor | int,
        noise: torch.Generator | None,
    ) -> Pieces:
        numbers = torch.arange(count, device=ray.device)
        parts: Tensor = (
            (numbers + 0.5).to(low) if noise is None else numbers + _uniform((len(ray), count), noise, low)
        )
        step = ((high - low) / count)[:, None]
        depths = low[:, None] + step * parts
        slot = (first_slot + numbers).expand(depths.shape)
        inside = torch.ones_like(slot, dtype=torch.bool)
        return Pieces(ray, thing, depths, (step * stretch[:, None]).expand_as(depths), inside, slot)


def into_boxes(rays: Rays, boxes: Boxes, padding: float) -> OwnRays:
    """Rays in the boxes' own spaces, cubes of +-1, and where they are within the cubes of +-(1 + padding)."""
    scale = boxes.scale[:, :, None]
    origins = (boxes.rotation @ (rays.origins[:, None] - boxes.translation)[..., None]).squeeze(-1) / boxes.scale
    directions = rays.directions[:, None] @ boxes.rotation.mT / scale
    origins, directions = origins.flatten(0, 1), directions.flatten(0, 1)
    # a ray along a side never crosses it: it is within the two planes from the first to the last depth, or never
    steep = directions.abs() > _TINY
    safe = torch.where(steep, directions, 1.0)
    ends = [(sign * (1 + padding) - origins[:, None]) / safe for sign in (-1.0, 1.0)]
    between = (origins.abs() <= 1 + padding)[:, None].expand_as(steep)
    low = torch.where(steep, torch.minimum(*ends), torch.where(between, -math.inf, math.inf))
    high = torch.where(steep, torch.maximum(*ends), torch.where(between, math.inf, -math.inf))
    return OwnRays(origins, directions, low.amax(-1).clamp_min(0.0), high.amin(-1))


def _hits(own: OwnRays, exists: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Box, ray and the two depths of each pair that meets."""
    pixels = own.enter.shape[1]
    objects = exists.shape[1]
    meet = (own.enter < own.leave) & exists.flatten()[:, None]
    flat = meet.flatten().nonzero().squeeze(1)
    thing = flat // pixels
    ray = thing // objects * pixels + flat % pixels
    return thing, ray, own.enter.flatten().index_select(0, flat), own.leave.flatten().index_select(0, flat)


def _uniform(shape: tuple[int, ...], noise: torch.Generator, like: Tensor) -> Tensor:
    return torch.rand(shape, generator=noise, device=noise.device).to(like)
