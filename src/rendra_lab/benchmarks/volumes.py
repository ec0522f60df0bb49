"""Rays through volumes: the step of the book's volume fit, and the kernel under it.

The book's work: 10 views of 128 x 128 rays with 150 samples each, from depth 0.1 to 3, through 128^3 voxels of a
density and a colour: 24.6 million samples. On the reference machine PyTorch3D 0.7.9 takes 10 to 25 s for the step.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from rendra.kernels.march_volume import march_volume, reference
from rendra_lab.benchmarking import Benchmark, Run
from rendra_lab.benchmarks.scene import Library, Scene, timed

_VIEWS, _SIZE, _SAMPLES, _VOXELS, _EXTENT = 10, 128, 150, 128, 3.0
_SMALL = 8  # times fewer views and samples, together, in what is timed sample by sample


def _cameras(library: Library, scene: Scene, views: int) -> object:
    """A ring."""
    R, T = library.renderer.look_at_view_transform(2.7, 0.0, 360 / views * torch.arange(views))
    return library.renderer.FoVPerspectiveCameras(R=R, T=T, device=scene.device)


def _volume_step(library: Library, scene: Scene) -> Run:
    """Log densities and log colours, both through a sigmoid, Huber losses of colour and silhouette, Adam."""
    cameras = _cameras(library, scene, _VIEWS)
    rays = library.renderer.NDCMultinomialRaysampler(
        image_width=_SIZE, image_height=_SIZE, n_pts_per_ray=_SAMPLES, min_depth=0.1, max_depth=3.0
    )
    render = library.renderer.VolumeRenderer(rays, library.renderer.EmissionAbsorptionRaymarcher())
    densities = torch.full((1, *[_VOXELS] * 3), -4.0, device=scene.device, requires_grad=True)
    colours = torch.zeros((3, *[_VOXELS] * 3), device=scene.device, requires_grad=True)
    # every run starts from nearly the same volume
    optimizer = torch.optim.Adam([densities, colours], lr=1e-4, fused=True)
    target = torch.rand(_VIEWS, _SIZE, _SIZE, 4, device=scene.device)

    def step() -> None:
        volumes = library.structures.Volumes(
            *(each.sigmoid()[None].expand(_VIEWS, -1, -1, -1, -1) for each in (densities, colours)),
            voxel_size=_EXTENT / _VOXELS,
        )
        images = render(cameras=cameras, volumes=volumes)[0]
        loss = (((images - target) ** 2 / 0.01 + 1).sqrt() - 1).mul(0.1).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def _rays(library: Library, scene: Scene, views: int) -> tuple[Tensor, Tensor]:
    """Origins and directions (1, views x rays, 3) in voxels."""
    sampler = library.renderer.NDCMultinomialRaysampler(
        image_width=_SIZE, image_height=_SIZE, n_pts_per_ray=1, min_depth=0.1, max_depth=3.0
    )
    bundle = sampler(_cameras(library, scene, views))
    scale = _VOXELS / _EXTENT
    middle = (_VOXELS - 1) / 2
    return bundle.origins.reshape(1, -1, 3) * scale + middle, bundle.directions.reshape(1, -1, 3) * scale


def _march(channels: int, *, backward: bool, is_sparse: bool = False) -> Callable[[Library, Scene], Run]:
    """The book's rays through a faint fog, or through a ball in a box that is known to be empty elsewhere."""

    def prepare(library: Library, scene: Scene) -> Run:
        origins, directions = _rays(library, scene, _VIEWS)
        grid = torch.full((1, *[_VOXELS] * 3, channels), 0.018, device=scene.device)
        occupancy = None
        if is_sparse:
            ticks = torch.linspace(-1, 1, 32, device=scene.device)
            z, y, x = torch.meshgrid(ticks, ticks, ticks, indexing="ij")
            occupancy = x * x + y * y + z * z < 0.2
        step = 2.9 / (_SAMPLES - 1)
        return timed(
            lambda: march_volume(grid, origins, directions, 0.1, step, _SAMPLES, occupancy=occupancy), grid, backward
        )

    return prepare


def _march_reference(library: Library, scene: Scene) -> Run:
    """One view with fewer samples: one in `_SMALL` times ten of the work."""
    origins, directions = _rays(library, scene, 1)
    grid = torch.full((1, *[_VOXELS] * 3, 4), 0.018, device=scene.device)
    samples = _SAMPLES // _SMALL
    step = 2.9 / samples
    lengths = torch.tensor([0.1, step, 1.0], device=scene.device).expand(*origins.shape[:2], 3)
    rays = torch.cat((origins, directions, lengths), dim=-1)
    return timed(
        lambda: reference.march_volume(grid, rays, None, samples, "opacity", ("none", "none"), 0.0), grid, True
    )


_MARCH = ("tests/rendra/kernels/test_march_volume.py",)
_RENDER = (*_MARCH, "tests/rendra/renderer/implicit/test_volume_renderer.py")
_WORK = "10 x 128 x 128 rays x 150 samples, 128^3 x 4 channels"

VOLUMES: tuple[Benchmark, ...] = (
    Benchmark("volume_step", "one volume step at the book's sizes, Adam", _volume_step, _RENDER, 400, 150),
    Benchmark("march_volume", f"forward, {_WORK}", _march(4, backward=False), _MARCH, is_public=False),
    Benchmark(
        "march_volume_backward", f"forward + backward, {_WORK}", _march(4, backward=True), _MARCH, 150, 75,
        is_public=False,
    ),
    Benchmark(
        "march_volume_sparse", "the same where 5 % of the box is occupied", _march(4, backward=True, is_sparse=True),
        _MARCH, is_public=False,
    ),
    Benchmark(
        "march_volume_reference", "its reference, an 83rd of the samples", _march_reference, _MARCH, is_public=False
    ),
)  # fmt: skip
