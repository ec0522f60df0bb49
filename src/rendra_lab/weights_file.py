"""Weights alone, as safetensors: what other programs read, and what cannot hold code at all."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from rendra_lab.checkpoint_archive import FORMAT, KEY, CheckpointError
from rendra_lab.durable import write_durably

_CHECKSUM = "crc32"


def write_weights_file(path: Path, weights: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
    """Writes weights whole or not at all.

    Args:
        path: of the `.safetensors` file.
        weights: by name, on any device.
        metadata: plain values that say what the weights are; kept as JSON under `rendra_lab`.

    Raises OSError where the disk refuses, CheckpointError where the file cannot be read back.
    """
    own = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in weights.items()}
    words = {"format": "pt", KEY: json.dumps(metadata), _CHECKSUM: str(_checksum(own))}
    content = save(own, words)
    write_durably(path, lambda sink: sink.write(content), read_weights_file)


def read_weights_file(path: Path) -> tuple[dict[str, Tensor], str | None]:
    """The weights of a `.safetensors` file on the CPU, and the class of the task they belong to, where it is said.

    Raises CheckpointError where it is damaged, or of a format that is not known yet.
    """
    try:
        with safe_open(path, framework="pt") as file:
            words = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        own = json.loads(words.get(KEY, "{}"))
    except (SafetensorError, ValueError) as error:
        raise CheckpointError(path, f"is damaged: {' '.join(str(error).split())}") from error
    if not isinstance(own, dict) or not isinstance(own.get("format", FORMAT), int):
        raise CheckpointError(path, "is damaged: it does not say what it is")
    if own.get("format", FORMAT) > FORMAT:
        raise CheckpointError(path, f"has format {own['format']}, newer than this program's {FORMAT}: update it")
    if _CHECKSUM in words and words[_CHECKSUM] != str(_checksum(tensors)):
        raise CheckpointError(path, "is damaged: its tensors fail their checksum")
    module = own.get("module")
    return tensors, module if isinstance(module, str) else None


def _checksum(tensors: Mapping[str, Tensor]) -> int:
    """Of all bytes in the order of names."""
    value = 0
    for name in sorted(tensors):
        value = zlib.crc32(cast(Any, tensors[name].reshape(-1).view(torch.uint8).numpy()), value)
    return value
