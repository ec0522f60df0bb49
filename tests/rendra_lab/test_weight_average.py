"""The average of a network's weights: closed form, what it leaves alone, what does not fit."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from rendra_lab.weight_average import average_of, follow


def test_an_average_of_a_network_that_moves_by_leaps() -> None:
    network = nn.Linear(2, 2).double()
    average = average_of(network)
    first = network.weight.detach().clone()
    with torch.no_grad():
        network.weight += 1
    for _ in range(5):
        follow(average, network, 0.9)
    torch.testing.assert_close(average.weight, first + 1 - 0.9**5)
    torch.testing.assert_close(average.bias, network.bias, rtol=0, atol=0)


@pytest.mark.parametrize(("decay", "share"), [(0.0, 1.0), (1.0, 0.0)])
def test_its_ends(decay: float, share: float) -> None:
    network = nn.Linear(1, 1)
    average = average_of(network)
    before = average.weight.clone()
    with torch.no_grad():
        network.weight.fill_(7.0)
    follow(average, network, decay)
    torch.testing.assert_close(average.weight, before + share * (7 - before), rtol=0, atol=0)


def test_nobody_trains_it_and_the_network_keeps_its_own() -> None:
    network = nn.Sequential(nn.Linear(2, 2), nn.BatchNorm1d(2))
    average = average_of(network)
    assert not any(each.requires_grad for each in average.parameters())
    assert all(each.requires_grad for each in network.parameters())
    network(torch.randn(8, 2)).sum().backward()
    follow(average, network, 0.5)
    assert network[0].weight.grad is not None
    torch.testing.assert_close(average[1].running_mean, network[1].running_mean, rtol=0, atol=0)
    assert int(average[1].num_batches_tracked) == 1


def test_other_weights() -> None:
    with pytest.raises(ValueError, match="only one of average and network has the weights bias"):
        follow(nn.Linear(2, 2), nn.Linear(2, 2, bias=False), 0.9)
