"""What a radiance field spends on its rays beside its network: samples in occupied space, and their compositing."""

from __future__ import annotations

import torch
from torch import Tensor

from rendra.kernels.composite import composite_densities
from rendra.kernels.occupancy import traverse
from rendra_lab.benchmarking import Benchmark, Run
from rendra_lab.benchmarks.scene import Library, Scene, timed

_RAYS = 8192
_SIDE = 128


def _ball(device: torch.device) -> Tensor:
    """A ball that fills a tenth of its box, with rough cells at its surface."""
    ticks = torch.linspace(-1, 1, _SIDE, device=device)
    z, y, x = torch.meshgrid(ticks, ticks, ticks, indexing="ij")
    noise = torch.rand((_SIDE,) * 3, generator=torch.Generator().manual_seed(0)).to(device)
    return (x * x + y * y + z * z).sqrt() + 0.05 * noise < 0.6


def _occupancy(library: Library, scene: Scene) -> Run:
    """Rays from a sphere of radius 3 towards points of the box, 16 samples a ray or so."""
    return _traversal(scene, stop_below=0.0)


def _light(library: Library, scene: Scene) -> Run:
    """The same, where a sample of an occupied cell stops half of the light: at most ten a ray."""
    return _traversal(scene, stop_below=1e-3)


def _traversal(scene: Scene, stop_below: float) -> Run:
    device = scene.device
    origins = 3 * torch.nn.functional.normalize(torch.randn(_RAYS, 3, device=device), dim=1)
    directions = torch.nn.functional.normalize(1.6 * torch.rand(_RAYS, 3, device=device) - 0.8 - origins, dim=1)
    nearest, offset = torch.ones(_RAYS, device=device), torch.rand(_RAYS, device=device)
    box = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], device=device)
    occupied = _ball(device)
    rays = origins, directions, nearest, 4 * nearest + 1, occupied, box, 2 / _SIDE, offset
    opacity = 0.5 * occupied.float()
    return lambda: traverse(*rays, opacity=opacity, stop_below=stop_below)


def _composite(library: Library, scene: Scene) -> Run:
    """About 200,000 samples, gradients of densities and colours."""
    counts = torch.randint(0, 50, (_RAYS,), device=scene.device)
    ray_first = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    total = int(ray_first[-1])
    field = torch.rand(total, 4, device=scene.device)
    deltas, positions = torch.full_like(field[:, 0], 0.02), torch.rand(total, device=scene.device)

    def forward() -> list[Tensor]:
        return list(composite_densities(10 * field[:, 3], deltas, field[:, :3], positions, ray_first))[:3]

    return timed(forward, field, backward=True)


RAYS: tuple[Benchmark, ...] = (
    Benchmark(
        "occupancy",
        "traverse, 8,192 rays through 128^3 cells, a tenth occupied",
        _occupancy,
        ("tests/rendra/kernels/test_occupancy.py",),
        aim_ms=2,
        is_public=False,
    ),
    Benchmark(
        "occupancy_light",
        "the same, ending where light does",
        _light,
        ("tests/rendra/kernels/test_occupancy.py",),
        aim_ms=2,
        is_public=False,
    ),
    Benchmark(
        "composite",
        "composite_densities, 200,000 samples, three channels, forward + backward",
        _composite,
        ("tests/rendra/kernels/test_composite.py",),
        must_ms=3,
        aim_ms=2,
        is_public=False,
    ),
)
