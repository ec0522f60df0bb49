"""A network whose weights are the moving average of another's: steadier than any of the states that it averages.

Karras et al., "Progressive Growing of GANs", ICLR 2018, Sec. 6.1 (of generators).
"""

from __future__ import annotations

import copy
from typing import TypeVar

import torch
from torch import nn

NetworkT = TypeVar("NetworkT", bound=nn.Module)


def average_of(network: NetworkT) -> NetworkT:
    """The average of a network that has not moved yet: a copy that nobody trains.

    Registered as a module of a task it is in its checkpoints, and a resumed fit goes on with it.
    """
    return copy.deepcopy(network).requires_grad_(False)


@torch.no_grad()
def follow(average: nn.Module, network: nn.Module, decay: float) -> None:
    """Takes a step of the network into its average.

    Args:
        average: of `average_of`, changed in place: each weight becomes decay * its own + (1 - decay) * the network's;
            buffers, which are no weights, become the network's.
        network: what has moved.
        decay: in [0, 1]; the average reaches about 1 / (1 - decay) steps back.

    Raises:
        ValueError: networks of different weights.
    """
    ours, theirs = dict(average.named_parameters()), dict(network.named_parameters())
    if ours.keys() != theirs.keys():
        raise ValueError(f"only one of average and network has the weights {', '.join(sorted(ours.keys() ^ theirs))}")
    for name, weight in ours.items():
        weight.lerp_(theirs[name], 1 - decay)
    for mine, other in zip(average.buffers(), network.buffers(), strict=True):
        mine.copy_(other)
