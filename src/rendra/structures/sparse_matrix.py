"""Constant sparse matrices that multiply tables of rows: sums over neighbours, differences along edges."""

from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.structures.ragged import lasting


class SparseMatrix:
    """
    A sparse matrix (R, C) made once and multiplied often, by `matrix @ values` for `values` (C, D).

    Every row of a product is summed by one thread in a fixed order, in the backward pass too: results do not
    depend on the number of threads. Products are differentiable with respect to `values`, any number of times.
    `torch.sparse` is twenty times slower here in its COO form, and warns of beta state in its CSR form.
    """

    def __init__(
        self, rows: Tensor, columns: Tensor, entries: Tensor, shape: tuple[int, int], symmetric: bool = False
    ) -> None:
        """
        Take the entries in any order; those at the same place add up.

        Args:
            rows: (K,) int64 in [0, R).
            columns: (K,) int64 in [0, C).
            entries: (K,) the numbers there; their type is the one of the products.
            shape: R and C.
            symmetric: a promise that the matrix is its own transpose, which then need not be made.
        """
        order = torch.argsort(rows, stable=True)
        counts = torch.bincount(rows, minlength=shape[0])
        self.shape = shape
        self._symmetric = symmetric
        self._columns = columns[order]
        self._entries = entries[order]
        self._ends = torch.cat([counts.new_zeros(1), counts.cumsum(0)])  # (R + 1,): where each row begins

    @property
    def transposed(self) -> "SparseMatrix":
        """The matrix (C, R) with rows and columns exchanged."""
        return self if self._symmetric else self._transposed

    @cached_property
    @lasting()
    def _transposed(self) -> "SparseMatrix":
        rows = torch.arange(self.shape[0], device=self._ends.device)
        rows = rows.repeat_interleave(self._ends.diff(), output_size=len(self._columns))
        return SparseMatrix(self._columns, rows, self._entries, (self.shape[1], self.shape[0]))

    def __matmul__(self, values: Tensor) -> Tensor:
        """The product (R, D) with rows (C, D)."""
        return _Product.apply(values, self)

    def _product(self, values: Tensor) -> Tensor:
        if self._columns.numel() == 0 or values.numel() == 0:
            return values.new_zeros(self.shape[0], values.shape[1])
        return F.embedding_bag(
            self._columns, values, self._ends, per_sample_weights=self._entries, mode="sum", include_last_offset=True
        )


class _Product(torch.autograd.Function):
    """`matrix @ values`, whose derivative is the product with the transposed matrix."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, matrix: SparseMatrix) -> Tensor:
        ctx.matrix = matrix
        return matrix._product(values)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        return _Product.apply(grads[0], ctx.matrix.transposed), None
