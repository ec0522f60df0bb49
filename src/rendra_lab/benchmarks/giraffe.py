"""GIRAFFE: pictures by the published networks, and a step of training by those for a laptop."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import nn
from torch.nn import functional as F

from rendra_lab.benchmarking import Benchmark, Run
from rendra_lab.benchmarks.scene import Library, Scene
from rendra_lab.tasks.giraffe.box_sampler import BoxSampler
from rendra_lab.tasks.giraffe.camera_sampler import CameraSampler
from rendra_lab.tasks.giraffe.discriminator import Discriminator
from rendra_lab.tasks.giraffe.feature_fields import FeatureField
from rendra_lab.tasks.giraffe.generator import Generator
from rendra_lab.tasks.giraffe.neural_renderer import NeuralRenderer
from rendra_lab.tasks.giraffe.ray_sampling import BoxSampling, DenseSampling, Sampling

_BATCH = 16


def _world(fov_deg: float) -> tuple[BoxSampler, CameraSampler]:
    """One object of a cow's proportions."""
    boxes = BoxSampler(
        1, ([0.187, 0.118, 0.163], [0.253, 0.16, 0.221]), ([-0.2, -0.2, 0.0], [0.2, 0.2, 0.0]), (0.0, 1.0)
    )
    return boxes, CameraSampler(fov_deg, polar=(0.33, 0.45))


def _paper(sampling: Sampling) -> Generator:
    """As conf/network/paper_64_of/giraffe.yaml."""
    fields = FeatureField(skips=[4]), FeatureField(128, 64, 4, 128, point_scale=12.0)
    return Generator(*fields, NeuralRenderer(), sampling, *_world(10.0))


def _small() -> Generator:
    """As conf/network/small_of/giraffe.yaml."""
    fields = (
        FeatureField(64, 64, 6, 64, 6, 0, [3], density_scale=10.0),
        FeatureField(64, 64, 4, 32, 7, 6, point_scale=6.0),
    )
    return Generator(*fields, NeuralRenderer(64), BoxSampling(), *_world(20.0), background_density_noise=0.0)


def _pictures(*, dense: bool) -> Callable[[Library, Scene], Run]:
    def prepare(library: Library, scene: Scene) -> Run:
        network = _paper(DenseSampling() if dense else BoxSampling()).to(scene.device)
        scenes = network.sample(_BATCH, torch.Generator().manual_seed(0))
        return torch.no_grad()(lambda: network(scenes))

    return prepare


def _step(library: Library, scene: Scene) -> Run:
    """Gradients of both objectives, R1 among them, without their optimizers."""
    network, judge = _small().to(scene.device), Discriminator(64, 256).to(scene.device)
    draw, real = torch.Generator().manual_seed(0), torch.rand(_BATCH, 3, 64, 64, device=scene.device)

    def run() -> None:
        network.zero_grad()
        pictures = network(network.sample(_BATCH, draw), draw).rgb
        F.softplus(-judge(pictures)).mean().backward()
        judge.zero_grad()
        _judged(judge, real.clone().requires_grad_(), pictures.detach()).backward()

    return run


def _judged(judge: nn.Module, real: torch.Tensor, fake: torch.Tensor) -> torch.Tensor:
    verdict = judge(real)
    (slope,) = torch.autograd.grad(verdict.sum(), real, create_graph=True)
    penalty = slope.square().flatten(1).sum(1).mean()
    return F.softplus(-verdict).mean() + F.softplus(judge(fake)).mean() + 10 * penalty


_FOLDER = "tests/rendra_lab/tasks/giraffe"
_PROOFS = (f"{_FOLDER}/test_generator.py", f"{_FOLDER}/test_ray_sampling.py", f"{_FOLDER}/test_feature_fields.py")
_WHAT = f"{_BATCH} pictures of 64x64 by the published networks"

GIRAFFE: tuple[Benchmark, ...] = (
    Benchmark(
        "giraffe",
        f"{_WHAT}, 64 strata a ray",
        _pictures(dense=True),
        _PROOFS,
        must_ms=250,
        aim_ms=60,
        is_public=False,
    ),
    Benchmark(
        "giraffe_boxes", f"{_WHAT}, 12 samples a box", _pictures(dense=False), _PROOFS, aim_ms=60, is_public=False
    ),
    Benchmark(
        "giraffe_step",
        f"gradients of generator and discriminator, {_BATCH} pictures of 64x64 by the small networks, with R1",
        _step,
        _PROOFS,
        must_ms=250,
        is_public=False,
    ),
)
