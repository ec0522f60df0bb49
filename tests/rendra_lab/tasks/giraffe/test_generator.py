"""Pictures of scenes: the published formula, whatever may be missing, and the configurations."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from torch import Tensor, nn

from rendra_lab.errors import UserError
from rendra_lab.tasks.giraffe import feature_fields, generator
from rendra_lab.tasks.giraffe.box_sampler import BoxSampler, rotation_about_z
from rendra_lab.tasks.giraffe.camera_sampler import CameraSampler
from rendra_lab.tasks.giraffe.feature_fields import FeatureField, Stretches
from rendra_lab.tasks.giraffe.generator import Generator
from rendra_lab.tasks.giraffe.neural_renderer import NeuralRenderer
from rendra_lab.tasks.giraffe.ray_sampling import BoxSampling, DenseSampling, Sampling
from rendra_lab.tasks.giraffe.records import Boxes, Scenes

CONF = Path(__file__).parents[4] / "conf"
WORLDS = sorted(path.stem for path in (CONF / "world").glob("*.yaml"))
SAMPLINGS: list[Sampling] = [BoxSampling(4, 3), DenseSampling(24), DenseSampling(24, last_length=1e10)]


def made(sampling: Sampling | None = None, objects: int = 2, **boxes: Any) -> Generator:
    """Fields dense enough to hide things."""
    torch.manual_seed(0)
    object_field = FeatureField(8, 16, 4, 6, 3, 2, [2], density_scale=40.0)
    nn.init.constant_(object_field.to_density.bias, 1.0)
    background_field = FeatureField(8, 8, 3, 4, 3, 2, point_scale=6.0, density_scale=0.2)
    sampler = BoxSampler(objects, ([0.3] * 3, [0.4] * 3), ([-0.3, -0.3, 0.0], [0.3, 0.3, 0.0]), **boxes)
    cameras = CameraSampler(30.0, polar=(0.3, 0.45), background_turns=(0.0, 0.25))
    return Generator(
        object_field, background_field, NeuralRenderer(8, 4, 16, 4), sampling or BoxSampling(4, 3), sampler, cameras
    )


def drawn(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def published(network: Generator, scenes: Scenes) -> tuple[Tensor, Tensor]:
    """The feature image and shares, sample by sample, everything evaluated everywhere; float64."""
    sampling = network.sampling
    assert isinstance(sampling, DenseSampling)
    rays, V = network.cameras.rays(scenes.cameras, network.feature_side), network.feature_side
    depths = torch.linspace(sampling.near, sampling.far, sampling.count, dtype=torch.float64)
    points = rays.origins[:, None, None] + depths[:, None] * rays.directions[:, :, None]  # (B, P, K, 3)
    delta = depths.diff()[:, None] * rays.directions.norm(dim=-1)[:, None]
    delta = torch.cat([delta, torch.full_like(delta[:, :1], 1e10)], 1).mT  # (B, P, K)
    densities, features = [], []
    for n in range(network.objects + 1):
        if n < network.objects:
            R, t, s = (getattr(scenes.boxes, name)[:, n] for name in ("rotation", "translation", "scale"))
            own = ((points - t[:, None, None]) @ R[:, None].mT) / s[:, None, None]
            directions = (rays.directions @ R.mT) / s[:, None]
            mask = (own.abs() <= 1.1).all(-1) & scenes.boxes.exists[:, n, None, None]
            field, codes = network.object_field, (scenes.codes.shape[:, n], scenes.codes.appearance[:, n])
        else:
            R = rotation_about_z(scenes.cameras.background_turn)
            own, directions = points @ R[:, None].mT, rays.directions @ R.mT
            mask, field = torch.ones(own.shape[:3], dtype=torch.bool), network.background_field
            codes = scenes.codes.background_shape, scenes.codes.background_appearance
        density, feature = plain(field, own, directions, *codes)
        densities.append(field.density_scale * density.relu() * mask)
        features.append(feature)
    sigma, f = torch.stack(densities), torch.stack(features)
    total = sigma.sum(0)
    mixed = (sigma[..., None] * f).sum(0) / torch.where(total == 0, 1e-4, total)[..., None]
    alpha = 1 - torch.exp(-total * delta)
    through = torch.cumprod(1 - alpha + 1e-10, -1).roll(1, -1)
    through[..., 0] = 1
    weights = alpha * through
    image = (weights[..., None] * mixed).sum(2).view(-1, V, V, mixed.shape[-1]).permute(0, 3, 1, 2)
    shares = (weights * sigma / torch.where(total == 0, 1e-4, total)).sum(-1)
    return image, shares.transpose(0, 1).unflatten(2, (V, V))


def plain(
    field: FeatureField, points: Tensor, directions: Tensor, shape: Tensor, look: Tensor
) -> tuple[Tensor, Tensor]:
    """The field of facts: (B, P, K) densities and (B, P, K, C) features."""

    def encoded(x: Tensor, count: int) -> Tensor:
        waves = [wave(2.0**i * math.pi * x) for i in range(count) for wave in (torch.sin, torch.cos)]
        return torch.cat(waves, -1)

    p, each = encoded(points / field.point_scale, field.point_octaves), lambda z: z[:, None, None]
    x = (field.from_points(p) + each(field.from_shape(shape))).relu()
    for number, layer in enumerate(field.trunk, 1):
        x = layer(x).relu()
        for skip, from_p, from_z in zip(field.skips, field.skips_from_points, field.skips_from_shape, strict=True):
            if skip == number:
                x = x + from_p(p) + each(from_z(shape))
    views = encoded(nn.functional.normalize(directions, dim=-1), field.view_octaves)[:, :, None]
    hidden = (field.to_view(x) + each(field.from_appearance(look)) + field.from_directions(views)).relu()
    return field.to_density(x).squeeze(-1), field.out(hidden)


@pytest.mark.parametrize("view_octaves", [0, 2])
def test_without_octaves_of_the_view_a_point_looks_the_same_from_everywhere(view_octaves: int) -> None:
    field = FeatureField(8, 8, 3, 4, 2, view_octaves)
    origins, codes = torch.randn(1, 3, generator=drawn()).expand(2, 3), torch.randn(1, 4, generator=drawn())
    either = Stretches(torch.zeros(2).long(), origins, torch.eye(3)[:2], torch.zeros(2, 1), torch.ones(2, 1).bool())
    density, hidden = field(either, codes, codes)
    assert_close(density[0], density[1])
    assert bool((hidden[0] == hidden[1]).all()) == (view_octaves == 0)


def test_dense_samples_with_exact_skipping_are_the_published_formula() -> None:
    network = made(DenseSampling(24, last_length=1e10), counts=[0.0, 1.0, 2.0]).double()
    scenes = network.sample(5, drawn())
    image, shares = published(network, scenes)
    assert 0.05 < float(shares[:, 0].detach().mean()) < 0.9
    assert_close(network(scenes).shares, shares, 1e-7)
    assert_close(network.feature_image(scenes), image, 1e-7)
    with torch.no_grad():
        assert_close(network.feature_image(scenes), image, 1e-6)


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_without_gradients_less_is_evaluated_and_nothing_else_seen(
    sampling: Sampling, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = made(sampling)
    scenes = network.sample(5, drawn())
    usual = network(scenes)
    monkeypatch.setattr(generator, "_FEW", 32)  # two pictures at a time
    monkeypatch.setattr(generator, "_AT_ONCE", 2)
    monkeypatch.setattr(feature_fields, "_FEW", 16)
    with torch.no_grad():
        less = network(scenes)
    assert_close(less.rgb, usual.rgb)
    assert_close(less.shares, usual.shares)


@pytest.mark.parametrize("sampling", SAMPLINGS)
@pytest.mark.parametrize("exists", [[True, True], [True, False], [False, False]])
def test_whatever_exists_pictures_and_gradients_are_finite(sampling: Sampling, exists: list[bool]) -> None:
    network = made(sampling)
    scenes = network.sample(3, drawn())
    scenes = replace(scenes, boxes=replace(scenes.boxes, exists=torch.tensor([exists] * 3)))
    for noise in (None, drawn(1)):
        network.zero_grad()
        pictures = network(scenes, noise)
        assert pictures.rgb.shape == (3, 3, 16, 16)
        assert pictures.shares.shape == (3, 3, 4, 4)
        shares = pictures.shares.detach()
        assert float(shares.min()) >= 0
        total = shares.sum(1)
        assert float(total.max()) <= 1 + 1e-5
        if sampling is not SAMPLINGS[2]:
            assert_close(total, torch.ones_like(total))
        assert not bool(shares[:, :2][:, ~torch.tensor(exists)].any())
        pictures.rgb.square().sum().backward()
        assert all(each.grad is not None and bool(each.grad.isfinite().all()) for each in network.parameters())


@torch.no_grad()
@pytest.mark.parametrize("deviation", [0.0, 1.0])
def test_a_background_is_noisy_in_training_where_asked(deviation: float) -> None:
    network = made(BoxSampling(4, 3))
    network.background_density_noise = deviation
    scenes = network.sample(3, drawn())
    nobody = replace(scenes, boxes=replace(scenes.boxes, exists=torch.zeros(3, 2, dtype=torch.bool)))
    first, again, other = (network(nobody, drawn(seed)).rgb for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert torch.equal(first, other) == (deviation == 0)


@torch.no_grad()
def test_an_object_that_is_taken_away_changes_only_what_it_covered() -> None:
    network = made(objects=1)
    scenes = network.sample(4, drawn())
    without = replace(scenes, boxes=replace(scenes.boxes, exists=torch.zeros(4, 1, dtype=torch.bool)))
    shares = network(scenes).shares[:, 0]
    change = (network.feature_image(scenes) - network.feature_image(without)).abs().amax(1)
    assert float(change[shares == 0].max()) == 0
    assert float(change[shares > 0.1].min()) > 0


def test_alpha_maps_show_each_thing_alone() -> None:
    for sampling in (BoxSampling(4, 3), DenseSampling(48)):
        network = made(sampling)
        scenes = network.sample(3, drawn())
        alone = network.alpha_maps(scenes)
        assert alone.shape == (3, 3, 4, 4)
        for n in range(2):
            exists = torch.zeros(3, 2, dtype=torch.bool)
            exists[:, n] = True
            lonely = replace(scenes, boxes=replace(scenes.boxes, exists=exists))
            assert_close(network.alpha_maps(lonely)[:, n], alone[:, n])
        assert bool((alone[:, :2] >= network(scenes).shares[:, :2] - 1e-5).all())
        assert_close(alone[:, 2], torch.ones(3, 4, 4))  # it ends with a wall


def test_scenes_come_from_one_generator_alone() -> None:
    network = made()
    first, again, cool = network.sample(4, drawn()), network.sample(4, drawn()), network.sample(4, drawn(), 0.5)
    assert torch.equal(first.codes.shape, again.codes.shape)
    assert torch.equal(first.cameras.camera_to_world, again.cameras.camera_to_world)
    assert_close(cool.codes.shape, 0.5 * first.codes.shape)
    assert torch.equal(cool.boxes.translation, first.boxes.translation)
    assert first.codes.shape.shape == (4, 2, 6)
    assert first.codes.background_appearance.shape == (4, 4)
    assert network.code_sizes == (6, 4)
    assert (network.picture_side, network.feature_side, network.objects) == (16, 4, 2)
    assert torch.equal(network(first, drawn(3)).rgb, network(first, drawn(3)).rgb)
    assert not torch.equal(network(first, drawn(3)).rgb, network(first, drawn(4)).rgb)


def test_no_picture_at_all_and_codes_of_another_size() -> None:
    network = made()
    none = network.sample(0, drawn())
    for grad in (True, False):
        with torch.set_grad_enabled(grad):
            assert network(none).rgb.shape == (0, 3, 16, 16)
            assert network.alpha_maps(none).shape == (0, 3, 4, 4)
    scenes = network.sample(1, drawn())
    with pytest.raises(ValueError, match="codes of 6 numbers for objects and 4 for the background, got 5 and 4"):
        network(
            replace(scenes, codes=replace(scenes.codes, shape=torch.zeros(1, 2, 5), appearance=torch.zeros(1, 2, 5)))
        )
    with pytest.raises(UserError, match=r"renderer takes 8 features, but .* make 8 and 4"):
        Generator(
            network.object_field, FeatureField(4, 8, 2, 4), network.renderer, network.sampling, network.boxes,
            network.cameras,
        )  # fmt: skip


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_pictures_on_another_device(far: torch.device, sampling: Sampling) -> None:  # noqa: F811
    network = made(sampling)
    usual = network.sample(2, drawn())
    expected = network(usual, drawn(1)), network.alpha_maps(usual)
    there = network.to(far)
    scenes = there.sample(2, drawn())
    assert isinstance(scenes.codes.shape, Far)
    assert isinstance(scenes.boxes.exists, Far)
    with torch.no_grad():
        assert_close(there(scenes).rgb.held, made(sampling)(usual).rgb)
    pictures = there(scenes, drawn(1))
    assert_close(pictures.rgb.held, expected[0].rgb)
    assert_close(there.alpha_maps(scenes).held, expected[1])


def networks(size: str, world: str = "cars") -> dict[str, Any]:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose(overrides=[f"+network/{size}_of@network=giraffe", f"+world={world}"])
        return {name: instantiate(part, _convert_="all") for name, part in config.network.items()}


def sizes(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_published_sizes() -> None:
    for size, expected in (
        ("paper_64", (266_241, 47_041, 98_313, 2_763_776)),
        ("paper", (266_241, 47_041, 98_313, 2_763_776)),
        ("paper_256", (282_753, 55_361, 410_383, 2_802_432)),
    ):
        parts = networks(size)
        network = parts["generator"]
        found = *(sizes(part) for part in network.children()), sizes(parts["discriminator"])
        assert found == expected
        assert sizes(network) == sum(expected[:3])
        assert network.picture_side == parts["discriminator"].picture_side == (256 if "256" in size else 64)
        assert network.object_field.views_downscaled
        assert network.sampling.last_length == 1e10


@pytest.mark.parametrize("world", WORLDS)
def test_every_world_fits_the_small_networks(world: str) -> None:
    parts = networks("small", world)
    network = parts["generator"]
    scenes = network.sample(1, drawn())
    with torch.no_grad():
        pictures = network(scenes)
    assert parts["discriminator"](pictures.rgb).shape == (1, 1)
    for n in range(network.objects):
        if bool(scenes.boxes.exists[0, n]):
            assert float(network.alpha_maps(scenes)[0, n].detach().max()) > 0  # in front of the camera
    assert isinstance(scenes.boxes, Boxes)
