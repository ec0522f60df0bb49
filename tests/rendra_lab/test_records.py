"""Records move, detach and stack field by field, and name their fields when asked for others."""

from dataclasses import FrozenInstanceError, dataclass
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from rendra_lab.records import FieldError, TensorRecord, read_field


@dataclass(frozen=True)
class Inner(TensorRecord):
    value: Tensor


@dataclass(frozen=True)
class Outer(TensorRecord):
    name: str
    inner: Inner
    parts: list[Tensor]
    table: dict[str, Tensor]
    nothing: Any = None


def outer() -> Outer:
    return Outer("cow", Inner(torch.ones(3, 2, requires_grad=True)), [torch.ones(3)], {"a": torch.ones(3)})


def test_moving_reaches_every_level_and_leaves_the_original() -> None:
    first = outer()
    moved = first.to(torch.float64)
    assert moved.inner.value.dtype == moved.parts[0].dtype == moved.table["a"].dtype == torch.float64
    assert first.inner.value.dtype == torch.float32
    assert moved.name == "cow"
    assert moved.nothing is None


def test_detaching_cuts_the_graph() -> None:
    assert not outer().detach().inner.value.requires_grad


def test_the_batch_size_is_the_first_tensors_leading_dimension() -> None:
    assert Inner(torch.zeros(5, 2)).batch_size == 5
    assert Inner(torch.tensor(1.0)).batch_size == 1


def test_stacking_works_as_a_collate_function() -> None:
    loader = torch.utils.data.DataLoader([outer(), outer()], batch_size=2, collate_fn=Outer.stack)  # type: ignore
    (batch,) = list(loader)
    assert batch.inner.value.shape == (2, 3, 2)
    assert batch.name == ["cow", "cow"]
    with pytest.raises(ValueError, match="zero records of Outer"):
        Outer.stack([])


def test_records_are_frozen() -> None:
    with pytest.raises(FrozenInstanceError):
        outer().name = "teapot"  # type: ignore[misc]


def test_a_missing_field_names_those_that_exist() -> None:
    assert read_field({"a": 1}, "a", "batch") == 1
    with pytest.raises(FieldError, match=r"prediction \(Inner\) has no field 'rgb'; it has: value"):
        read_field(Inner(torch.zeros(1)), "rgb", "prediction")
    with pytest.raises(FieldError, match=r"batch \(dict\) has no field 'rgb'; it has: a"):
        read_field({"a": 1}, "rgb", "batch")


class Pair(NamedTuple):
    left: Tensor
    right: Tensor


@dataclass(frozen=True)
class Holder(TensorRecord):
    pair: Pair


def test_named_tuples_stay_what_they_are() -> None:
    moved = Holder(Pair(torch.ones(2), torch.zeros(2))).to(torch.float64)
    assert isinstance(moved.pair, Pair)
    assert moved.pair.left.dtype == torch.float64


@pytest.mark.parametrize("name", ["names", "to", "detach", "stack", "batch_size"])
def test_a_field_that_would_hide_a_method_is_refused(name: str) -> None:
    with pytest.raises(TypeError, match=f"Hiding.{name} would hide TensorRecord.{name}"):
        type("Hiding", (TensorRecord,), {"__annotations__": {name: Tensor}})


def test_a_change_of_all_tensors_reaches_the_records_within() -> None:
    first = outer()
    halved = first._map(lambda value: value[:1], lambda value: isinstance(value, Tensor))
    assert halved.inner.value.shape == (1, 2)
    assert first.inner.value.shape == (3, 2)
