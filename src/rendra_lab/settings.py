"""What a setting may be: its type and its range, read from the signature of whatever takes it.

A range stands where the parameter is born: `every_n_steps: Count`, `keep: Annotated[float, Range(0, 1)]`.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import math
import re
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import torch

from rendra_lab.errors import UserError


@dataclass(frozen=True)
class Range:
    """The numbers from `least` to `most`; `least` itself only where `closed`."""

    least: float = -math.inf
    most: float = math.inf
    closed: bool = True

    def holds(self, number: float) -> bool:
        """Whether a number lies in the range."""
        return number <= self.most and (number >= self.least if self.closed else number > self.least)

    def __str__(self) -> str:
        if math.isinf(self.most):
            return f"{'of at least' if self.closed else 'above'} {self.least:.10g}"
        return (
            f"from {self.least:.10g} to {self.most:.10g}"
            if self.closed
            else f"above {self.least:.10g}, at most {self.most:.10g}"
        )


Count = Annotated[int, Range(0)]
Positive = Annotated[int, Range(1)]
Size = Annotated[float, Range(0, closed=False)]
Amount = Annotated[float, Range(0)]
Fraction = Annotated[float, Range(0, 1)]

_NAMES: dict[Any, str] = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    Path: "a path",
}

_OBJECT, _MAPPING = "an object with a _target_", "a mapping such as {name: value}"

# What a run is told besides its parts: the top level of conf/train.yaml.
_TOP: dict[str, Any] = {
    "seed": Annotated[int, Range(0, 2**32 - 1)],
    "threads": Annotated[int, Range(1, 4096)] | None,
    "ckpt_path": str | None,
    "test": Literal["last", "best"] | None,
    "optimized_metric": str | None,
    "direction": Literal["minimize", "maximize"],
    "output_root": str,
}
_PARTS = ("data", "module", "trainer")  # one object each
_GROUPS = ("callbacks", "logger", "loss", "metric")  # named objects
# Ranges that Lightning and torch leave to whatever happens then.
_FOREIGN: dict[str, dict[str, Any]] = {
    "Trainer": {
        "max_steps": Annotated[int, Range(-1)],
        "max_epochs": Annotated[int, Range(-1)] | None,
        "log_every_n_steps": Count | None,
        "num_sanity_val_steps": Annotated[int, Range(-1)] | None,
        "gradient_clip_val": Amount | None,
        "accumulate_grad_batches": Positive,
        "check_val_every_n_epoch": Positive | None,
        "num_nodes": Positive,
        "val_check_interval": Size | str | dict | None,
    },
    "ModelCheckpoint": {
        "every_n_train_steps": Count | None,
        "every_n_epochs": Count | None,
        "save_top_k": Annotated[int, Range(-1)],
    },
    "StepLR": {"step_size": Positive, "gamma": Amount},
}


def check_run(tree: Mapping[str, Any]) -> None:
    """Refuses a configuration whose top level is not that of conf/train.yaml: a part that is a number, a bad seed."""
    for name, hint in _TOP.items():
        if name in tree:
            check_value(tree[name], hint, name)
    for name in _PARTS:
        if name in tree and not _is_object(tree[name]):
            raise UserError(f"{name} must name what it is, {name}._target_=..., got {_shown(tree[name])}")
    for group in _GROUPS:
        members = tree.get(group) or {}
        if not isinstance(members, Mapping):
            raise UserError(f"{group} must be one of its choices or a list of them, got {_shown(members)}")
        for name, member in members.items():
            if member is not None and not isinstance(member, Mapping):  # without _target_: left out
                raise UserError(f"{group}.{name} must be null or have a _target_, got {_shown(member)}")


def check_values(target: Any, node: Mapping[str, Any], key: str) -> None:
    """Refuses a value that the annotation of the parameter which takes it excludes; UserError with its key."""
    hints = hints_of(target)
    for name, value in node.items():
        if name in hints:
            check_value(value, hints[name], f"{key}.{name}")


@functools.cache
def hints_of(target: Any) -> dict[str, Any]:
    """The annotations of every parameter by name; those that cannot be read are left out."""
    known: dict[str, Any] = {}
    for function in _signatures(target):
        with contextlib.suppress(NameError, TypeError, AttributeError):
            found = get_type_hints(function, include_extras=True)
            known = {**found, **known}
    known.update(_FOREIGN.get(getattr(target, "__name__", ""), {}) if _is_foreign(target) else {})
    return known


def parameters_of(target: Any) -> list[str] | None:
    """The names of all that a target takes by keyword, its base classes' included; None where it takes anything."""
    names: list[str] = []
    for function in _signatures(target):
        try:
            parameters = inspect.signature(function).parameters.values()
        except (TypeError, ValueError):
            return None
        open_ended = any(one.kind is inspect.Parameter.VAR_KEYWORD for one in parameters)
        names += [one.name for one in parameters if one.kind in _BY_KEYWORD and one.name != "self"]
        if not open_ended:
            return list(dict.fromkeys(names))
    return None


_BY_KEYWORD = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


def check_value(value: Any, hint: Any, key: str) -> None:
    """Refuses one value that its annotation excludes."""
    if _fits(value, hint):
        return
    words = list(dict.fromkeys(_wanted(hint, ranges=_is_number(value))))
    simple = [word for word in words if word not in (_OBJECT, _MAPPING)]
    wanted = " or ".join(simple if set(simple) - {"null"} else words)
    advice = f"; quote it twice: {key}='\"{value}\"'" if wanted.startswith("text") and _is_number(value) else ""
    raise UserError(f"{key} must be {wanted}, got {_shown(value)}{advice}")


def check_numbers(group: str, hint: Any, **numbers: float | None) -> None:
    """Refuses numbers that an annotation excludes, for the constructor that got them; UserError with `group.name`."""
    for name, number in numbers.items():
        check_value(number, hint, f"{group}.{name}")


def rehearse(
    optimizer: Callable[..., Any] | None, scheduler: Callable[..., Any] | None, name: str = "optimizer"
) -> None:
    """Makes both once with one weight, so that what they refuse is known before a fit begins; UserError.

    Args:
        optimizer, scheduler: what makes them; None makes none.
        name: of the optimizer's settings, for complaints.
    """
    if optimizer is None:
        return
    with _refusals_named(name):
        made = optimizer([torch.nn.Parameter(torch.zeros(1))])
    if scheduler is not None:
        with _refusals_named("scheduler"):
            takes_end = "total_steps" in inspect.signature(scheduler).parameters
            scheduler(made, **({"total_steps": 100} if takes_end else {}))


@contextlib.contextmanager
def _refusals_named(key: str) -> Iterator[None]:
    try:
        yield
    except (ValueError, TypeError, AssertionError, RuntimeError) as error:
        words = " ".join(str(error).split())
        invalid = re.match(r"Invalid (learning rate|epsilon|beta|\w+)", words)
        place = f"{key}.{_TORCH_WORDS.get(invalid[1], invalid[1])}" if invalid else key
        raise UserError(f"{place}: {words}") from error


_TORCH_WORDS = {"learning rate": "lr", "epsilon": "eps", "beta": "betas"}


def _signatures(target: Any) -> Iterator[Callable[..., Any]]:
    """What is called, from the class itself to the bases that its `**kwargs` reach."""
    if not inspect.isclass(target):
        yield target
        return
    for home in target.__mro__:
        if "__init__" in vars(home) and home is not object:
            yield vars(home)["__init__"]


def _is_foreign(target: Any) -> bool:
    return str(getattr(target, "__module__", "")).startswith(("lightning.", "torch."))


def _is_object(node: Any) -> bool:
    return isinstance(node, Mapping) and "_target_" in node


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _shown(value: Any) -> str:
    text = str(value).lower() if isinstance(value, bool) else "null" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _fits(value: Any, hint: Any) -> bool:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        bounds = [item for item in arguments[1:] if isinstance(item, Range)]
        return _fits(value, arguments[0]) and all(bound.holds(value) for bound in bounds if _is_number(value))
    if _is_object(value):
        return True  # what it becomes is known only when it is made
    if origin in (Union, types.UnionType):
        return any(_fits(value, one) for one in arguments)
    if origin is Literal:
        return value in arguments
    if value is None:
        return hint in (None, type(None), Any, object) or not _is_plain(hint)
    if isinstance(origin, type) and issubclass(origin, Sequence):
        return isinstance(value, list) and _items_fit(value, origin, arguments)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return isinstance(value, Mapping) and (
            len(arguments) < 2 or all(_fits(item, arguments[1]) for item in value.values())
        )
    return _fits_plain(value, hint)


def _items_fit(items: list[Any], origin: type, arguments: tuple[Any, ...]) -> bool:
    if not arguments:
        return True
    if origin is tuple and arguments[-1] is not Ellipsis:
        return len(items) == len(arguments) and all(map(_fits, items, arguments))
    return all(_fits(item, arguments[0]) for item in items)


def _fits_plain(value: Any, hint: Any) -> bool:
    if hint in (str, Path):
        return isinstance(value, str)
    if hint is bool:
        return isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint is float:
        return _is_number(value) and math.isfinite(value)
    if hint in (list, tuple):
        return isinstance(value, list)
    if hint is dict:
        return isinstance(value, Mapping)
    if isinstance(hint, type) and hint is not object:
        with contextlib.suppress(TypeError):
            return isinstance(value, hint)
    return hint is not type(None)  # whoever takes it knows what it can do with the value


def _is_plain(hint: Any) -> bool:
    return hint in (*_NAMES, list, tuple, dict) or (
        isinstance(get_origin(hint), type) and issubclass(get_origin(hint), Sequence | Mapping)
    )


def _wanted(hint: Any, ranges: bool) -> Iterator[str]:
    """What fits an annotation, in words; its range too, for whom a word was not the mistake."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        bounds = [str(item) for item in arguments[1:] if isinstance(item, Range) and ranges]
        yield " ".join([*_wanted(arguments[0], ranges), *bounds])
    elif origin in (Union, types.UnionType):
        nulls = [one for one in arguments if one is type(None)]
        for one in [*(one for one in arguments if one is not type(None)), *nulls]:
            yield from _wanted(one, ranges)
    elif origin is Literal:
        yield " or ".join(str(one) for one in arguments)
    elif hint in (None, type(None)):
        yield "null"
    elif origin is not None and isinstance(origin, type) and issubclass(origin, Sequence):
        yield _listed(arguments, ranges)
    elif origin is not None and isinstance(origin, type) and issubclass(origin, Mapping):
        yield _MAPPING
    else:
        yield _NAMES.get(hint, "a list" if hint in (list, tuple) else _OBJECT)


def _listed(arguments: tuple[Any, ...], ranges: bool) -> str:
    items = [one for one in arguments if one is not Ellipsis]
    exact = len(items) if len(arguments) == len(items) > 1 else None
    inner = next(_wanted(items[0], ranges)) if items else ""
    plural = (
        inner.replace("a whole number", "whole numbers").replace("a number", "numbers").replace("a list", "lists")
    )
    return f"a list of {exact} {plural}" if exact else f"a list of {plural}" if inner else "a list"
