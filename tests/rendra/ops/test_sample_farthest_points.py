"""Farthest points: laws of the greedy choice, padding, gradients, devices."""

import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401

from rendra.ops import sample_farthest_points
from rendra.ops.sample_farthest_points import sample_farthest_points_naive


def test_a_line_is_halved() -> None:
    line = torch.arange(9.0).view(1, 9, 1)
    points, indices = sample_farthest_points(line, K=9)
    assert indices[0].tolist() == [0, 8, 4, 2, 6, 1, 3, 5, 7]
    assert torch.equal(points[0, :, 0], indices[0].float())


def test_each_point_is_the_farthest_from_those_before() -> None:
    cloud = torch.rand(1, 500, 3, dtype=torch.float64)
    points, indices = sample_farthest_points(cloud, K=30)
    for k in range(1, 30):
        reach = torch.cdist(cloud[0], points[0, :k]).amin(1)
        assert_close(reach[indices[0, k]], reach.max())


def test_any_number_for_each_cloud() -> None:
    cloud = torch.rand(4, 20, 5)
    lengths = torch.tensor([20, 7, 0, 12])
    for K in ([6, 30, 3, 12], torch.tensor([6, 30, 3, 12])):
        points, indices = sample_farthest_points(cloud, lengths, K)
        assert points.shape == (4, 30, 5)
        assert (indices >= 0).sum(1).tolist() == [6, 7, 0, 12]
        assert ((indices >= 0).long().diff(dim=1) <= 0).all()
        assert (points[indices < 0] == 0).all()
        for n in range(4):
            taken = indices[n][indices[n] >= 0]
            assert torch.equal(points[n, : len(taken)], cloud[n, taken])
            assert (taken < lengths[n]).all()


def test_default_number_and_naive_name() -> None:
    cloud = torch.rand(2, 80, 3)
    points, indices = sample_farthest_points(cloud)
    assert points.shape == (2, 50, 3)
    for mine, theirs in zip((points, indices), sample_farthest_points_naive(cloud), strict=True):
        assert torch.equal(mine, theirs)


def test_random_starts_are_drawn_from_the_points() -> None:
    cloud, lengths = torch.rand(200, 6, 2), torch.tensor([4] * 199 + [0])
    _, indices = sample_farthest_points(cloud, lengths, K=2, random_start_point=True)
    assert indices[:199, 0].unique().tolist() == [0, 1, 2, 3]
    assert indices[199].tolist() == [-1, -1]
    torch.manual_seed(3)
    first = sample_farthest_points(cloud, K=2, random_start_point=True)[1]
    torch.manual_seed(3)
    assert torch.equal(first, sample_farthest_points(cloud, K=2, random_start_point=True)[1])


def test_gradients_reach_the_points_that_were_taken() -> None:
    cloud = torch.rand(2, 10, 3, requires_grad=True)
    points, indices = sample_farthest_points(cloud, torch.tensor([10, 2]), K=4)
    points.sum().backward()
    expected = torch.zeros(2, 10, 1)
    for n in range(2):
        expected[n, indices[n][indices[n] >= 0]] = 1
    assert_close(cloud.grad, expected.expand(2, 10, 3))


@pytest.mark.parametrize("shape", [(0, 5, 3), (2, 0, 3), (2, 5, 0)])
@pytest.mark.parametrize("K", [0, 3])
def test_nothing_to_sample(shape: tuple[int, ...], K: int) -> None:
    points, indices = sample_farthest_points(torch.zeros(shape), K=K)
    width = 0 if shape[0] == 0 else K
    assert points.shape == (shape[0], width, shape[2])
    assert indices.shape == (shape[0], width)


def test_points_stay_where_they_are(far) -> None:  # noqa: F811
    cloud, lengths = torch.rand(2, 30, 3), torch.tensor([30, 4])
    points, indices = sample_farthest_points(cloud.to(far), lengths.to(far), K=6)
    assert isinstance(points, Far)
    expected = sample_farthest_points(cloud, lengths, K=6)
    assert_close(points.cpu(), expected[0])
    assert torch.equal(indices.cpu(), expected[1])
    drawn = sample_farthest_points(cloud.to(far), K=[2, 3], random_start_point=True)
    assert isinstance(drawn[1], Far)


def test_bad_input_is_named() -> None:
    cloud = torch.rand(2, 5, 3)
    with pytest.raises(ValueError, match=r"points must be floats of shape \(N, P, D\)"):
        sample_farthest_points(cloud[0])
    with pytest.raises(ValueError, match="points and lengths must have same batch dimension"):
        sample_farthest_points(cloud, torch.tensor([5]))
    with pytest.raises(ValueError, match=r"lengths must lie between 0 and the 5 points of each cloud, got \[5, 6\]"):
        sample_farthest_points(cloud, torch.tensor([5, 6]))
    with pytest.raises(ValueError, match="K and points must have the same batch dimension"):
        sample_farthest_points(cloud, K=[1, 2, 3])
    with pytest.raises(ValueError, match="K must not be negative"):
        sample_farthest_points(cloud, K=-1)
    with pytest.raises(ValueError, match="K must be whole numbers"):
        sample_farthest_points(cloud, K=2.5)
    cloud[1, 3, 2] = float("nan")
    with pytest.raises(ValueError, match=r"points\[1, 3\] is not finite"):
        sample_farthest_points(cloud, K=2)
    sample_farthest_points(cloud, torch.tensor([5, 3]), K=2)
