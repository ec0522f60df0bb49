"""
Rows of a batch moved between its packed and its padded form, for batches that are known by their first rows only.

Letters: N items, F packed rows, M rows of each item when padded. Any type, any device, differentiable.
"""

import torch
from torch import Tensor


def packed_to_padded(inputs: Tensor, first_idxs: Tensor, max_size: int) -> Tensor:
    """
    Give every item `max_size` rows of its own, filled up with 0.

    Args:
        inputs: (F, ...), the rows of item 0, then those of item 1, and so on.
        first_idxs: (N,) integers, ascending: the row that each item begins with.
        max_size: M; what an item has beyond it is left out.

    Returns:
        (N, M, ...).

    Raises:
        ValueError: `inputs` has no rows, `first_idxs` is not a list of integers, or `max_size` is negative.
    """
    _check_starts(first_idxs, inputs)
    if max_size < 0:
        raise ValueError(f"max_size must not be negative, got {max_size}")
    shape = (len(first_idxs), max_size, *inputs.shape[1:])
    if inputs.numel() == 0 or 0 in shape:
        return inputs.new_zeros(shape) + inputs.sum().to(inputs.dtype)
    ends = torch.cat([first_idxs[1:], first_idxs.new_full((1,), len(inputs))])
    rows = first_idxs[:, None] + torch.arange(max_size, device=inputs.device)  # (N, M)
    filled = rows < ends[:, None]
    gathered = inputs.index_select(0, rows.where(filled, 0).flatten()).view(shape)
    return gathered.masked_fill(~_beside(filled, gathered), 0)


def padded_to_packed(inputs: Tensor, first_idxs: Tensor, num_inputs: int, max_size_dim: int = 1) -> Tensor:
    """
    Put the rows of all items one after another; the inverse of `packed_to_padded`.

    Args:
        inputs: (N, ..., M, ...).
        first_idxs: (N,) integers, ascending: the packed row that each item begins with.
        num_inputs: F, the number of packed rows.
        max_size_dim: which dimension of `inputs` counts the rows, M.

    Returns:
        (F, ...): `inputs` without its dimensions of N and M. Rows that belong to no item, or that an item has
        beyond M, are 0.

    Raises:
        ValueError: shapes that do not fit together.
    """
    if not 1 <= max_size_dim < inputs.ndim:
        raise ValueError(
            f"max_size_dim must name a dimension behind the first of inputs {tuple(inputs.shape)}, got {max_size_dim}"
        )
    _check_starts(first_idxs, inputs)
    if len(first_idxs) != len(inputs):
        raise ValueError(f"inputs and first_idxs must have the same length, got {len(inputs)} and {len(first_idxs)}")
    padded = inputs.movedim(max_size_dim, 1)
    max_size = padded.shape[1]
    if padded.numel() == 0 or num_inputs == 0:
        return inputs.new_zeros(num_inputs, *padded.shape[2:]) + inputs.sum().to(inputs.dtype)
    packed = torch.arange(num_inputs, device=inputs.device)
    item = torch.searchsorted(first_idxs.contiguous(), packed.to(first_idxs.dtype), right=True) - 1
    row = packed - first_idxs[item.clamp(min=0)]
    filled = (item >= 0) & (row < max_size)
    rows = (item * max_size + row).where(filled, 0)
    gathered = padded.flatten(0, 1).index_select(0, rows)
    return gathered.masked_fill(~_beside(filled, gathered), 0)


def _check_starts(first_idxs: Tensor, inputs: Tensor) -> None:
    if inputs.ndim == 0:
        raise ValueError("inputs must have rows, got a tensor without dimensions")
    if first_idxs.ndim != 1 or first_idxs.is_floating_point():
        raise ValueError(
            f"first_idxs must have shape (N,) and hold integers, got {tuple(first_idxs.shape)} {first_idxs.dtype}"
        )
    if first_idxs.device != inputs.device:
        raise ValueError(f"inputs and first_idxs must be on one device, got {inputs.device} and {first_idxs.device}")


def _beside(mask: Tensor, rows: Tensor) -> Tensor:
    """The mask with as many dimensions as the rows that it belongs to."""
    return mask.reshape(*mask.shape, *[1] * (rows.ndim - mask.ndim))
