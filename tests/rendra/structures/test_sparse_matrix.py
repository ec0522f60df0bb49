import pytest
import torch
from assertions import assert_close

from rendra.structures.sparse_matrix import SparseMatrix


def _random(rows: int, columns: int, entries: int, dtype=torch.float64) -> tuple[SparseMatrix, torch.Tensor]:
    i, j = torch.randint(rows, (entries,)), torch.randint(columns, (entries,))
    values = torch.randn(entries, dtype=dtype)
    dense = torch.zeros(rows, columns, dtype=dtype).index_put((i, j), values, accumulate=True)
    return SparseMatrix(i, j, values, (rows, columns)), dense


@pytest.mark.parametrize("width", [1, 3, 17])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_multiplies_like_the_dense_matrix(width: int, dtype: torch.dtype) -> None:
    matrix, dense = _random(7, 11, 30, dtype)
    values = torch.randn(11, width, dtype=dtype)
    assert_close(matrix @ values, dense @ values)
    assert_close(matrix.transposed @ (dense @ values), dense.T @ (dense @ values))


def test_rows_that_are_not_contiguous() -> None:
    matrix, dense = _random(7, 11, 30)
    assert_close(
        matrix @ torch.arange(33.0).double().view(3, 11).T, dense @ torch.arange(33.0).double().view(3, 11).T
    )
    values = torch.randn(11, 3, dtype=torch.float64, requires_grad=True)
    (matrix @ values).sum().backward()
    assert_close(values.grad, dense.sum(0)[:, None].expand(-1, 3))


def test_derivatives_of_any_order() -> None:
    matrix, _ = _random(4, 3, 6)
    values = torch.randn(3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: matrix @ v, values)
    assert torch.autograd.gradgradcheck(lambda v: (matrix @ v).pow(3), values)


def test_nothing_to_multiply() -> None:
    none = torch.zeros(0, dtype=torch.int64)
    empty = SparseMatrix(none, none, torch.zeros(0), (3, 2))
    assert_close(empty @ torch.ones(2, 4), torch.zeros(3, 4))
    assert_close(empty.transposed @ torch.ones(3, 4), torch.zeros(2, 4))
    assert (SparseMatrix(none, none, torch.zeros(0), (0, 0)) @ torch.zeros(0, 3)).shape == (0, 3)
