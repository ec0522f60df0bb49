"""A grid of density and colour that rays march through, refined on the way.

Sun et al., "Direct voxel grid optimization", CVPR 2022: values are activated after they are interpolated, so that a
surface may be thinner than a voxel.
Shapes: D H W voxels along z, y and x; Q rays.  Densities are per `unit` of length.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rendra.kernels.march_volume import march_volume
from rendra_lab.data.ray_views import Scene, within_box
from rendra_lab.data.scene_box import carve, cells_along
from rendra_lab.errors import UserError
from rendra_lab.networks.radiance import Rays, RaysSeen, in_pieces
from rendra_lab.networks.sizes import take_sizes
from rendra_lab.settings import Fraction, Positive, Size, check_numbers

_UNITS_ACROSS = 100.0  # units of length along the longest side of the box: densities are then about as large as 1
_SHORTEST = 1e-9  # step of a ray without length, as a share of others
_CELLS_ACROSS = 64  # of the occupancy, along the longest side


class _SlabVariation(torch.autograd.Function):
    """The mean squared difference of neighbouring voxels in a slab along z, summed over the three axes.

    With a gradient that is written into one volume, where torch's own would add up six of them.
    """

    @staticmethod
    def forward(ctx: Any, grid: Tensor, first: int, thick: int) -> Tensor:
        ctx.save_for_backward(grid)
        ctx.slab = slice(first, first + thick)
        slab = grid[0, ctx.slab]
        return torch.stack([slab.diff(dim=axis).square().mean() for axis in range(3)]).sum()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        (grid,) = ctx.saved_tensors
        gradient = torch.zeros_like(grid)
        slab, out = grid[0, ctx.slab], gradient[0, ctx.slab]
        for axis in range(3):
            change = slab.diff(dim=axis)
            change *= gradients[0] * (2 / max(change.numel(), 1))
            out.narrow(axis, 1, change.shape[axis]).add_(change)
            out.narrow(axis, 0, change.shape[axis]).sub_(change)
        return gradient, None, None


class VolumeGrid(nn.Module):
    """Raw density and colour at the corners of voxels, and which cells are empty.

    Every level has parameters of its own, so that a checkpoint holds all of them; the last one that was reached is
    the volume.

    Args:
        voxels: along the longest side of the box, of each level.
        steps_per_voxel: samples that a ray takes in a voxel.
        start_density: everywhere, before training, per `unit`.
        empty_below: a cell is empty where no voxel about it stops more than this share of light in one sample.
        stop_below: a ray ends where less light than this is left.
        rays_at_once: rays of a view that are rendered together.
    """

    box: Tensor
    level: Tensor
    occupied: Tensor
    is_placed: Tensor

    def __init__(
        self,
        voxels: Sequence[int] = (48, 96, 160),
        steps_per_voxel: float = 2.0,
        start_density: float = 0.05,
        empty_below: Fraction = 1e-3,
        stop_below: Fraction = 1e-3,
        rays_at_once: int = 65536,
    ) -> None:
        super().__init__()
        if not voxels or min(voxels) < 2 or sorted(voxels) != list(voxels):
            raise UserError(
                f"volume.voxels are numbers of voxels, at least 2, rising from level to level, got {voxels}"
            )
        check_numbers("volume", Size, steps_per_voxel=steps_per_voxel, start_density=start_density)
        check_numbers("volume", Fraction, empty_below=empty_below, stop_below=stop_below)
        check_numbers("volume", Positive, rays_at_once=rays_at_once)
        self.voxels = list(voxels)
        self.steps_per_voxel = steps_per_voxel
        self.start_density = start_density
        self.empty_below = empty_below
        self.stop_below = stop_below
        self.rays_at_once = rays_at_once
        self.register_buffer("box", torch.tensor([[-1.0] * 3, [1.0] * 3]))
        self.register_buffer("level", torch.tensor(0))
        self.register_buffer("is_placed", torch.tensor(False))
        self.register_buffer("occupied", torch.ones(1, 1, 1, dtype=torch.uint8))
        self.grids = nn.ParameterList(nn.Parameter(torch.zeros(1, 2, 2, 2, 4)) for _ in voxels)

    def place(self, scene: Scene) -> None:
        """Lay the voxels into the box of a scene, and leave out what is not in the visual hull of its silhouettes."""
        self.box.copy_(scene.box)
        raw = torch.tensor(self.start_density).expm1().log()
        for grid, voxels in zip(self.grids, self.voxels, strict=True):
            shape = cells_along(self.box, voxels, least=2)
            # NumPy's memory comes in large pages: rays miss the translation cache less
            grid.data = torch.from_numpy(np.zeros((1, *shape, 4), np.float32)).to(self.box.device)
            grid.data[..., 0] = raw
        hull = carve(scene.train, scene.box.cpu(), cells_along(self.box, _CELLS_ACROSS, least=2))
        self.occupied = hull.to(self.box.device, torch.uint8)
        self.is_placed.fill_(True)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Torch's hook: takes on the sizes that a checkpoint has."""
        take_sizes((*self.grids.named_parameters(prefix="grids"), ("occupied", self.occupied)), state_dict, prefix)
        super()._load_from_state_dict(state_dict, prefix, *args)

    @property
    def grid(self) -> Tensor:
        """The volume as it stands, (1, D, H, W, 4): raw density, raw colour."""
        return self.grids[int(self.level)]

    @torch.no_grad()
    def refine_to(self, level: int) -> None:
        """Go on with finer voxels."""
        coarse = self.grid.movedim(-1, 1)
        self.level.fill_(level)
        fine = F.interpolate(coarse, size=self.grid.shape[1:4], mode="trilinear", align_corners=True)
        self.grid.copy_(fine.movedim(1, -1))

    @torch.no_grad()
    def look_for_space(self) -> None:
        """Find the cells that have become empty; they stay empty."""
        density = F.softplus(self.grid[0, ..., 0])
        alpha = -torch.expm1(-density * self._delta())
        if any(few < many for few, many in zip(alpha.shape, self.occupied.shape, strict=True)):
            alpha = F.max_pool3d(alpha[None], 3, stride=1, padding=1)[0]  # a voxel reaches further than a cell
        cells = F.adaptive_max_pool3d(alpha[None], self.occupied.shape)[0]
        near = F.max_pool3d(cells[None], 3, stride=1, padding=1)[0]
        self.occupied &= (near > self.empty_below).to(torch.uint8)

    def render(self, rays: Rays, jitter: bool = False) -> RaysSeen:
        """What rays see."""
        size = (self.box[1] - self.box[0]).amax()
        last = self.grid.new_tensor(self.grid.shape[3:0:-1]) - 1
        scale = last / (self.box[1] - self.box[0])  # voxels a unit of length, xyz
        offset = torch.rand_like(rays.nearest) if jitter else torch.full_like(rays.nearest, 0.5)
        reach = (rays.farthest - rays.nearest).amax() if len(rays.nearest) else size
        count = int(reach / self._step()) + 1
        step = self._steps(rays, count)
        seen = march_volume(
            self.grid,
            ((rays.origins - self.box[0]) * scale)[None],
            (rays.directions * scale)[None],
            (rays.nearest + offset * step)[None],
            step[None],
            count,
            mode="density",
            delta=step[None] / self._unit(),
            activations=("softplus", "sigmoid"),
            occupancy=self.occupied,
            stop_below=self.stop_below,
        )
        return RaysSeen(seen.features[0], seen.opacity[0], seen.depth[0])

    def forward(self, rays: Rays) -> RaysSeen:
        """What rays see: jittered while training, piece by piece where no gradient is wanted."""
        if torch.is_grad_enabled():
            return self.render(rays, jitter=self.training)
        return in_pieces(self.render, rays, self.rays_at_once)

    def roughness(self, share: float = 0.125) -> Tensor:
        """Total variation: mean squared difference of neighbours in a random slab of the volume, a share of it."""
        thick = max(2, round(share * self.grid.shape[1]))
        first = int(torch.randint(self.grid.shape[1] - thick + 1, ()))
        return _SlabVariation.apply(self.grid, first, thick)

    def read(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Density per unit (M,) and colour (M, 3) at points (M, 3) of the world; nothing where rays find nothing."""
        places = 2 * (points - self.box[0]) / (self.box[1] - self.box[0]) - 1
        raw = F.grid_sample(self.grid.movedim(-1, 1), places[None, None, None], align_corners=True)[0, :, 0, 0]
        cells = self.occupied[None, None].to(raw.dtype)
        held = F.grid_sample(cells, places[None, None, None], mode="nearest", align_corners=False)[0, 0, 0, 0]
        return F.softplus(raw[0]) * held, raw[1:].T.sigmoid()

    def opacity(self, points: Tensor, step: float) -> Tensor:
        """Opacity (M,) of matter of thickness `step`."""
        return -torch.expm1(-self.read(points)[0] * step / self._unit())

    def _unit(self) -> float:
        return float((self.box[1] - self.box[0]).amax()) / _UNITS_ACROSS

    def _step(self) -> float:
        size = float((self.box[1] - self.box[0]).amax())
        return size / (self.voxels[int(self.level)] - 1) / self.steps_per_voxel

    def _steps(self, rays: Rays, count: int) -> Tensor:
        """From sample to sample of each ray (Q,): the box ends most rays, and what ends before it is divided."""
        leaves = within_box(rays.origins, rays.directions, self.box)[1]
        length = rays.farthest - rays.nearest
        ends_before = rays.nearest + length < leaves * (1 - 1e-5)
        step = torch.full_like(length, self._step())
        return torch.where(ends_before, (length / count).clamp_min(_SHORTEST * self._step()), step)

    def _delta(self) -> float:
        return self._step() / self._unit()
