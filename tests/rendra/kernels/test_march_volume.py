"""The fused march through grids against its reference in float64, closed forms, and itself on other threads."""

import math

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.kernels.march_volume import march_volume

ACTIVE = ("softplus", "sigmoid")


def scene(shape=(7, 6, 5), channels=4, grids=2, rays=40, samples=30, seed=0):
    """Rays towards random points of small grids: from inside, from outside, and past them."""
    torch.manual_seed(seed)
    size = torch.tensor(shape[::-1]).float()
    grid = 0.3 * torch.rand(grids, *shape, channels)
    origins = (torch.rand(2, rays, 3) * 3 - 1) * size
    directions = (torch.rand(2, rays, 3) * 1.2 * size - origins) / samples
    return grid, origins, directions, torch.rand(2, rays), 1.3, samples


def gradients(grid, *rest, dtype=torch.float32, weights=None, **options):
    """Results, the gradient of the grid for random weights of the results, and the weights."""
    leaf = grid.to(dtype).requires_grad_()
    places = [each.to(dtype) if isinstance(each, torch.Tensor) else each for each in rest]
    seen = march_volume(leaf, *places, **options)
    weights = [torch.randn_like(each) for each in seen] if weights is None else weights
    total = sum((each * weight).sum() for each, weight in zip(seen, weights, strict=True))
    (gradient,) = torch.autograd.grad(total, leaf)
    return [each.detach() for each in seen], gradient, weights


OPTIONS = {
    "opacity": {},
    "density": {"mode": "density", "delta": 0.7},
    "softplus": {"mode": "density", "delta": 0.7, "activations": ACTIVE},
    "exp": {"mode": "density", "delta": 0.7, "activations": ("exp", "none")},
    "sigmoid": {"activations": ("sigmoid", "sigmoid")},
    "stopped": {"mode": "density", "delta": 2.0, "stop_below": 0.3},
    "cells": {"occupancy": torch.rand(3, 4, 9, generator=torch.Generator().manual_seed(0)) > 0.6},
    "cell": {"occupancy": torch.ones(1, 1, 1, dtype=torch.uint8), "activations": ACTIVE},
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("grids", [1, 2])
def test_value_and_gradient_agree_with_the_reference_in_float64(options, grids):
    given = scene(grids=grids)
    fast, fast_gradient, weights = gradients(*given, **options)
    slow, slow_gradient, _ = gradients(*given, dtype=torch.float64, weights=weights, **options)
    for a, b in zip(fast, slow, strict=True):
        assert_close(a, b.float(), atol=3e-5, rtol=2e-5)
    assert (fast_gradient - slow_gradient).norm() <= 1e-5 * slow_gradient.norm()


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 6, 5), (7, 1, 2), (40, 3, 2), (33, 2, 3)], ids=str)
@pytest.mark.parametrize("channels", [4, 2])
def test_flat_and_long_grids(shape, channels):
    given = scene(shape, channels)
    fast, fast_gradient, weights = gradients(*given)
    slow, slow_gradient, _ = gradients(*given, dtype=torch.float64, weights=weights)
    assert_close(fast[0], slow[0].float(), atol=3e-5)
    assert (fast_gradient - slow_gradient).norm() <= 1e-5 * slow_gradient.norm() + 1e-6


@pytest.mark.parametrize("channels", [1, 3, 40])
def test_any_number_of_channels(channels):
    given = scene(channels=channels, rays=5)
    fast, fast_gradient, weights = gradients(*given)
    slow, slow_gradient, _ = gradients(*given, dtype=torch.float64, weights=weights)
    assert fast[0].shape == (2, 5, channels - 1)
    assert_close(fast[1], slow[1].float(), atol=3e-5)
    assert (fast_gradient - slow_gradient).norm() <= 1e-5 * slow_gradient.norm()


def test_rays_along_axes_and_rays_that_stand_still():
    grid, origins, directions, *rest = scene()
    directions = directions * torch.nn.functional.one_hot(torch.arange(40) % 4, 4)[:, :3]
    given = grid, origins.round(), directions.sign(), *rest
    fast, fast_gradient, weights = gradients(*given)
    slow, slow_gradient, _ = gradients(*given, dtype=torch.float64, weights=weights)
    assert_close(fast[2], slow[2].float(), atol=1e-4)
    assert (fast_gradient - slow_gradient).norm() <= 1e-5 * slow_gradient.norm()


def test_a_slab_of_even_density_absorbs_by_beer_and_lambert():
    """1 - exp(-sigma d) over the distance d between the outermost centres, whatever the number of samples."""
    grid = torch.full((1, 11, 3, 3, 2), 0.25)
    for samples in (40, 400):
        step = 20 / samples
        seen = march_volume(
            grid, torch.tensor([[[1.0, 1, -5]]]), torch.tensor([[[0.0, 0, 1]]]), 0.5 * step, step, samples,
            mode="density", delta=step, activations=("none", "sigmoid"),
        )  # fmt: skip
        opacity = 1 - math.exp(-0.25 * 10)
        assert seen.opacity.item() == pytest.approx(opacity, rel=2e-5)
        assert seen.features.item() == pytest.approx(opacity / (1 + math.exp(-0.25)), rel=2e-5)
    mean = 5 + 4 - 10 * (1 - opacity) / opacity  # of an exponential distribution cut off at 10
    assert seen.depth.item() / opacity == pytest.approx(mean, rel=1e-3)


def test_an_opaque_voxel_has_the_gradient_of_what_it_hides():
    """Three voxels and a sample on each: dF/da_0 = f_0 - a_1 f_1 - (1 - a_1) a_2 f_2."""
    grid = torch.tensor([[1.0, 0.5], [0.25, 3.0], [1.0, 2.0]]).view(1, 1, 1, 3, 2).requires_grad_()
    seen = march_volume(grid, torch.zeros(1, 1, 3), torch.tensor([[[1.0, 0, 0]]]), 0.0, 1.0, 3)
    seen.features.sum().backward()
    assert_close(grid.grad.view(3, 2), [[0.5 - 0.75 - 0.75 * 2, 1.0], [0.0, 0.0], [0.0, 0.0]])


def test_an_occupancy_that_is_right_changes_nothing():
    grid, *rest = scene(shape=(17, 17, 17), grids=1, samples=200)
    grid[:, 6:] = 0  # of 17 planes; cells of 4 have their borders at 0, 4, 8, 12 and 16
    occupancy = torch.zeros(4, 4, 4, dtype=torch.bool)
    occupancy[:2] = True
    whole, part = gradients(grid, *rest), gradients(grid, *rest, occupancy=occupancy)
    assert all(map(torch.equal, whole[0], part[0]))


def test_empty_cells_are_seen_through():
    given = scene(shape=(9, 9, 9), grids=1)
    seen, gradient, _ = gradients(*given, occupancy=torch.zeros(5, 2, 3, dtype=torch.bool))
    assert all(each.abs().max() == 0 for each in (*seen, gradient))


def test_results_do_not_depend_on_threads():
    given = scene(shape=(37, 20, 20), grids=1, rays=300, samples=90)
    threads, results = torch.get_num_threads(), []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        torch.manual_seed(1)
        seen, gradient, _ = gradients(*given)
        results.append((*seen, gradient))
    torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(map(torch.equal, results[0], other))


def test_chunks_of_rays_add_up(monkeypatch):
    given = scene()
    _, whole, weights = gradients(*given)
    monkeypatch.setattr("rendra.kernels.march_volume.numba_cpu._BYTES_AT_ONCE", 7 * 30 * 20)
    _, pieces, _ = gradients(*given, weights=weights)
    assert_close(pieces, whole, atol=1e-4)


def test_every_element_is_written(monkeypatch):
    given = scene()
    fill = torch.Tensor.new_empty
    monkeypatch.setattr(torch.Tensor, "new_empty", lambda self, *shape: fill(self, *shape).fill_(math.nan))
    for each in march_volume(*given):
        assert_finite(each)


def test_rays_get_gradients_too():
    grid, origins, directions, first, step, samples = scene(rays=3)
    origins.requires_grad_()
    march_volume(grid, origins, directions, first, step, samples).opacity.sum().backward()
    assert_finite(origins.grad)
    assert origins.grad.abs().max() > 0


@pytest.mark.parametrize(
    "options", [{}, {"mode": "density", "delta": 0.5, "activations": ACTIVE}], ids=["raw", "active"]
)
def test_reference_gradients_are_finite_differences(options):
    grid, *rest = scene(shape=(2, 3, 2), rays=4, samples=6)
    rest = [each.double() if isinstance(each, torch.Tensor) else each for each in rest]
    assert torch.autograd.gradcheck(
        lambda g: tuple(march_volume(g, *rest, **options)), grid.double().requires_grad_()
    )


@pytest.mark.parametrize(("batches", "rays", "samples"), [(0, 5, 4), (2, 0, 4), (2, 5, 0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nothing_to_march(batches, rays, samples, dtype):
    grid = torch.rand(1, 2, 3, 4, 4, dtype=dtype, requires_grad=True)
    seen = march_volume(grid, *torch.rand(2, batches, rays, 3, dtype=dtype), 0.0, 1.0, samples)
    assert [tuple(each.shape) for each in seen] == [(batches, rays, 3), (batches, rays), (batches, rays)]
    sum(each.sum() for each in seen).backward()
    assert all(each.abs().sum() == 0 for each in (*seen, grid.grad))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_not_finite_is_seen(dtype):
    grid, origins, directions, first, step, samples = scene(rays=6)
    origins[0, 2, 1], directions[1, 3, 0] = math.nan, math.inf
    given = [each.to(dtype) for each in (grid, origins, directions)]
    seen = march_volume(*given, first.to(dtype), step, samples)
    is_lost = torch.zeros(2, 6, dtype=torch.bool)
    is_lost[0, 2], is_lost[1, 3] = True, True
    assert torch.equal(seen.opacity.isnan(), is_lost)
    assert torch.equal(seen.features.isnan().all(-1), is_lost)
    given[0] = torch.full_like(given[0], math.nan)
    blind = march_volume(*given, first.to(dtype), step, samples)
    assert blind.opacity.isnan().sum() > 2


def test_the_operator_is_well_registered():
    grid, *_ = scene(rays=4)
    arguments = (grid.requires_grad_(), torch.rand(2, 4, 9), None, 5, "opacity", "none", "none", 0.0)
    torch.library.opcheck(torch.ops.rendra.march_volume.default, arguments)


def test_grids_elsewhere_stay_there(far):  # noqa: F811
    grid, origins, directions, first, step, samples = scene(rays=4)
    cells = torch.ones(2, 2, 2, dtype=torch.bool)
    seen = march_volume(
        grid.to(far), origins.to(far), directions.to(far), first.to(far), step, samples, occupancy=cells.to(far)
    )
    assert all(isinstance(each, Far) for each in seen)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"grid": torch.zeros(2, 3, 3, 4)}, r"grid must be floats of shape .* got torch.float32 of \(2, 3, 3, 4\)"),
        ({"grid": torch.zeros(3, 3, 3, 3, 4)}, "1 grid, or one for each of 2 batches of rays; got 3"),
        ({"grid": torch.zeros(1, 0, 3, 3, 4)}, "grid must be floats"),
        ({"origins": torch.zeros(2, 5, 3)}, r"got \(2, 5, 3\) and \(2, 4, 3\)"),
        ({"origins": torch.zeros(2, 4, 3).double()}, "origins must be torch.float32 on cpu, got torch.float64"),
        (
            {"first_length": torch.zeros(3)},
            r"first_length must be a number or expand to \(N, R\) = \(2, 4\), got \(3,\)",
        ),
        ({"num_samples": -1}, "num_samples must not be negative, got -1"),
        ({"stop_below": 1.0}, r"stop_below must be in \[0, 1\), got 1.0"),
        ({"mode": "alpha"}, "mode must be one of opacity, density; got 'alpha'"),
        ({"mode": "density"}, "delta belongs to mode='density'"),
        ({"delta": 1.0}, "delta belongs to mode='density'"),
        ({"activations": ("relu", "none")}, "activations must be one of none, sigmoid, softplus, exp"),
        ({"occupancy": torch.ones(2, 2)}, r"occupancy must be bool or uint8 of shape \(d, h, w\), got torch.float32"),
    ],
)
def test_impossible_input_is_refused(change, message):
    grid, origins, directions, *_ = scene(rays=4)
    given = {"grid": grid, "origins": origins, "directions": directions, "first_length": 0.0, "step_length": 1.0}
    with pytest.raises(ValueError, match=message):
        march_volume(**(given | {"num_samples": 5} | change))
