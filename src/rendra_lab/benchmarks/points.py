"""Point clouds: rasterising and rendering them."""

from __future__ import annotations

from collections.abc import Callable

import torch

from rendra_lab.benchmarking import Benchmark, Run
from rendra_lab.benchmarks.scene import Library, Scene, timed

_LAYERS = 8


def _rasterization(num_points: int, backward: bool) -> Callable[[Library, Scene], Run]:
    """Points that fill a box in front of the camera, each a disc of a little more than one pixel."""

    def prepare(library: Library, scene: Scene) -> Run:
        box = torch.tensor([2.0, 2.0, 3.0], device=scene.device)
        points = torch.rand(num_points, 3, device=scene.device) * box - torch.tensor([1.0, 1.0, -1.0]).to(box)

        def forward() -> list[torch.Tensor]:
            _, *fragments = library.renderer.points.rasterize_points(
                library.structures.Pointclouds(points[None]), 256, radius=0.01, points_per_pixel=_LAYERS
            )
            return fragments

        return timed(forward, points, backward)

    return prepare


def _rendering(num_points: int) -> Callable[[Library, Scene], Run]:
    """The same as coloured points through a camera, with gradients of points."""

    def prepare(library: Library, scene: Scene) -> Run:
        api = library.renderer
        points, colors = torch.rand(2, num_points, 3, device=scene.device)
        points = points * 2 - 1
        settings = api.PointsRasterizationSettings(image_size=256, radius=0.01, points_per_pixel=_LAYERS)
        renderer = api.PointsRenderer(
            api.PointsRasterizer(scene.cameras_of(library), settings), api.AlphaCompositor(background_color=(1, 1, 1))
        )
        return timed(
            lambda: [renderer(library.structures.Pointclouds(points[None], features=colors[None]))], points, True
        )

    return prepare


_PROOFS = ("tests/rendra/kernels/test_rasterize_points.py", "tests/rendra/renderer/points/test_rasterizer.py")
_RENDERING = (
    *_PROOFS,
    "tests/rendra/kernels/test_composite_points.py",
    "tests/rendra/renderer/points/test_renderer.py",
)

POINTS: tuple[Benchmark, ...] = (
    *(
        Benchmark(
            f"points_{number}" + ("_backward" if backward else ""),
            f"rasterize_points 256x256, K={_LAYERS}, {number:,} points, forward"
            + (" + backward" if backward else ""),
            _rasterization(number, backward),
            _PROOFS,
        )
        for number in (5_000, 100_000)
        for backward in (False, True)
    ),
    Benchmark(
        "points_renderer_backward",
        f"PointsRenderer 256x256, K={_LAYERS}, 100,000 points, forward + backward",
        _rendering(100_000),
        _RENDERING,
    ),
)
