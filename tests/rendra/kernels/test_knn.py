"""Nearest points against their reference, closed forms and counts, on clouds that break lesser trees."""

import math

import pytest
import torch
from assertions import assert_close, assert_finite

from rendra.kernels.knn import nearest_points, nearest_sums, numba_cpu, points_in_ball, reference


def cloud(kind, num=300, seed=0, D=3):
    """One cloud (num, D)."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(num, D, generator=generator)
    if kind == "line":
        points = points[:, :1].expand(-1, D).clone()
    elif kind == "coincident":
        points = torch.full_like(points, 0.25)
    elif kind == "twins":
        points = points[torch.randint(num // 8, (num,), generator=generator)]
    elif kind == "outlier":
        points[num // 2] = 1e6
    elif kind == "clusters":
        centres = 1e3 * torch.rand(5, D, generator=generator)
        points = centres[torch.randint(5, (num,), generator=generator)] + 1e-3 * points
    elif kind == "scales":  # each half of what is left lies in a box a hundred times smaller
        points *= 100.0 ** -torch.arange(num).div(num / 12, rounding_mode="floor")[:, None]
    elif kind == "far":
        points += 1e3
    elif kind == "grid":
        points = (points * 6).round()
    elif kind == "huge":
        points = (points - 0.5) * 3e38
    return points


KINDS = ["even", "line", "coincident", "twins", "outlier", "clusters", "scales", "far", "grid", "huge"]


def lengths(*numbers):
    return torch.tensor(numbers)


def whole(points):
    return torch.full((len(points),), points.shape[1])


def agree(p1, p2, l1, l2, norm, K):
    """Both twins, in float32: the same numbers in the same order of operations, hence equal to the bit."""
    dists, idx = nearest_points(p1, p2, l1, l2, norm, K)
    expected, expected_idx = reference.nearest_points(p1, p2, l1, l2, norm, K)
    assert torch.equal(idx, expected_idx)
    assert_close(dists, expected, atol=0, rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("norm", "K"), [(2, 1), (1, 1), (2, 7), (1, 3)])
def test_awkward_clouds_agree_with_the_reference(kind, norm, K):
    for first, second in (("even", kind), (kind, "even"), (kind, kind)):
        p1, p2 = cloud(first, 201, seed=1)[None], cloud(second, 333, seed=2)[None]
        agree(p1, p2, whole(p1), whole(p2), norm, K)


@pytest.mark.parametrize("D", [1, 2, 3, 4, 9])
@pytest.mark.parametrize("norm", [1, 2])
def test_any_dimension_agrees_with_the_reference(D, norm):
    p1, p2 = torch.randn(2, 90, D), torch.randn(2, 130, D)
    agree(p1, p2, lengths(90, 33), lengths(17, 130), norm, 4)
    agree(p2, p1, lengths(130, 1), lengths(16, 0), norm, 1)


@pytest.mark.parametrize(("P1", "P2"), [(1, 1), (1, 17), (16, 16), (65, 257), (0, 5), (5, 0), (40, 4200)])
@pytest.mark.parametrize("K", [1, 5, 20])
def test_awkward_sizes_agree_with_the_reference(P1, P2, K):
    p1, p2 = torch.rand(3, P1, 3), torch.rand(3, P2, 3)
    agree(p1, p2, lengths(0, P1 // 2, P1), lengths(P2, P2 // 2, P2 // 3), 2, K)


def test_no_clouds_have_no_neighbours():
    dists, idx = nearest_points(torch.zeros(0, 4, 3), torch.zeros(0, 4, 3), lengths().long(), lengths().long(), 2, 2)
    assert dists.shape == idx.shape == (0, 4, 2)


def test_a_cloud_is_its_own_neighbour_and_ties_go_to_the_lower_index():
    p = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 0, 0], [-1, 0, 0], [1, 0, 0]]])
    dists, idx = nearest_points(p, p, whole(p), whole(p), 2, 5)
    assert idx[0, 2].tolist() == [0, 2, 1, 3, 4]
    assert dists[0, 2].tolist() == [0, 0, 1, 1, 1]
    assert idx[0, 4].tolist() == [1, 4, 0, 2, 3]


def test_points_that_are_not_finite_are_infinitely_far():
    p1, p2 = cloud("even", 50, 1)[None], cloud("even", 60, 2)[None]
    for points, place in ((p1, 3), (p2, 7), (p2, 50)):
        points[0, place, 1] = float("nan")
    p2[0, 20, 2], p1[0, 9, 0] = float("inf"), -float("inf")
    agree(p1, p2, whole(p1), whole(p2), 2, 58)
    dists, idx = nearest_points(p1, p2, whole(p1), whole(p2), 2, 1)
    assert dists[0, [3, 9], 0].tolist() == [math.inf] * 2
    assert idx[0, [3, 9], 0].tolist() == [0, 0]
    assert_finite(dists[0, :3])
    assert not set(idx[0, :, 0].tolist()) & {7, 20, 50}


@pytest.mark.parametrize("norm", [1, 2])
@pytest.mark.parametrize("D", [2, 3, 5])
def test_gradients_agree_with_the_reference(norm, D):
    p1, p2, weight = torch.randn(2, 40, D), torch.randn(2, 55, D), torch.randn(2, 40, 3)
    grads = []
    for dtype in (torch.float32, torch.float64):
        leaves = [p.detach().to(dtype).requires_grad_() for p in (p1, p2)]
        dists, _ = nearest_points(*leaves, lengths(40, 13), lengths(2, 55), norm, 3)
        (dists * weight.to(dtype)).sum().backward()
        grads.append([leaf.grad.float() for leaf in leaves])
    for fast, slow in zip(*grads, strict=True):
        assert_close(fast, slow, atol=1e-5)


@pytest.mark.parametrize("norm", [1, 2])
def test_reference_gradients_are_finite_differences(norm):
    p1, p2 = torch.randn(2, 4, 3).double().requires_grad_(), torch.randn(2, 5, 3).double().requires_grad_()
    counts, ones = (lengths(4, 2), lengths(5, 1)), torch.ones(2).double()
    assert torch.autograd.gradcheck(lambda a, b: nearest_points(a, b, *counts, norm, 2)[0], (p1, p2))
    assert torch.autograd.gradcheck(lambda a, b: points_in_ball(a, b, *counts, 2, 2.0)[0], (p1, p2))
    assert torch.autograd.gradcheck(lambda a, b: nearest_sums(a, b, *counts, ones, 2 * ones, norm), (p1, p2))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("K", [1, 6])
def test_balls_hold_the_lowest_indices(kind, K):
    p1, p2 = cloud("even", 150, 1)[None], cloud(kind, 260, 2)[None]
    for radius in (0.0, 0.2, 5.0):
        dists, idx = points_in_ball(p1, p2, lengths(120), lengths(250), K, radius)
        expected, expected_idx = reference.points_in_ball(p1, p2, lengths(120), lengths(250), K, radius)
        assert torch.equal(idx, expected_idx)
        assert_close(dists, expected, atol=0, rtol=1e-6)


def test_a_point_on_the_sphere_is_outside():
    p1, p2 = torch.zeros(1, 1, 3), torch.tensor([[[0.5, 0, 0], [0.25, 0, 0], [0, -0.375, 0]]])
    dists, idx = points_in_ball(p1, p2, lengths(1), lengths(3), 3, 0.5)
    assert idx.tolist() == [[[1, 2, -1]]]
    assert dists.tolist() == [[[0.0625, 0.140625, 0.0]]]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("norm", [1, 2])
def test_sums_agree_with_the_reference(kind, norm):
    x = torch.stack([cloud(kind, 210, 1), cloud("even", 210, 2)])
    y = torch.stack([cloud("even", 150, 3), cloud(kind, 150, 4)])
    if kind == "huge":
        x, y = x / 1e25, y / 1e25
    x_weights, y_weights = torch.tensor([0.5, 2.0]), torch.tensor([1.5, 0.0])
    results = []
    for twin in (nearest_sums, reference.nearest_sums):  # both in float32: rounding decides whom clusters match
        leaves = [p.clone().requires_grad_() for p in (x, y)]
        sums = twin(*leaves, lengths(210, 99), lengths(150, 60), x_weights, y_weights, norm)
        (sums * torch.tensor([1.0, -3.0])).sum().backward()
        results.append([sums.detach(), *[leaf.grad for leaf in leaves]])
    for fast, slow in zip(*results, strict=True):
        assert_close(fast, slow, atol=1e-5 * float(slow.abs().max()), rtol=1e-5)


def test_sums_of_empty_clouds_and_of_one_gradient():
    x, y = torch.rand(3, 20, 3, requires_grad=True), torch.rand(3, 30, 3)
    sums = nearest_sums(x, y, lengths(0, 20, 5), lengths(30, 0, 7), torch.ones(3), torch.ones(3), 2)
    assert (sums[:2] == 0).all()
    sums.sum().backward()
    assert (x.grad[:2] == 0).all()
    assert (x.grad[2, 5:] == 0).all()
    assert x.grad[2, :5].norm() > 0
    for shape in ((0, 5, 3), (2, 0, 3)):
        none = torch.zeros(shape)
        assert (nearest_sums(none, none, whole(none), whole(none), *[torch.ones(len(none))] * 2, 2) == 0).all()


def test_every_gradient_is_written():
    clouds = [cloud("even", num, num)[None].numpy() for num in (600, 1100)]
    grads = [torch.full((1, num, 3), float("nan")) for num in (600, 1100)]
    weights = [torch.ones(1).numpy()] * 2
    counts = [lengths(500).numpy(), lengths(1000).numpy()]
    axes = torch.arange(3).numpy()
    numba_cpu.nearest_sums(tuple(clouds), tuple(counts), tuple(weights), axes, 2, tuple(g.numpy() for g in grads))
    for grad, length in zip(grads, (500, 1000), strict=True):
        assert_finite(grad)
        assert (grad[0, length:] == 0).all()


def test_results_do_not_depend_on_threads():
    threads, results = torch.get_num_threads(), []
    p1, p2 = torch.stack([cloud(kind, 700, 1) for kind in KINDS]), torch.stack([cloud("even", 900, 2)] * len(KINDS))
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        a, b = p1.clone().requires_grad_(), p2.clone().requires_grad_()
        dists, idx = nearest_points(a, b, whole(a), whole(b), 2, 3)
        sums = nearest_sums(a, b, whole(a), whole(b), *[torch.ones(len(a))] * 2, 2)
        (dists.sum((1, 2)) + sums).nan_to_num(0, 0, 0).sum().backward()
        results.append((dists.detach(), idx, sums.detach(), a.grad, b.grad))
    torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(
            torch.equal(first.nan_to_num(), second.nan_to_num())
            for first, second in zip(results[0], other, strict=True)
        )


@pytest.mark.parametrize("queries", [*KINDS, "apart"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("K", "limit"), [(1, 5), (2, 30)])
def test_work_stays_far_from_quadratic(queries, kind, K, limit):
    """Looks at leaves per query, of 313 (K = 2), or of 20, as 16 queries look at once (K = 1), however they lie."""
    p1 = cloud("even", 2000, 1) + 100 if queries == "apart" else cloud(queries, 2000, 1)
    p2, axes = cloud(kind, 5000, 2), torch.arange(3).numpy()
    dists, idx = torch.zeros(1, 2000, K), torch.full((1, 2000, K), -1)
    looks = numba_cpu.search(
        (p1[None].numpy(), p2[None].numpy()), (lengths(2000).numpy(), lengths(5000).numpy()), axes, 2, -1.0,
        dists.numpy(), idx.numpy(),
    )  # fmt: skip
    assert looks <= limit * 2000


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("norm", [1, 2])
def test_one_neighbour_is_the_first_of_two(kind, norm):
    """One is searched for 16 queries at once, two are not: independent walks, the same answer to the bit."""
    p1, p2 = cloud("even", 777, 1)[None], cloud(kind, 3000, 2)[None]
    p1[0, [5, 300]], p2[0, 11] = float("nan"), float("inf")
    for a, b in ((p1, p2), (p2, p1), (p2, p2)):
        one, two = (nearest_points(a, b, whole(a), whole(b), norm, K) for K in (1, 2))
        assert torch.equal(one[0][..., 0], two[0][..., 0])
        assert torch.equal(one[1][..., 0], two[1][..., 0])


def test_operators_are_well_registered():
    p1, p2 = torch.rand(2, 9, 3, requires_grad=True), torch.rand(2, 7, 3, requires_grad=True)
    counts = lengths(9, 4), lengths(7, 6)
    torch.library.opcheck(torch.ops.rendra.knn.default, (p1, p2, *counts, 2, 3, -1.0))
    arguments = (p1, p2, *counts, torch.ones(2), torch.ones(2), 2, True, True)
    torch.library.opcheck(torch.ops.rendra.nearest_sums.default, arguments)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"p1": torch.zeros(2, 3)}, r"shapes \(N, P1, D\)"),
        ({"p2": torch.zeros(1, 5, 3)}, r"got \(2, 4, 3\) and \(1, 5, 3\)"),
        ({"p2": torch.zeros(2, 5, 2)}, "the clouds must have shapes"),
        ({"p2": torch.zeros(2, 5, 3).double()}, "floats of one type"),
        ({"l1": torch.tensor([4])}, r"lengths must be int64 of shape \(2,\)"),
        ({"l2": torch.tensor([4.0, 4.0])}, "got torch.float32"),
        ({"l2": torch.tensor([4, 6])}, r"between 0 and 5, got \[4, 6\]"),
        ({"norm": 3}, "Support for 1 or 2 norm"),
        ({"K": 0}, "K must be at least 1"),
    ],
)
def test_bad_arguments_are_named(change, message):
    good = {"p1": torch.zeros(2, 4, 3), "p2": torch.zeros(2, 5, 3), "l1": lengths(4, 4), "l2": lengths(5, 5)}
    with pytest.raises(ValueError, match=message):
        nearest_points(*{**good, "norm": 2, "K": 1, **change}.values())


def test_a_negative_radius_is_named():
    with pytest.raises(ValueError, match="radius must be zero or positive"):
        points_in_ball(torch.zeros(1, 1, 3), torch.zeros(1, 1, 3), lengths(1), lengths(1), 1, -1.0)
