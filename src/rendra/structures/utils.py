"""
Conversions between the three forms of a batch whose items differ in length.

list: one tensor an item; padded: one tensor (N, longest, ...) filled up at the end; packed: all rows in one
tensor (total, ...). PyTorch3D's names and signatures.
"""

from collections.abc import Sequence

import torch
from torch import Tensor


def list_to_padded(
    x: Sequence[Tensor],
    pad_size: Sequence[int] | None = None,
    pad_value: float = 0.0,
    equisized: bool = False,
) -> Tensor:
    """
    Stack tensors of different sizes, filling up at the end of every dimension.

    Args:
        x: N tensors with the same number of dimensions; an empty 1-D tensor stands for an item of size zero.
        pad_size: the size of every dimension of an item after padding; the largest of the list if None.
        pad_value: what fills up.
        equisized: promises that all have one shape, and skips the work.

    Returns:
        (N, *pad_size); (0,) for an empty list.

    Raises:
        ValueError: `pad_size` has the wrong length or is smaller than an item, or the items differ in their
            number of dimensions.
    """
    if equisized:
        return torch.stack(list(x))
    if not x:
        return torch.zeros(0)
    ndim = max(item.ndim for item in x)
    items = [item if item.ndim == ndim else _empty_like(item, ndim) for item in x]
    largest = [max(item.shape[d] for item in items) for d in range(ndim)]
    size = list(largest if pad_size is None else pad_size)
    if len(size) != ndim:
        raise ValueError(f"pad_size must contain a target size for each of the {ndim} dimensions, got {tuple(size)}")
    if any(given < needed for given, needed in zip(size, largest, strict=True)):
        raise ValueError(f"pad_size {tuple(size)} is smaller than the largest item {tuple(largest)}")
    padded = items[0].new_full((len(items), *size), pad_value)
    for i, item in enumerate(items):
        padded[i][tuple(slice(0, s) for s in item.shape)] = item
    return padded


def _empty_like(item: Tensor, ndim: int) -> Tensor:
    if item.numel():
        raise ValueError(f"all tensors must have the same number of dimensions, got {item.ndim} beside {ndim}")
    return item.new_zeros((0,) * ndim)


def padded_to_list(x: Tensor, split_size: Sequence[int] | Sequence[Sequence[int]] | None = None) -> list[Tensor]:
    """
    Cut the padding off.

    Args:
        x: (N, M, ...).
        split_size: per item the number of rows to keep, or the size to keep in each leading dimension;
            None keeps the padding.

    Returns:
        N views of `x`.

    Raises:
        ValueError: `split_size` has not N entries.
    """
    items = list(x.unbind(0))
    if split_size is None:
        return items
    if len(split_size) != len(items):
        raise ValueError(f"split_size must have one entry for each of the {len(items)} items, got {len(split_size)}")
    sizes = [(s,) if isinstance(s, int) else tuple(s) for s in split_size]
    return [item[tuple(slice(0, n) for n in s)] for item, s in zip(items, sizes, strict=True)]


def list_to_packed(x: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """
    Put all rows into one tensor.

    Args:
        x: N >= 1 tensors (M_i, ...), alike but in their first dimension.

    Returns:
        The rows (sum M_i, ...); the number of rows of each item (N,); the index of each item's first row
        (N,); the item of each row (sum M_i,).

    Raises:
        ValueError: the list is empty.
    """
    if not x:
        raise ValueError("list_to_packed needs at least one tensor, got an empty list")
    device = x[0].device
    num_items = torch.tensor([len(item) for item in x], dtype=torch.int64, device=device)
    item_idx = torch.arange(len(x), device=device).repeat_interleave(num_items)
    return torch.cat(list(x)), num_items, num_items.cumsum(0) - num_items, item_idx


def packed_to_list(x: Tensor, split_size: list[int] | int) -> list[Tensor]:
    """Split packed rows (total, ...) into items of `split_size` rows each."""
    return list(x.split(split_size, dim=0))


def padded_to_packed(
    x: Tensor,
    split_size: Sequence[int] | None = None,
    pad_value: float | int | None = None,
) -> Tensor:
    """
    Put the rows of a padded tensor (N, M, ...) into one tensor, without the padding.

    Args:
        x: (N, M, ...).
        split_size: the number of rows to keep of each item.
        pad_value: alternatively, a row that consists of this value only is padding.

    Returns:
        (rows kept, ...); all N * M rows if neither is given.

    Raises:
        ValueError: both are given, or `split_size` has not N entries.
    """
    if split_size is not None and pad_value is not None:
        raise ValueError("Only one of split_size or pad_value should be provided.")
    rows = x.flatten(0, 1)
    if pad_value is not None:
        return rows[(rows != pad_value).reshape(len(rows), -1).any(1)]
    if split_size is None:
        return rows
    return torch.cat(padded_to_list(x, split_size)) if len(x) else rows
