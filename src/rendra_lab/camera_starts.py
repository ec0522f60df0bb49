"""Where a camera fit begins: at a given place, or at the best of many after a coarse search."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from rendra.transforms import euler_angles_to_matrix
from rendra_lab.data.views import ViewBatch, check_visible, shrink
from rendra_lab.networks.camera_pose import CameraPose, PosePrediction, SixDofPose, look_at_origin
from rendra_lab.networks.mesh_view import MeshView
from rendra_lab.optimizers import levenberg_marquardt_step
from rendra_lab.settings import Positive, Size

Residuals = Callable[[PosePrediction, ViewBatch], Tensor]
"""A task's `residuals_of`: one prediction, one target of the same size -> a vector (D,)."""


Comparison = Callable[[Tensor, Tensor], Tensor]
"""Poses R (M, 3, 3), T (M, 3) -> residual vectors (M, D)."""


class Level(NamedTuple):
    """One stage of a search."""

    side_px: int  # short side of the rendered images
    shrunk_px: int  # short side of the images that are compared: smooth enough for Gauss-Newton
    kept: int  # poses that go on
    steps: int  # Gauss-Newton steps of each


class GivenStart:
    """A camera at a position, looking at the origin.

    Args:
        position: in world units; the book's is (3, 6.9, 2.5).
    """

    def __init__(self, position: Sequence[float] = (3.0, 6.9, 2.5)) -> None:
        if len(position) != 3 or not any(position):
            raise ValueError(f"a start position has three coordinates and is not the origin, got {list(position)}")
        self.position = [float(x) for x in position]

    @torch.no_grad()
    def __call__(
        self, scene: MeshView, pose: CameraPose, target: ViewBatch, residuals: Residuals
    ) -> tuple[Tensor, Tensor]:
        """The pose R (1, 3, 3), T (1, 3); UserError where nothing is seen from there, so that nothing pulls."""
        R, T = look_at_origin(torch.tensor([self.position], device=target.rgb.device))
        check_visible(scene(R, T)[0], scene, f"the start, seen from init.position={self.position}")
        return R, T


class MultiStart:
    """The pose from nothing: many directions at low resolution, then Gauss-Newton on the most promising.

    1. The mesh is rendered from `directions` spread evenly over the sphere, for a free camera in `rolls` turns each.
    2. Each silhouette's area and centroid against the target's give distance and shift.
    3. The poses are scored by the task's own losses; the best few are refined and thinned out, level by level.

    Args:
        directions: number of directions; neighbours are about 200 / sqrt(directions) degrees apart.
        rolls: turns about the optical axis, tried by a free camera alone.
        levels: the stages from coarse to fine (`Level`: side_px, shrunk_px, kept, steps).
        difference: step of the numerical derivatives, world units or rad.
        at_once: poses rendered together.
    """

    def __init__(
        self,
        directions: Positive = 256,
        rolls: Positive = 12,
        levels: Sequence[Sequence[int]] = ((64, 16, 12, 6), (128, 32, 4, 6), (256, 64, 2, 5)),
        difference: Size = 0.03,
        at_once: int = 32,
    ) -> None:
        if directions < 1 or rolls < 1 or not levels:
            raise ValueError("a search needs at least one direction, one roll and one level")
        self.directions = directions
        self.rolls = rolls
        self.levels = [Level(*level) for level in levels]
        self.difference = difference
        self.at_once = at_once

    @torch.no_grad()
    def __call__(
        self, scene: MeshView, pose: CameraPose, target: ViewBatch, residuals: Residuals
    ) -> tuple[Tensor, Tensor]:
        """The best pose R (1, 3, 3), T (1, 3), by the task's own residuals.

        Raises:
            ValueError: the target's silhouette is empty.
        """
        if not target.silhouette.amax() > 0.5:
            raise ValueError("the target's silhouette is empty: there is no pose to find")
        R, T = self._hypotheses(scene, pose, target.resized(_scaled(scene, self.levels[0].side_px)))
        for level in self.levels:
            compare = self._comparison(scene, target, level, residuals)
            best = compare(R, T).square().sum(-1).argsort()[: level.kept]
            R, T = self._refine(pose, R[best], T[best], compare, level.steps)
        best = compare(R, T).square().sum(-1).argmin()
        return R[best][None], T[best][None]

    def _comparison(self, scene: MeshView, target: ViewBatch, level: Level, residuals: Residuals) -> Comparison:
        """Renders poses at one level's size, the edge as many pixels wide as at full size, and shrinks the images."""
        size, shrunk = _scaled(scene, level.side_px), target.resized(_scaled(scene, level.shrunk_px))
        sigma = scene.sigma * (min(scene.image_size) / min(size)) ** 2

        def compare(R: Tensor, T: Tensor) -> Tensor:
            silhouettes, colours = scene(R, T, size, sigma)
            seen = shrink(colours, silhouettes, (shrunk.rgb.shape[1], shrunk.rgb.shape[2]))
            rows = zip(*(x.split(1) for x in (*seen, R, T)), strict=True)
            return torch.stack([residuals(PosePrediction(*row), shrunk) for row in rows])

        return lambda R, T: self._chunked(compare, R, T)

    def _hypotheses(self, scene: MeshView, pose: CameraPose, target: ViewBatch) -> tuple[Tensor, Tensor]:
        """Poses all around the mesh, as far and as shifted as their silhouettes say."""
        distance, device = _viewing_distance(scene), target.rgb.device
        R, T = look_at_origin(sphere_directions(self.directions).to(device) * distance)
        is_free = isinstance(pose, SixDofPose)
        if is_free:
            turns = torch.zeros(self.rolls, 3, device=device)
            turns[:, 2] = torch.arange(self.rolls, device=device) * (2 * math.pi / self.rolls)
            R = (R[:, None] @ euler_angles_to_matrix(turns, "XYZ")).flatten(0, 1)
            T = T.repeat_interleave(self.rolls, dim=0)
        size = (target.silhouette.shape[1], target.silhouette.shape[2])
        wanted = _moments(target.silhouette)
        for _ in range(2):  # perspective makes the first estimate of the distance a little wrong
            seen = self._chunked(lambda R, T: _moments(scene(R, T, size)[0]), R, T)
            T = T.clone()
            T[:, 2] *= (seen[:, 2] / wanted[:, 2].clamp(min=1e-9)).clamp(1e-2, 1e2).sqrt()
            if is_free:
                T[:, :2] += (wanted[:, :2] - seen[:, :2]) * T[:, 2:] * math.tan(math.radians(scene.fov_deg / 2))
        return R, T

    def _refine(
        self, pose: CameraPose, R: Tensor, T: Tensor, compare: Comparison, steps: int
    ) -> tuple[Tensor, Tensor]:
        """Levenberg-Marquardt on all poses side by side."""
        delta, damping = R.new_zeros(len(R), pose.degrees_of_freedom), R.new_full((len(R),), 1e-2)

        def moved(delta: Tensor) -> Tensor:
            tried = delta.shape[1]
            bases = R.repeat_interleave(tried, 0), T.repeat_interleave(tried, 0)
            return compare(*pose.retract(*bases, delta.flatten(0, 1))).unflatten(0, (len(R), tried))

        longest = 0.2 * float(T.norm(dim=1).mean())
        for _ in range(steps):
            delta, damping, _ = levenberg_marquardt_step(moved, delta, damping, self.difference, longest)
        return pose.retract(R, T, delta)

    def _chunked(self, function: Callable[[Tensor, Tensor], Tensor], R: Tensor, T: Tensor) -> Tensor:
        """The function of a few poses at a time."""
        return torch.cat([function(*some) for some in zip(R.split(self.at_once), T.split(self.at_once), strict=True)])


def sphere_directions(count: int) -> Tensor:
    """Unit vectors (count, 3) spread evenly: a Fibonacci spiral, poles left out."""
    height = 1 - (2 * torch.arange(count) + 1) / count
    angle = torch.arange(count) * (math.pi * (3 - math.sqrt(5)))
    ring = (1 - height.square()).sqrt()
    return torch.stack([ring * angle.cos(), height, ring * angle.sin()], dim=-1)


def _scaled(scene: MeshView, side_px: int) -> tuple[int, int]:
    """The scene's (H, W) with a short side of `side_px` pixels, or as it is if that is smaller."""
    height, width = scene.image_size
    scale = min(1.0, side_px / min(height, width))
    return max(1, round(height * scale)), max(1, round(width * scale))


def _viewing_distance(scene: MeshView) -> float:
    """A distance from the origin at which the whole mesh is in view."""
    reach = float(scene.mesh.verts_packed().norm(dim=1).amax())
    return 1.2 * reach / math.sin(math.radians(scene.fov_deg / 2))


def _moments(silhouette: Tensor) -> Tensor:
    """Centroid in NDC and area (M, 3): x, y, pixels, of silhouettes (M, H, W)."""
    _, height, width = silhouette.shape
    short = min(height, width)
    x = torch.arange(width - 1, -width, -2, device=silhouette.device) / short
    y = torch.arange(height - 1, -height, -2, device=silhouette.device) / short
    area = silhouette.sum((1, 2))
    safe = area.clamp(min=1e-9)
    return torch.stack([(silhouette.sum(1) * x).sum(1) / safe, (silhouette.sum(2) * y).sum(1) / safe, area], dim=-1)
