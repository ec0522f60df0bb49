"""A sphere that becomes a surface: offsets of its vertices, level by level, each diffused over the surface.

Nicolet, Jacobson & Jakob, "Large Steps in Inverse Rendering of Geometry", SIGGRAPH Asia 2021; equation numbers refer
to it.
Shapes: V vertices of the level in work, F faces; P points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu
from torch import Tensor, nn

from rendra.ops import SubdivideMeshes, self_intersections
from rendra.structures import Meshes
from rendra.utils import ico_sphere

_FINEST = 7  # 163,842 vertices
_REACHES = (2, 3, 4, 6, 8, 12, None)  # edges round crossing faces that are held back; None: all
_SPREAD = 3**0.5  # half-axis of an ellipsoid over the standard deviation of points on it, along each axis


class Diffusion:
    """x = (I + smoothness L)^-1 u with L = D - A, the graph's Laplacian (Eq. 8): factorised once, on the CPU.

    Args:
        edges: (E, 2), each once.
        num_verts: V.
        smoothness: lambda; the reach of a change is about its square root, counted in edges.
    """

    def __init__(self, edges: Tensor, num_verts: int, smoothness: float) -> None:
        low, high = edges.cpu().numpy().T
        rows, columns = np.concatenate([low, high]), np.concatenate([high, low])
        adjacency = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(num_verts, num_verts))
        degrees = np.asarray(adjacency.sum(1)).ravel()
        matrix = diags(1 + smoothness * degrees) - smoothness * adjacency
        self._factors = splu(
            matrix.tocsc().astype(np.float32), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
        )
        self._matrix = matrix.tocsr().astype(np.float32)

    def solve(self, u: Tensor) -> Tensor:
        """The x (V, 3) of u (V, 3)."""
        return torch.from_numpy(self._factors.solve(u.detach().cpu().float().numpy())).to(u)

    def undo(self, x: Tensor) -> Tensor:
        """The u (V, 3) of x (V, 3)."""
        return torch.from_numpy(self._matrix @ x.detach().cpu().float().numpy()).to(x)


class _Diffused(torch.autograd.Function):
    """The matrix is symmetric, so that the gradient is diffused like the values."""

    @staticmethod
    def forward(ctx: Any, u: Tensor, diffusion: Diffusion) -> Tensor:
        ctx.diffusion = diffusion
        return diffusion.solve(u)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        return ctx.diffusion.solve(gradients[0]), None


class SpherePyramid(nn.Module):
    """An icosphere whose vertices are moved, refined on the way.

    Every level has parameters of its own, which stay zero until it is reached: a checkpoint holds all of them.

    Args:
        levels: of the icosphere, each one finer than the last: 4 has 2,562 vertices, 5 has 10,242.
        smoothness: lambda of `Diffusion` at each level; 0 moves every vertex by itself.
        start: `sphere`, of radius 1 about the origin; or `ellipsoid`, with the centre and the axes of the points.
        stays_simple: whether `check` keeps the surface from crossing itself.
    """

    level: Tensor  # index into levels
    is_placed: Tensor

    def __init__(
        self,
        levels: Sequence[int] = (3, 4, 5),
        smoothness: float | Sequence[float] = 20.0,
        start: str = "ellipsoid",
        stays_simple: bool = True,
    ) -> None:
        super().__init__()
        if not levels or list(levels) != list(range(levels[0], levels[0] + len(levels))) or levels[0] < 0:
            raise ValueError(f"surface.levels must be consecutive levels of an icosphere, got {list(levels)}")
        if levels[-1] > _FINEST:
            raise ValueError(
                f"surface.levels must be at most {_FINEST}, got {list(levels)}: four times the faces each"
            )
        if start not in ("sphere", "ellipsoid"):
            raise ValueError(f"surface.start must be sphere or ellipsoid, got {start!r}")
        weights = [smoothness] * len(levels) if isinstance(smoothness, (int, float)) else list(smoothness)
        if len(weights) != len(levels) or not all(0 <= weight < math.inf for weight in weights):
            raise ValueError(f"surface.smoothness must be one number of at least 0 or one a level, got {smoothness}")
        self.start = start
        self.stays_simple = stays_simple
        self.smoothness = [float(weight) for weight in weights]
        self._templates = _templates(levels)
        self._diffusions: dict[int, Diffusion] = {}
        self.offsets = nn.ParameterList([torch.zeros_like(mesh.verts_packed()) for mesh in self._templates])
        for index, mesh in enumerate(self._templates):
            self.register_buffer(f"base_{index}", mesh.verts_packed().clone())
            # of the last check; kept, so that a resumed fit goes on as if it had not stopped
            self.register_buffer(f"checked_{index}", mesh.verts_packed().clone())
        self.register_buffer("level", torch.tensor(0))
        self.register_buffer("is_placed", torch.tensor(False))

    def forward(self) -> Meshes:
        """The surface now: a batch of one, differentiable in the offsets of its level."""
        index = int(self.level)
        moved = self._base(index) + self._diffused(index)
        if self._templates[index].device != moved.device:
            self._templates = [mesh.to(moved.device) for mesh in self._templates]
        return self._templates[index].update_padded(moved[None])

    @torch.no_grad()
    def place(self, points: Tensor) -> None:
        """Begin round the points (P, 3)."""
        if self.start == "ellipsoid":
            centre = points.mean(0)
            spread, axes = torch.linalg.eigh((points - centre).T.cov())
            half = _SPREAD * spread.clamp_min(1e-4 * float(spread.amax().clamp_min(1e-12))).sqrt()
            if torch.linalg.det(axes) < 0:
                axes = -axes  # a mirrored sphere would be inside out
            self._base(0).copy_(centre + (self._base(0) * half) @ axes.T)
            self._checked(0).copy_(self._base(0))
        self.is_placed.fill_(True)

    @torch.no_grad()
    def refine_to(self, index: int) -> None:
        """Go on at a finer level, which begins as the present surface; nothing happens if it is reached already."""
        while int(self.level) < index:
            finer = SubdivideMeshes()(self())
            self.level += 1
            for begun in (self._base, self._checked):
                begun(int(self.level)).copy_(finer.verts_packed())

    @torch.no_grad()
    def check(self) -> None:
        """Take back, where the surface crosses itself now, what vertices moved since the last check.

        Vertices of crossing faces go back to where they were, those around them part of the way; if faces cross
        still, a wider part goes back, at last everything: what never crossed itself never will.
        """
        if not self.stays_simple:
            return
        index, mesh = int(self.level), self()
        after, before = mesh.verts_packed(), self._checked(index)
        held = torch.zeros_like(after[:, :1])
        for reach in _REACHES:
            pairs = self_intersections(mesh)
            if not len(pairs):
                break
            held[mesh.faces_packed()[pairs.reshape(-1)].reshape(-1)] = 1
            share = torch.ones_like(held) if reach is None else self._spread(index, held, reach)
            mesh = mesh.update_padded(torch.lerp(after, before, share)[None])
        if bool(held.any()):
            offsets = mesh.verts_packed() - self._base(index)
            self.offsets[index].copy_(self._undiffused(index, offsets))
        before.copy_(mesh.verts_packed())

    def _spread(self, index: int, held: Tensor, rounds: int) -> Tensor:
        """A mask (V, 1) that is one on the held vertices and falls off round them, over as many edges as rounds."""
        edges = self._templates[index].edges_packed()
        ends, others = torch.cat([edges, edges.flip(1)]).unbind(1)
        share = held
        for _ in range(rounds):
            share = share.scatter_reduce(0, ends[:, None], share[others] - 1 / (rounds + 1), "amax")
        return share.clamp_min(0)

    def _base(self, index: int) -> Tensor:
        return getattr(self, f"base_{index}")

    def _checked(self, index: int) -> Tensor:
        return getattr(self, f"checked_{index}")

    def _diffused(self, index: int) -> Tensor:
        if self.smoothness[index] == 0:
            return self.offsets[index]
        return _Diffused.apply(self.offsets[index], self._diffusion(index))

    def _undiffused(self, index: int, offsets: Tensor) -> Tensor:
        return offsets if self.smoothness[index] == 0 else self._diffusion(index).undo(offsets)

    def _diffusion(self, index: int) -> Diffusion:
        if index not in self._diffusions:
            mesh = self._templates[index]
            size = len(mesh.verts_packed())
            self._diffusions[index] = Diffusion(mesh.edges_packed(), size, self.smoothness[index])
        return self._diffusions[index]


def _templates(levels: Sequence[int]) -> list[Meshes]:
    meshes = [ico_sphere(levels[0])]
    for _ in levels[1:]:
        meshes.append(SubdivideMeshes()(meshes[-1]))
    return meshes
