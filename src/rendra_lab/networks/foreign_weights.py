"""Weights of networks that others trained, from a file that the user names."""

from __future__ import annotations

import pickle
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from rendra_lab import report
from rendra_lab.errors import UserError

_DAMAGE = (pickle.UnpicklingError, SafetensorError, RuntimeError, ValueError, KeyError, TypeError, EOFError)


class ForeignWeights:
    """What a file of `torch.save` or safetensors holds by name, on the CPU. No code in it is run.

    Args:
        path: of the file; one whose name ends in .safetensors is read as that.
        network: the weights' own, for messages.
        wanted: which file it should be, for messages.

    Raises:
        UserError: there is no such file, or it holds something else.
    """

    def __init__(self, path: Path, network: str, wanted: str) -> None:
        if not path.is_file():
            raise UserError(f"there is no file {report.short_path(path)} with the weights of {network}: {wanted}")
        self.path, self.network, self.wanted = path, network, wanted
        try:
            if path.suffix == ".safetensors":
                state = load_file(path)
            else:
                state = torch.load(path, map_location="cpu", weights_only=True)
        except _DAMAGE as error:
            words = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise UserError(f"{report.short_path(path)} cannot be read as weights of {network}: {words}") from error
        if not isinstance(state, dict):
            raise UserError(f"{report.short_path(path)} holds no weights by name: {wanted} is wanted")
        self.state = state

    def taken(self, name: str, shape: tuple[int, ...]) -> Tensor:
        """One tensor, float32 and of a shape; UserError where it is something else. What else there is stays."""
        found = self.state.get(name)
        if not isinstance(found, Tensor) or found.shape != shape or not found.is_floating_point():
            what = tuple(found.shape) if isinstance(found, Tensor) else "nothing"
            raise UserError(
                f"{report.short_path(self.path)} is not {self.network}: {name} must be numbers {tuple(shape)}, found "
                f"{what}; {self.wanted} is wanted"
            )
        return found.detach().float()
