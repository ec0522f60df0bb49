"""What radiance fields are made of: encodings by grids and planes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from rendra.kernels.encode_grid import encode_grid, encode_planes, grid_offsets, grid_resolutions
from rendra_lab.benchmarking import Benchmark, Run
from rendra_lab.benchmarks.scene import Library, Scene, timed


def _points_along_rays(device: torch.device) -> Tensor:
    """1,024 rays through the unit cube, 64 points on each, ray by ray: (65536, 3)."""
    draw = torch.Generator().manual_seed(0)
    ends = torch.rand(2, 1024, 1, 3, generator=draw)
    steps = torch.linspace(0, 1, 64)[:, None]
    return (ends[0] + steps * (ends[1] - ends[0])).view(-1, 3).to(device)


def _encode_grid(for_points: bool) -> Callable[[Library, Scene], Run]:
    """Twelve levels from 16 to 256 cells, 2^15 rows of two features each; gradients of the table or of the points."""

    def prepare(library: Library, scene: Scene) -> Run:
        points = _points_along_rays(scene.device)
        resolutions = grid_resolutions(16, 256, 12)
        offsets = grid_offsets(resolutions, 15)
        table = 1e-4 * torch.randn(offsets[-1], 2, device=scene.device)
        leaf = points if for_points else table
        return timed(lambda: [encode_grid(points, table, resolutions, offsets)], leaf, backward=True)

    return prepare


def _encode_planes(library: Library, scene: Scene) -> Run:
    points = _points_along_rays(scene.device)
    planes = 0.1 + 0.4 * torch.rand(3, 128, 128, 8, device=scene.device)
    return timed(lambda: [encode_planes(points, planes)], planes, backward=True)


_ENCODINGS = ("tests/rendra/kernels/test_encode_grid.py",)
_BACK = "forward + backward"

RADIANCE: tuple[Benchmark, ...] = (
    Benchmark(
        "encode_grid",
        f"encode_grid, 65,536 points, 12 levels of 2 features, 2^15 rows, {_BACK}",
        _encode_grid(for_points=False),
        _ENCODINGS,
        must_ms=25,
        aim_ms=20,
        is_public=False,
    ),
    Benchmark(
        "encode_grid_points",
        f"the same, {_BACK} to the points",
        _encode_grid(for_points=True),
        _ENCODINGS,
        is_public=False,
    ),
    Benchmark(
        "encode_planes",
        f"encode_planes, 65,536 points, product of three planes of 128^2 x 8, {_BACK}",
        _encode_planes,
        _ENCODINGS,
        is_public=False,
    ),
)
