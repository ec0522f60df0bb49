"""Sums of rows against a product with a matrix, in value and gradient, on both paths."""

from __future__ import annotations

import pytest
import torch

from rendra_lab.detection.weighted_rows import weighted_rows


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("channels", [1, 2, 37])
def test_it_is_a_product_with_a_matrix(channels: int, dtype: torch.dtype) -> None:
    table = torch.randn(11, channels, dtype=dtype, requires_grad=True)
    sizes = torch.tensor([3, 0, 5, 1, 0, 20])
    rows, weights = torch.randint(11, (29,)), torch.randn(29, dtype=dtype)
    weights[4] = 0
    matrix = torch.zeros(6, 11, dtype=dtype)
    matrix.index_put_((torch.arange(6).repeat_interleave(sizes), rows), weights, accumulate=True)
    sums = weighted_rows(table, rows, weights, sizes.cumsum(0) - sizes)
    torch.testing.assert_close(sums, matrix @ table)
    grad = torch.randn(channels, 6, dtype=dtype).T  # not contiguous
    (slopes,) = torch.autograd.grad(sums, table, grad)
    torch.testing.assert_close(slopes, matrix.T @ grad)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nothing_to_sum(dtype: torch.dtype) -> None:
    table = torch.randn(4, 3, dtype=dtype, requires_grad=True)
    none = torch.zeros(0, dtype=torch.int64)
    sums = weighted_rows(table, none, torch.zeros(0, dtype=dtype), none)
    sums.sum().backward()
    assert sums.shape == (0, 3)
    assert torch.equal(table.grad, torch.zeros(4, 3, dtype=dtype))
