"""Traversal against asking every sample, closed forms, and the grid's update."""

import math

import numpy as np
import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.kernels.composite import compact, visible
from rendra.kernels.occupancy import (
    Samples,
    cells_of,
    dilate,
    numba_cpu,
    occupied_cells,
    reference,
    traverse,
    update_density_grid,
)

BOX = torch.tensor([[-1.0, -2.0, -0.5], [1.0, 1.0, 2.0]])
STEP = 0.03


def bundle(num_rays=150):
    """Rays from within and without: some miss, some run along axes, some have tiny components, some end early."""
    wanted, num_rays = num_rays, max(num_rays, 100)
    origins = 3 * torch.randn(num_rays, 3) * torch.rand(num_rays, 1)
    targets = BOX[0] + torch.rand(num_rays, 3) * (BOX[1] - BOX[0])
    directions = torch.nn.functional.normalize(targets - origins, dim=1)
    directions[:20, 0] = 0
    directions[10:30, 1] = 0
    directions[30:40, 2] = torch.rand(10) * 1e-20
    directions[40:45, 2] = 1e-42
    directions[50:60] *= 3
    origins[60:70] = torch.round(origins[60:70])  # on planes between cells
    directions[60:70] = torch.sign(directions[60:70]) / math.sqrt(3)
    nearest = torch.rand(num_rays)
    farthest = torch.full((num_rays,), math.inf)
    farthest[::3] = nearest[::3] + 4 * torch.rand(len(farthest[::3])) - 0.5
    return origins[:wanted], directions[:wanted], nearest[:wanted], farthest[:wanted]


def specified(rays, occupied, step=STEP, offset=None, growth=0.0, max_samples=None, box=BOX, **light):
    offset = torch.zeros_like(rays[2]) if offset is None else offset
    return Samples(*reference.traverse((*rays, offset), occupied, box, step, growth, max_samples, **light))


def lit(every, rays, opacity, stop_below, max_samples=None):
    """Of all samples of rays those that light reaches, found afterwards."""
    middles = (every.starts + every.ends) / 2
    points = rays[0][every.ray_index] + middles[:, None] * rays[1][every.ray_index]
    alphas = opacity.flatten()[cells_of(points, BOX, tuple(opacity.shape))]
    seen = visible(alphas, every.ray_first, stop_below)
    if max_samples is not None:
        seen &= torch.arange(len(seen)) < every.ray_first[every.ray_index] + max_samples
    kept, ray_first = compact(seen, every.ray_first)
    return Samples(ray_first, *(column[kept] for column in every[1:]))


def assert_same(first, second):
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 7, 9), (33, 20, 6), (16, 32, 48)])
@pytest.mark.parametrize("share", [0.02, 0.3, 1.0])
def test_every_sample_is_the_one_that_asking_all_finds(shape, share):
    occupied, rays = torch.rand(shape) < share, bundle()
    for offset in (None, torch.rand(len(rays[0]))):
        assert_same(traverse(*rays, occupied, BOX, STEP, offset), specified(rays, occupied, offset=offset))


@pytest.mark.parametrize("step", [0.004, 0.5])
def test_steps_shorter_and_longer_than_cells(step):
    occupied, rays = torch.rand(12, 20, 16) < 0.2, bundle(40)
    assert_same(traverse(*rays, occupied, BOX, step), specified(rays, occupied, step))


def test_few_cells_in_a_large_grid():
    """Whole blocks are empty, and crossed at once."""
    occupied = torch.zeros(70, 50, 66, dtype=torch.bool)
    occupied[torch.tensor([3, 40, 69]), torch.tensor([0, 25, 49]), torch.tensor([65, 30, 1])] = True
    occupied[20:24, 10:30, 10:12] = True
    rays = bundle(400)
    assert_same(traverse(*rays, occupied, BOX, 0.01), specified(rays, occupied, 0.01))


def test_more_runs_than_foreseen():
    """Every other layer is occupied."""
    occupied = (torch.arange(200) % 2 == 0).expand(1, 1, 200).contiguous()
    rays = torch.tensor([[-2.0, 0.1, 0.2]]), torch.tensor([[1.0, 0, 0]]), torch.zeros(1), torch.full((1,), 9.0)
    found = traverse(*rays, occupied, BOX, 0.001)
    assert_same(found, specified(rays, occupied, 0.001))
    assert (found.starts.diff() > 0.0015).sum() == 99


def test_growing_steps_agree_but_for_rounding():
    occupied, rays, offset = torch.rand(12, 20, 16) < 0.3, bundle(), torch.rand(150)
    fast = traverse(*rays, occupied, BOX, STEP, offset, growth=0.05)
    slow = specified(rays, occupied, offset=offset, growth=0.05)
    assert (fast.ray_first.diff() != slow.ray_first.diff()).sum() <= 1  # counted: a middle on a plane between cells
    same = fast.ray_first.diff()[fast.ray_index] == slow.ray_first.diff()[fast.ray_index]
    there = fast.ray_first.diff()[slow.ray_index] == slow.ray_first.diff()[slow.ray_index]
    assert_close(fast.starts[same], slow.starts[there])
    assert_close(fast.ends[same], slow.ends[there])


def test_samples_grow_with_the_distance():
    box = torch.tensor([[-1e4, -1e4, -1e4], [1e4, 1e4, 1e4]])
    ray = torch.zeros(1, 3), torch.tensor([[0.0, 0, 1]]), torch.tensor([0.5]), torch.tensor([1000.0])
    found = traverse(*ray, torch.ones(2, 2, 2, dtype=torch.bool), box, 0.1, growth=0.01)
    lengths = found.ends - found.starts
    assert_close(lengths[:-1], torch.maximum(0.01 * found.starts[:-1], torch.tensor(0.1)), atol=1e-6, rtol=1e-3)
    assert torch.equal(found.starts[1:], found.ends[:-1])
    assert found.ends[-1] == 1000


def test_a_full_box_is_covered_from_face_to_face():
    """Along x: the samples tile the chord, to half a step at each end."""
    rays = torch.tensor([[-3.0, 0, 0]]), torch.tensor([[1.0, 0, 0]]), torch.zeros(1), torch.full((1,), math.inf)
    found = traverse(*rays, torch.ones(4, 4, 4, dtype=torch.bool), BOX, 0.01)
    assert abs(float(found.starts[0]) - 2) <= 0.0051
    assert abs(float(found.ends[-1]) - 4) <= 0.0051
    assert torch.equal(found.starts[1:], found.ends[:-1])
    assert float((found.ends - found.starts).sum()) == pytest.approx(2, abs=0.011)


def test_the_last_sample_ends_with_the_ray():
    rays = torch.zeros(1, 3), torch.tensor([[1.0, 0, 0]]), torch.zeros(1), torch.tensor([0.25])
    found = traverse(*rays, torch.ones(4, 4, 4, dtype=torch.bool), BOX, 0.1, torch.tensor([0.5]))
    assert_close(found.starts, [0.05, 0.15])
    assert_close(found.ends, [0.15, 0.25])


def test_upper_faces_of_cells_belong_to_the_next():
    """Along the plane between two cells the upper one counts; along the upper face of the box none."""
    origins = torch.tensor([[-3.0, -0.5, 0.1], [-3.0, 1.0, 0.1], [-3.0, -2.0, 0.1]])
    rays = origins, torch.tensor([[1.0, 0, 0]]).repeat(3, 1), torch.zeros(3), torch.full((3,), 9.0)
    occupied = torch.zeros(1, 2, 1, dtype=torch.bool)
    occupied[0, 1] = True
    assert (traverse(*rays, occupied, BOX, 0.1).ray_first.diff() > 0).tolist() == [True, False, False]
    assert (traverse(*rays, ~occupied, BOX, 0.1).ray_first.diff() > 0).tolist() == [False, False, True]


def test_no_rays_no_cells_no_way():
    occupied, rays = torch.ones(3, 3, 3, dtype=torch.bool), bundle()
    assert traverse(*(x[:0] for x in rays), occupied, BOX, STEP).ray_first.tolist() == [0]
    assert len(traverse(*rays, ~occupied, BOX, STEP).starts) == 0
    bad = torch.tensor([math.nan, math.inf, 0.0])
    origins, directions, nearest = torch.zeros(3, 3), torch.ones(3, 3), torch.zeros(3)
    directions[2] = 0
    origins[:2, 1] = bad[:2]
    for farthest in (torch.full((3,), 5.0), torch.full((3,), math.nan)):
        arguments = origins, directions, nearest, farthest
        assert traverse(*arguments, occupied, BOX, STEP).ray_first.tolist() == [0, 0, 0, 0]
        assert specified(arguments, occupied).ray_first.tolist() == [0, 0, 0, 0]


def test_only_the_nearest_samples_of_a_ray():
    occupied, rays = torch.rand(12, 20, 16) < 0.5, bundle()
    found, every = traverse(*rays, occupied, BOX, STEP, max_samples=7), traverse(*rays, occupied, BOX, STEP)
    assert_same(found, specified(rays, occupied, max_samples=7))
    assert torch.equal(found.ray_first.diff(), every.ray_first.diff().clamp(max=7))


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 7, 9), (33, 20, 6), (16, 32, 48)])
@pytest.mark.parametrize("stop_below", [1e-3, 0.3, 1.0])
def test_rays_end_where_light_does(shape, stop_below):
    """The samples that are visible among all, to the bit; whole, short and growing steps, many and few samples."""
    occupied, opacity, rays = torch.rand(shape) < 0.4, torch.rand(shape) ** 4, bundle()
    opacity[torch.rand(shape) < 0.2] = 0
    for options in ({}, {"offset": torch.rand(150)}, {"step": 0.004}, {"growth": 0.05}, {"max_samples": 5}):
        given = {"step": STEP, **options}
        found = traverse(*rays, occupied, BOX, **given, opacity=opacity, stop_below=stop_below)
        most = given.pop("max_samples", None)
        assert_same(found, lit(traverse(*rays, occupied, BOX, **given), rays, opacity, stop_below, most))
        if not options.get("growth"):
            assert_same(found, specified(rays, occupied, **options, opacity=opacity, stop_below=stop_below))


def test_clear_cells_hide_nothing_and_opaque_ones_all_behind():
    occupied, rays = torch.rand(9, 12, 10) < 0.5, bundle()
    every = traverse(*rays, occupied, BOX, STEP)
    for light in (
        {"opacity": torch.zeros(9, 12, 10), "stop_below": 1.0},
        {"opacity": torch.ones(9, 12, 10), "stop_below": 0.0},
    ):
        assert_same(traverse(*rays, occupied, BOX, STEP, **light), every)
        assert_same(specified(rays, occupied, **light), every)
    light = {"opacity": torch.ones(9, 12, 10), "stop_below": 1e-6}
    first = traverse(*rays, occupied, BOX, STEP, **light)
    assert_same(first, specified(rays, occupied, **light))
    assert torch.equal(first.ray_first.diff(), every.ray_first.diff().clamp(max=1))
    assert torch.equal(first.starts, every.starts[every.ray_first[:-1][every.ray_first.diff() > 0]])


def test_the_sample_that_takes_the_last_light_is_kept():
    """Half of the light in each sample: 1, 1/2, 1/4 and 1/8 before the first four, exactly."""
    rays = torch.tensor([[-3.0, 0, 0]]), torch.tensor([[1.0, 0, 0]]), torch.zeros(1), torch.full((1,), math.inf)
    for stop_below, count in ((1.0, 1), (0.5, 2), (0.125, 4), (0.1251, 3)):
        light = {"opacity": torch.full((4, 4, 4), 0.5), "stop_below": stop_below}
        occupied = torch.ones(4, 4, 4, dtype=torch.bool)
        assert len(traverse(*rays, occupied, BOX, 0.01, **light).starts) == count
        assert len(specified(rays, occupied, 0.01, **light).starts) == count


def test_diverged_opacities_end_rays():
    rays, occupied = bundle(), torch.ones(3, 3, 3, dtype=torch.bool)
    light = {"opacity": torch.full((3, 3, 3), math.nan), "stop_below": 0.5}
    found = traverse(*rays, occupied, BOX, STEP, **light)
    assert_same(found, specified(rays, occupied, **light))
    assert found.ray_first.diff().max() == 1


def test_light_of_no_rays_and_no_cells():
    light = {"opacity": torch.rand(3, 3, 3), "stop_below": 0.1}
    occupied, rays = torch.ones(3, 3, 3, dtype=torch.bool), bundle()
    for given, cells in (((x[:0] for x in rays), occupied), (rays, ~occupied)):
        given = tuple(given)
        found = traverse(*given, cells, BOX, STEP, **light)
        assert_same(found, specified(given, cells, **light))
        assert not len(found.starts)


def test_float64_far_devices_and_strides(far):  # noqa: F811
    occupied, rays = torch.rand(6, 5, 4) < 0.5, bundle(30)
    expected = traverse(*rays, occupied, BOX, STEP)
    double = traverse(*(x.double() for x in rays), occupied, BOX.double(), STEP)
    assert double.starts.dtype == torch.float64
    assert (double.ray_first.diff() != expected.ray_first.diff()).sum() <= 2  # counted: middles on planes
    there = traverse(*(x.to(far) for x in rays), occupied.to(far), BOX.to(far), STEP)
    assert isinstance(there.starts, Far)
    assert_same([x.cpu() for x in there], expected)
    turned = occupied.permute(2, 1, 0).contiguous().permute(2, 1, 0)
    assert_same(traverse(rays[0].T.contiguous().T, *rays[1:], turned, BOX, STEP), expected)
    thin = torch.rand(4, 5, 6).permute(2, 1, 0)
    light = {"opacity": thin, "stop_below": 0.2}
    expected = traverse(*rays, occupied, BOX, STEP, **light)
    assert_same(traverse(*rays, occupied, BOX, STEP, opacity=thin.contiguous(), stop_below=0.2), expected)
    light["opacity"] = thin.to(far)
    assert_same([x.cpu() for x in traverse(*(x.to(far) for x in rays), occupied.to(far), BOX.to(far), STEP, **light)],
                expected)  # fmt: skip


def test_results_do_not_depend_on_threads():
    occupied, rays, threads, results = torch.rand(30, 30, 30) < 0.1, bundle(500), torch.get_num_threads(), []
    opacity = torch.rand(30, 30, 30)
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        every = traverse(*rays, occupied, BOX, STEP)
        results.append([*every, *traverse(*rays, occupied, BOX, STEP, opacity=opacity, stop_below=0.01)])
    torch.set_num_threads(threads)
    assert_same(results[0], results[1])
    assert_same(results[0], results[2])


def test_every_element_is_written(monkeypatch):
    empty = np.empty

    def poisoned(shape, dtype=float, **options):
        made = empty(shape, dtype, **options)
        made.fill(np.nan if np.issubdtype(dtype, np.floating) else 77)
        return made

    monkeypatch.setattr(numba_cpu.np, "empty", poisoned)
    found = traverse(*bundle(), torch.rand(9, 9, 9) < 0.3, BOX, STEP)
    assert_finite(found.starts)
    assert_finite(found.ends)
    assert (found.ray_index.diff() >= 0).all()
    assert found.ray_index.max() < 150


def test_cells_of_points():
    points = torch.tensor([[-1.0, -2.0, -0.5], [0.99, 0.99, 1.99], [1.0, 0, 0], [0.1, -0.6, 0.9], [math.nan, 0, 0]])
    assert cells_of(points, BOX, (5, 3, 2)).tolist() == [0, 29, -1, 2 * 6 + 1 * 2 + 1, -1]


def test_density_fades_where_one_looks_and_stays_elsewhere():
    grid = torch.tensor([4.0, 8.0, 2.0]).view(1, 1, 3)
    cells, densities = torch.tensor([0, 0, -1, 1]), torch.tensor([1.0, 3.0, 99.0, 9.0])
    assert_close(update_density_grid(grid, cells, densities, 0.5).flatten(), [3.0, 9.0, 2.0])
    assert_close(grid.flatten(), [4.0, 8.0, 2.0])


def test_cells_above_the_threshold_or_the_mean():
    grid = torch.tensor([0.0, 1.0, 2.0, 9.0]).view(1, 2, 2)
    assert occupied_cells(grid, 0.5).flatten().tolist() == [False, True, True, True]
    assert occupied_cells(grid, 50.0).flatten().tolist() == [False, False, False, True]
    with pytest.raises(ValueError, match="holds NaN"):
        occupied_cells(grid * math.nan, 0.5)


def test_dilation_reaches_the_26_neighbours():
    occupied = torch.zeros(5, 6, 7, dtype=torch.bool)
    occupied[2, 2, 2] = occupied[4, 5, 6] = True
    grown = dilate(occupied)
    assert grown[1:4, 1:4, 1:4].all()
    assert int(grown.sum()) == 27 + 8
    assert torch.equal(occupied_cells(occupied.float(), 0.5, dilation=True), grown)


def test_bad_input_is_named():
    rays, occupied = bundle(5), torch.ones(2, 2, 2, dtype=torch.bool)
    for change, message in (
        ({"step": 0.0}, "step must be positive"),
        ({"growth": -1.0}, "growth"),
        ({"max_samples": 0}, "max_samples must be at least 1"),
        ({"box": BOX.flip(0)}, "least corner"),
        ({"box": BOX.double()}, "box must be torch.float32"),
        ({"occupied": occupied.float()}, "occupied must be torch.bool"),
        ({"offset": torch.zeros(4)}, "offset must be"),
        ({"farthest": torch.zeros(5).double()}, "farthest must be"),
        ({"origins": torch.zeros(5, 2)}, "origins must be floats"),
        ({"stop_below": 0.1}, "stop_below=0.1 needs the opacity"),
        ({"opacity": torch.zeros(2, 2, 2), "stop_below": 1.5}, r"stop_below must be a transmittance in \[0, 1\]"),
        ({"opacity": torch.zeros(2, 2, 2), "stop_below": math.nan}, "stop_below must be"),
        ({"opacity": torch.zeros(2, 2, 2).double()}, "opacity must be torch.float32"),
        ({"opacity": torch.zeros(2, 2)}, "opacity must be torch.float32 of shape"),
        ({"opacity": torch.zeros(2, 2, 3)}, r"opacity must have the shape of occupied, \(2, 2, 2\)"),
    ):
        names = dict(zip(("origins", "directions", "nearest", "farthest"), rays, strict=True))
        with pytest.raises(ValueError, match=message):
            traverse(**{**names, "occupied": occupied, "box": BOX, "step": STEP, **change})
    ray = torch.zeros(300, 3), torch.ones(300, 3), torch.zeros(300), torch.full((300,), 9.0)
    with pytest.raises(ValueError, match="at most 268,435,456"):
        traverse(*ray, occupied, BOX, 1e-7)


def test_the_operator_is_well_registered():
    arguments = *bundle(8), torch.zeros(8), torch.rand(4, 4, 4) < 0.5, BOX, STEP, 0.0, None
    for light in ((None, 0.0), (torch.rand(4, 4, 4), 0.1)):
        torch.library.opcheck(torch.ops.rendra.traverse.default, (*arguments, *light))


@pytest.mark.gpu
def test_cuda_takes_the_reference():
    occupied, rays = torch.rand(12, 20, 16) < 0.3, bundle()
    found = traverse(*(x.cuda() for x in rays), occupied.cuda(), BOX.cuda(), STEP)
    assert_same([x.cpu() for x in found], traverse(*rays, occupied, BOX, STEP))
