"""Devices as the public API takes them: a `torch.device` or its name."""

from typing import TypeAlias

import torch
from torch import Tensor

Device: TypeAlias = str | torch.device


def make_device(device: Device) -> torch.device:
    """The `torch.device` that `device` names; a bare "cuda" means the current CUDA device, by index."""
    made = torch.device(device)
    if made.type == "cuda" and made.index is None:
        return torch.device("cuda", torch.cuda.current_device())
    return made


def get_device(x: object, device: Device | None = None) -> torch.device:
    """Where to compute: `device` if given, else where the tensor `x` lies, else the CPU."""
    if device is not None:
        return make_device(device)
    return x.device if isinstance(x, Tensor) else torch.device("cpu")
