"""Rows keep their values and their gradients on the way from packed to padded and back."""

import pytest
import torch
from far_device import Far, far  # noqa: F401
from torch import Tensor

from rendra.ops import packed_to_padded, padded_to_packed
from rendra.structures.utils import list_to_padded


def starts(sizes: list[int]) -> Tensor:
    counts = torch.tensor(sizes, dtype=torch.int64)
    return counts.cumsum(0) - counts


@pytest.mark.parametrize("sizes", [[3], [2, 0, 5, 1], [0, 4, 0, 0], [4, 4]], ids=str)
@pytest.mark.parametrize("width", [(), (3,), (2, 4)], ids=str)
def test_there_and_back(sizes: list[int], width: tuple[int, ...]) -> None:
    items = [torch.randn(n, *width) for n in sizes]
    packed, longest = torch.cat(items), max(sizes)
    padded = packed_to_padded(packed, starts(sizes), longest)
    assert torch.equal(padded, list_to_padded(items, (longest, *width)))
    assert torch.equal(padded_to_packed(padded, starts(sizes), len(packed)), packed)
    for dim in range(2, 2 + len(width)):  # wherever the dimension of the rows stands
        moved = padded.movedim(1, dim)
        assert torch.equal(padded_to_packed(moved, starts(sizes), len(packed), max_size_dim=dim), packed)


def test_long_items_are_cut_and_their_rest_comes_back_as_zero() -> None:
    packed = torch.arange(1.0, 7)
    padded = packed_to_padded(packed, starts([4, 2]), 3)
    assert padded.tolist() == [[1, 2, 3], [5, 6, 0]]
    assert padded_to_packed(padded, starts([4, 2]), 6).tolist() == [1, 2, 3, 0, 5, 6]


def test_rows_before_the_first_item_are_nobodys() -> None:
    assert packed_to_padded(torch.arange(1.0, 4), torch.tensor([1]), 3).tolist() == [[2, 3, 0]]
    assert padded_to_packed(torch.tensor([[2.0, 3, 0]]), torch.tensor([1]), 3).tolist() == [0, 2, 3]


def test_gradients_go_to_the_rows_that_were_copied() -> None:
    packed = torch.randn(6, 2, dtype=torch.float64, requires_grad=True)
    padded = torch.randn(3, 3, 2, dtype=torch.float64, requires_grad=True)
    first = starts([4, 0, 2])
    assert torch.autograd.gradcheck(lambda rows: packed_to_padded(rows, first, 3), packed)
    assert torch.autograd.gradcheck(lambda rows: padded_to_packed(rows, first, 6), padded)
    poisoned = packed_to_padded(torch.tensor([torch.nan, 1.0], requires_grad=True), starts([1, 1]), 2)
    assert poisoned[1].tolist() == [1, 0]  # what is padding comes from nowhere


def test_empty_batches_stay_in_the_graph() -> None:
    rows = torch.zeros(0, 3, requires_grad=True)
    padded = packed_to_padded(rows, starts([0, 0]), 4)
    assert padded.shape == (2, 4, 3)
    padded_to_packed(padded, starts([0, 0]), 0).sum().backward()
    assert rows.grad.shape == (0, 3)
    assert packed_to_padded(torch.zeros(0), starts([]), 0).shape == (0, 0)
    assert packed_to_padded(torch.arange(3), starts([1, 2]), 2).dtype == torch.int64


def test_rows_stay_on_their_device(far) -> None:  # noqa: F811
    first = starts([2, 1]).to(far)
    padded = packed_to_padded(torch.ones(3, 2, device=far), first, 2)
    assert isinstance(padded, Far)
    assert isinstance(padded_to_packed(padded, first, 3), Far)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: packed_to_padded(torch.ones(3), torch.ones(1), 2), r"hold integers, got \(1,\) torch.float32"),
        (lambda: packed_to_padded(torch.ones(3), torch.zeros(1, 1, dtype=torch.int64), 2), r"shape \(N,\)"),
        (lambda: packed_to_padded(torch.ones(3), starts([3]), -1), "must not be negative"),
        (lambda: packed_to_padded(torch.tensor(1.0), starts([1]), 1), "must have rows"),
        (lambda: padded_to_packed(torch.ones(2, 3), starts([3]), 3), "same length, got 2 and 1"),
        (lambda: padded_to_packed(torch.ones(2, 3), starts([3, 3]), 6, 2), r"inputs \(2, 3\), got 2"),
    ],
)
def test_what_does_not_fit_is_named(call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
