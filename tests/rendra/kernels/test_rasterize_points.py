"""The point rasteriser's two twins against closed forms, finite differences and each other."""

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401
from scenes import packed

from rendra.kernels.rasterize_points import numba_cpu, rasterize_points, reference


def dust(num_points, seed=0):
    """Random points (P, 3) in and around the image, between depths 1 and 4."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(num_points, 3, generator=generator) * torch.tensor([2.8, 2.8, 3.0]) - torch.tensor(
        [1.4, 1.4, -1]
    )


def with_monsters(points):
    """The points and, among them: ones at and behind the camera, NaN, infinity, ones far away."""
    nan, inf = float("nan"), float("inf")
    monsters = [
        [0.1, 0.1, 0.0], [0.1, 0.1, -0.0], [0.1, 0.1, -1.0], [nan, 0.1, 1.0], [0.1, nan, 1.0], [0.1, 0.1, nan],
        [inf, 0.1, 1.0], [0.1, -inf, 1.0], [0.1, 0.1, inf], [0.1, 0.1, -inf], [1e9, 0.0, 1.0], [0.0, -3e38, 1.0],
        [0.1, 0.1, 1e-42],
    ]  # fmt: skip
    return torch.cat([points[:1], torch.tensor(monsters), points[1:]])


def radii(points, radius):
    """One radius for all, or random ones up to it if it is negative."""
    if radius >= 0:
        return torch.full_like(points[:, 0], radius)
    generator = torch.Generator().manual_seed(7)
    return (torch.rand(len(points), generator=generator) * -radius).to(points)


def draw(points, counts=None, size=(24, 24), radius=0.2, layers=4, twin=rasterize_points):
    return twin(points, radii(points, radius), *packed(*(counts or (len(points),))), size, layers)


def assert_twins_agree(points, **settings):
    """To the bit: the kernel adds and multiplies as the reference does."""
    fast, slow = draw(points, **settings), draw(points, twin=reference.rasterize_points, **settings)
    for a, b in zip(fast, slow, strict=True):
        assert torch.equal(a, b)
    return fast


BOTH = pytest.mark.parametrize("twin", [rasterize_points, reference.rasterize_points])


@BOTH
def test_a_point_is_a_disc_of_pixels(twin):
    """Against the definition, written for pixels in rows and columns: +X left, +Y up, short side in [-1, 1]."""
    height, width, radius = 20, 30, 0.3
    x, y = 0.21, -0.33
    idx, zbuf, dists = draw(torch.tensor([[x, y, 2.5]]), size=(height, width), radius=radius, layers=1, twin=twin)
    column, row = torch.arange(width), torch.arange(height)[:, None]
    px, py = (width / 2 - column - 0.5) / (height / 2), (height / 2 - row - 0.5) / (height / 2)
    squared = (px - x) ** 2 + (py - y) ** 2
    inside = squared < radius**2
    assert inside.sum() > 20
    assert torch.equal(idx[0, ..., 0] == 0, inside)
    assert torch.equal(zbuf[0, ..., 0] == 2.5, inside)
    assert_close(dists[0, ..., 0], torch.where(inside, squared, -1.0).float(), atol=1e-6)
    assert (dists[0, ..., 0][~inside] == -1).all()


def test_a_disc_covers_its_area():
    covered = (draw(torch.tensor([[0.013, 0.021, 1.0]]), size=(400, 400), radius=0.7, layers=1)[0] >= 0).sum()
    assert_close(covered.float() / 200**2, torch.tensor(torch.pi * 0.7**2), rtol=2e-3)


@BOTH
def test_the_rim_of_a_disc_is_outside_it(twin):
    """With four pixels a side, centres lie at odd quarters: a disc of exactly half reaches none of the next."""
    idx = draw(torch.tensor([[0.25, 0.25, 1.0]]), size=(4, 4), radius=0.5, layers=1, twin=twin)[0]
    assert (idx >= 0).nonzero()[:, 1:3].tolist() == [[1, 1]]


@pytest.mark.parametrize("size", [(24, 24), (17, 31), (31, 17), (1, 1), (1, 40), (9, 8)])
@pytest.mark.parametrize(
    ("radius", "layers"), [(0.2, 1), (0.05, 4), (-0.4, 9), (0.0, 2), (float("inf"), 3), (1e-6, 2)]
)
def test_twins_agree_on_awkward_sizes(size, radius, layers):
    assert_twins_agree(with_monsters(dust(60)), size=size, radius=radius, layers=layers)


def test_twins_agree_where_tiles_are_split(monkeypatch):
    monkeypatch.setattr(reference, "_PAIRS_AT_ONCE", 50)
    assert_twins_agree(with_monsters(dust(80, seed=1)), size=(13, 21), radius=-0.5, layers=6)


def test_twins_agree_to_the_bit_at_the_rim():
    """Radii that are distances: rounding decides, and decides alike."""
    points = dust(300, seed=2)
    x = (23 - 2 * torch.randint(0, 24, (300,))) / 24
    reach = (points[:, 0] - x).abs()
    settings = (reach, *packed(300), (24, 24), 40)
    for a, b in zip(rasterize_points(points, *settings), reference.rasterize_points(points, *settings), strict=True):
        assert torch.equal(a, b)


def test_twins_agree_on_a_ragged_batch():
    idx = assert_twins_agree(dust(40, seed=3), counts=(13, 0, 27), layers=3)[0]
    assert (idx[1] == -1).all()
    assert set(idx[0].unique().tolist()) <= set(range(-1, 13))
    assert set(idx[2].unique().tolist()) <= {-1, *range(13, 40)}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_points_and_no_images(dtype):
    for outputs in (draw(torch.zeros(0, 3, dtype=dtype)), draw(torch.zeros(0, 3, dtype=dtype), counts=(0, 0))):
        assert all((output == -1).all() for output in outputs)
    none = torch.zeros(0, dtype=torch.int64)
    nothing = torch.zeros(0, dtype=dtype)
    outputs = rasterize_points(torch.zeros(0, 3, dtype=dtype), nothing, none, none, (5, 7), 2)
    assert [tuple(output.shape) for output in outputs] == [(0, 5, 7, 2)] * 3


def test_every_output_element_is_written():
    points, size, layers = dust(30), (13, 22), 7
    shape = (2, *size, layers)
    idx, zbuf, dists = torch.full(shape, -7), torch.full(shape, float("nan")), torch.full(shape, float("nan"))
    first, num = packed(10, 20)
    outputs = (idx.numpy(), zbuf.numpy(), dists.numpy())
    numba_cpu.forward(points.numpy(), radii(points, 0.2).numpy(), first.numpy(), num.numpy(), outputs)
    assert (idx >= -1).all()
    assert_finite(zbuf)
    assert_finite(dists)


@BOTH
def test_ties_go_to_the_lower_index_and_order_is_by_depth(twin):
    points = torch.tensor([[0.0, 0.0, 2.0], [0.01, 0.0, 2.0], [0.0, 0.01, 1.0], [0.0, 0.0, 2.0]])
    assert draw(points, size=(3, 3), twin=twin)[0][0, 1, 1].tolist() == [2, 0, 1, 3]
    assert draw(points, size=(3, 3), layers=2, twin=twin)[0][0, 1, 1].tolist() == [2, 0]


def test_hits_are_the_nearest_first():
    idx, zbuf, _ = draw(dust(200, seed=4), radius=0.4, layers=8)
    full = idx[..., -1] >= 0
    assert full.any()
    assert (zbuf.diff(dim=-1)[full] >= 0).all()
    assert torch.equal(zbuf >= 0, idx >= 0)


def test_more_layers_than_points_add_padding_only():
    few, many = draw(dust(12), layers=12), draw(dust(12), layers=40)
    assert (many[0][..., 12:] == -1).all()
    for a, b in zip(few, many, strict=True):
        assert torch.equal(a, b[..., :12])


def test_points_may_come_in_any_order():
    points, order = dust(80, seed=5), torch.randperm(80)
    plain, shuffled = draw(points, radius=0.3), draw(points[order], radius=0.3)
    back = torch.where(shuffled[0] >= 0, order[shuffled[0].clamp(min=0)], -1)
    assert torch.equal(back, plain[0])
    assert torch.equal(shuffled[2], plain[2])


def test_turning_the_points_turns_the_image():
    """A half turn about the axis of sight: rows and columns run backwards."""
    points = dust(50, seed=6)
    turned = draw(points * torch.tensor([-1.0, -1.0, 1.0]), size=(17, 24))
    for a, b in zip(draw(points, size=(17, 24)), turned, strict=True):
        assert torch.equal(a, b.flip(1, 2))


def test_results_do_not_depend_on_threads():
    points, threads = dust(400, seed=7), torch.get_num_threads()
    results = []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        leaf = points.clone().requires_grad_()
        outputs = draw(leaf, counts=(150, 250), layers=6, size=(50, 40))
        (outputs[1].square().sum() + outputs[2].square().sum()).backward()
        results.append((*outputs, leaf.grad))
    torch.set_num_threads(threads)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)


@pytest.mark.parametrize("reported", [(1,), (2,), (1, 2)])
def test_gradients_agree_with_the_reference_in_float64(reported):
    single, double = (
        with_monsters(dust(150, seed=8)).to(dtype).requires_grad_() for dtype in (torch.float32, torch.float64)
    )
    fast, slow = (draw(leaf, counts=(60, 103), size=(20, 28), radius=-0.4, layers=5) for leaf in (single, double))
    assert torch.equal(fast[0], slow[0])
    weights = [torch.randn_like(fast[i]) for i in reported]
    a = torch.autograd.grad([fast[i] for i in reported], single, weights)[0]
    b = torch.autograd.grad([slow[i] for i in reported], double, [weight.double() for weight in weights])[0]
    assert b.abs().max() > 0
    assert_finite(a)
    assert_close(a, b, atol=1e-5)


def test_reference_gradients_are_finite_differences():
    points = dust(9, seed=9).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda p: draw(p, size=(6, 7), radius=0.5, layers=3)[1:], (points,))


def test_fitting_a_point_to_a_pixel_moves_it_there():
    """Descent on dists: the gradient points from the disc's pixels to its centre."""
    point = torch.tensor([[0.3, -0.2, 1.0]], requires_grad=True)
    idx, _, dists = draw(point, size=(21, 21), radius=0.5, layers=1)
    (gradient,) = torch.autograd.grad(dists[0, 10, 10, 0], point)
    assert idx[0, 10, 10, 0] == 0
    assert_close(gradient, 2 * point.detach() * torch.tensor([1.0, 1.0, 0.0]))


@pytest.mark.parametrize("layers", [1, 5])
def test_a_cloud_stays_on_its_device(far, layers):  # noqa: F811
    points, radius, (first, num) = dust(40), torch.full((40,), 0.3), packed(15, 25)
    leaf = points.to(far).requires_grad_()
    there = rasterize_points(leaf, radius.to(far), first.to(far), num.to(far), (9, 14), layers)
    assert all(isinstance(output, Far) for output in there)
    here = rasterize_points(points, radius, first, num, (9, 14), layers)
    for a, b in zip(there, here, strict=True):
        assert torch.equal(a.detach().cpu(), b)
    there[2].sum().backward()
    assert isinstance(leaf.grad, Far)


def test_the_operator_is_well_registered():
    first, num = packed(8)
    arguments = (dust(8).requires_grad_(), torch.full((8,), 0.3), first, num, 6, 5, 2)
    checks = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(torch.ops.rendra.rasterize_points.default, arguments, test_utils=checks)


@pytest.mark.filterwarnings("ignore")  # of torch.compile itself
def test_the_operator_compiles():
    first, num = packed(8)

    def loss(points):
        _, zbuf, dists = torch.ops.rendra.rasterize_points(points, torch.full((8,), 0.3), first, num, 6, 5, 2)
        return zbuf.sum() + dists.square().sum()

    eager, compiled = dust(8).requires_grad_(), dust(8).requires_grad_()
    loss(eager).backward()
    torch.compile(loss, backend="aot_eager")(compiled).backward()
    assert_close(compiled.grad, eager.grad)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": torch.zeros(4, 2)}, r"points must be floats of shape \(P, 3\)"),
        ({"points": torch.zeros(4, 3, dtype=torch.int64)}, r"points must be floats of shape \(P, 3\)"),
        ({"radius": torch.zeros(3)}, r"radius must be torch.float32 of shape \(4,\)"),
        ({"radius": torch.zeros(4).double()}, r"radius must be torch.float32 of shape \(4,\)"),
        ({"radius": torch.tensor([0.1, 0.1, -0.1, 0.1])}, "radius must be zero or positive"),
        ({"radius": torch.tensor([0.1, 0.1, float("nan"), 0.1])}, "radius must be zero or positive"),
        ({"image_size": (0, 4)}, "image_size must be"),
        ({"points_per_pixel": 0}, "points_per_pixel must be at least 1"),
        ({"num_points_per_cloud": torch.tensor([9])}, "leaves the 4 points"),
        ({"num_points_per_cloud": torch.tensor([2, 2])}, r"must both have shape \(N,\)"),
        ({"cloud_to_packed_first_idx": torch.tensor([0.0])}, "must be int64"),
    ],
)
def test_bad_input_is_named(change, message):
    arguments = {
        "points": dust(4), "radius": torch.full((4,), 0.1), "cloud_to_packed_first_idx": torch.tensor([0]),
        "num_points_per_cloud": torch.tensor([4]), "image_size": (4, 4), "points_per_pixel": 1,
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        rasterize_points(**{**arguments, **change})


@pytest.mark.gpu
def test_cuda_takes_the_reference():
    points, (first, num) = dust(200), packed(200)
    arguments = points, torch.full((200,), 0.2), first, num
    cuda = rasterize_points(*(tensor.cuda() for tensor in arguments), (32, 24), 4)
    assert (cuda[0].cpu() != rasterize_points(*arguments, (32, 24), 4)[0]).sum() <= 4
