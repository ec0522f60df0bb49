"""Batched named tensors that cameras, lights and materials share, and sampling of images at NDC points.

N is the batch. Image sizes are (H, W) in pixels; NDC has +X left, +Y up and the short side in [-1, 1].
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rendra.common.datatypes import Device, make_device

BROADCAST_TYPES = (float, int, list, tuple, Tensor, np.ndarray)
_MODULE_INTERNALS = frozenset(nn.Module().__dict__)


class TensorAccessor(nn.Module):
    """One element, or a slice, of a `TensorProperties`: reads and writes its tensors at that index.

    Args:
        class_object: the batch.
        index: which of its elements.
    """

    def __init__(self, class_object: TensorProperties, index: int | slice) -> None:
        self.__dict__["class_object"] = class_object
        self.__dict__["index"] = index

    def __setattr__(self, name: str, value: Any) -> None:
        """Writes `value`, a number, list or tensor, into the batch's tensor `name` at the index.

        Raises:
            AttributeError: if the batch has no tensor of that name.
            ValueError: if the value does not fit the element's shape.
        """
        whole = getattr(self.class_object, name)
        if not isinstance(whole, Tensor):
            raise AttributeError(f"Expected {name} to be a tensor; it is a {type(whole).__name__}")
        value = torch.as_tensor(value, dtype=whole.dtype, device=whole.device)
        changed = whole.clone()  # an expanded tensor has one memory for many elements
        shape = tuple(changed[self.index].shape)
        if value.dim() > len(shape):
            raise ValueError(f"Expected {name} of shape {shape}; got {tuple(value.shape)}")
        try:
            changed[self.index] = value
        except RuntimeError as error:
            raise ValueError(f"Expected {name} of shape {shape}; got {tuple(value.shape)}") from error
        setattr(self.class_object, name, changed)

    def __getattr__(self, name: str) -> Any:
        """The batch's tensor `name` at the index; other attributes as they are."""
        value = getattr(self.__dict__["class_object"], name)
        return value[self.__dict__["index"]] if isinstance(value, Tensor) else value


class TensorProperties(nn.Module):
    """Named tensors of one batch size, all on one device.

    Numbers, lists, arrays and tensors become tensors whose first dimension is N: the common size, 1
    broadcast. Strings, booleans and None are kept as they are.

    Args:
        dtype: of tensors made here from numbers, lists and arrays; tensors keep theirs.
        device: where all of them go.
        **kwargs: the properties; each becomes an attribute.

    Raises:
        ValueError: if the first dimensions do not agree, or for a value of another type.
    """

    device: torch.device
    _N: int

    def __init__(self, dtype: torch.dtype = torch.float32, device: Device = "cpu", **kwargs: Any) -> None:
        super().__init__()
        self.device = make_device(device)
        self._N = 0
        shared = {k: v for k, v in kwargs.items() if v is None or isinstance(v, (str, bool))}
        batched = {k: v for k, v in kwargs.items() if k not in shared}
        for name, value in batched.items():
            if not isinstance(value, BROADCAST_TYPES):
                raise ValueError(f"Arg {name} with type {type(value)} is not broadcastable")
        for name, value in shared.items():
            setattr(self, name, value)
        if batched:
            values = convert_to_tensors_and_broadcast(*batched.values(), dtype=dtype, device=self.device)
            self.__dict__.update(zip(batched, values, strict=True))
            self._N = values[0].shape[0]

    def __len__(self) -> int:
        """N."""
        return self._N

    def isempty(self) -> bool:
        """Whether N is 0."""
        return self._N == 0

    def __getitem__(self, index: int | slice) -> Any:
        """A view of one element or a slice, which can be read and written by attribute.

        Raises:
            ValueError: if the index is neither an integer nor a slice.
        """
        if not isinstance(index, (int, slice)):
            raise ValueError(f"Expected index of type int or slice; got {type(index)}")
        return TensorAccessor(class_object=self, index=index)

    def to(self, device: Device = "cpu") -> Any:  # type: ignore[override]
        """Moves every tensor to `device`, in place as modules do, and returns the object."""
        return super().to(device=make_device(device))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:
        """Also moves the tensors that are plain attributes, so that a parent module takes them along."""
        super()._apply(fn, recurse)
        for name, value in self._plain_tensors().items():
            self.__dict__[name] = fn(value)
        self.device = fn(torch.empty(0, device=self.device)).device
        return self

    def clone(self, other: Any) -> Any:
        """Copies every property into `other`, of the same class, and returns it; gradients flow through."""
        for name, value in self.__dict__.items():
            if name not in _MODULE_INTERNALS:
                other.__dict__[name] = value.clone() if isinstance(value, Tensor) else copy.deepcopy(value)
        for name, tensor in (*self._parameters.items(), *self._buffers.items()):
            other.__dict__[name] = None if tensor is None else tensor.clone()
        return other

    def gather_props(self, batch_idx: Tensor) -> Any:
        """Replaces, in place, every tensor of N > 1 elements by its rows `batch_idx`; returns the object.

        Args:
            batch_idx: (P,) integers in [0, N), for instance the mesh of each packed face.
        """
        for name, value in self._plain_tensors().items():
            if value.dim() > 0 and value.shape[0] > 1:
                self.__dict__[name] = value[batch_idx]
        return self

    def _plain_tensors(self) -> dict[str, Tensor]:
        """The attributes that are tensors but neither parameters nor buffers."""
        return {name: value for name, value in self.__dict__.items() if isinstance(value, Tensor)}


def format_tensor(input: Any, dtype: torch.dtype = torch.float32, device: Device = "cpu") -> Tensor:
    """A number, list, array or tensor as a tensor of at least one dimension on `device`.

    A given tensor keeps its dtype; everything else gets `dtype`.
    """
    target = make_device(device)
    out = input.to(target) if isinstance(input, Tensor) else torch.tensor(input, dtype=dtype, device=target)
    return out if out.dim() > 0 else out.view(1)


def convert_to_tensors_and_broadcast(
    *args: Any, dtype: torch.dtype = torch.float32, device: Device = "cpu"
) -> list[Tensor]:
    """Every argument as a tensor on `device` whose first dimension is the common N; 1 is expanded.

    Raises:
        ValueError: if the first dimensions do not agree.
    """
    tensors = [format_tensor(argument, dtype, device) for argument in args]
    sizes = {tensor.shape[0] for tensor in tensors} - {1}
    if len(sizes) > 1:
        raise ValueError(f"Got non-broadcastable sizes {[t.shape[0] for t in tensors]}")
    n = sizes.pop() if sizes else 1
    return [tensor.expand(n, *tensor.shape[1:]) for tensor in tensors]


def parse_image_size(image_size: int | Sequence[int]) -> tuple[int, int]:
    """An image size, one integer or (H, W), as (H, W).

    Raises:
        ValueError: unless it is one or two positive integers.
    """
    size = tuple(image_size) if isinstance(image_size, (tuple, list)) else (image_size, image_size)
    if len(size) != 2:
        raise ValueError(f"Image size can only be a tuple/list of (H, W); got {image_size}")
    if not all(isinstance(side, (int, np.integer)) for side in size):
        raise ValueError(f"Image sizes must be integers; got {size[0]}, {size[1]}")
    height, width = int(size[0]), int(size[1])
    if height <= 0 or width <= 0:
        raise ValueError(f"Image sizes must be greater than 0; got {height}, {width}")
    return height, width


def ndc_grid_sample(
    input: Tensor, grid_ndc: Tensor, *, align_corners: bool = False, **grid_sample_kwargs: Any
) -> Tensor:
    """Samples images at NDC points.

    Args:
        input: images (N, C, H, W).
        grid_ndc: points (N, ..., 2), x then y.
        align_corners: False means that NDC covers the image from the outer edges of its border pixels, as the
            renderers have it.
        **grid_sample_kwargs: `mode` and `padding_mode` of `torch.nn.functional.grid_sample`.

    Returns:
        (N, C, ...), the samples.

    Raises:
        ValueError: if the shapes do not fit this.
    """
    batch, *spatial, two = grid_ndc.shape
    if input.dim() != 4:
        raise ValueError(f"input has to be a 4-dimensional tensor; got shape {tuple(input.shape)}")
    if batch != input.shape[0]:
        raise ValueError(
            f"batch dimension of both input and grid_ndc have to match; got {input.shape[0]} and {batch}"
        )
    if two != 2:
        raise ValueError(f"the last dimension of grid_ndc has to be 2; got {two}")
    grid = ndc_to_grid_sample_coords(grid_ndc.reshape(batch, -1, 1, 2), tuple(input.shape[2:]))
    sampled = F.grid_sample(input, grid, align_corners=align_corners, **grid_sample_kwargs)
    return sampled.reshape(batch, input.shape[1], *spatial)


def ndc_to_grid_sample_coords(xy_ndc: Tensor, image_size_hw: Sequence[int]) -> Tensor:
    """NDC points (..., 2) as the coordinates of `grid_sample`: +X right, +Y down, both sides in [-1, 1].

    Raises:
        ValueError: unless the image size is two positive integers (H, W).
    """
    if len(image_size_hw) != 2 or any(size <= 0 for size in image_size_hw):
        raise ValueError(f"image_size_hw has to be a 2-tuple of positive integers; got {image_size_hw}")
    height, width = image_size_hw
    short = min(height, width)
    return xy_ndc * xy_ndc.new_tensor([-short / width, -short / height])
