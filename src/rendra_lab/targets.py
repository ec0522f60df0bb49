"""Which code a configuration may call: the guard in front of every `_target_`."""

from __future__ import annotations

import difflib
import importlib
import inspect
import os
from collections.abc import Mapping
from typing import Any

from rendra_lab.errors import UserError

# A configuration may come from anywhere, and `_target_` calls what it names: only these are called.
_ALLOWED_TARGETS = (
    "rendra",
    "rendra_lab",
    "lightning.pytorch.Trainer",
    "lightning.pytorch.callbacks",
    "lightning.pytorch.plugins",
    "lightning.pytorch.profilers",
    "lightning.pytorch.strategies",
    "torch.nn",
    "torch.optim",
    "torchmetrics",
)
_ALLOWED_HOMES = ("rendra", "rendra_lab", "lightning.pytorch", "torch.nn", "torch.optim", "torchmetrics")


def check_targets(tree: Any, key: str = "") -> None:
    """Refuses every `_target_` outside the allowed packages and every argument that a target does not take.

    The environment variable RENDRA_LAB_PACKAGES names further packages, separated by commas: a plug-in is
    trusted by whoever runs it, never by a configuration file.
    """
    if isinstance(tree, Mapping):
        if "_target_" in tree:
            _check_arguments(_locate(str(tree["_target_"]), key), tree, key)
        for name, value in tree.items():
            check_targets(value, f"{key}.{name}" if key else str(name))
    elif isinstance(tree, list):
        for index, value in enumerate(tree):
            check_targets(value, f"{key}[{index}]")


def _locate(path: str, key: str) -> Any:
    extra = tuple(name.strip() for name in os.environ.get("RENDRA_LAB_PACKAGES", "").split(",") if name.strip())
    if not _below(path, _ALLOWED_TARGETS + extra):
        raise UserError(
            f"{key}: a configuration may not call {path!r}; allowed are {', '.join(_ALLOWED_TARGETS)}"
            " and the packages named in RENDRA_LAB_PACKAGES"
        )
    target = _resolve(path, key)
    home = getattr(target, "__module__", None) or type(target).__module__
    if not _below(home, _ALLOWED_HOMES + extra) or not callable(target):
        raise UserError(f"{key}: a configuration may not call {path!r}, which is {home}'s")
    return target


def _resolve(path: str, key: str) -> Any:
    """The object under a dotted path: the longest importable module, then attributes."""
    names = path.split(".")
    for length in range(len(names) - 1, 0, -1):
        module_name = ".".join(names[:length])
        try:
            target: Any = importlib.import_module(module_name)
        except ModuleNotFoundError as error:
            if error.name is None or not _below(module_name, (error.name,)):
                raise  # the module exists; something that it imports does not
            continue
        for done, name in enumerate(names[length:], length):
            if not hasattr(target, name):
                near = difflib.get_close_matches(name, dir(target), 1)
                hint = f"; did you mean {near[0]!r}?" if near else ""
                raise UserError(f"{key}: {'.'.join(names[:done])} has no {name!r}{hint}")
            target = getattr(target, name)
        return target
    raise UserError(f"{key}: there is no module {names[0]!r}, named by {path!r}")


def _below(path: str, packages: tuple[str, ...]) -> bool:
    return any(path == package or path.startswith(f"{package}.") for package in packages)


def _check_arguments(target: Any, node: Mapping[str, Any], key: str) -> None:
    try:
        parameters = inspect.signature(target).parameters
    except (TypeError, ValueError):
        return
    if any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in parameters.values()):
        return
    for name in node:
        if name not in parameters and not (name.startswith("_") and name.endswith("_")):
            near = difflib.get_close_matches(name, parameters, 1)
            hint = f"did you mean {near[0]!r}?" if near else f"it takes: {', '.join(parameters)}"
            raise UserError(f"{key}.{name}: {target.__qualname__} takes no {name!r}; {hint}")
