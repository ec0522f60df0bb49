"""What every renderer of a radiance field does: rays in, what they saw out."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from rendra_lab.data.ray_views import Scene
from rendra_lab.networks.radiance import Rays, RaysSeen, in_pieces
from rendra_lab.settings import Positive, check_numbers
from rendra_lab.tasks.nerf.fields import RadianceField


class RayRenderer(nn.Module, ABC):
    """Asks a field about samples along rays. Subclasses say where the samples lie.

    Args:
        field: the field that is shown; the finer one where there are two.
        rays_at_once: rays of a view that are rendered together when nothing is trained.
    """

    def __init__(self, field: RadianceField, rays_at_once: int = 8192) -> None:
        super().__init__()
        check_numbers("sampler", Positive, rays_at_once=rays_at_once)
        self.field = field
        self.rays_at_once = rays_at_once

    @abstractmethod
    def render(self, rays: Rays) -> RaysSeen:
        """What rays see, all at once."""

    def forward(self, rays: Rays) -> RaysSeen:
        """What rays see; piece by piece, to bounded memory, where no gradient is wanted."""
        if torch.is_grad_enabled():
            return self.render(rays)
        return in_pieces(self.render, rays, self.rays_at_once)

    def place(self, scene: Scene) -> None:
        """Say where the scene lies, before the first step."""
        for module in self.modules():
            if isinstance(module, RadianceField):
                module.place(scene.box)

    def refresh(self, step: int) -> None:
        """Called before every training step: a renderer that remembers empty space looks again now and then."""

    def looks_at(self, points: Tensor) -> Tensor:
        """Whether rays are ever sampled about points (M, 3): (M,) bool. Elsewhere the field means nothing."""
        return torch.ones(len(points), dtype=torch.bool, device=points.device)
