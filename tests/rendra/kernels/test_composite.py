"""Compositing against its reference, against closed forms, and its gradients."""

import math

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.kernels.composite import (
    alphas_of,
    compact,
    composite_alphas,
    composite_densities,
    numba_cpu,
    visible,
)


def ragged(num_rays=60, longest=30, channels=3):
    """Packed samples: alphas, densities, deltas, features, positions, ray_first; some rays are empty."""
    counts = torch.randint(0, longest, (num_rays,))
    counts[::7] = 0
    first = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    total = int(first[-1])
    alphas = 0.4 * torch.rand(total)
    alphas[torch.rand(total) < 0.05] = 1.0
    alphas[torch.rand(total) < 0.05] = 0.0
    densities, deltas = torch.randn(total).mul(3).exp(), 0.05 * torch.rand(total)
    return alphas, densities, deltas, torch.randn(total, channels), 7 * torch.rand(total), first


def arguments(form, data, dtype=torch.float32):
    alphas, densities, deltas, features, positions, first = data
    leaves = (alphas, features, positions) if form == "alphas" else (densities, deltas, features, positions)
    function = composite_alphas if form == "alphas" else composite_densities
    leaves = [x.to(dtype).clone().requires_grad_() for x in leaves]
    return leaves, lambda stop=0.0: function(*leaves, first, stop)


def values_and_gradients(form, data, dtype=torch.float32, stop=0.0, outputs=(0, 1, 2, 3)):
    leaves, run = arguments(form, data, dtype)
    results = run(stop)
    generator = torch.Generator().manual_seed(3)
    upstream = [torch.randn(x.shape, generator=generator).to(dtype) for x in results]
    loss = sum((results[k] * upstream[k]).sum() for k in outputs)
    return [*(x.detach() for x in results), *torch.autograd.grad(loss, leaves, materialize_grads=True)]


def assert_alike(fast, slow, tolerance=1e-5):
    for a, b in zip(fast, slow, strict=True):
        assert_finite(a)
        assert (a - b).abs().max() <= tolerance * (b.abs().max() + 1) if b.numel() else a.shape == b.shape


@pytest.mark.parametrize("form", ["alphas", "densities"])
@pytest.mark.parametrize("channels", [3, 1, 5, 0])
@pytest.mark.parametrize("stop", [0.0, 0.05])
def test_value_and_gradient_agree_with_the_reference_in_float64(form, channels, stop):
    data = ragged(channels=channels)
    assert_alike(
        values_and_gradients(form, data, stop=stop), values_and_gradients(form, data, torch.float64, stop=stop)
    )


@pytest.mark.parametrize("outputs", [(0,), (1,), (2,), (3,)])
def test_each_result_has_its_own_gradient(outputs):
    data = ragged()
    fast, slow = (values_and_gradients("alphas", data, dtype, 0, outputs) for dtype in (torch.float32, torch.float64))
    assert_alike(fast, slow)


@pytest.mark.parametrize("form", ["alphas", "densities"])
def test_reference_gradients_are_finite_differences(form):
    data = ragged(4, 6, 2)
    data[0].clamp_(max=0.9)
    data[1].clamp_(max=30.0)
    leaves, _ = arguments(form, data, torch.float64)
    function = composite_alphas if form == "alphas" else composite_densities
    assert torch.autograd.gradcheck(lambda *x: tuple(function(*x, data[-1])), leaves)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("sigma", [1e-7, 0.3, 40.0])
def test_a_slab_of_constant_density(dtype, sigma):
    """Opacity 1 - exp(-sigma L), colour in proportion, depth (1 - (1 + sigma L) exp(-sigma L)) / sigma."""
    count, length = 4000, 2.0
    edges = torch.linspace(0, length, count + 1, dtype=torch.float64)
    deltas, middles = edges.diff().to(dtype), ((edges[1:] + edges[:-1]) / 2).to(dtype)
    colour = torch.tensor([[0.2, 0.5, 1.0]], dtype=dtype).expand(count, 3)
    seen = composite_densities(torch.full_like(deltas, sigma), deltas, colour, middles, torch.tensor([0, count]))
    opacity = -math.expm1(-sigma * length)
    depth = (opacity - sigma * length * math.exp(-sigma * length)) / sigma
    assert float(seen.opacity) == pytest.approx(opacity, rel=1e-6)
    assert seen.features[0].tolist() == pytest.approx([0.2 * opacity, 0.5 * opacity, opacity], rel=1e-4)
    assert float(seen.depth) == pytest.approx(depth, rel=1e-4)
    assert float(seen.weights.sum()) == pytest.approx(opacity, rel=1e-4)


def test_an_opaque_sample_hides_what_is_behind_and_gets_a_finite_gradient():
    alphas = torch.tensor([0.25, 1.0, 0.5], requires_grad=True)
    features, first = torch.tensor([[1.0], [10.0], [100.0]]), torch.tensor([0, 3])
    seen = composite_alphas(alphas, features, torch.tensor([1.0, 2, 3]), first)
    assert_close(seen.features[0], [0.25 + 7.5])
    assert_close(seen.opacity, [1.0])
    assert_close(seen.depth, [0.25 + 1.5])
    # d/da_0 = f_0 - f_1; d/da_1 = 0.75 (f_1 - 0.5 f_2); nothing is seen of the last
    assert_close(torch.autograd.grad(seen.features.sum(), alphas)[0], [-9.0, 0.75 * (10 - 50), 0.0])


def test_densities_keep_their_digits_where_they_are_tiny_and_where_they_are_huge():
    densities, deltas = torch.tensor([1e-9, 3e-5, 20.0], requires_grad=True), torch.ones(3)
    first, ones = torch.tensor([0, 1, 2, 3]), torch.ones(3, 1)
    seen = composite_densities(densities, deltas, ones, ones[:, 0], first)
    exact = densities.detach().double()
    torch.testing.assert_close(seen.opacity.double(), -torch.expm1(-exact), rtol=3e-7, atol=0)
    (grad,) = torch.autograd.grad(seen.opacity.sum(), densities)
    torch.testing.assert_close(grad.double(), torch.exp(-exact), rtol=2e-6, atol=0)
    torch.testing.assert_close(
        alphas_of(densities.detach(), deltas).double(), -torch.expm1(-exact), rtol=3e-7, atol=0
    )


def test_many_thin_samples_let_through_what_one_thick_one_does():
    thin, ones = torch.full((100_000,), 1e-8), torch.ones(100_000)
    seen = composite_densities(thin, ones, ones[:, None], ones, torch.tensor([0, 100_000]))
    assert float(seen.opacity) == pytest.approx(-math.expm1(-1e-3), rel=1e-6)


def test_both_forms_agree():
    _, densities, deltas, *others = ragged()
    by_density = composite_densities(densities, deltas, *others)
    by_alpha = composite_alphas(alphas_of(densities, deltas), *others)
    assert_alike(by_density, by_alpha)


def test_empty_rays_see_nothing():
    none, first = torch.zeros(0), torch.zeros(4, dtype=torch.int64)
    for dtype in (torch.float32, torch.float64):
        seen = composite_alphas(none.to(dtype), torch.zeros(0, 3, dtype=dtype), none.to(dtype), first)
        assert [x.shape for x in seen] == [(3, 3), (3,), (3,), (0,)]
        assert all((x == 0).all() for x in seen)
        seen = composite_alphas(none.to(dtype), torch.zeros(0, 3, dtype=dtype), none.to(dtype), first[:1])
        assert [x.shape for x in seen] == [(0, 3), (0,), (0,), (0,)]


def test_what_is_not_visible_is_what_stopping_leaves_out():
    alphas, _, _, features, positions, first = ragged()
    mask = visible(alphas, first, 0.05)
    assert torch.equal(mask, visible(alphas.double(), first, 0.05))
    stopped = composite_alphas(alphas, features, positions, first, stop_below=0.05)
    assert (stopped.weights[~mask] == 0).all()
    assert_close(stopped.weights[mask], composite_alphas(alphas, features, positions, first).weights[mask])
    assert visible(alphas, first, 0.0).all()
    kept, firsts = compact(mask, first)
    again = composite_alphas(alphas[kept], features[kept], positions[kept], firsts)
    for a, b in zip(again[:3], stopped[:3], strict=True):
        assert torch.equal(a, b)


def test_compacting_keeps_rays_apart():
    mask = torch.tensor([True, False, True, False, False, True])
    kept, first = compact(mask, torch.tensor([0, 2, 2, 5, 6]))
    assert kept.tolist() == [0, 2, 5]
    assert first.tolist() == [0, 1, 1, 2, 3]
    assert compact(mask[:0], torch.tensor([0, 0]))[1].tolist() == [0, 0]


def test_every_element_is_written():
    alphas, densities, deltas, features, positions, first = ragged()
    rays, total = len(first) - 1, len(alphas)
    shapes = (rays, 3), (rays,), (rays,), (total,)
    for values, lengths in ((alphas, None), (densities, deltas.numpy())):
        packed = values.numpy(), lengths, features.numpy(), positions.numpy()
        outputs = [torch.full(shape, float("nan")).numpy() for shape in shapes]
        numba_cpu.forward(packed, first.numpy(), 0.2, tuple(outputs))
        sizes = (total,), (0 if lengths is None else total,), (total, 3), (total,)
        grads = [torch.full(size, float("nan")).numpy() for size in sizes]
        numba_cpu.backward(packed, first.numpy(), outputs[3], 0.2, tuple(outputs), tuple(grads))
        for array in (*outputs, *grads):
            assert_finite(torch.from_numpy(array))
    mask = torch.full((total,), True)
    mask.view(torch.uint8).fill_(77)
    numba_cpu.visible(alphas.numpy(), first.numpy(), 0.1, mask.numpy())
    assert (mask.view(torch.uint8) <= 1).all()


@pytest.mark.parametrize("form", ["alphas", "densities"])
def test_results_do_not_depend_on_threads(form):
    data, threads, results = ragged(400), torch.get_num_threads(), []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        results.append(values_and_gradients(form, data))
    torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_far_devices_take_the_reference(far):  # noqa: F811
    alphas, densities, deltas, features, positions, first = ragged()
    for form, values in ((composite_alphas, (alphas,)), (composite_densities, (densities, deltas))):
        near = form(*values, features, positions, first, 0.01)
        there = form(*(x.to(far) for x in (*values, features, positions, first)), 0.01)
        assert all(isinstance(x, Far) for x in there)
        assert_alike([x.cpu() for x in there], near)
    mask = visible(alphas.to(far), first.to(far), 0.05)
    assert torch.equal(mask.cpu(), visible(alphas, first, 0.05))
    kept, firsts = compact(mask, first.to(far))
    assert torch.equal(kept.cpu(), mask.cpu().nonzero().squeeze(1))
    assert isinstance(firsts, Far)


def test_strides_do_not_matter():
    alphas, _, _, features, positions, first = ragged()
    turned = features.T.contiguous().T
    expected = composite_alphas(alphas, features, positions, first)
    for a, b in zip(composite_alphas(alphas, turned, positions, first), expected, strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("form", ["alphas", "densities"])
def test_the_operator_is_well_registered(form):
    alphas, densities, deltas, features, positions, first = ragged(8, 5)
    values, lengths = (alphas, None) if form == "alphas" else (densities, deltas)
    leaves = [x if x is None else x.requires_grad_() for x in (values, lengths, features, positions)]
    torch.library.opcheck(torch.ops.rendra.composite.default, (*leaves, first, 0.1))


def test_bad_input_is_named():
    alphas, densities, deltas, features, positions, first = ragged()
    for change, message in (
        ({"features": features[1:]}, r"features must have shape \(\d+, C\)"),
        ({"positions": positions.double()}, "positions must have shape"),
        ({"alphas": alphas[:, None]}, r"alphas must be floats of shape \(M,\)"),
        ({"ray_first": first.int()}, "ray_first must be int64"),
        ({"ray_first": first[:-2]}, "end at the number of samples"),
        ({"stop_below": 1.5}, r"stop_below must be a transmittance in \[0, 1\], got 1.5"),
    ):
        given = {"alphas": alphas, "features": features, "positions": positions, "ray_first": first, **change}
        with pytest.raises(ValueError, match=message):
            composite_alphas(**given)
    with pytest.raises(ValueError, match="deltas must have shape"):
        composite_densities(densities, deltas[1:], features, positions, first)
    with pytest.raises(ValueError, match="threshold must be"):
        visible(alphas, first, -0.1)
    with pytest.raises(ValueError, match="mask must be bool"):
        compact(alphas, first)


@pytest.mark.gpu
def test_cuda_takes_the_reference():
    data = ragged()
    cuda = values_and_gradients("densities", [x.cuda() for x in data])
    assert_alike([x.cpu() for x in cuda], values_and_gradients("densities", data))
