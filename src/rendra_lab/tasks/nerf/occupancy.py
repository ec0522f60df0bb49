"""The renderer that skips what is empty and what is hidden.

Mueller et al., "Instant neural graphics primitives", SIGGRAPH 2022 (occupancy); Li et al., "NerfAcc", ICCV 2023.
Letters: Q rays, M samples of all of them; D H W cells along z, y, x.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rendra.kernels.composite import compact, composite_alphas, visible
from rendra.kernels.occupancy import cells_of, dilate, traverse
from rendra_lab.data.ray_views import Scene
from rendra_lab.data.scene_box import carve, cells_along
from rendra_lab.errors import UserError
from rendra_lab.networks.radiance import Rays, RaysSeen
from rendra_lab.networks.sizes import take_sizes
from rendra_lab.settings import Count, Fraction, Positive, check_numbers
from rendra_lab.tasks.nerf.fields import RadianceField
from rendra_lab.tasks.nerf.renderers import RayRenderer

_POINTS_AT_ONCE = 2**18


class OccupancyRenderer(RayRenderer):
    """Samples of equal length in the cells that are not empty, as far as light reaches.

    Cells start as the visual hull of the silhouettes, where images have them, and are looked at again in the course
    of training: those that have become empty are skipped, and the mean opacity of the others tells how far light
    comes. What may be lit after that is asked of the field. Training also looks at the neighbours of the cells that
    are not empty, so that matter can grow; a finished scene is shown without them: they hold but specks.

    Args:
        field: see `RayRenderer`.
        cells: along the longest side of the scene's box.
        steps_across: samples along that side.
        refresh_every: steps between two looks at the cells.
        empty_from: the first step at which cells may be empty: before, everything is thin.
        empty_below: a cell is empty where the opacity of a sample in it, the largest of late, is less.
        decay: of what is remembered of a cell, from look to look.
        stop_below: samples before which less light than this is left are hidden.
        looks_first: ask the field for opacities without gradients, to find what is hidden, before it is asked with
            them: worth its time where the field is costly and light ends soon.
        jitter: shift the samples of a ray at random in training.
        rays_at_once: see `RayRenderer`.
    """

    occupied: Tensor  # (D, H, W) bool: the cells that training looks at: those of `solid`, and their neighbours
    solid: Tensor  # (D, H, W) bool: the cells in which something was found of late, all that is looked at afterwards
    hull: Tensor  # (D, H, W) bool: outside it there is nothing, ever
    largest: Tensor  # (D, H, W) opacity of a sample in a cell, the largest of late
    usual: Tensor  # (D, H, W) its mean of late
    is_placed: Tensor

    def __init__(
        self,
        field: RadianceField,
        cells: int = 64,
        steps_across: int = 256,
        refresh_every: int = 16,
        empty_from: Count = 100,
        empty_below: Fraction = 0.01,
        decay: Fraction = 0.8,
        stop_below: Fraction = 1e-3,
        looks_first: bool = False,
        jitter: bool = True,
        rays_at_once: int = 65536,
    ) -> None:
        super().__init__(field, rays_at_once)
        check_numbers("sampler", Positive, cells=cells, steps_across=steps_across, refresh_every=refresh_every)
        check_numbers("sampler", Fraction, empty_below=empty_below, decay=decay, stop_below=stop_below)
        if not field.is_density:
            raise UserError(
                f"sampler=occupancy needs a field of densities, and a sample of {type(field).__name__} is as opaque "
                "at any length: take sampler=stratified"
            )
        self.cells = cells
        self.steps_across = steps_across
        self.refresh_every = refresh_every
        self.empty_from = empty_from
        self.empty_below = empty_below
        self.decay = decay
        self.stop_below = stop_below
        self.looks_first = looks_first
        self.jitter = jitter
        for name in ("occupied", "solid", "hull"):
            self.register_buffer(name, torch.ones(1, 1, 1, dtype=torch.bool))
        for name in ("largest", "usual"):
            self.register_buffer(name, torch.zeros(1, 1, 1))
        self.register_buffer("is_placed", torch.tensor(False))

    def place(self, scene: Scene) -> None:
        """Lay the cells into the box of a scene; only the visual hull may hold anything."""
        if bool(self.is_placed):
            return
        super().place(scene)
        shape = cells_along(scene.box, self.cells)
        self.hull = carve(scene.train, scene.box.cpu(), shape).to(self.hull.device)
        self.occupied, self.solid = self.hull.clone(), self.hull.clone()
        self.largest = torch.zeros(self.hull.shape, device=self.hull.device)
        self.usual = torch.zeros_like(self.largest)
        self.is_placed.fill_(True)

    @torch.no_grad()
    def refresh(self, step: int) -> None:
        """Look at the cells again, at a random point of each."""
        if step == 0 or step % self.refresh_every != 0:
            return
        cells = self.hull.nonzero()  # (P, 3) zyx
        size = torch.tensor(self.hull.shape, device=cells.device)
        low, high = self.field.box
        points = low + (cells + torch.rand(cells.shape, device=cells.device)).flip(1) / size.flip(0) * (high - low)
        length = points.new_full((len(points),), self.step_length)
        pieces = zip(points.split(_POINTS_AT_ONCE), length.split(_POINTS_AT_ONCE), strict=True)
        found = torch.cat([self.field.opacity(*piece) for piece in pieces])
        largest, usual = self.largest[self.hull], self.usual[self.hull]
        self.largest[self.hull] = torch.maximum(found, self.decay * largest)
        self.usual[self.hull] = torch.lerp(found, usual, self.decay) if step > self.refresh_every else found
        if step >= self.empty_from:
            self.solid.copy_((self.largest > self.empty_below) & self.hull)  # in place: processes share it
            self.occupied.copy_(dilate(self.solid) & self.hull)

    @property
    def step_length(self) -> float:
        """Of a sample, in world units."""
        return float((self.field.box[1] - self.field.box[0]).amax()) / self.steps_across

    def render(self, rays: Rays) -> RaysSeen:
        """What rays see."""
        offset = (
            torch.rand_like(rays.nearest) if self.jitter and self.training else torch.full_like(rays.nearest, 0.5)
        )
        cells = self.occupied if self.training else self.solid
        samples = traverse(
            rays.origins,
            rays.directions,
            rays.nearest,
            rays.farthest,
            cells,
            self.field.box,
            self.step_length,
            offset,
            opacity=self.usual,
            stop_below=self.stop_below,
        )
        ray_first, ray_index = samples.ray_first, samples.ray_index
        points, middles, lengths = self._points(rays, samples.starts, samples.ends, ray_index)
        if self.looks_first:
            with torch.no_grad():
                opacities = self.field.opacity(points, lengths)
            kept, ray_first = compact(visible(opacities, ray_first, self.stop_below), ray_first)
            points, middles, lengths, ray_index = (
                values.index_select(0, kept) for values in (points, middles, lengths, ray_index)
            )
        alphas, rgb = self._ask(points, rays.directions, lengths, ray_index)
        light = composite_alphas(alphas, rgb, middles, ray_first)
        return RaysSeen(light.features, light.opacity, light.depth)

    def _ask(self, points: Tensor, directions: Tensor, lengths: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """The field's opacities (M,) and light (M, 3); piece by piece where no gradient is wanted."""
        if torch.is_grad_enabled() or len(points) <= _POINTS_AT_ONCE:
            return self.field(points, directions, lengths, ray_index)
        pieces = zip(*(rows.split(_POINTS_AT_ONCE) for rows in (points, lengths, ray_index)), strict=True)
        asked = [self.field(some, directions, length, index) for some, length, index in pieces]
        return torch.cat([alphas for alphas, _ in asked]), torch.cat([rgb for _, rgb in asked])

    def looks_at(self, points: Tensor) -> Tensor:
        """Whether points (M, 3) lie in cells that are not empty: (M,) bool."""
        depth, height, width = self.occupied.shape
        cell = cells_of(points, self.field.box, (depth, height, width))
        return self.occupied.flatten().index_select(0, cell.clamp_min(0)) & (cell >= 0)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Torch's hook: takes on the sizes that a checkpoint has."""
        take_sizes(self.named_buffers(recurse=False), state_dict, prefix)
        super()._load_from_state_dict(state_dict, prefix, *args)

    @staticmethod
    def _points(rays: Rays, starts: Tensor, ends: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The middles of samples: points (M, 3) and distances (M,); and the samples' lengths (M,)."""
        middles = (starts + ends) / 2
        origins, directions = (rows.index_select(0, ray_index) for rows in (rays.origins, rays.directions))
        return origins + middles[:, None] * directions, middles, ends - starts
