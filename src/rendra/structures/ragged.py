"""A batch of rows of which every item has its own number: the storage behind meshes, clouds and textures."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from itertools import accumulate
from numbers import Integral
from typing import Any

import torch
from torch import Tensor


@contextmanager
def lasting() -> Iterator[None]:
    """What is computed inside may be kept: it consists of normal tensors, in inference mode too.

    Autograd refuses inference tensors, so a picture taken in inference mode would spoil its mesh for training.
    """
    if not torch.is_inference_mode_enabled():
        yield
        return
    with torch.inference_mode(False), torch.no_grad():
        yield


class Lengths:
    """How many rows belong to each of N items, and the integer tensors that follow from it."""

    def __init__(self, sizes: Sequence[int], device: torch.device, padded_size: int | None = None) -> None:
        self.sizes = list(sizes)
        self.device = device
        self.padded_size = max(self.sizes, default=0) if padded_size is None else padded_size
        self.total = sum(self.sizes)
        self.dense = all(size == self.padded_size for size in self.sizes)  # nothing is padding

    def __len__(self) -> int:
        return len(self.sizes)

    @cached_property
    @lasting()
    def counts(self) -> Tensor:
        """Rows of each item. (N,)"""
        return torch.tensor(self.sizes, dtype=torch.int64, device=self.device)

    @cached_property
    @lasting()
    def first_idx(self) -> Tensor:
        """Packed index of each item's first row. (N,)"""
        starts = list(accumulate(self.sizes, initial=0))[:-1]
        return torch.tensor(starts, dtype=torch.int64, device=self.device)

    @cached_property
    @lasting()
    def item_idx(self) -> Tensor:
        """The item that each packed row belongs to. (total,)"""
        items = torch.arange(len(self.sizes), device=self.device)
        return items.repeat_interleave(self.counts, output_size=self.total)

    @cached_property
    @lasting()
    def padded_idx(self) -> Tensor:
        """Where each packed row lies among the N * padded_size rows of the padded form. (total,)"""
        rows = torch.arange(self.total, device=self.device)
        if self.dense:
            return rows
        shift = torch.arange(len(self.sizes), device=self.device) * self.padded_size - self.first_idx
        return rows + shift[self.item_idx]

    def select(self, indices: Sequence[int]) -> "Lengths":
        """The lengths of some of the items, repetition allowed."""
        return Lengths([self.sizes[i] for i in indices], self.device)

    def to(self, device: torch.device) -> "Lengths":
        """The same lengths with their tensors on `device`."""
        return self if device == self.device else Lengths(self.sizes, device, self.padded_size)


class Ragged:
    """
    One quantity of every row as list, padded or packed; held in one form, turned into the others on demand.

    A form derived from a leaf that requires grad is not kept: the optimiser changes such a leaf in place, and
    every backward pass needs its own graph. Nor is what was derived without the graph that it would have had.
    """

    def __init__(
        self,
        lengths: Lengths,
        *,
        packed: Tensor | None = None,
        padded: Tensor | None = None,
        items: list[Tensor] | None = None,
        pad_value: float = 0,
    ) -> None:
        """Take the rows in one form: (total, ...), (N, padded_size, ...) or a non-empty list."""
        self.lengths = lengths
        self.pad_value = pad_value
        self._packed = packed
        self._padded = padded
        self._items = items
        held = items if items is not None else [packed if padded is None else padded]
        grad = [t for t in held if t is not None and t.requires_grad]
        self._requires_grad = bool(grad)
        self._trainable = any(t.is_leaf for t in grad)

    @classmethod
    def from_list(cls, items: Sequence[Tensor], like: Tensor, pad_value: float = 0) -> "Ragged":
        """Keep a list; `like` (rows, ...) gives device, type and row shape where the list is empty."""
        lengths = Lengths([len(item) for item in items], like.device)
        if items:
            return cls(lengths, items=list(items), pad_value=pad_value)
        return cls(lengths, packed=like.new_zeros((0, *like.shape[1:])), pad_value=pad_value)

    @classmethod
    def from_padded(cls, lengths: Lengths, padded: Tensor, pad_value: float = 0) -> "Ragged":
        """Take (N, padded_size, ...), whose padding may hold anything."""
        if lengths.dense:
            return cls(lengths, padded=padded, pad_value=pad_value)
        rows = padded.flatten(0, 1).index_select(0, lengths.padded_idx)
        return cls(lengths, packed=rows, pad_value=pad_value)

    def __len__(self) -> int:
        return len(self.lengths)

    @property
    def is_lasting(self) -> bool:
        """Whether what is derived from the rows now may be kept."""
        return not self._requires_grad or (torch.is_grad_enabled() and not self._trainable)

    def packed(self) -> Tensor:
        """All rows in one tensor. (total, ...)"""
        if self._packed is not None:
            return self._packed
        return self._keep("_packed", self._pack)

    def _pack(self) -> Tensor:
        if self._items is not None:
            return self._items[0] if len(self._items) == 1 else torch.cat(self._items)
        assert self._padded is not None
        rows = self._padded.flatten(0, 1)
        return rows if self.lengths.dense else rows.index_select(0, self.lengths.padded_idx)

    def padded(self) -> Tensor:
        """Every item filled up at its end. (N, padded_size, ...)"""
        if self._padded is not None:
            return self._padded
        return self._keep("_padded", self._pad)

    def _pad(self) -> Tensor:
        rows, lengths = self.packed(), self.lengths
        shape = (len(lengths), lengths.padded_size, *rows.shape[1:])
        if lengths.dense:
            return rows.reshape(shape)
        filled = rows.new_full((shape[0] * shape[1], *rows.shape[1:]), self.pad_value)
        return filled.index_copy(0, lengths.padded_idx, rows).view(shape)

    def items(self) -> list[Tensor]:
        """One tensor an item. N of (M_i, ...)"""
        if self._items is not None:
            return list(self._items)
        if len(self) == 0:
            return []
        return list(self._keep("_items", lambda: list(self.packed().split(self.lengths.sizes))))

    def _keep(self, form: str, derive: Callable[[], Any]) -> Any:
        with lasting():
            value = derive()
        if self.is_lasting:
            setattr(self, form, value)
        return value

    def select(self, indices: Sequence[int]) -> "Ragged":
        """Some of the items, repetition allowed; one gather where all have the same length."""
        lengths = self.lengths.select(indices)
        if self.lengths.dense:
            rows = self.padded()
            chosen = rows.index_select(0, torch.tensor(list(indices), dtype=torch.int64, device=rows.device))
            return Ragged(lengths, padded=chosen, pad_value=self.pad_value)
        items = self.items()
        return Ragged.from_list([items[i] for i in indices], self.packed(), self.pad_value)

    def apply(self, fn: Callable[[Tensor], Tensor]) -> "Ragged":
        """The same rows after `fn`, which keeps shapes (clone, detach, to)."""
        if self._items is not None:
            items = [fn(item) for item in self._items]
            return Ragged(self.lengths.to(items[0].device), items=items, pad_value=self.pad_value)
        if self._packed is not None:
            packed = fn(self._packed)
            return Ragged(self.lengths.to(packed.device), packed=packed, pad_value=self.pad_value)
        assert self._padded is not None
        padded = fn(self._padded)
        return Ragged(self.lengths.to(padded.device), padded=padded, pad_value=self.pad_value)

    def scaled(self, scale: float | Tensor) -> "Ragged":
        """
        The rows times a number, or times one for each item (N,).

        Raises:
            ValueError: another shape.
        """
        if isinstance(scale, Tensor) and scale.numel() != 1:
            if scale.shape != (len(self),):
                raise ValueError(f"scale must be a number or have shape ({len(self)},), got {tuple(scale.shape)}")
            scale = scale[self.lengths.item_idx, None]
        return Ragged(self.lengths, packed=self.packed() * scale, pad_value=self.pad_value)

    def bounds(self) -> Tensor:
        """Smallest and largest entry of each item's rows (M_i, C); (inf, -inf) without rows. (N, C, 2)"""
        rows = self.packed()
        owner = self.lengths.item_idx[:, None].expand_as(rows)
        empty = rows.new_full((len(self), rows.shape[1]), torch.inf)
        low = empty.scatter_reduce(0, owner, rows, "amin")
        high = (-empty).scatter_reduce(0, owner, rows, "amax")
        return torch.stack([low, high], dim=2)


def batch_indices(index: Any, size: int) -> list[int]:
    """
    The items that `index` picks from a batch, as numbers from 0.

    Args:
        index: an int, a slice, a list of ints, or a 1-D tensor of integers or of `size` booleans.
        size: the number of items of the batch.

    Raises:
        IndexError: another kind of index, or one out of range.
    """
    if isinstance(index, slice):
        return list(range(size))[index]
    if isinstance(index, Tensor):
        if index.ndim > 1 or index.is_floating_point():
            raise IndexError(
                f"index must be a 1-D tensor of integers or booleans, got {index.dtype} {tuple(index.shape)}"
            )
        if index.dtype == torch.bool and index.numel() != size:
            raise IndexError(f"a boolean index needs one entry for each of the {size} items, got {index.numel()}")
        index = index.nonzero()[:, 0].tolist() if index.dtype == torch.bool else index.tolist()
    picked = [index] if isinstance(index, Integral) else index
    if not isinstance(picked, list) or not all(isinstance(i, Integral) for i in picked):
        raise IndexError(f"index must be an int, a slice, a list of ints or a 1-D tensor, got {index!r}")
    for i in picked:
        if not -size <= i < size:
            raise IndexError(f"index {i} is out of range for a batch of {size}")
    return [int(i) % size for i in picked]


def consecutive_parts(split_sizes: list[int], size: int, items: str) -> list[slice]:
    """
    Where consecutive parts of the given sizes lie in a batch of `size` items.

    Raises:
        ValueError: `split_sizes` is not a list of integers that sum to `size`; the message calls them `items`.
    """
    if not all(isinstance(part, int) and part >= 0 for part in split_sizes):
        raise ValueError(f"Value of split_sizes must be a list of integers, got {split_sizes}")
    if sum(split_sizes) != size:
        raise ValueError(f"split_sizes must sum to the {size} {items} of the batch, got {split_sizes}")
    ends = list(accumulate(split_sizes))
    return [slice(end - part, end) for end, part in zip(ends, split_sizes, strict=True)]


def each_repeated(size: int, N: int) -> list[int]:
    """
    Every index of a batch N times in a row.

    Raises:
        ValueError: N is not a positive integer.
    """
    if not isinstance(N, int) or N <= 0:
        raise ValueError(f"N must be an integer > 0, got {N!r}")
    return [i for i in range(size) for _ in range(N)]
