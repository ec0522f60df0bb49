"""Neighbours as scripts ask for them: shapes, padding, gathering, devices, errors."""

import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401

from rendra.ops import ball_query, knn_gather, knn_points


def clouds(N=3, P1=20, P2=30, D=3):
    generator = torch.Generator().manual_seed(0)
    return torch.rand(N, P1, D, generator=generator), torch.rand(N, P2, D, generator=generator)


def test_neighbours_are_those_of_a_sorted_table():
    p1, p2 = clouds()
    dists, idx, nearest = knn_points(p1, p2, K=4, return_nn=True)
    table = ((p1[:, :, None] - p2[:, None]) ** 2).sum(-1).sort(-1)
    assert torch.equal(idx, table.indices[..., :4])
    assert_close(dists, table.values[..., :4], atol=1e-6)
    assert_close(((nearest - p1[:, :, None]) ** 2).sum(-1), dists, atol=1e-6)
    assert knn_points(p1, p2).knn is None


def test_padding_is_zero():
    p1, p2 = clouds()
    lengths1, lengths2 = torch.tensor([20, 3, 0]), torch.tensor([2, 30, 0])
    found = knn_points(p1, p2, lengths1, lengths2, K=5, return_nn=True)
    assert found.knn.shape == (3, 20, 5, 3)
    for tensor in found:
        assert (tensor[0, :, 2:] == 0).all()
        assert (tensor[1, 3:, :, ...][..., :1] == tensor[1, 3:, :, ...][..., :1]).all()
        assert (tensor[2] == 0).all()
    assert (found.dists[1, 3:] == 0).all()
    assert (found.idx[1, 3:] == 0).all()


def test_more_neighbours_than_points():
    p1, p2 = clouds(P2=4)
    found = knn_points(p1, p2, K=6)
    assert found.idx[0, 0].sort().values.tolist() == [0, 0, 0, 1, 2, 3]
    assert (found.dists[..., 4:] == 0).all()


def test_gathering_follows_the_indices_and_its_gradient_flows_back():
    x = torch.rand(2, 6, 5, requires_grad=True)
    idx = torch.randint(6, (2, 7, 3))
    gathered = knn_gather(x, idx, torch.tensor([6, 2]))
    assert torch.equal(gathered[0, 4, 1], x[0, idx[0, 4, 1]])
    assert (gathered[1, :, 2:] == 0).all()
    gathered.sum().backward()
    assert x.grad.sum() == 5 * 7 * (3 + 2)


def test_balls_pad_indices_with_minus_one():
    p1, p2 = torch.zeros(1, 2, 3), torch.tensor([[[0.1, 0, 0], [5, 0, 0], [0, 0.15, 0], [0, 0, 0]]])
    for skip in (False, True):
        dists, idx, near = ball_query(p1, p2, torch.tensor([1]), K=3, skip_points_outside_cube=skip)
        assert idx.tolist() == [[[0, 2, 3], [-1, -1, -1]]]
        assert_close(dists, [[[0.01, 0.0225, 0.0], [0.0, 0.0, 0.0]]])
        assert_close(near[0, 0], p2[0, [0, 2, 3]])
        assert (near[0, 1] == 0).all()
    assert ball_query(p1, p2, K=1).idx[..., 0].tolist() == [[0, 0]]
    assert ball_query(p1, p2, return_nn=False).knn is None
    assert ball_query(p1, p2).idx.shape == (1, 2, 500)


def test_gradients_reach_both_clouds():
    p1, p2 = (p.double().requires_grad_() for p in clouds(N=1, P1=4, P2=5))
    assert torch.autograd.gradcheck(lambda a, b: knn_points(a, b, K=2, return_nn=True)[::2], (p1, p2))
    assert torch.autograd.gradcheck(lambda a, b: ball_query(a, b, K=2, radius=0.9)[::2], (p1, p2))


def test_neighbours_stay_on_the_device_of_their_input(far):  # noqa: F811
    p1, p2 = clouds()
    lengths = torch.tensor([5, 30, 0])
    for search in (knn_points, ball_query):
        there = search(p1.to(far), p2.to(far), lengths2=lengths.to(far), K=3, return_nn=True)
        here = search(p1, p2, lengths2=lengths, K=3, return_nn=True)
        for ours, theirs in zip(there, here, strict=True):
            assert isinstance(ours, Far)
            assert_close(ours.cpu(), theirs, atol=1e-6)


@pytest.mark.parametrize("search", [knn_points, ball_query])
def test_clouds_that_do_not_fit_are_named(search):
    for shape, message in (
        ((1, 5, 3), "same batch dimension"),
        ((2, 5, 2), "same point dimension"),
        ((5, 3), "N, P, D"),
    ):
        with pytest.raises(ValueError, match=message):
            search(torch.zeros(2, 4, 3), torch.zeros(shape))
    with pytest.raises(ValueError, match="same batch dimension"):
        knn_gather(torch.zeros(2, 4, 3), torch.zeros(1, 2, 2, dtype=torch.int64))
