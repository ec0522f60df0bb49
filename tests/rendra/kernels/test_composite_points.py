"""Compositing of lists of points: both twins against the formulas, finite differences and each other."""

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.kernels.composite_points import MODES, composite_points, reference

BOTH = pytest.mark.parametrize("twin", [composite_points, reference.composite_points])


def lists(num_lists, layers, points=11, channels=3, seed=0, holes=0.3):
    """Random lists with holes anywhere, opacities among which are 0 and 1, and features."""
    generator = torch.Generator().manual_seed(seed)
    idx = torch.randint(0, points, (num_lists, layers), generator=generator)
    idx = torch.where(torch.rand(idx.shape, generator=generator) < holes, -1, idx)
    alphas = (torch.rand(idx.shape, generator=generator) * 1.4 - 0.2).clamp(0, 1)
    return idx, alphas, torch.randn(points, channels, generator=generator)


@BOTH
@pytest.mark.parametrize("mode", MODES)
def test_against_the_formulas(twin, mode):
    idx, alphas, features = lists(30, 6)
    out = twin(idx, alphas, features, mode)
    for q in range(30):
        total, clear, expected = 0.0, 1.0, torch.zeros(3)
        for k in range(6):
            if idx[q, k] >= 0:
                a = alphas[q, k].item()
                total += a
                expected = expected + features[idx[q, k]] * a * clear
                clear *= 1 - a if mode == "alpha" else 1
        if mode == "norm":
            expected = expected / max(total, 1e-4)
        assert_close(out[q], expected)


@BOTH
def test_what_stands_in_empty_slots_is_ignored(twin):
    idx, alphas, features = lists(20, 5)
    spoilt = torch.where(idx < 0, float("nan"), alphas)
    for mode in MODES:
        assert torch.equal(twin(idx, spoilt, features, mode), twin(idx, alphas, features, mode))


@BOTH
def test_an_opaque_point_hides_what_is_behind_it(twin):
    idx, alphas, features = lists(20, 5, holes=0.0)
    alphas[:, 1] = 1.0
    out = twin(idx, alphas, features, "alpha")
    assert_close(out, twin(idx[:, :2], alphas[:, :2], features, "alpha"))


def test_equal_features_come_out_as_they_are():
    """A mean of equals is that; and over opaque points the same holds of compositing."""
    idx, alphas, _ = lists(50, 7)
    seen = ((alphas * (idx >= 0)).sum(1) > 1e-4)[:, None].float()
    same = torch.tensor([[0.3, -2.0]]).expand(11, 2)
    assert_close(composite_points(idx, alphas, same, "norm"), seen * same[:1])


def test_order_matters_to_compositing_alone():
    idx, alphas, features = lists(40, 8)
    for mode in MODES:
        forth = composite_points(idx, alphas, features, mode)
        back = composite_points(idx.flip(1), alphas.flip(1), features, mode)
        assert torch.allclose(forth, back, atol=1e-5) is (mode != "alpha")


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("num_lists", "layers", "channels"), [(1, 1, 1), (200, 9, 3), (65, 1, 5), (129, 40, 64)])
def test_twins_agree_in_value_and_gradient(mode, num_lists, layers, channels):
    idx, alphas, features = lists(num_lists, layers, channels=channels, seed=num_lists)
    results = []
    for twin, dtype in ((composite_points, torch.float32), (reference.composite_points, torch.float64)):
        leaves = [tensor.to(dtype).requires_grad_() for tensor in (alphas, features)]
        out = twin(idx, *leaves, mode)
        torch.manual_seed(1)
        results.append((out, *torch.autograd.grad(out, leaves, torch.randn(out.shape).to(dtype))))
    for a, b in zip(*results, strict=True):
        assert_finite(a)
        assert_close(a, b, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("mode", MODES)
def test_reference_gradients_are_finite_differences(mode, monkeypatch):
    monkeypatch.setattr(reference, "_NUMBERS_AT_ONCE", 40)
    idx, alphas, features = lists(6, 4)
    leaves = [tensor.double().requires_grad_() for tensor in (0.1 + 0.8 * alphas, features)]
    assert torch.autograd.gradcheck(lambda a, f: composite_points(idx, a, f, mode), leaves)


@BOTH
def test_a_sum_at_its_floor_does_not_move(twin):
    """Weights far below 1e-4 are divided by 1e-4, whatever they are."""
    idx, features = torch.tensor([[0, 1]]), torch.tensor([[2.0], [3.0]])
    alphas = torch.tensor([[1e-6, 2e-6]], requires_grad=True)
    out = twin(idx, alphas, features, "norm")
    assert_close(out, [[0.08]])
    assert_close(torch.autograd.grad(out.sum(), alphas)[0], [[2e4, 3e4]])


@pytest.mark.parametrize("mode", MODES)
def test_results_do_not_depend_on_threads(mode):
    idx, alphas, features = lists(700, 12)
    threads, results = torch.get_num_threads(), []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        leaves = [tensor.clone().requires_grad_() for tensor in (alphas, features)]
        out = composite_points(idx, *leaves, mode)
        results.append((out, *torch.autograd.grad(out.square().sum(), leaves)))
    torch.set_num_threads(threads)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("shape", "points", "channels"), [((0, 4), 5, 3), ((6, 0), 5, 3), ((6, 4), 0, 3), ((6, 4), 5, 0)]
)
def test_nothing_gives_zeros(mode, dtype, shape, points, channels):
    idx = torch.full(shape, -1)
    alphas = torch.rand(shape, dtype=dtype, requires_grad=True)
    features = torch.rand(points, channels, dtype=dtype, requires_grad=True)
    out = composite_points(idx, alphas, features, mode)
    assert out.shape == (shape[0], channels)
    assert (out == 0).all()
    for gradient in torch.autograd.grad(out.sum(), (alphas, features)):
        assert (gradient == 0).all()


def test_lists_stay_on_their_device(far):  # noqa: F811
    idx, alphas, features = lists(20, 5)
    leaf = features.to(far).requires_grad_()
    out = composite_points(idx.to(far), alphas.to(far), leaf, "alpha")
    assert isinstance(out, Far)
    assert_close(out.detach().cpu(), composite_points(idx, alphas, features, "alpha"))
    out.sum().backward()
    assert isinstance(leaf.grad, Far)


def test_the_operator_is_well_registered():
    idx, alphas, features = lists(10, 3)
    arguments = (idx, alphas.requires_grad_(), features.requires_grad_(), 0)
    checks = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(torch.ops.rendra.composite_points.default, arguments, test_utils=checks)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mode": "over"}, "mode must be one of alpha, sum, norm, got over"),
        ({"idx": torch.zeros(4, 2)}, r"idx must be int64 of shape \(Q, K\)"),
        ({"idx": torch.full((4, 2), 3)}, "idx names point 3, but features are those of 3 points"),
        ({"alphas": torch.zeros(4, 3)}, r"alphas must be torch.float32 of shape \(4, 2\)"),
        ({"alphas": torch.zeros(4, 2).double()}, r"alphas must be torch.float32 of shape \(4, 2\)"),
        ({"features": torch.zeros(3)}, r"features must be floats of shape \(P, C\)"),
        ({"features": torch.zeros(3, 1, dtype=torch.uint8)}, r"features must be floats of shape \(P, C\)"),
    ],
)
def test_bad_input_is_named(change, message):
    arguments = {
        "idx": torch.zeros(4, 2, dtype=torch.int64), "alphas": torch.zeros(4, 2), "features": torch.zeros(3, 1),
        "mode": "alpha",
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        composite_points(**{**arguments, **change})


@pytest.mark.gpu
def test_cuda_takes_the_reference():
    idx, alphas, features = lists(200, 8)
    for mode in MODES:
        cuda = composite_points(idx.cuda(), alphas.cuda(), features.cuda(), mode)
        assert_close(cuda.cpu(), composite_points(idx, alphas, features, mode))
