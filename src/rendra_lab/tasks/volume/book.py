"""The book's volume (chapter 5): opacities and colours of voxels, all of them, at one size, from the first step on.

Shapes: Q rays, M points, n voxels along each side.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rendra.kernels.march_volume import march_volume
from rendra_lab.data.ray_views import Scene
from rendra_lab.errors import UserError
from rendra_lab.networks.radiance import Rays, RaysSeen, in_pieces
from rendra_lab.settings import Positive, Range, Size, check_numbers

_Several = Annotated[int, Range(2)]


class BookVolume(nn.Module):
    """A cube of voxels about the origin. Its matter is the opacity of a sample, however long: no density.

    More samples along a ray are therefore another scene: show it with as many as in training.

    Args:
        voxels: n, along each side.
        side: of the cube of n voxels, world units.
        samples: along every ray, evenly over `depth_range`.
        depth_range: distances of the first and the last sample; the book's are depths along the axis of the camera.
        start: raw opacity of all voxels before training, in logits.
        rays_at_once: rays of a view that are rendered together.
    """

    box: Tensor
    level: Tensor
    is_placed: Tensor

    def __init__(
        self,
        voxels: _Several = 128,
        side: Size = 3.0,
        samples: _Several = 150,
        depth_range: Sequence[float] = (0.1, 3.0),
        start: float = -4.0,
        rays_at_once: Positive = 65536,
    ) -> None:
        super().__init__()
        check_numbers("volume", _Several, voxels=voxels, samples=samples)
        check_numbers("volume", Positive, rays_at_once=rays_at_once)
        check_numbers("volume", Size, side=side)
        if len(depth_range) != 2 or not 0 <= depth_range[0] < depth_range[1]:
            raise UserError(
                f"volume.depth_range is two ascending distances, such as [0.1, 3.0]; got {[*depth_range]}"
            )
        self.voxels = [voxels]
        self.samples = samples
        self.depth_range = depth_range
        self.rays_at_once = rays_at_once
        self.spacing = side / voxels
        reach = (voxels - 1) / 2 * self.spacing  # to the outermost centres
        self.register_buffer("box", torch.tensor([[-reach] * 3, [reach] * 3]))
        self.register_buffer("level", torch.tensor(0))
        self.register_buffer("is_placed", torch.tensor(False))
        raw = torch.zeros(1, voxels, voxels, voxels, 4)
        raw[..., 0] = start
        self.raw = nn.Parameter(raw)  # logits of opacity and colour

    def place(self, scene: Scene) -> None:
        """The cube stays where it is, as the book's does."""
        self.is_placed.fill_(True)

    def refine_to(self, level: int) -> None:
        """There is one size of voxels."""
        raise ValueError(f"the book's volume has one level, not level {level}")

    def look_for_space(self) -> None:
        """All of space is looked at."""

    def roughness(self) -> Tensor:
        """Total variation: mean squared difference of neighbouring voxels."""
        return torch.stack([self.raw.diff(dim=axis).square().mean() for axis in (1, 2, 3)]).sum()

    def forward(self, rays: Rays) -> RaysSeen:
        """What rays see, piece by piece."""
        grid = self.raw.sigmoid()
        return in_pieces(lambda some: self._march(grid, some), rays, self.rays_at_once)

    def read(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Opacity of a sample (M,) and colour (M, 3) at points (M, 3) of the world."""
        places = points / self.box[1]
        grid = self.raw.sigmoid().movedim(-1, 1)
        found = F.grid_sample(grid, places[None, None, None], align_corners=True)[0, :, 0, 0]
        return found[0], found[1:].T

    def opacity(self, points: Tensor, step: float) -> Tensor:
        """Opacity (M,) of matter of thickness `step`, as if samples that far apart made it up."""
        between = (self.depth_range[1] - self.depth_range[0]) / (self.samples - 1)
        return -torch.expm1(step / between * torch.log1p(-self.read(points)[0].clamp(max=1 - 1e-6)))

    def _march(self, grid: Tensor, rays: Rays) -> RaysSeen:
        nearest, farthest = self.depth_range
        seen = march_volume(
            grid,
            ((rays.origins - self.box[0]) / self.spacing)[None],
            (rays.directions / self.spacing)[None],
            nearest,
            (farthest - nearest) / (self.samples - 1),
            self.samples,
            mode="opacity",
        )
        return RaysSeen(seen.features[0], seen.opacity[0], seen.depth[0])
