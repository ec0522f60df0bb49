"""Means, gathers and covariances against their definitions."""

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.ops.utils import (
    convert_pointclouds_to_tensor,
    eyes,
    get_point_covariances,
    is_pointclouds,
    masked_gather,
    wmean,
)
from rendra.structures import Pointclouds


def test_gathered_points_are_those_named_and_zero_for_none() -> None:
    points = torch.randn(2, 5, 3)
    for idx in (torch.tensor([[0, -1, 4], [2, 2, -1]]), torch.randint(-1, 5, (2, 4, 3))):
        gathered = masked_gather(points, idx)
        for place in torch.cartesian_prod(*map(torch.arange, idx.shape)).tolist():
            wanted = points[place[0], idx[tuple(place)]] if idx[tuple(place)] >= 0 else torch.zeros(3)
            assert torch.equal(gathered[tuple(place)], wanted)
    assert masked_gather(points[:, :0], idx).abs().max() == 0


def test_gradients_count_how_often_a_point_was_gathered() -> None:
    points = torch.randn(1, 3, 2, requires_grad=True)
    masked_gather(points, torch.tensor([[0, 2, 2, -1]])).sum().backward()
    assert_close(points.grad, [[[1.0, 1], [0, 0], [2, 2]]])


def test_weighted_means() -> None:
    x, weight = torch.randn(2, 6, 4, 3), torch.rand(2, 6, 4)
    assert_close(wmean(x), x.mean(-2, keepdim=True))
    assert_close(wmean(x, torch.ones(4)), x.mean(-2, keepdim=True))  # broadcast, as documented
    assert_close(wmean(x, 7 * weight), wmean(x, weight))
    for dim in (-2, 1, (1, 2), (0, 1, 2)):
        expected = (x * weight[..., None]).sum(dim) / weight[..., None].sum(dim)
        assert_close(wmean(x, weight, dim, keepdim=False), expected)
        assert wmean(x, weight, dim).ndim == x.ndim
    assert_close(wmean(x, torch.full((1, 6, 1), 2.0), dim=2), x.mean(2, keepdim=True))
    assert wmean(x, torch.zeros(4)).abs().max() == 0
    with pytest.raises(ValueError, match=r"not compatible with the tensor: \(5,\) does not broadcast to \(2, 6, 4\)"):
        wmean(x, torch.ones(5))


def test_eyes_are_identities() -> None:
    assert torch.equal(eyes(3, 2), torch.eye(3).expand(2, 3, 3))
    assert eyes(2, 0, dtype=torch.float64).shape == (0, 2, 2)


def test_both_kinds_of_clouds_are_understood() -> None:
    clouds = Pointclouds([torch.randn(2, 3), torch.randn(4, 3)])
    assert is_pointclouds(clouds)
    assert not is_pointclouds(torch.ones(1, 2, 3))
    points, counts = convert_pointclouds_to_tensor(clouds)
    assert points.shape == (2, 4, 3)
    assert counts.tolist() == [2, 4]
    again, counts = convert_pointclouds_to_tensor(points)
    assert again is points
    assert counts.tolist() == [4, 4]
    for wrong in ([points], points[0]):
        with pytest.raises(ValueError, match="either Pointclouds objects or tensors"):
            convert_pointclouds_to_tensor(wrong)


def test_the_neighborhood_of_all_points_has_the_covariance_of_the_cloud() -> None:
    clouds = [torch.randn(n, 3, dtype=torch.float64) for n in (9, 5, 1)]
    points, counts = convert_pointclouds_to_tensor(Pointclouds(clouds))
    covariances, neighbors = get_point_covariances(points, counts, 9)
    assert neighbors.shape == (3, 9, 9, 3)
    for i, cloud in enumerate(clouds):
        n = len(cloud)
        expected = torch.cov(cloud.T, correction=0).expand(n, 3, 3)
        assert_close(covariances[i, :n], expected, atol=1e-12)
        assert_close(neighbors[i, :n, :n].sum(1), cloud.sum(0).expand(n, 3), atol=1e-12)
        assert covariances[i, n:].abs().sum() == neighbors[i, n:].abs().sum() == neighbors[i, :, n:].abs().sum() == 0


def test_covariances_are_differentiable() -> None:
    points = torch.randn(2, 6, 3, dtype=torch.float64, requires_grad=True)
    counts = torch.tensor([6, 4])
    assert torch.autograd.gradcheck(lambda p: get_point_covariances(p, counts, 4), points)
    same = torch.zeros(1, 4, 3, requires_grad=True)
    get_point_covariances(same, torch.tensor([4]), 3)[0].sum().backward()
    assert_finite(same.grad)


def test_points_stay_on_their_device(far) -> None:  # noqa: F811
    points = torch.rand(2, 5, 3, device=far)
    idx = torch.zeros(2, 4, dtype=torch.int64, device=far)
    assert isinstance(masked_gather(points, idx), Far)
    assert isinstance(wmean(points, points[..., 0]), Far)
    assert isinstance(eyes(3, 2, device=far), Far)
    assert all(isinstance(part, Far) for part in convert_pointclouds_to_tensor(points))


def test_gathers_that_do_not_fit_are_named() -> None:
    with pytest.raises(ValueError, match="same batch dimension, got 2 and 1"):
        masked_gather(torch.ones(2, 5, 3), torch.zeros(1, 4, dtype=torch.int64))
    with pytest.raises(ValueError, match=r"got \(2, 5, 3\) and \(2,\)"):
        masked_gather(torch.ones(2, 5, 3), torch.zeros(2, dtype=torch.int64))
