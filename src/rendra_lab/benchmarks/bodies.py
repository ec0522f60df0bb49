"""Bodies: the built-in one posed, with the gradients of its shape, pose and place, and the kernel under it."""

from __future__ import annotations

from collections.abc import Callable

import torch

from rendra.body import SMPL
from rendra.kernels.skinning import SkinWeights, reference, skin, skin_weights
from rendra_lab.benchmarking import Benchmark, Run
from rendra_lab.benchmarks.scene import Library, Scene


def _body(count: int, low: bool) -> Callable[[Library, Scene], Run]:
    """Forward and backward with respect to all that a body is made of."""

    def prepare(library: Library, scene: Scene) -> Run:
        body = SMPL.free(low).to(scene.device)
        shapes = (count, body.num_betas), (count, body.num_joints, 3), (count, 3)
        leaves = [(0.3 * torch.randn(shape, device=scene.device)).requires_grad_() for shape in shapes]
        upstream = torch.rand_like(body(*leaves).verts)
        return lambda: torch.autograd.grad(body(*leaves).verts, leaves, upstream)

    return prepare


def _skin(*, by_reference: bool) -> Callable[[Library, Scene], Run]:
    """Sixteen bodies of 13,718 vertices and 24 joints, forward and backward."""

    def prepare(library: Library, scene: Scene) -> Run:
        weights = SkinWeights(*(each.to(scene.device) for each in skin_weights(SMPL.free().weights)))
        verts = torch.randn(16, len(weights.joints), 3, device=scene.device, requires_grad=True)
        moves = torch.randn(16, 24, 3, 4, device=scene.device, requires_grad=True)
        upstream = torch.rand_like(verts)

        def run() -> None:
            moved = reference.skin(verts, moves, *weights) if by_reference else skin(verts, moves, weights)
            torch.autograd.grad(moved, (verts, moves), upstream)

        return run

    return prepare


_KERNEL = ("tests/rendra/kernels/test_skinning.py",)
_BODY = (*_KERNEL, "tests/rendra/body/test_smpl.py")

BODIES: tuple[Benchmark, ...] = (
    Benchmark(
        "body", "body of 13,718 vertices, forward + backward", _body(1, low=False), _BODY, 15, 5, is_public=False
    ),
    Benchmark("body_64", "64 of them", _body(64, low=False), _BODY, 500, 150, is_public=False),
    Benchmark("body_low_64", "64 of 1,229 vertices", _body(64, low=True), _BODY, is_public=False),
    Benchmark(
        "skinning", "16 x 13,718 vertices, forward + backward", _skin(by_reference=False), _KERNEL, is_public=False
    ),
    Benchmark("skinning_reference", "its reference", _skin(by_reference=True), _KERNEL, is_public=False),
)
