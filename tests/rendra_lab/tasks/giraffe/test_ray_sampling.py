"""Boxes that rays cross, and what their samples weigh."""

import math

import pytest
import torch
from assertions import assert_close
from torch import Tensor

from rendra_lab.errors import UserError
from rendra_lab.tasks.giraffe.box_sampler import rotation_about_z
from rendra_lab.tasks.giraffe.camera_sampler import Rays
from rendra_lab.tasks.giraffe.composition import clear, per_density, seen, walled
from rendra_lab.tasks.giraffe.ray_sampling import BoxSampling, DenseSampling, Samples, Sampling, into_boxes
from rendra_lab.tasks.giraffe.records import Boxes


def boxes(*middles: list[float], half: float = 0.5, turn: float = 0.0, exists: list[bool] | None = None) -> Boxes:
    count = len(middles)
    return Boxes(
        torch.full((1, count, 3), half),
        torch.tensor([middles]),
        rotation_about_z(torch.full((1, count), turn)),
        torch.tensor([exists or [True] * count]),
    )


def along_x(*offsets: tuple[float, float]) -> Rays:
    """From x = -3 towards +x; two units of length a unit of depth."""
    rays = [torch.tensor([2.0, y, z]) for y, z in offsets]
    return Rays(torch.tensor([[-3.0, 0.0, 0.0]]), torch.stack(rays)[None])


def taken(sampling: Sampling, rays: Rays, at: Boxes, noise: torch.Generator | None = None) -> Samples:
    return sampling.samples(rays, into_boxes(rays, at, sampling.padding), at.exists, noise)


def summed(samples: Samples, weights: Tensor, rays: int) -> Tensor:
    return torch.zeros(rays).index_add(0, samples.objects.ray, weights.sum(1))


def test_compositing_sums_to_what_is_stopped() -> None:
    thickness = torch.rand(4, 6)
    assert_close(seen(thickness).sum(1), 1 - torch.exp(-thickness.sum(1)))
    assert_close(clear(thickness)[:, 0], torch.ones(4))
    assert_close(clear(thickness)[:, -1], torch.exp(-thickness[:, :-1].sum(1)))
    assert_close(seen(walled(thickness)).sum(1), torch.ones(4))
    assert float(seen(walled(torch.zeros(1, 3)))[0, -1]) == 1
    assert_close(per_density(torch.tensor([[0.5, 0.0]]), torch.tensor([[2.0, 0.0]])), [[0.25, 0.0]])


def test_where_rays_cross_boxes() -> None:
    own = into_boxes(along_x((0.0, 0.0), (0.0, 3.0)), boxes([0.0, 0.0, 0.0], [0.0, 5.0, 0.0]), 0.0)
    assert_close(torch.stack([own.enter, own.leave], -1)[0, 0], [1.25, 1.75])  # x from -0.5 to 0.5
    assert (own.enter < own.leave).tolist() == [[True, False], [False, False]]
    padded = into_boxes(along_x((0.0, 0.0)), boxes([0.0, 0.0, 0.0]), 0.1)
    assert_close(torch.stack([padded.enter, padded.leave], -1)[0, 0], [1.225, 1.775])
    turned = into_boxes(along_x((0.0, 0.0)), boxes([0.0, 0.0, 0.0], turn=math.pi / 4), 0.0)
    assert_close((turned.leave - turned.enter)[0, 0], torch.tensor(math.sqrt(2) / 2))
    inside = into_boxes(along_x((0.0, 0.0)), boxes([-3.0, 0.0, 0.0]), 0.0)
    assert_close(torch.stack([inside.enter, inside.leave], -1)[0, 0], [0.0, 0.25])  # not behind the camera
    behind = into_boxes(along_x((0.0, 0.0)), boxes([-9.0, 0.0, 0.0]), 0.0)
    assert not bool((behind.enter < behind.leave).any())


def test_points_in_a_boxs_own_space() -> None:
    torch.manual_seed(0)
    at, rays = boxes([0.3, -0.2, 0.1], half=0.4, turn=0.7), along_x((0.1, 0.2))
    own = into_boxes(rays, at, 0.1)
    p = rays.origins[0] + 1.3 * rays.directions[0, 0]
    expected = at.rotation[0, 0] @ (p - at.translation[0, 0]) / at.scale[0, 0]
    assert_close(own.origins[0] + 1.3 * own.directions[0, 0], expected)


def test_an_even_box_stops_what_its_chord_says() -> None:
    at = boxes([0.0, 0.0, 0.0], turn=math.pi / 4)
    for sampling in (BoxSampling(5, 2, padding=0.0), DenseSampling(4000, 0.5, 6.0, padding=0.0)):
        samples = taken(sampling, along_x((0.0, 0.0)), at)
        density = 0.8 * samples.objects.inside.float()
        weights, behind = sampling.weights(samples, density, torch.zeros_like(samples.background.depths))
        share = 1 - math.exp(-0.8 * math.sqrt(2))
        assert_close(weights.sum(), torch.tensor(share), 1e-3 if isinstance(sampling, DenseSampling) else 1e-6)
        assert_close(weights.sum() + behind.sum(), torch.tensor(1.0))
        assert_close(sampling.alone(samples.objects, density), [share], 1e-3)
        assert float(behind.sum()) == float(behind[0, -1])


def test_what_is_in_front_hides_what_is_behind() -> None:
    for sampling in (BoxSampling(4, 12), DenseSampling(64)):
        rays, at = along_x((0.0, 0.0)), boxes([2.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 9.0, 0.0])
        samples = taken(sampling, rays, at)
        assert sorted(samples.objects.thing.tolist()) == [0, 1]
        nearer = (samples.objects.thing == 1)[:, None]
        density = 1e3 * samples.objects.inside.float()
        nothing = torch.zeros_like(samples.background.depths)
        weights, behind = sampling.weights(samples, density, nothing)
        assert_close((weights * nearer).sum(), torch.tensor(1.0))
        assert float((weights * ~nearer).sum()) + float(behind.sum()) < 1e-5
        fog, thick = sampling.weights(samples, density, nothing + 0.5)
        assert 0.1 < float(fog.sum()) < 0.9
        assert_close(fog.sum() + thick.sum(), torch.tensor(1.0))
        left = sampling.clear(samples, density, nothing)[0]
        far = samples.background.depths[0] > 2
        assert bool(left[~far].gt(0).any())
        assert float(left[far].max()) < 1e-6


def test_dense_samples_of_a_box_are_those_within_it() -> None:
    sampling, noise = DenseSampling(32, padding=0.1), torch.Generator().manual_seed(0)
    at = boxes([0.0, 0.0, 0.0], [0.3, 0.0, 0.0], half=0.6)
    rays = along_x((0.0, 0.0), (0.2, 0.1), (3.0, 0.0))
    for generator in (None, noise):
        samples = taken(sampling, rays, at, generator)
        depths = samples.background.depths
        assert bool((depths.diff(dim=1) >= 0).all())
        for thing, ray, found, inside in zip(
            samples.objects.thing, samples.objects.ray, samples.objects.depths, samples.objects.inside, strict=True
        ):
            points = rays.origins[0] + depths[ray, :, None] * rays.directions[0, ray]
            within = ((points - at.translation[0, thing]).abs() <= 1.1 * 0.6).all(-1)
            assert_close(found[inside], depths[ray][within])
        assert 2 not in samples.objects.ray.tolist()


def test_depths_are_random_within_their_strata() -> None:
    rays, at = along_x(*[(0.0, 0.0)] * 50), boxes([0.0, 0.0, 0.0])
    for sampling in (BoxSampling(4, 3, shaken_background=True), DenseSampling(16)):
        usual, first, again, other = (
            taken(sampling, rays, at, None if seed is None else torch.Generator().manual_seed(seed))
            for seed in (None, 1, 1, 2)
        )
        assert torch.equal(first.background.depths, again.background.depths)
        assert not torch.equal(first.background.depths, other.background.depths)
        stratum = 5.5 / (3 if isinstance(sampling, BoxSampling) else 15)
        shift = (first.background.depths - usual.background.depths).abs()
        assert 0.4 * stratum < float(shift.max()) <= stratum / 2 + 1e-5
        assert abs(float((first.background.depths - usual.background.depths).mean())) < 0.05 * stratum


def test_depths_of_a_background_stay_unless_asked_otherwise_and_those_of_objects_do_not() -> None:
    rays, at = along_x(*[(0.0, 0.0)] * 50), boxes([0.0, 0.0, 0.0])
    usual, shaken = (taken(BoxSampling(4, 3), rays, at, each) for each in (None, torch.Generator().manual_seed(1)))
    assert torch.equal(usual.background.depths, shaken.background.depths)
    assert not torch.equal(usual.objects.depths, shaken.objects.depths)


def test_the_published_last_length_is_a_hole_where_nothing_is() -> None:
    rays, at = along_x((0.0, 0.0)), boxes([0.0, 0.0, 0.0], exists=[False])
    published, honest = DenseSampling(8, last_length=1e10), DenseSampling(8)
    samples = taken(published, rays, at)
    assert len(samples.objects.ray) == 0
    nothing, some = torch.zeros_like(samples.background.depths), torch.full_like(samples.background.depths, 1e-3)
    objects = samples.objects.depths
    assert float(published.weights(samples, objects, nothing)[1].sum()) == 0
    assert_close(published.weights(samples, objects, some)[1].sum(), torch.tensor(1.0))
    assert_close(honest.weights(samples, objects, nothing)[1].sum(), torch.tensor(1.0))
    assert float(published.alone(samples.background, some)) < 0.1


def test_gradients_stay_finite_where_densities_vanish() -> None:
    rays, at = along_x((0.0, 0.0), (9.0, 0.0)), boxes([0.0, 0.0, 0.0], [0.2, 0.0, 0.0])
    for sampling in (BoxSampling(4, 3), DenseSampling(16), DenseSampling(16, last_length=1e10)):
        samples = taken(sampling, rays, at)
        for size in (0.0, 1e-30, 1e-12, 1.0, 1e6):
            objects = torch.full_like(samples.objects.depths, size).requires_grad_()
            background = torch.full_like(samples.background.depths, size).requires_grad_()
            weights = sampling.weights(samples, objects, background)
            (weights[0].square().sum() + (weights[1] * torch.rand_like(weights[1])).sum()).backward()
            assert all(bool(each.grad.isfinite().all()) for each in (objects, background) if each.grad is not None)
            assert float(summed(samples, weights[0].detach(), 2)[1]) == 0


def test_numbers_that_cannot_be() -> None:
    with pytest.raises(UserError, match=r"near below far, got count=64, near=6.0, far=0.5"):
        DenseSampling(near=6.0, far=0.5)
    with pytest.raises(UserError, match="a sample or more of each"):
        BoxSampling(near=2.0, far=1.0)
