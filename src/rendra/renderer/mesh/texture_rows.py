"""What the textures share: the rows that they store, and the filled slots that they are sampled at."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.ops.interp_face_attrs import interpolate_face_attributes
from rendra.structures.ragged import Lengths, Ragged

SubmeshIds = Sequence[Sequence[Tensor]]


class Hits:
    """The filled slots of fragments: textures are computed for them only, seldom more than a fifth."""

    def __init__(self, fragments: Any) -> None:
        pix_to_face: Tensor = fragments.pix_to_face
        flat = pix_to_face.reshape(-1)
        self.shape = pix_to_face.shape
        self.slots = (flat >= 0).nonzero()[:, 0]  # (M,)
        self.faces = flat.index_select(0, self.slots)  # (M,)
        self.bary = fragments.bary_coords.reshape(-1, 3).index_select(0, self.slots)  # (M, 3)

    def interpolate(self, corners: Tensor) -> Tensor:
        """Values (M, C) between those at the corners of all faces (sum F, 3, C)."""
        return interpolate_face_attributes(self.faces, self.bary.to(corners.dtype), corners)

    def spread(self, values: Tensor) -> Tensor:
        """Values (M, C) in their slots, 0 in the others. (N, H, W, K, C)"""
        dense = values.new_zeros(self.shape.numel(), values.shape[1])
        return dense.index_copy(0, self.slots, values).view(*self.shape, values.shape[1])


def rows_of(value: Sequence[Tensor] | Tensor, name: str, row: tuple[int | str, ...], pad_value: float = 0) -> Ragged:
    """Rows given as N tensors (M_i, *row) or as one (N, M, *row); letters in `row` stand for any size.

    Raises:
        ValueError: another type or shape.
    """
    shown = ", ".join(map(str, row))
    if isinstance(value, Tensor):
        _check_row(value, name, row, f"(N, M, {shown})", leading=2)
        lengths = Lengths([value.shape[1]] * len(value), value.device)
        return Ragged(lengths, padded=value, pad_value=pad_value)
    if not isinstance(value, (list, tuple)):
        raise ValueError(f"{name} must be a list of tensors or a tensor (N, M, {shown}), got {type(value)}")
    for i, item in enumerate(value):
        _check_row(item, f"{name}[{i}]", row, f"(M, {shown})", leading=1)
    if len({item.shape[1:] for item in value}) > 1:
        raise ValueError(f"{name} must have rows of one shape, got {[tuple(item.shape) for item in value]}")
    empty_row = [size if isinstance(size, int) else 1 for size in row]
    like = value[0] if value else torch.zeros(0, *empty_row, dtype=torch.float32 if pad_value == 0 else torch.int64)
    return Ragged.from_list(value, like, pad_value)


def _check_row(value: Any, name: str, row: tuple[int | str, ...], expected: str, leading: int) -> None:
    shape = tuple(value.shape) if isinstance(value, Tensor) else type(value)
    fits = isinstance(value, Tensor) and value.ndim == leading + len(row)
    if not fits or any(isinstance(n, int) and n != m for n, m in zip(row, value.shape[leading:], strict=True)):
        raise ValueError(f"{name} must be a tensor {expected}, got {shape}")


def checked_maps(maps: Sequence[Tensor] | Tensor, expected: str) -> list[Tensor] | Tensor:
    """Maps in the form in which they were given, of which `expected` names the shape for one mesh.

    Raises:
        ValueError: another type, shape or number format.
    """
    ndim = expected.count(",") + 1
    if isinstance(maps, Tensor):
        if maps.ndim != ndim + 1 or not maps.is_floating_point():
            raise ValueError(f"maps must be floating point (N, {expected[1:]}, got {maps.dtype} {tuple(maps.shape)}")
        return maps
    if not isinstance(maps, (list, tuple)):
        raise ValueError(f"maps must be a list of tensors or a tensor, got {type(maps)}")
    for i, m in enumerate(maps):
        if not isinstance(m, Tensor) or m.ndim != ndim or not m.is_floating_point():
            shape = f"{m.dtype} {tuple(m.shape)}" if isinstance(m, Tensor) else type(m)
            raise ValueError(f"maps[{i}] must be a floating point tensor {expected}, got {shape}")
    return list(maps)


def resized(maps: Tensor, size: list[int]) -> Tensor:
    """Maps (..., h, w, C) enlarged to (..., H, W, C)."""
    if list(maps.shape[-3:-1]) == size:
        return maps
    stack = maps.reshape(-1, *maps.shape[-3:]).permute(0, 3, 1, 2)
    enlarged = F.interpolate(stack, size=size, mode="bilinear", align_corners=True).permute(0, 2, 3, 1)
    return enlarged.reshape(*maps.shape[:-3], *size, maps.shape[-1])


def fit_rows(rows: Ragged, lengths: Lengths, name: str) -> Ragged:
    """The rows with the numbers of `lengths`: themselves if they have those already.

    Raises:
        ValueError: a list of other lengths.
    """
    own = rows.lengths
    if own.sizes == lengths.sizes:
        return rows
    if not own.dense:
        raise ValueError(f"{name} has {own.sizes} rows, the meshes have {lengths.sizes}")
    fitted = Lengths(lengths.sizes, own.device, own.padded_size)
    return Ragged(fitted, padded=rows.padded(), pad_value=rows.pad_value)


def picked(rows: Ragged, ids_list: SubmeshIds) -> Ragged:
    """For each item, the rows of each of its submeshes."""
    chosen = [own[ids] for own, ids_of_item in zip(rows.items(), ids_list, strict=True) for ids in ids_of_item]
    return Ragged.from_list(chosen, rows.packed(), rows.pad_value)


def concatenated(parts: list[Any]) -> Ragged:
    """The items of several batches in order.

    Raises:
        ValueError: rows of different shapes.
    """
    first: Ragged = parts[0]
    if len({part.packed().shape[1:] for part in parts}) > 1:
        raise ValueError(f"textures must have equal shapes, got {[tuple(part.packed().shape) for part in parts]}")
    return Ragged.from_list([item for part in parts for item in part.items()], first.packed(), first.pad_value)


def as_one_item(rows: Ragged) -> Ragged:
    """All rows as those of one item."""
    packed = rows.packed()
    return Ragged.from_list([packed], packed, rows.pad_value)


def require_same_class(first: Any, others: list[Any]) -> None:
    """Raise ValueError if a texture is of another class than the first."""
    if any(type(other) is not type(first) for other in others):
        names = sorted({type(other).__name__ for other in others})
        raise ValueError(f"All textures must be of type {type(first).__name__}, got {names}")
