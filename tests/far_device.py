"""A device that is not the CPU, for machines without one: it refuses what CUDA refuses, and computes on the CPU.

Tensors on it call themselves `meta`, but hold their values. An operation that mixes them with CPU tensors of one or
more dimensions fails, as does `numpy()`: code that forgets a device is found without a GPU.
"""

from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = torch.device("meta")
_MOVES = ("_to_copy", "copy_", "lift_fresh")
_TAKES_CPU_INDICES = ("index", "index_put", "index_put_")

_make_tensor, _getitem = torch.tensor, torch.Tensor.__getitem__


class Far(torch.Tensor):
    """A tensor there."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> "Far":
        made = torch.Tensor._make_wrapper_subclass(
            cls, held.size(), strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype,
            layout=held.layout, device=DEVICE,
        )  # fmt: skip
        made.held = held.detach()
        return made

    def tolist(self) -> Any:
        """Waits for the device, as everywhere."""
        return self.held.tolist()

    def numpy(self, *_: Any, **__: Any) -> Any:
        """Refused, as on CUDA."""
        raise TypeError("can't convert a far tensor to numpy")

    def __getitem__(self, index: Any) -> Any:
        parts = index if isinstance(index, tuple) else (index,)
        return _getitem(self, tuple(_make_tensor(part) if isinstance(part, list) else part for part in parts))

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class _Mode(TorchDispatchMode):
    """Also sees what is made there out of nothing."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    name = func.__name__.split(".")[0]
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    is_far = any(isinstance(tensor, Far) for tensor in tensors)
    is_free = name in _MOVES or (name in _TAKES_CPU_INDICES and isinstance(args[0], Far))
    if is_far and not is_free and any(tensor.dim() and not isinstance(tensor, Far) for tensor in tensors):
        raise RuntimeError(f"{func} mixes devices: {[(tuple(t.shape), type(t).__name__) for t in tensors]}")
    here, options = tree_map(lambda leaf: leaf.held if isinstance(leaf, Far) else leaf, (args, kwargs))
    if kwargs.get("device") is not None:
        is_far = torch.device(kwargs["device"]) == DEVICE
        options["device"] = torch.device("cpu")
    result = func(*here, **options)
    if name.endswith("_") and tensors:
        return args[0]
    return tree_map(lambda leaf: Far(leaf) if is_far and isinstance(leaf, torch.Tensor) else leaf, result)


def _tensor(data: Any, *, dtype: torch.dtype | None = None, device: Any = None) -> torch.Tensor:
    """`torch.tensor`, which makes its result before any mode can see it."""
    made = _make_tensor(data, dtype=dtype)
    return Far(made) if device is not None and torch.device(device) == DEVICE else made


def _as_tensor(data: Any, dtype: torch.dtype | None = None, device: Any = None) -> torch.Tensor:
    if isinstance(data, torch.Tensor):
        return data.to(device=device or data.device, dtype=dtype or data.dtype)
    return _tensor(data, dtype=dtype, device=device)


def _new_tensor(self: torch.Tensor, data: Any) -> torch.Tensor:
    return _tensor(data, dtype=self.dtype, device=self.device)


@pytest.fixture
def far(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The device, within reach while a test runs."""
    monkeypatch.setattr(torch, "tensor", _tensor)
    monkeypatch.setattr(torch, "as_tensor", _as_tensor)
    monkeypatch.setattr(torch.Tensor, "new_tensor", _new_tensor)
    with _Mode():
        yield DEVICE
