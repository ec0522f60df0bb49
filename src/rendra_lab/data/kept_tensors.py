"""Tensors that take long to make, kept in files: whole, checked when read, and made anew where anything is wrong."""

from __future__ import annotations

import hashlib
import logging
import zlib
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from rendra_lab.durable import draft_of

log = logging.getLogger(__name__)

Tensors = Mapping[str, Tensor]


def code_versions() -> tuple[str, str]:
    """Of rendra and torch: part of the name of whatever they make."""
    try:
        ours = version("rendra")
    except PackageNotFoundError:
        ours = "not installed"
    return ours, torch.__version__


def fingerprint(*determinants: object) -> str:
    """16 hexadecimal digits that stand for all that determines what is made: these, as they print, and the code."""
    return hashlib.sha256(repr((*determinants, *code_versions())).encode()).hexdigest()[:16]


def kept_or_made(path: Path, what: str, make: Callable[[], Tensors]) -> Tensors:
    """The tensors of a file; where there is none, or a broken one, those that are made now, and kept there.

    A folder that cannot be written is a warning, and a broken file is another.

    Args:
        path: whose name stands for everything that determines the tensors.
        what: they are, for the warnings: "views".
        make: the tensors, on the CPU.
    """
    tensors = _read(path, what)
    if tensors is None:
        tensors = make()
        _write(path, what, tensors)
    return tensors


def _read(path: Path, what: str) -> Tensors | None:
    if not path.is_file():
        return None
    try:
        with safe_open(path, "pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            checksum = (file.metadata() or {}).get("crc32")
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        log.warning("the cached %s %s are made anew: %s", what, path, error)
        return None
    if checksum != _checksum(tensors):
        log.warning("the cached %s %s are made anew: they are not what was written", what, path)
        return None
    return tensors


def _write(path: Path, what: str, tensors: Tensors) -> None:
    try:
        whole = {key: tensor.contiguous() for key, tensor in tensors.items()}
        with draft_of(path) as draft:
            save_file(whole, draft, {"crc32": _checksum(whole)})
    except OSError as error:
        log.warning("%s cannot be cached in %s: %s", what, path.parent, error)


def _checksum(tensors: Tensors) -> str:
    total = 0
    for name in sorted(tensors):
        tensor = tensors[name]
        total = zlib.crc32(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode(), total)
        total = zlib.crc32(tensor.contiguous().numpy().tobytes(), total)
    return str(total)
