"""Frozen records of tensors: what batches and predictions are made of."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from rendra_lab.errors import UserError

RecordT = TypeVar("RecordT", bound="TensorRecord")


class FieldError(UserError):
    """A loss, a metric or a panel asked for a field that the record does not have."""


@dataclasses.dataclass(frozen=True)
class TensorRecord:
    """Base of frozen dataclasses whose fields are tensors, records, containers of them, or have a `.to`.

    Subclass with `@dataclass(frozen=True)` and annotate the fields with their shapes. Fields that cannot move
    (strings, numbers, None) pass through unchanged. A field that would hide a method of this class, such as one
    called `names`, is a TypeError where the subclass is defined.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        taken = [name for name in inspect.get_annotations(cls) if hasattr(TensorRecord, name)]
        if taken:
            raise TypeError(
                f"{cls.__name__}.{taken[0]} would hide TensorRecord.{taken[0]}: give the field another name"
            )

    def to(self: RecordT, *args: Any, **kwargs: Any) -> RecordT:
        """The same record on another device or in another dtype; the arguments are those of `Tensor.to`."""
        return self._map(lambda value: value.to(*args, **kwargs), lambda value: hasattr(value, "to"))

    def detach(self: RecordT) -> RecordT:
        """The same values, cut from the autograd graph."""
        return self._map(lambda value: value.detach(), lambda value: hasattr(value, "detach"))

    @classmethod
    def names(cls) -> list[str]:
        """The names of the fields, in the order of their declaration."""
        return [field.name for field in dataclasses.fields(cls)]

    @property
    def batch_size(self) -> int:
        """The leading dimension of the first tensor field; 1 where there is none."""
        for name in self.names():
            value = getattr(self, name)
            if isinstance(value, Tensor) and value.ndim > 0:
                return len(value)
        return 1

    @classmethod
    def stack(cls: type[RecordT], records: Sequence[RecordT]) -> RecordT:
        """One record whose tensors are stacked along a new first dimension: the `collate_fn` of a DataLoader.

        Raises ValueError on an empty sequence. Fields that are not tensors become lists.
        """
        if not records:
            raise ValueError(f"cannot stack zero records of {cls.__name__}")
        columns = {name: [getattr(record, name) for record in records] for name in cls.names()}
        return cls(**{name: _stack_column(column) for name, column in columns.items()})

    def _map(self: RecordT, move: Callable[[Any], Any], movable: Callable[[Any], bool]) -> RecordT:
        fields = {name: _map_value(getattr(self, name), move, movable) for name in self.names()}
        return dataclasses.replace(self, **fields)


def read_field(record: Any, name: str, role: str) -> Any:
    """The field `name` of a batch or prediction; `role` says which of the two in the error.

    Raises FieldError with the names that exist.
    """
    if isinstance(record, Mapping) and name in record:
        return record[name]
    if not isinstance(record, Mapping) and hasattr(record, name):
        return getattr(record, name)
    if isinstance(record, Mapping):
        known = list(record)
    else:
        known = [field.name for field in dataclasses.fields(record)] if dataclasses.is_dataclass(record) else []
    raise FieldError(
        f"the {role} ({type(record).__name__}) has no field {name!r}; it has: {', '.join(known) or 'nothing'}"
    )


def _map_value(value: Any, move: Callable[[Any], Any], movable: Callable[[Any], bool]) -> Any:
    if movable(value):
        return move(value)
    if isinstance(value, TensorRecord):
        return value._map(move, movable)
    if isinstance(value, Mapping):
        return {key: _map_value(item, move, movable) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        items = [_map_value(item, move, movable) for item in value]
        return type(value)(*items) if hasattr(value, "_fields") else type(value)(items)
    return value


def _stack_column(column: list[Any]) -> Any:
    if isinstance(column[0], Tensor):
        return torch.stack(column)
    if isinstance(column[0], TensorRecord):
        return type(column[0]).stack(column)
    return column
