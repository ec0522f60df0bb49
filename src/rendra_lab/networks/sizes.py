"""Tensors whose sizes are known only to the data or a checkpoint, such as grids laid into the box of a scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor


def take_sizes(named: Iterable[tuple[str, Tensor]], state_dict: Mapping[str, Tensor], prefix: str) -> None:
    """Gives parameters and buffers the sizes of a checkpoint, before torch's `_load_from_state_dict` copies it.

    They stay what they are, type, device and identity; their numbers are lost. A checkpoint with another number of
    axes is left to torch to refuse.

    Args:
        named: the tensors, by their names in the module.
        state_dict: the checkpoint's.
        prefix: of the module in it.
    """
    for name, tensor in named:
        found = state_dict.get(prefix + name)
        if found is not None and found.ndim == tensor.ndim:
            tensor.data = torch.empty(found.shape, dtype=tensor.dtype, device=tensor.device)
