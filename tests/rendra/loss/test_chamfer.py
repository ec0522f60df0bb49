"""Chamfer distance: closed forms, symmetries, its two paths against each other, options and errors."""

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.loss import chamfer_distance
from rendra.structures import Pointclouds


def clouds(N=3, P1=40, P2=55, D=3, dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    x, y = (torch.randn(N, P, D, generator=generator).to(dtype) for P in (P1, P2))
    return x.requires_grad_(), y.requires_grad_()


def by_hand(x, y, x_lengths, y_lengths, norm=2):
    """Per cloud and way, the nearest distances: lists of (length,)."""
    ways = ([], [])
    for a, b, la, lb in zip(x, y, x_lengths, y_lengths, strict=True):
        table = torch.cdist(a[:la], b[:lb], p=float(norm), compute_mode="donot_use_mm_for_euclid_dist") ** norm
        ways[0].append(table.amin(1) if lb else a.new_zeros(la))
        ways[1].append(table.amin(0) if la else a.new_zeros(lb))
    return ways


def test_two_points():
    """One point at distance 5 from another: 25 each way; absolute differences 3 + 4."""
    x, y = torch.zeros(1, 1, 3), torch.tensor([[[3.0, 4.0, 0.0]]])
    assert_close(chamfer_distance(x, y)[0], 50.0)
    assert_close(chamfer_distance(x, y, norm=1)[0], 14.0)
    assert_close(chamfer_distance(x, y, single_directional=True)[0], 25.0)
    assert chamfer_distance(x, y)[1] is None


def test_a_cloud_is_no_distance_from_itself_in_any_order():
    x, _ = clouds()
    loss, _ = chamfer_distance(x, x.flip(1))
    loss.backward()
    assert loss == 0
    assert (x.grad == 0).all()


def test_both_ways_are_symmetric():
    x, y = clouds()
    assert_close(chamfer_distance(x, y)[0], chamfer_distance(y, x)[0])


LENGTHS = (torch.tensor([40, 7, 0]), torch.tensor([55, 0, 20]))


@pytest.mark.parametrize("point_reduction", ["mean", "sum", "max"])
@pytest.mark.parametrize("batch_reduction", ["mean", "sum", None])
@pytest.mark.parametrize("norm", [1, 2])
@pytest.mark.parametrize("single", [True, False])
def test_reductions_are_what_they_say(point_reduction, batch_reduction, norm, single):
    x, y = clouds()
    weights = torch.tensor([0.5, 2.0, 1.0])
    loss, _ = chamfer_distance(
        x, y, *LENGTHS, weights=weights, batch_reduction=batch_reduction, point_reduction=point_reduction, norm=norm,
        single_directional=single,
    )  # fmt: skip
    reduce = {"mean": lambda d: d.mean() if len(d) else d.sum(), "sum": torch.sum,
              "max": lambda d: d.amax() if len(d) else d.sum()}[point_reduction]  # fmt: skip
    there, back = (torch.stack([reduce(d) for d in way]) for way in by_hand(x, y, *LENGTHS, norm))
    both = torch.maximum(there, back) if point_reduction == "max" else there + back
    expected = (there if single else both) * weights
    if batch_reduction is not None:
        expected = expected.sum() / (weights.sum() if batch_reduction == "mean" else 1)
    assert_close(loss, expected)
    grads = torch.autograd.grad(loss.sum(), (x, y)), torch.autograd.grad(expected.sum(), (x, y))
    for ours, theirs in zip(*grads, strict=True):
        assert_close(ours, theirs, atol=1e-4)


@pytest.mark.parametrize("D", [1, 2, 3, 4])
@pytest.mark.parametrize("norm", [1, 2])
def test_the_fused_path_equals_the_general_one(D, norm):
    x, y = clouds(P1=150, P2=260, D=D)
    lengths = torch.tensor([150, 31, 0]), torch.tensor([260, 0, 9])
    fused, _ = chamfer_distance(x, y, *lengths, norm=norm)
    fused_grads = torch.autograd.grad(fused, (x, y))
    ways, _ = chamfer_distance(x, y, *lengths, batch_reduction=None, point_reduction=None, norm=norm)
    means = [way.sum(1) / length.clamp(min=1) for way, length in zip(ways, lengths, strict=True)]
    general = sum(means).mean()
    assert_close(fused, general)
    for ours, theirs in zip(fused_grads, torch.autograd.grad(general, (x, y)), strict=True):
        assert_close(ours, theirs, atol=1e-6)


def test_single_precision_agrees_with_double():
    x, y = clouds(P1=500, P2=400)
    doubles = [p.detach().double().requires_grad_() for p in (x, y)]
    loss, expected = chamfer_distance(x, y)[0], chamfer_distance(*doubles)[0]
    assert_close(loss, expected.float())
    for ours, theirs in zip(torch.autograd.grad(loss, (x, y)), torch.autograd.grad(expected, doubles), strict=True):
        assert_close(ours, theirs.float(), atol=1e-7)


@pytest.mark.parametrize("point_reduction", ["mean", None])
def test_gradients_are_finite_differences(point_reduction):
    x, y = clouds(N=2, P1=5, P2=6, dtype=torch.float64)
    reduction = {"batch_reduction": "mean" if point_reduction else None, "point_reduction": point_reduction}
    lengths = torch.tensor([5, 3]), torch.tensor([2, 6])
    assert torch.autograd.gradcheck(lambda a, b: chamfer_distance(a, b, *lengths, **reduction)[0], (x, y))
    normals = [torch.randn(2, P, 3).double().requires_grad_() for P in (5, 6)]
    assert torch.autograd.gradcheck(
        lambda n, m: chamfer_distance(x, y, *lengths, n, m, **reduction)[1], tuple(normals)
    )


@pytest.mark.parametrize("abs_cosine", [True, False])
def test_normals_count_by_their_angle(abs_cosine):
    """Normals at 60 degrees cost 1 - 1/2; opposite ones nothing, or 2."""
    x = torch.tensor([[[0.0, 0, 0], [9, 0, 0]]])
    up = torch.tensor([[[0.0, 0, 1], [0, 0, 2]]])
    tilted = torch.tensor([[[0.0, 3**0.5 / 2, 0.5], [0, 0, -1]]])
    dist, normals = chamfer_distance(x, x, x_normals=up, y_normals=tilted, abs_cosine=abs_cosine)
    assert dist == 0
    assert_close(normals, 2 * (0.5 + (0.0 if abs_cosine else 2.0)) / 2)
    _, (there, back) = chamfer_distance(
        x, x, x_normals=up, y_normals=tilted, abs_cosine=abs_cosine, batch_reduction=None, point_reduction=None
    )
    assert_close(there, [[0.5, 0.0 if abs_cosine else 2.0]])
    assert_close(back, there)
    assert chamfer_distance(x, x, x_normals=up)[1] is None


def test_normals_of_padding_do_not_count():
    x, y = clouds()
    normals = [torch.randn_like(p) for p in (x, y)]
    loss, cosine = chamfer_distance(x, y, *LENGTHS, *normals, batch_reduction=None)
    alone = chamfer_distance(x[:1], y[:1], x_normals=normals[0][:1], y_normals=normals[1][:1])
    assert_close(torch.stack([loss[0], cosine[0]]), torch.stack(alone))
    assert loss[1:].tolist() == cosine[1:].tolist() == [0.0, 0.0]


def test_pointclouds_bring_lengths_and_normals():
    x, y = clouds()
    points = [
        [p.detach()[n, :length] for n, length in enumerate(lengths)]
        for p, lengths in ((x, [40, 7, 3]), (y, [55, 1, 20]))
    ]
    normals = [[torch.randn_like(p) for p in batch] for batch in points]
    first, second = (Pointclouds(p, normals=n) for p, n in zip(points, normals, strict=True))
    loss, cosine = chamfer_distance(first, second)
    expected = chamfer_distance(
        x, y, torch.tensor([40, 7, 3]), torch.tensor([55, 1, 20]), first.normals_padded(), second.normals_padded()
    )
    assert_close(torch.stack([loss, cosine]), torch.stack(expected))
    assert chamfer_distance(Pointclouds(points[0]), second)[1] is None


def test_weights_of_zero_give_zero():
    x, y = clouds()
    for options in ({}, {"batch_reduction": None}, {"point_reduction": "sum"}, {"point_reduction": "max"}):
        loss, _ = chamfer_distance(x, y, weights=torch.zeros(3), **options)
        assert (loss == 0).all()
        for grad in torch.autograd.grad(loss.sum(), (x, y)):
            assert (grad == 0).all()


@pytest.mark.parametrize("shape", [(0, 5, 3), (2, 0, 3)])
def test_nothing_is_no_distance_away(shape):
    x = torch.zeros(shape, requires_grad=True)
    for options in ({}, {"point_reduction": "max"}, {"norm": 1}):
        loss, _ = chamfer_distance(x, torch.zeros(shape[0], 4, 3), **options)
        assert loss == 0
        loss.backward()
        assert_finite(x.grad)


def test_shapes_without_reduction():
    x, y = clouds()
    none = {"batch_reduction": None, "point_reduction": None}
    (there, back), _ = chamfer_distance(x, y, **none)
    assert (there.shape, back.shape) == ((3, 40), (3, 55))
    assert chamfer_distance(x, y, single_directional=True, **none)[0].shape == (3, 40)


@pytest.mark.parametrize("options", [{}, {"batch_reduction": None, "point_reduction": "max"}, {"norm": 1}])
def test_it_stays_on_the_device_of_its_input(far, options):  # noqa: F811
    x, y = clouds(P1=6, P2=7)
    there = [p.detach().to(far).requires_grad_() for p in (x, y)]
    loss, _ = chamfer_distance(*there, weights=torch.ones(3, device=far), **options)
    assert isinstance(loss, Far)
    expected, _ = chamfer_distance(x, y, weights=torch.ones(3), **options)
    assert_close(loss.cpu(), expected)
    loss.sum().backward()
    expected.sum().backward()
    assert_close(there[0].grad.cpu(), x.grad, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"batch_reduction": "max"}, r"batch_reduction must be one of \[\"mean\", \"sum\"\] or None, got 'max'"),
        ({"point_reduction": "min"}, "point_reduction must be one of"),
        ({"point_reduction": None}, "Batch reduction must be None if point_reduction is None"),
        ({"norm": 0}, "Support for 1 or 2 norm"),
        ({"x": torch.zeros(4, 3)}, r"shape \(N, P, D\), got \(4, 3\)"),
        ({"x": [[0.0]]}, "either Pointclouds objects or torch.Tensor"),
        ({"y": torch.zeros(3, 5, 3)}, "y does not have the correct shape"),
        ({"y": torch.zeros(2, 5, 2)}, "y does not have the correct shape"),
        ({"x_lengths": torch.tensor([1])}, r"Expected lengths to be of shape \(2,\), got \(1,\)"),
        ({"y_lengths": torch.tensor([1, 6])}, "A length value was too long: 6 of 5 points"),
        ({"x_normals": torch.zeros(4, 3)}, r"Expected normals to be of shape \(N, P, 3\)"),
        ({"x_normals": torch.zeros(2, 4, 3), "point_reduction": "max"}, "Normals must be None"),
        ({"weights": torch.ones(3)}, r"weights must be of shape \(2,\), got \(3,\)"),
        ({"weights": torch.tensor([1.0, -1.0])}, "weights cannot be negative"),
    ],
)
def test_bad_arguments_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        chamfer_distance(**{"x": torch.zeros(2, 4, 3), "y": torch.zeros(2, 5, 3), **change})
