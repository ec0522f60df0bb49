"""Pixels of one picture as soft discs in another: SynSin's renderer at its published size."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.kernels.splat_features import splat_features
from rendra_lab.benchmarking import Benchmark, Run
from rendra_lab.benchmarks.scene import Library, Scene
from rendra_lab.tasks.synsin.splatting import lift

_SIDE, _CHANNELS = 256, 64


def _points(device: torch.device) -> tuple[Tensor, Tensor]:
    """Pixels (1, P, 2) and depths (1, P) of a picture, hills 2 to 10 m away, after a step aside and forward."""
    hills = 2 + 8 * torch.rand(1, 1, 9, 9, generator=torch.Generator().manual_seed(0))
    depth = F.interpolate(hills, (_SIDE, _SIDE), mode="bilinear").to(device)
    half = _SIDE / 2
    camera = torch.tensor([[[_SIDE, 0, half], [0, _SIDE, half], [0, 0, 1.0]]], device=device)
    motion = torch.eye(4, device=device)[None]
    motion[:, 0, 3], motion[:, 2, 3] = 0.2, -0.3
    return lift(depth, camera, camera, motion)


def _splat(backward: bool) -> Callable[[Library, Scene], Run]:
    """Forward, or with the gradients of places and features."""

    def prepare(library: Library, scene: Scene) -> Run:
        points, depths = _points(scene.device)
        features = torch.randn(1, _SIDE**2, _CHANNELS, device=scene.device)
        leaves = [x.requires_grad_(backward) for x in (points, features)]
        upstream = [torch.rand(1, n, _SIDE, _SIDE, device=scene.device) for n in (_CHANNELS, 1)]
        upstream[0] = upstream[0].contiguous(memory_format=torch.channels_last)

        def run() -> None:
            seen = splat_features(leaves[0], depths, leaves[1], (_SIDE, _SIDE), 4.0, 128)
            if backward:
                torch.autograd.grad(list(seen), leaves, upstream)

        return run

    return prepare


_PROOFS = ("tests/rendra/kernels/test_splat_features.py", "tests/rendra_lab/tasks/synsin/test_splatting.py")
_WHAT = "splat_features, 65,536 points of 64 channels, 256x256, radius 4, K=128, forward"
SPLATS: tuple[Benchmark, ...] = (
    Benchmark("splat_features", _WHAT, _splat(False), _PROOFS, is_public=False),
    Benchmark(
        "splat_features_backward",
        f"{_WHAT} + backward",
        _splat(True),
        _PROOFS,
        must_ms=400,
        aim_ms=100,
        is_public=False,
    ),
)
