"""Fast farthest point sampling against its specification: the same indices, to the last."""

import pytest
import torch

from rendra.kernels.sample_farthest_points import numba_cpu, reference, sample_farthest_points


def sample(points: torch.Tensor, number: int, lengths: list[int] | None = None, start: int = 0, by=None):
    n = len(points)
    length = torch.tensor([points.shape[1]] * n if lengths is None else lengths, dtype=torch.int64)
    arguments = (points, length, length.clamp(max=number), torch.full((n,), start).minimum((length - 1).clamp(min=0)))
    return (by or sample_farthest_points)(*arguments)


CLOUDS = {
    "cube": torch.rand(2, 900, 3, generator=torch.Generator().manual_seed(1)),
    "sphere": torch.nn.functional.normalize(
        torch.randn(1, 1500, 3, generator=torch.Generator().manual_seed(2)), dim=-1
    ),
    "lattice with many ties": torch.cartesian_prod(*[torch.arange(7.0)] * 3)[torch.randperm(343)][None],
    "coinciding": torch.ones(1, 400, 3),
    "few places": torch.randint(0, 3, (1, 600, 2), generator=torch.Generator().manual_seed(3)).float(),
    "far clusters": torch.rand(1, 800, 3) + 1e6 * torch.randint(0, 2, (1, 800, 1)),
    "line": torch.linspace(0, 1, 700)[None, :, None],
    "halving for ever": 2.0 ** -torch.arange(140.0)[None, :, None].repeat(1, 3, 2),
    "overflowing": torch.tensor([-3e38, 3e38, 0.0, 1e38])[torch.arange(300) % 4][None, :, None].expand(1, 300, 3),
    "nineteen dimensions": torch.randn(2, 400, 19),
    "no dimension": torch.zeros(2, 5, 0),
    "one point": torch.rand(3, 1, 3),
    "no point": torch.zeros(2, 0, 3),
    "no cloud": torch.zeros(0, 5, 3),
}


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("number", [0, 1, 7, 150])
def test_equals_the_reference(name: str, number: int) -> None:
    points = CLOUDS[name]
    fast, slow = sample(points, number, start=2), sample(points, number, start=2, by=reference.sample_farthest_points)
    assert fast.dtype == torch.int64
    assert torch.equal(fast, slow)


@pytest.mark.parametrize("bucket", [1, 2, 5])
def test_small_buckets_change_nothing(bucket: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cutting, checked down to single points; `py_func` so that the constants may be changed."""
    monkeypatch.setattr(numba_cpu, "_BUCKET", bucket)
    monkeypatch.setattr(numba_cpu, "_BUCKETS_PER_SAMPLE", 100)
    cloud, picked = CLOUDS["few places"][0, :60], torch.zeros(20, dtype=torch.int64)
    numba_cpu._sample.py_func(cloud.numpy(), 60, 20, 4, picked.numpy())
    assert torch.equal(picked[None], sample(cloud[None], 20, start=4, by=reference.sample_farthest_points))


def test_all_points_of_a_cloud_are_taken_once() -> None:
    assert sample(CLOUDS["sphere"], 1500)[0].unique().numel() == 1500


def test_lengths_and_what_lies_behind() -> None:
    points = torch.rand(4, 300, 3)
    points[0, 250:], points[1, 3:] = float("nan"), 1e30
    lengths = [250, 3, 0, 300]
    fast = sample(points, 40, lengths)
    assert torch.equal(fast, sample(points, 40, lengths, by=reference.sample_farthest_points))
    assert (fast >= 0).sum(1).tolist() == [40, 3, 0, 40]


def test_results_do_not_depend_on_threads() -> None:
    threads, results = torch.get_num_threads(), []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        results.append(sample(torch.rand(5, 400, 3, generator=torch.Generator().manual_seed(5)), 60))
    torch.set_num_threads(threads)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_the_operator_is_well_registered() -> None:
    numbers = torch.tensor([5, 3])
    arguments = (torch.rand(2, 9, 3), numbers, numbers, torch.zeros(2, dtype=torch.int64))
    torch.library.opcheck(torch.ops.rendra.sample_farthest_points.default, arguments)


def test_bad_input_is_named() -> None:
    one, points = torch.ones(1, dtype=torch.int64), torch.rand(1, 4, 3)
    with pytest.raises(ValueError, match=r"points must be floats of shape \(N, P, D\), got torch.int64"):
        sample_farthest_points(points.long(), one, one, one)
    with pytest.raises(ValueError, match=r"lengths must be int64 of shape \(1,\) on cpu, got torch.float32"):
        sample_farthest_points(points, one.float(), one, one)
    with pytest.raises(ValueError, match="cloud 0 of 4 points cannot have length 1, 1 samples and start 1"):
        sample_farthest_points(points, one, one, one)


@pytest.mark.gpu
def test_cuda_takes_the_reference() -> None:
    points, three = torch.rand(2, 50, 3), torch.full((2,), 3)
    there = sample_farthest_points(points.cuda(), 10 * three.cuda(), three.cuda(), 0 * three.cuda())
    assert torch.equal(there.cpu(), sample_farthest_points(points, 10 * three, three, 0 * three))
