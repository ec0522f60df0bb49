"""Which code a configuration may call: the guard in front of every `_target_`."""

from __future__ import annotations

import difflib
import importlib
import inspect
import os
from collections.abc import Mapping
from typing import Any

from rendra_lab.errors import UserError
from rendra_lab.settings import check_values, parameters_of

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
# A class makes an object. A function may do anything: those of these modules compute and return.
_ALLOWED_FUNCTIONS = (
    "rendra.loss",
    "rendra.ops",
    "rendra.transforms",
    "rendra.utils",
    "rendra_lab.data.bodies",
    "rendra_lab.data.meshes",
    "rendra_lab.detection.average_precision",
    "rendra_lab.detection.coco_evaluation",
    "rendra_lab.detection.detector_losses",
    "rendra_lab.generative.features",
    "rendra_lab.generative.terms",
    "rendra_lab.losses",
    "rendra_lab.mesh_quality",
    "rendra_lab.mesh_scores",
    "rendra_lab.metrics",
    "rendra_lab.perceptual",
    "rendra_lab.schedulers",
    "rendra_lab.shape_losses",
    "rendra_lab.tasks.giraffe.gan_losses",
    "rendra_lab.tasks.mesh_rcnn.losses",
    "rendra_lab.tasks.smplify.pose_prior",
    "rendra_lab.tasks.smplify.scores",
    "rendra_lab.tasks.synsin.adversarial_losses",
    "rendra_lab.tasks.synsin.scores",
    "torch.nn.functional",
    "torchmetrics.functional",
)
# Made of other parts of the tree: a complaint names those first.
_COMPOSED = ("data", "module")
# What runs programs and whole configurations is no part of one.
_REFUSED = ("rendra_lab.benchmarking", "rendra_lab.experiment", "rendra_lab.front_door", "rendra_lab.sweep")


def check_targets(tree: Any, key: str = "") -> None:
    """Refuses every `_target_` outside the allowed packages and every argument that a target does not take.

    The environment variable RENDRA_LAB_PACKAGES names further packages, separated by commas: a plug-in is
    trusted by whoever runs it, never by a configuration file.
    """
    if isinstance(tree, Mapping):
        if "_target_" in tree:
            _check_arguments(_locate(tree["_target_"], key), tree, key)
        for name in sorted(tree, key=lambda name: not key and name in _COMPOSED):
            check_targets(tree[name], f"{key}.{name}" if key else str(name))
    elif isinstance(tree, list):
        for index, value in enumerate(tree):
            check_targets(value, f"{key}[{index}]")


def trusted_packages() -> tuple[str, ...]:
    """The plug-ins that whoever runs the program trusts: RENDRA_LAB_PACKAGES."""
    return tuple(name.strip() for name in os.environ.get("RENDRA_LAB_PACKAGES", "").split(",") if name.strip())


def parameters_of_path(path: str) -> list[str]:
    """The names of what an allowed target takes; none where it takes anything, or is not allowed."""
    try:
        return parameters_of(_locate(path, "")) or []
    except UserError:
        return []


def _locate(path: Any, key: str) -> Any:
    if not isinstance(path, str):
        raise UserError(f"{key}._target_ must be the dotted name of a class or function, got {path!r}")
    extra = trusted_packages()
    if not below(path, _ALLOWED_TARGETS + extra) or below(path, _REFUSED):
        raise UserError(
            f"{key}: a configuration may not call {path!r}; allowed are {', '.join(_ALLOWED_TARGETS)}"
            " and the packages named in RENDRA_LAB_PACKAGES"
        )
    target = _resolve(path, key)
    home = getattr(target, "__module__", None) or type(target).__module__
    if not below(home, _ALLOWED_HOMES + extra) or below(home, _REFUSED) or not callable(target):
        raise UserError(f"{key}: a configuration may not call {path!r}, which is {home}'s")
    if not inspect.isclass(target) and not below(home, _ALLOWED_FUNCTIONS + extra):
        raise UserError(
            f"{key}: a configuration may not call {path!r}: of {home} it may make objects of classes only"
        )
    return target


def _resolve(path: str, key: str) -> Any:
    """The object under a dotted path: a public name of the longest importable module."""
    names = path.split(".")
    if any(name.startswith("_") for name in names):
        raise UserError(f"{key}: a configuration may not call {path!r}, which is private")
    for length in range(len(names) - 1, 0, -1):
        module_name = ".".join(names[:length])
        try:
            module = importlib.import_module(module_name)
        except ModuleNotFoundError as error:
            if error.name is None or not below(module_name, (error.name,)):
                raise  # the module exists; something that it imports does not
            continue
        if not hasattr(module, names[length]):
            near = difflib.get_close_matches(names[length], dir(module), 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise UserError(f"{key}: {module_name} has no {names[length]!r}{hint}")
        if length + 1 < len(names):
            raise UserError(f"{key}: a configuration may not call {path!r}, which is no name of {module_name} itself")
        return getattr(module, names[length])
    raise UserError(f"{key}: there is no module {names[0]!r}, named by {path!r}")


def below(path: str, packages: tuple[str, ...]) -> bool:
    """Whether a dotted path is one of some packages, or lies in one."""
    return any(path == package or path.startswith(f"{package}.") for package in packages)


def _check_arguments(target: Any, node: Mapping[str, Any], key: str) -> None:
    names = parameters_of(target)
    for name in node:
        if names is not None and name not in names and not (name.startswith("_") and name.endswith("_")):
            near = difflib.get_close_matches(name, names, 1)
            hint = f"did you mean {near[0]!r}?" if near else f"it takes: {', '.join(names)}"
            raise UserError(f"{key}.{name}: {target.__qualname__} takes no {name!r}; {hint}")
    check_values(target, node, key)
