import pytest
import torch
from torch import Tensor

from rendra.structures import list_to_packed, list_to_padded, packed_to_list, padded_to_list, padded_to_packed

SIZES = [3, 0, 5, 1]


@pytest.fixture
def items() -> list[Tensor]:
    return [torch.rand(size, 2, requires_grad=True) for size in SIZES]


def assert_same(actual: list[Tensor], expected: list[Tensor]) -> None:
    assert len(actual) == len(expected)
    for a, e in zip(actual, expected, strict=True):
        torch.testing.assert_close(a, e, rtol=0, atol=0)


def test_padding_and_cutting_is_identity(items: list[Tensor]) -> None:
    padded = list_to_padded(items, pad_value=-7)
    assert padded.shape == (4, 5, 2)
    assert (padded[0, 3:] == -7).all()
    assert_same(padded_to_list(padded, SIZES), items)
    assert_same(padded_to_list(padded, [(s, 2) for s in SIZES]), items)


def test_packing_and_splitting_is_identity(items: list[Tensor]) -> None:
    packed, counts, first, owner = list_to_packed(items)
    assert_same(packed_to_list(packed, SIZES), items)
    assert counts.tolist() == SIZES
    assert first.tolist() == [0, 3, 3, 8]
    assert owner.tolist() == [0, 0, 0, 2, 2, 2, 2, 2, 3]


def test_padded_to_packed_drops_the_padding(items: list[Tensor]) -> None:
    padded, packed = list_to_padded(items, pad_value=-7), torch.cat(items)
    assert_same([padded_to_packed(padded, split_size=SIZES)], [packed])
    assert_same([padded_to_packed(padded, pad_value=-7)], [packed])
    assert padded_to_packed(padded).shape == (20, 2)


def test_gradients_pass_through_padding(items: list[Tensor]) -> None:
    list_to_padded(items).sum().backward()
    assert all((item.grad == 1).all() for item in items)


def test_pad_size_and_equisized() -> None:
    items = [torch.ones(2, 3, dtype=torch.int64)] * 2
    assert list_to_padded(items, pad_size=(4, 5)).shape == (2, 4, 5)
    assert list_to_padded(items, equisized=True).dtype == torch.int64
    assert list_to_padded([torch.tensor([]), torch.ones(2, 3)]).shape == (2, 2, 3)
    assert list_to_padded([]).shape == (0,)
    assert padded_to_list(torch.ones(2, 3))[0].shape == (3,)


def test_wrong_sizes_are_named() -> None:
    items = [torch.ones(2, 3)]
    with pytest.raises(ValueError, match="target size for each of the 2 dimensions"):
        list_to_padded(items, pad_size=(4,))
    with pytest.raises(ValueError, match="smaller than the largest item"):
        list_to_padded(items, pad_size=(1, 3))
    with pytest.raises(ValueError, match="same number of dimensions"):
        list_to_padded([torch.ones(2), torch.ones(2, 3)])
    with pytest.raises(ValueError, match="one entry for each of the 2 items"):
        padded_to_list(torch.ones(2, 3), [1])
    with pytest.raises(ValueError, match="Only one of"):
        padded_to_packed(torch.ones(2, 3, 3), split_size=[1, 1], pad_value=0)
    with pytest.raises(ValueError, match="empty list"):
        list_to_packed([])
