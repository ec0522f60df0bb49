"""Checkpoints that know the sizes of tensors."""

import pytest
import torch
from torch import nn

from rendra_lab.networks.sizes import take_sizes


class Grid(nn.Module):
    """A parameter and a buffer without a size of their own."""

    def __init__(self, side: int) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.rand(side, side))
        self.register_buffer("mask", torch.rand(side) > 0.5)

    def _load_from_state_dict(self, state_dict, prefix, *args):
        take_sizes((("values", self.values), ("mask", self.mask)), state_dict, prefix)
        super()._load_from_state_dict(state_dict, prefix, *args)


def test_tensors_take_the_sizes_of_a_checkpoint_and_stay_who_they_are() -> None:
    trained, fresh = nn.Sequential(Grid(7)), nn.Sequential(Grid(1))
    values, mask = fresh[0].values, fresh[0].mask
    fresh.load_state_dict(trained.state_dict())
    assert torch.equal(values, trained[0].values)
    assert torch.equal(mask, trained[0].mask)
    assert fresh[0].values is values  # an optimizer that holds it still does
    assert values.data_ptr() != trained[0].values.data_ptr()


def test_another_number_of_axes_is_refused_by_torch() -> None:
    with pytest.raises(RuntimeError, match="size mismatch for values"):
        Grid(3).load_state_dict({"values": torch.zeros(2, 2, 2), "mask": torch.zeros(3, dtype=torch.bool)})
