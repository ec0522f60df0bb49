"""Nearest faces and points against the reference, and both against closed forms and other formulas."""

import pytest
import torch
from assertions import assert_close, assert_finite

from rendra.kernels.point_face_distance import nearest_face, nearest_point, reference

BOTH = [nearest_face, nearest_point]
TRIANGLE = torch.tensor([[[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 3.0, 0.0]]])


def first(*counts):
    return torch.tensor([0, *counts[:-1]]).cumsum(0)


def nasty(num_points=60, num_faces=45, on_grid=True):
    """Points and faces with every kind of degeneracy; on a grid of eighths, where ties abound."""
    points, tris = torch.randn(num_points, 3), torch.randn(num_faces, 1, 3) + 0.4 * torch.randn(num_faces, 3, 3)
    if on_grid:
        points, tris = (points * 8).round() / 8, (tris * 8).round() / 8
    tris[3] = tris[2]  # a copy
    tris[5] = tris[4].roll(1, 0)  # a copy that starts elsewhere
    tris[6, 2] = tris[6, 1]  # an edge
    tris[7] = tris[7, :1]  # a point
    tris[8, 2] = (tris[8, 0] + tris[8, 1]) / 2  # three in a row
    tris[9, 2] = tris[9, 0] + torch.tensor([1e-4, 0.0, 0.0])  # a needle
    tris[10] = tris[10, :1] + 1e-20 * torch.randn(3, 3)  # smaller than anything
    tris[11] *= 100  # larger than all the rest
    points[0], points[1] = tris[12, 0], tris[13].mean(0)  # on a corner, on a face
    points[2] = (tris[14, 0] + tris[14, 1]) / 2  # on an edge
    points[4] = points[3]
    return points, tris


def sphere_of_faces(rows=12, columns=16):
    """Faces that share their edges, so that points have two nearest ones wherever an edge is nearest."""
    polar, turn = torch.linspace(0, torch.pi, rows + 1), torch.arange(columns + 1) % columns / columns * 2 * torch.pi
    ring = torch.stack([turn.cos(), turn.sin()], -1) * polar.sin()[:, None, None]
    grid = torch.cat([ring, polar.cos()[:, None, None].expand(-1, columns + 1, 1)], -1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return torch.cat([torch.stack(corners, -2).reshape(-1, 3, 3) for corners in ((a, b, c), (c, d, a))])


@pytest.mark.parametrize("nearest", BOTH)
@pytest.mark.parametrize("min_area", [0.0, 5e-3, 0.1])
@pytest.mark.parametrize(
    "counts", [((60,), (45,)), ((1,), (45,)), ((20, 0, 40), (15, 12, 18)), ((9, 31, 20), (45, 0, 0))]
)
def test_the_twins_agree_to_the_bit(nearest, min_area, counts):
    points, tris = nasty(sum(counts[0]) + 5, sum(counts[1]))
    arguments = points[: sum(counts[0])], first(*counts[0]), tris, first(*counts[1]), min_area
    fast, slow = nearest(*arguments), getattr(reference, nearest.__name__)(*arguments)
    assert torch.equal(fast[1], slow[1])
    assert torch.equal(fast[2], slow[2])
    assert_close(fast[0], slow[0], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("nearest", BOTH)
@pytest.mark.parametrize("min_area", [0.0, 5e-2])
def test_ties_at_shared_edges_and_corners_go_to_the_lower_face(nearest, min_area):
    points, tris = torch.randn(700, 3), sphere_of_faces()
    arguments = points, first(700), tris, first(len(tris)), min_area
    assert torch.equal(nearest(*arguments)[1], getattr(reference, nearest.__name__)(*arguments)[1])


@pytest.mark.parametrize("nearest", BOTH)
def test_far_from_the_origin(nearest):
    points, tris = torch.randn(200, 3) + 1000, torch.randn(150, 3, 3) * 0.1 + torch.randn(150, 1, 3) + 1000
    arguments = points, first(200), tris, first(150), 0.0
    fast, slow = nearest(*arguments), getattr(reference, nearest.__name__)(*arguments)
    assert torch.equal(fast[1], slow[1])
    exact = nearest(points.double(), first(200), tris.double(), first(150), 0.0)
    assert_close(fast[0].double(), exact[0], rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("nearest", BOTH)
@pytest.mark.parametrize("min_area", [0.0, 5e-2])
def test_gradients_agree_with_the_reference_in_float64(nearest, min_area):
    points, tris = nasty(on_grid=False)  # ties of the rounded grid are none in float64
    grads = []
    for dtype in (torch.float32, torch.float64):
        p, t = (x.to(dtype, copy=True).requires_grad_() for x in (points, tris))
        squared = nearest(p, first(25, 35), t, first(20, 25), min_area)[0]
        (squared * torch.linspace(-1, 2, len(squared))).sum().backward()
        grads.append((p.grad, t.grad))
    for single, double in zip(*grads, strict=True):
        assert_finite(single)
        assert (single - double).norm() <= 1e-5 * double.norm()


@pytest.mark.parametrize("nearest", BOTH)
@pytest.mark.parametrize("min_area", [0.0, 10.0])
def test_gradients_are_finite_differences(nearest, min_area):
    points = torch.randn(9, 3, dtype=torch.float64, requires_grad=True)
    tris = torch.randn(7, 3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p, t: nearest(p, first(4, 5), t, first(3, 4), min_area)[0], (points, tris))


@pytest.mark.parametrize(
    ("point", "squared", "weights"),
    [
        ((1.0, 1.0, 2.0), 4.0, (5 / 12, 1 / 4, 1 / 3)),  # above the inside
        ((2.0, -3.0, 0.0), 9.0, (0.5, 0.5, 0.0)),  # an edge
        ((-3.0, 1.5, 4.0), 25.0, (0.5, 0.0, 0.5)),  # another
        ((2.0 + 3.0, 1.5 + 4.0, 0.0), 25.0, (0.0, 0.5, 0.5)),  # the long one
        ((-1.0, -2.0, 2.0), 9.0, (1.0, 0.0, 0.0)),  # corners
        ((6.0, -1.0, 2.0), 9.0, (0.0, 1.0, 0.0)),
        ((0.0, 5.0, 0.0), 4.0, (0.0, 0.0, 1.0)),
    ],
)
@pytest.mark.parametrize("nearest", BOTH)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_closed_forms(nearest, dtype, point, squared, weights):
    found = nearest(torch.tensor([point], dtype=dtype), first(1), TRIANGLE.to(dtype), first(1), 0.0)
    assert_close(found[0], torch.tensor([squared], dtype=dtype), rtol=1e-6)
    assert_close(found[2], torch.tensor([weights], dtype=dtype), atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_face_below_the_area_is_its_edges(dtype):
    """A point 2 above the inside: 1 from the edge y = 0, 1 from x = 0, so 4 + 1 in place of 4. The area is 6."""
    point, tris = torch.tensor([[1.0, 1.0, 2.0]], dtype=dtype), TRIANGLE.to(dtype)
    for min_area, squared in ((5.9, 4.0), (6.0, 4.0), (6.1, 5.0)):
        for nearest in BOTH:
            found = nearest(point, first(1), tris, first(1), min_area)[0].item()
            assert found == pytest.approx(squared, rel=1e-6)


def test_no_sampled_point_of_a_face_is_nearer():
    points, tris = torch.randn(40, 3).double(), torch.randn(6, 3, 3).double()
    u, v = torch.rand(2, 20000).double()
    samples = torch.stack([1 - u.sqrt(), u.sqrt() * (1 - v), u.sqrt() * v], -1) @ tris  # (F, S, 3)
    sampled = torch.cdist(points, samples.reshape(-1, 3)).amin(1)
    squared = nearest_face(points, first(40), tris, first(6), 0.0)[0]
    assert (squared.sqrt() <= sampled + 1e-12).all()
    assert (sampled - squared.sqrt()).max() < 0.1


@pytest.mark.parametrize("nearest", BOTH)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_not_finite_is_nearest_to_nothing(nearest, dtype):
    points, tris = (x.to(dtype) for x in nasty())
    clean = nearest(points[2:], first(58), tris[2:], first(43), 0.0)
    points[0, 1], points[1, 2], tris[0, 1, 2], tris[1] = torch.nan, torch.inf, -torch.inf, torch.nan
    points.requires_grad_()
    tris.requires_grad_()
    found = nearest(points, first(60), tris, first(45), 0.0)
    assert found[0][:2].isnan().all()
    assert (found[1][:2] == -1).all()
    assert torch.equal(found[1][2:] - 2, clean[1])
    assert torch.equal(found[0][2:], clean[0])
    found[0][2:].sum().backward()
    assert_finite(points.grad)
    assert_finite(tris.grad)


@pytest.mark.parametrize("nearest", BOTH)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nothing_to_compare_with_is_distance_zero(nearest, dtype):
    points, tris = (x.to(dtype).requires_grad_() for x in nasty())
    squared, index, weights = nearest(points, first(60, 0), tris, first(0, 45))
    assert (squared == 0).all()
    assert (index == -1).all()
    assert (weights == 0).all()
    squared.sum().backward()
    assert (points.grad == 0).all()
    assert (tris.grad == 0).all()
    empty = nearest(points[:0], first(0), tris[:0], first(0))
    assert [len(x) for x in empty] == [0, 0, 0]
    none = torch.zeros(0, dtype=torch.int64)
    assert len(nearest(points[:0], none, tris[:0], none)[0]) == 0


def test_results_do_not_depend_on_threads():
    points, tris = torch.randn(3000, 3), torch.randn(1500, 1, 3) + 0.05 * torch.randn(1500, 3, 3)
    threads, results = torch.get_num_threads(), []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        p, t = points.clone().requires_grad_(), tris.clone().requires_grad_()
        found = [nearest(p, first(1000, 2000), t, first(900, 600), 1e-3) for nearest in BOTH]
        (found[0][0].sum() + found[1][0].square().sum()).backward()
        results.append([x.detach() for x in (*found[0], *found[1], p.grad, t.grad)])
    torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_clustered_and_coinciding_items_make_deep_trees():
    clusters = torch.cat([torch.randn(300, 3) * 10.0**-k + k for k in range(1, 7)] + [torch.ones(400, 3)])
    tris = clusters[:, None] + 1e-3 * torch.randn(len(clusters), 3, 3)
    for nearest in BOTH:
        arguments = clusters, first(len(clusters)), tris, first(len(tris)), 0.0
        assert torch.equal(nearest(*arguments)[1], getattr(reference, nearest.__name__)(*arguments)[1])


def test_the_operator_is_well_registered():
    points, tris = nasty()
    for by_point in (True, False):
        arguments = points.requires_grad_(), first(60), tris.requires_grad_(), first(45), 0.0, by_point
        torch.library.opcheck(torch.ops.rendra.nearest_on_faces.default, arguments)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": torch.zeros(4, 2)}, r"points must be floats of shape \(P, 3\), got torch.float32 of \(4, 2\)"),
        ({"tris": torch.zeros(5, 3, 3).double()}, "faces must be torch.float32 of shape"),
        ({"points_first_idx": torch.tensor([0, 1])}, r"must both have shape \(N,\), got \(2,\) and \(1,\)"),
        ({"points_first_idx": torch.tensor([0], dtype=torch.int32)}, "first_idx of the points must be int64"),
        ({"points_first_idx": torch.tensor([1])}, "must start at 0 and never fall or pass the end, got"),
        (
            {"points_first_idx": torch.tensor([0, 7]), "tris_first_idx": torch.tensor([0, 0])},
            "first_idx of the 4 points",
        ),
        ({"min_triangle_area": -1.0}, "min_triangle_area must be zero or positive, got -1.0"),
    ],
)
def test_bad_input_is_named(change, message):
    zero = torch.zeros(1, dtype=torch.int64)
    good = {
        "points": torch.zeros(4, 3),
        "points_first_idx": zero,
        "tris": torch.zeros(5, 3, 3),
        "tris_first_idx": zero,
    }
    with pytest.raises(ValueError, match=message):
        nearest_face(**{**good, **change})


@pytest.mark.gpu
def test_cuda_takes_the_reference():
    points, tris = nasty()
    here = nearest_face(points, first(60), tris, first(45))
    there = nearest_face(points.cuda(), first(60).cuda(), tris.cuda(), first(45).cuda())
    assert_close(there[0].cpu(), here[0], atol=1e-5)
