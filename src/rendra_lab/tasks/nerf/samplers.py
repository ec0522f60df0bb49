"""Renderers that take as many samples along every ray: evenly, or where a first look found something.

Letters: Q rays, S samples along each.  Distances are world units along the ray.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.ops.sample_pdf import sample_pdf
from rendra_lab.errors import UserError
from rendra_lab.networks.radiance import Rays, RaysSeen
from rendra_lab.settings import Positive, Range, check_numbers
from rendra_lab.tasks.nerf.fields import RadianceField
from rendra_lab.tasks.nerf.renderers import RayRenderer

ENDLESS = 1e10
"""The length of the last sample in the code of Mildenhall et al.: whatever matter it meets is opaque."""


class DenseRenderer(RayRenderer):
    """As many samples along every ray that meets the scene.

    Args:
        field: see `RayRenderer`.
        jitter: move samples at random in training.
        disparity: spread samples evenly in 1 / distance, for scenes that go far back.
        endless: let the last sample reach infinitely far, as the original does; else to where the ray leaves.
        depth_range: look between these two distances along every ray, wherever it meets the box of the scene. Fields
            whose matter is the opacity of a sample need it: their samples must be equally far apart on all rays.
        rays_at_once: see `RayRenderer`.
    """

    def __init__(
        self,
        field: RadianceField,
        jitter: bool = True,
        disparity: bool = False,
        endless: bool = False,
        depth_range: Sequence[float] | None = None,
        rays_at_once: int = 2048,
    ) -> None:
        super().__init__(field, rays_at_once)
        if depth_range is not None and not (len(depth_range) == 2 and 0 <= depth_range[0] < depth_range[1]):
            raise UserError(
                f"sampler.depth_range is two ascending distances, such as [0.1, 3.0], or null; got {depth_range}"
            )
        self.jitter = jitter
        self.disparity = disparity
        self.endless = endless
        self.depth_range = depth_range

    @abstractmethod
    def look(self, rays: Rays) -> RaysSeen:
        """What rays see that all meet the scene; there may be none."""

    def render(self, rays: Rays) -> RaysSeen:
        """What rays see; nothing where they miss the scene, and nothing is asked there."""
        if self.depth_range is not None:
            near, far = (torch.full_like(rays.nearest, distance) for distance in self.depth_range)
            rays = replace(rays, nearest=near, farthest=far)
        meets = (rays.farthest > rays.nearest).nonzero()[:, 0]
        if len(meets) == len(rays.nearest):
            return self.look(rays)
        seen = self.look(rays._map(lambda value: value[meets], lambda value: isinstance(value, Tensor)))
        return seen._map(
            lambda value: value.new_zeros(len(rays.nearest), *value.shape[1:]).index_copy(0, meets, value),
            lambda value: isinstance(value, Tensor),
        )

    def distances(self, rays: Rays, samples: int) -> Tensor:
        """Even places (Q, S) from nearest to farthest, both included; jitter moves each up to halfway to the next."""
        share = torch.linspace(0, 1, samples, device=rays.nearest.device, dtype=rays.nearest.dtype)
        near, far = rays.nearest[:, None], rays.farthest[:, None]
        if self.disparity:
            near = torch.maximum(near, 1e-3 * far)  # a box that holds the camera begins at 0
            places = 1 / ((1 - share) / near + share / far)
        else:
            places = near * (1 - share) + far * share
        if not self._jitters:
            return places
        middles = (places[:, 1:] + places[:, :-1]) / 2
        lower = torch.cat([places[:, :1], middles], dim=1)
        upper = torch.cat([middles, places[:, -1:]], dim=1)
        return lower + (upper - lower) * torch.rand_like(places)

    def march(self, field: RadianceField, rays: Rays, distances: Tensor) -> tuple[Tensor, RaysSeen]:
        """Weights (Q, S) of the samples of a field at ascending distances (Q, S), and what they show together."""
        count, samples = distances.shape
        points = rays.origins[:, None] + rays.directions[:, None] * distances[..., None]
        steps = torch.diff(distances, append=rays.farthest[:, None])
        if self.endless:
            steps[:, -1] = ENDLESS
        ray_index = torch.arange(count, device=distances.device).repeat_interleave(samples)
        alpha, rgb = field(points.reshape(-1, 3), rays.directions, steps.reshape(-1), ray_index)
        return composite(alpha.view(count, samples), rgb.view(count, samples, 3), distances)

    @property
    def _jitters(self) -> bool:
        return self.jitter and self.training


class StratifiedRenderer(DenseRenderer):
    """Even samples, jittered in training (Mildenhall et al., "NeRF", ECCV 2020, Eq. 2).

    Args:
        field: to look at.
        samples: S.
        **marching: see `DenseRenderer`.
    """

    def __init__(self, field: RadianceField, samples: int = 128, **marching: Any) -> None:
        super().__init__(field, **marching)
        check_numbers("sampler", Annotated[int, Range(2)], samples=samples)
        self.samples = samples

    def look(self, rays: Rays) -> RaysSeen:
        """What rays see that all meet the scene."""
        return self.march(self.field, rays, self.distances(rays, self.samples))[1]


class HierarchicalRenderer(DenseRenderer):
    """Even samples of a coarse field say where to look at a fine one (Mildenhall et al., Sec. 5.2).

    Args:
        field: the fine one, looked at with the samples of both passes.
        coarse: the field that is looked at first.
        coarse_samples: of the first pass.
        fine_samples: that the second adds.
        **marching: see `DenseRenderer`.
    """

    def __init__(
        self,
        field: RadianceField,
        coarse: RadianceField,
        coarse_samples: int = 64,
        fine_samples: int = 128,
        **marching: Any,
    ) -> None:
        super().__init__(field, **marching)
        check_numbers("sampler", Annotated[int, Range(3)], coarse_samples=coarse_samples)
        check_numbers("sampler", Positive, fine_samples=fine_samples)
        self.coarse = coarse
        self.coarse_samples = coarse_samples
        self.fine_samples = fine_samples

    def look(self, rays: Rays) -> RaysSeen:
        """What rays see that all meet the scene, in both passes."""
        even = self.distances(rays, self.coarse_samples)
        weights, first = self.march(self.coarse, rays, even)
        _, second = self.march(self.field, rays, self.refined(even, weights.detach()))
        return RaysSeen(second.rgb, second.opacity, second.depth, first.rgb, first.opacity)

    def refined(self, distances: Tensor, weights: Tensor) -> Tensor:
        """Distances (Q, S) and new ones where the weights (Q, S) are, ascending.

        Where to look is data: it has no gradient.
        """
        middles = (distances[:, 1:] + distances[:, :-1]) / 2
        drawn = sample_pdf(middles, weights[:, 1:-1], self.fine_samples, det=not self._jitters, eps=1e-5)
        return torch.cat([distances, drawn], dim=1).sort(dim=1).values


def composite(alpha: Tensor, rgb: Tensor, distances: Tensor) -> tuple[Tensor, RaysSeen]:
    """Emission and absorption, front to back (Max 1995; Mildenhall et al., Eq. 3).

    Args:
        alpha: (Q, S) in [0, 1].
        rgb: (Q, S, 3).
        distances: (Q, S), ascending.

    Returns:
        The weights w_i = alpha_i prod_{j < i} (1 - alpha_j), (Q, S), and their sums over light and distance.
    """
    passed = (1 - alpha[:, :-1] + 1e-10).cumprod(dim=1)  # the original's guard: no product is quite 0
    weights = alpha * F.pad(passed, (1, 0), value=1.0)
    seen = RaysSeen((weights[..., None] * rgb).sum(1), weights.sum(1), (weights * distances).sum(1))
    return weights, seen
