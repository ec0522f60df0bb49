"""Encodings by grids and planes against their references, and both against closed forms."""

import math
from itertools import pairwise

import pytest
import torch
from assertions import assert_close
from far_device import far  # noqa: F401

from rendra.kernels import encode_grid as package
from rendra.kernels.encode_grid import (
    COMBINATIONS,
    encode_grid,
    encode_planes,
    grid_offsets,
    grid_resolutions,
    reference,
)

RESOLUTIONS = (2, 5, 9, 16)  # with 256 rows at most: two levels dense, two hashed
OFFSETS = grid_offsets(RESOLUTIONS, 8)
DTYPES = [torch.float32, torch.float64]


def nasty_points(count, dtype=torch.float32):
    """Inside, outside, on borders of cells and corners of the cube."""
    points = torch.rand(count, 3, dtype=dtype) * 1.3 - 0.15
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0], dtype=dtype)] * 3)
    borders = torch.randint(0, 17, (count, 3)).to(dtype) / 16
    beyond = torch.tensor([[torch.inf, 0.5, 0.5], [0.5, -torch.inf, 0.2], [1e30, -1e30, 1.0]], dtype=dtype)
    return torch.cat([corners, beyond, points, borders])[:count]


def smooth_points(count):
    """Away from the borders of all cells of RESOLUTIONS, where derivatives jump; some are outside."""
    points = torch.rand(8 * count, 3) * 1.2 - 0.1
    nearest = torch.stack([(points * n - (points * n).round()).abs().amin(1) for n in RESOLUTIONS]).amin(0)
    return points[nearest > 0.01][:count]


def gradients(encode, points, table, upstream):
    points, table = points.clone().requires_grad_(), table.clone().requires_grad_()
    return torch.autograd.grad(encode(points, table), (points, table), upstream)


def grid(points, table):
    return encode_grid(points, table, RESOLUTIONS, OFFSETS)


@pytest.mark.parametrize("features", [1, 2, 3, 4, 7, 8])
@pytest.mark.parametrize("count", [0, 1, 255, 2049])
def test_the_twins_agree(features, count):
    points, table = nasty_points(count), torch.randn(OFFSETS[-1], features)
    fast, slow = grid(points, table), reference.encode_grid(points.double(), table.double(), RESOLUTIONS, OFFSETS)
    assert fast.shape == (count, 4 * features)
    assert_close(fast.double(), slow, atol=3e-5, rtol=0)
    points = smooth_points(count)
    upstream = torch.randn(count, 4 * features)
    ours = gradients(grid, points, table, upstream)
    theirs = gradients(grid, points.double(), table.double(), upstream.double())
    assert theirs[0].dtype == torch.float64
    for one, other in zip(ours, theirs, strict=True):
        assert_close(one.double(), other, atol=2e-5 * max(1.0, other.abs().max().item() if count else 0.0), rtol=0)


@pytest.mark.parametrize("combine", COMBINATIONS)
@pytest.mark.parametrize("features", [1, 2, 3, 8, 11])
@pytest.mark.parametrize("count", [0, 1, 2049])
def test_the_twins_of_planes_agree(combine, features, count):
    planes = torch.randn(3, 17, 17, features)

    def encode(points, planes):
        return encode_planes(points, planes, combine)

    points = nasty_points(count)
    fast, slow = encode(points, planes), reference.encode_planes(points.double(), planes.double(), combine)
    assert fast.shape == (count, features * (3 if combine == "concat" else 1))
    assert_close(fast.double(), slow, atol=1e-5, rtol=1e-5)
    points, upstream = smooth_points(count), torch.randn_like(fast)
    ours = gradients(encode, points, planes, upstream)
    theirs = gradients(encode, points.double(), planes.double(), upstream.double())
    for one, other in zip(ours, theirs, strict=True):
        assert_close(one.double(), other, atol=2e-5 * max(1.0, other.abs().max().item() if count else 0.0), rtol=0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_dense_levels_reproduce_what_is_linear_in_each_axis(dtype):
    resolutions = (1, 2, 7)
    offsets = grid_offsets(resolutions)

    def law(points):
        x, y, z = points.unbind(-1)
        return torch.stack([1 + 2 * x - 3 * y + z, x * y * z + y * z], -1)

    vertices = [torch.cartesian_prod(*[torch.arange(n + 1, dtype=dtype) / n] * 3).flip(1) for n in resolutions]
    points = torch.rand(300, 3, dtype=dtype, requires_grad=True)
    found = encode_grid(points, law(torch.cat(vertices)), resolutions, offsets)
    expected = law(points).repeat(1, 3)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    assert_close(found, expected, atol=tolerance, rtol=0)
    weights = torch.arange(6.0, dtype=dtype)
    (ours,) = torch.autograd.grad((found * weights).sum(), points)
    (theirs,) = torch.autograd.grad((expected * weights).sum(), points)
    assert_close(ours, theirs, atol=20 * tolerance, rtol=0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("combine", COMBINATIONS)
def test_planes_know_their_axes(dtype, combine):
    """Planes of u + 10 v, u the first coordinate of a plane."""
    ticks = torch.linspace(0, 1, 9, dtype=dtype)
    plane = (ticks[None, :] + 10 * ticks[:, None])[None, :, :, None].expand(3, -1, -1, 1)
    points = torch.rand(50, 3, dtype=dtype)
    x, y, z = points.unbind(-1)
    parts = torch.stack([x + 10 * y, x + 10 * z, y + 10 * z], -1)
    expected = {"concat": parts, "sum": parts.sum(1, True), "product": parts.prod(1, True)}[combine]
    assert_close(encode_planes(points, plane, combine), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("dtype", DTYPES)
def test_vertices_return_their_rows(dtype):
    """Also hashed ones: Eq. 4 written out with Python's numbers."""
    table = torch.arange(256, dtype=dtype)[:, None]
    for x, y, z in ((0, 0, 0), (16, 16, 16), (3, 0, 7), (15, 16, 1), (0, 16, 9)):
        row = (x ^ (y * 2654435761 & 0xFFFFFFFF) ^ (z * 805459861 & 0xFFFFFFFF)) % 256
        point = torch.tensor([[x, y, z]], dtype=dtype) / 16
        assert encode_grid(point, table, (16,), (0, 256)).item() == row


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_hashed_level_without_collisions_is_a_dense_one(dtype):
    """A level of 2^3 cells: its 27 vertices shuffled to where the hash of a table of 16 rows, too few, sends them."""
    vertices = torch.cartesian_prod(*[torch.arange(3)] * 3).flip(1)
    x, y, z = vertices.unbind(1)
    rows = (x ^ y * 2654435761 ^ z * 805459861) % 16
    dense = torch.randn(27, 2, dtype=dtype)
    for row in range(16):
        same = (rows == row).nonzero().squeeze(1)
        dense[same] = dense[same[:1]]  # where vertices collide, they agree
    hashed = torch.zeros(16, 2, dtype=dtype)
    hashed[rows] = dense
    points = nasty_points(200, dtype)
    assert_close(encode_grid(points, hashed, (2,), (0, 16)), encode_grid(points, dense, (2,), (0, 27)), atol=1e-6)


def test_colliding_vertices_add_up_their_gradients():
    points, upstream = torch.rand(500, 3), torch.randn(500, 2)
    _, hashed = gradients(lambda p, t: encode_grid(p, t, (2,), (0, 16)), points, torch.zeros(16, 2), upstream)
    _, dense = gradients(lambda p, t: encode_grid(p, t, (2,), (0, 27)), points, torch.zeros(27, 2), upstream)
    x, y, z = torch.cartesian_prod(*[torch.arange(3)] * 3).flip(1).unbind(1)
    rows = (x ^ y * 2654435761 ^ z * 805459861) % 16
    assert_close(hashed, torch.zeros(16, 2).index_add(0, rows, dense), atol=1e-4, rtol=0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_outside_is_clamped_without_gradient(dtype):
    table = torch.randn(OFFSETS[-1], 2, dtype=dtype)
    points = torch.tensor([[-0.5, 0.3, 2.0], [0.0, 0.3, 1.0]], dtype=dtype, requires_grad=True)
    found = grid(points, table)
    assert torch.equal(found[0], found[1])
    (grad,) = torch.autograd.grad(found.sum(), points)
    assert (grad[0, [0, 2]] == 0).all()
    assert (grad[1] != 0).all()
    assert grad[0, 1] == grad[1, 1]


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_point_that_is_not_a_number_stays_one(dtype):
    points = torch.tensor([[math.nan, 0.5, 0.5], [0.2, 0.5, 0.5]], dtype=dtype)
    for found in (
        grid(points, torch.randn(OFFSETS[-1], 2, dtype=dtype)),
        encode_planes(points, torch.randn(3, 4, 4, 2, dtype=dtype), "product"),
    ):
        assert found[0].isnan().all()
        assert found[1].isfinite().all()


def test_gradients_are_finite_differences():
    points = smooth_points(5).double().requires_grad_()
    table = torch.randn(27 + 32, 1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x, t: encode_grid(x, t, (2, 16), (0, 27, 59)), (points, table))
    planes = torch.randn(3, 3, 3, 1, dtype=torch.float64, requires_grad=True)
    for combine in COMBINATIONS:
        assert torch.autograd.gradcheck(lambda x, p, c=combine: encode_planes(x, p, c), (points, planes))


@pytest.mark.parametrize("order", ["random", "along rays"])
def test_results_do_not_depend_on_threads(order):
    points = torch.rand(5000, 3)
    if order == "along rays":
        points = points.sort(0).values
    table, planes = torch.randn(OFFSETS[-1], 2), torch.randn(3, 9, 9, 6)
    upstream = torch.randn(5000, 8), torch.randn(5000, 6)
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(
                (
                    grid(points, table),
                    *gradients(grid, points, table, upstream[0]),
                    encode_planes(points, planes),
                    *gradients(encode_planes, points, planes, upstream[1]),
                )
            )
    finally:
        torch.set_num_threads(before)
    for one, other in pairwise(results):
        assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_levels_are_dealt_out_once_each(monkeypatch):
    for threads in (1, 2, 3, 5, 64):
        monkeypatch.setattr(package, "num_threads", lambda threads=threads: threads)
        for levels in (1, 2, 7, 12, 16):
            dealt = package._shares(levels)
            assert len(dealt) == min(threads, levels)
            assert sorted(dealt[dealt >= 0].tolist()) == list(range(levels))
            assert (dealt >= 0).sum(1).max() - (dealt >= 0).sum(1).min() <= 1


def test_only_what_needs_a_gradient_gets_one():
    points, table = torch.rand(10, 3, requires_grad=True), torch.randn(OFFSETS[-1], 2)
    grid(points, table).sum().backward()
    assert points.grad is not None
    table.requires_grad_()
    grid(points.detach(), table).sum().backward()
    assert table.grad is not None


def test_strided_tensors_are_read_as_they_are():
    points, table = torch.rand(3, 90).t(), torch.randn(2, OFFSETS[-1]).t()
    assert torch.equal(grid(points, table), grid(points.contiguous(), table.contiguous()))
    upstream = torch.ones(1, 8).expand(90, 8)
    for a, b in zip(
        gradients(grid, points, table, upstream), gradients(grid, points, table, upstream.contiguous()), strict=True
    ):
        assert torch.equal(a, b)


@pytest.mark.parametrize("encode", [grid, encode_planes])
def test_a_second_derivative_is_refused(encode):
    points = torch.rand(10, 3, requires_grad=True)
    features = torch.randn(OFFSETS[-1], 2) if encode is grid else torch.randn(3, 4, 4, 2)
    features.requires_grad_()
    (slope,) = torch.autograd.grad(encode(points, features).sum(), points, create_graph=True)
    with pytest.raises(RuntimeError, match="differentiable once"):
        slope.sum().backward()


def test_chunks_of_the_reference_change_nothing(monkeypatch):
    points, table = torch.rand(100, 3).double(), torch.randn(OFFSETS[-1], 2).double()
    planes, upstream = torch.randn(3, 5, 5, 2).double(), torch.randn(100, 8).double()
    whole = grid(points, table), *gradients(grid, points, table, upstream), encode_planes(points, planes)
    monkeypatch.setattr(reference, "_LOOKUPS_AT_ONCE", 7 * 64)
    parts = grid(points, table), *gradients(grid, points, table, upstream), encode_planes(points, planes)
    for one, other in zip(whole, parts, strict=True):
        assert_close(one, other, atol=1e-12, rtol=0)


def test_another_device_takes_the_reference(far):  # noqa: F811
    points, table, planes = torch.rand(20, 3), torch.randn(OFFSETS[-1], 2), torch.randn(3, 5, 5, 2)
    found = grid(points.to(far), table.to(far)), encode_planes(points.to(far), planes.to(far))
    assert_close(found[0].held, grid(points, table), atol=1e-5)
    assert_close(found[1].held, encode_planes(points, planes), atol=1e-5)


def test_operators_are_registered_as_torch_wants_them():
    points, table = torch.rand(5, 3, requires_grad=True), torch.randn(OFFSETS[-1], 2, requires_grad=True)
    checks = ("test_schema", "test_faketensor", "test_autograd_registration")
    arguments = points, table, list(RESOLUTIONS), list(OFFSETS)
    torch.library.opcheck(package._encode_on_cpu, arguments, test_utils=checks)
    for multiply in (True, False):
        planes = torch.randn(3, 4, 4, 2, requires_grad=True)
        torch.library.opcheck(package._sample_on_cpu, (points, planes, multiply), test_utils=checks)


def test_levels_grow_geometrically():
    """The paper's settings for radiance fields: 16 to 2048 in 16 levels."""
    levels = grid_resolutions(16, 2048, 16)
    assert levels[:4] == (16, 22, 30, 42)
    assert levels[-1] == 2048
    growth = math.exp(math.log(2048 / 16) / 15)
    assert all(abs(n - 16 * growth**level) <= 1 for level, n in enumerate(levels))
    assert grid_resolutions(7, 7, 3) == (7, 7, 7)
    assert grid_resolutions(5, 9, 1) == (5,)
    for coarsest in range(1, 60):
        assert grid_resolutions(coarsest, 3 * coarsest + 1, 5)[-1] == 3 * coarsest + 1


def test_rows_are_vertices_up_to_the_table_size():
    assert grid_offsets((1, 2, 9), 6) == (0, 8, 8 + 27, 8 + 27 + 64)
    assert grid_offsets((1, 9)) == (0, 8, 1008)


@pytest.mark.parametrize(
    ("call", "complaint"),
    [
        (lambda p, t: encode_grid(p[:, :2], t, RESOLUTIONS, OFFSETS), r"points must be floats of shape \(M, 3\)"),
        (lambda p, t: encode_grid(p.long(), t, RESOLUTIONS, OFFSETS), "points must be floats"),
        (lambda p, t: encode_grid(p, t.double(), RESOLUTIONS, OFFSETS), "table must be torch.float32"),
        (lambda p, t: encode_grid(p, t[:, :0], RESOLUTIONS, OFFSETS), "table must be"),
        (lambda p, t: encode_grid(p, t[0], RESOLUTIONS, OFFSETS), "table must be"),
        (lambda p, t: encode_grid(p, t[:-1], RESOLUTIONS, OFFSETS), "from 0 to the table's 754 rows"),
        (lambda p, t: encode_grid(p, t, RESOLUTIONS, OFFSETS[:-1]), "one number more than the 4"),
        (lambda p, t: encode_grid(p, t[:0], (), (0,)), "at least one"),
        (lambda p, t: encode_grid(p, t[:100], (9,), (0, 100)), "level 0 has 100 rows: expected all 1000 vertices"),
        (lambda p, t: encode_grid(p, t[:8], (1, 0), (0, 8, 8)), "resolutions must be in 1"),
        (lambda p, t: encode_grid(p, t[:8], (1, 1), (0, 8, 8)), "level 1 has 0 rows"),
        (lambda p, t: encode_planes(p, t), r"shape \(3, R, R, F\)"),
        (lambda p, t: encode_planes(p, torch.zeros(3, 1, 1, 2)), r"shape \(3, R, R, F\) with R from 2"),
        (lambda p, t: encode_planes(p, torch.zeros(3, 4, 4, 2).double()), "planes must be torch.float32"),
        (lambda p, t: encode_planes(p, torch.zeros(3, 4, 4, 2), "mean"), "product, sum, concat, got 'mean'"),
        (lambda p, t: grid_resolutions(16, 8, 3), "1 <= coarsest <= finest"),
        (lambda p, t: grid_resolutions(16, 32, 0), "at least one level"),
        (lambda p, t: grid_offsets((4,), 31), "log2_table_size must be in 0..30"),
        (lambda p, t: grid_offsets((0,), 3), "resolutions must be in 1"),
    ],
)
def test_what_cannot_be_is_refused(call, complaint):
    with pytest.raises(ValueError, match=complaint):
        call(torch.rand(5, 3), torch.randn(OFFSETS[-1], 2))
