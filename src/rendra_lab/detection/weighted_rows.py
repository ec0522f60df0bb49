"""Weighted sums of rows of a table, differentiable in the table: what resampling comes to.

Torch's own backward sorts all indices. On the CPU in float32 a loop adds the rows up where they belong instead.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from rendra.kernels.parallel import num_threads, parallel_kernel


def weighted_rows(
    table: Float[Tensor, "N C"], rows: Int[Tensor, " E"], weights: Float[Tensor, " E"], offsets: Int[Tensor, " K"]
) -> Float[Tensor, "K C"]:
    """Sums of weights times rows, bag by bag.

    Args:
        table: what is summed.
        rows: indices into it.
        weights: not differentiated.
        offsets: where in `rows` each of K bags begins, ascending; the last ends with `rows`.
    """
    weights = weights.detach().to(table)
    if table.device.type == "cpu" and table.dtype == torch.float32:
        return _WeightedRows.apply(table, rows, weights, offsets)
    return F.embedding_bag(rows, table, offsets, mode="sum", per_sample_weights=weights)


class _WeightedRows(torch.autograd.Function):
    """Threads own channels: each sum runs over the rows in their order, whatever the number of threads."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor, weights: Tensor, offsets: Tensor) -> Tensor:
        ctx.save_for_backward(rows, weights, offsets)
        ctx.table_shape = table.shape
        return F.embedding_bag(rows, table, offsets, mode="sum", per_sample_weights=weights)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
        slopes = grad.new_zeros(ctx.table_shape)
        rows, weights, offsets = (tensor.contiguous().numpy() for tensor in ctx.saved_tensors)
        if len(rows):
            _add_rows(grad.contiguous().numpy(), rows, weights, offsets, num_threads(), slopes.numpy())
        return slopes, None, None, None


@parallel_kernel
def _add_rows(
    grad: np.ndarray, rows: np.ndarray, weights: np.ndarray, offsets: np.ndarray, workers: int, slopes: np.ndarray
) -> None:
    """Add weights times rows of grad (K, C) to the rows of slopes (N, C) that they were read from."""
    channels = slopes.shape[1]
    for worker in prange(workers):
        low, high = worker * channels // workers, (worker + 1) * channels // workers
        for bag in range(len(offsets)):
            end = offsets[bag + 1] if bag + 1 < len(offsets) else len(rows)
            given = grad[bag, low:high]
            for place in range(offsets[bag], end):
                weight, taken = weights[place], slopes[rows[place], low:high]
                if weight:
                    for channel in range(high - low):
                        taken[channel] += weight * given[channel]
