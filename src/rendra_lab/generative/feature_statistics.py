"""What is kept of a set of feature vectors: its count, its mean, its covariance, and the first of the vectors.

Letters: D numbers of a vector.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rendra_lab.generative.features import FeatureNetwork
from rendra_lab.records import read_field

MOST_KEPT = 5_000  # vectors


@dataclass(frozen=True)
class FeatureStatistics:
    """Of one set; on the CPU."""

    count: int
    mean: Tensor  # (D,) float64; NaN without vectors
    covariance: Tensor  # (D, D) float64, unbiased; NaN with fewer than two vectors
    sample: Tensor  # (at most 5,000, D) float32: the first vectors

    @classmethod
    def of_sums(cls, count: int, total: Tensor, squares: Tensor, sample: Tensor | None = None) -> FeatureStatistics:
        """From the sum (D,) of vectors x and the sum (D, D) of x x^T, float64."""
        mean = total.cpu() / count if count else torch.full_like(total, torch.nan, device="cpu")
        if count > 1:
            covariance = (squares.cpu() - count * torch.outer(mean, mean)) / (count - 1)
            covariance = (covariance + covariance.T) / 2
        else:
            covariance = torch.full_like(squares, torch.nan, device="cpu")
        return cls(count, mean, covariance, torch.zeros(0, len(mean)) if sample is None else sample.cpu())

    @classmethod
    def of_vectors(cls, vectors: Tensor) -> FeatureStatistics:
        """Of vectors (N, D)."""
        return cls.of_sums(len(vectors), *sums(vectors), vectors[:MOST_KEPT].float())

    @cached_property
    def root(self) -> Tensor:
        """The square root (D, D) of the covariance."""
        return symmetric_root(self.covariance)


def sums(vectors: Tensor) -> tuple[Tensor, Tensor]:
    """The sum (D,) of vectors (N, D), and that of their outer products (D, D), float64."""
    vectors = vectors.double()
    return vectors.sum(0), vectors.T @ vectors


def symmetric_root(matrix: Tensor) -> Tensor:
    """The symmetric positive square root of a symmetric matrix (D, D) without negative eigenvalues.

    Eigenvalues that rounding alone can have made, of either sign, count as 0: their roots would be eight orders of
    magnitude larger.
    """
    values, vectors = torch.linalg.eigh(matrix)
    least = len(matrix) * torch.finfo(matrix.dtype).eps * values[-1].abs()
    return (vectors * values.where(values > least, 0.0).sqrt()) @ vectors.T


def reference_statistics(
    features: FeatureNetwork, batches: Iterable[Any], field: str = "rgb", cache: Path | None = None
) -> FeatureStatistics:
    """Of real pictures as a network sees them.

    Args:
        features: the network.
        batches: of pictures (B, 3, H, W) in [0, 1], or records that have them.
        field: of records: where the pictures are.
        cache: folder in which the vectors of each batch are kept by content; None sees all pictures anew.

    Raises:
        ValueError: no picture, or pictures of another shape.
    """
    count, held, sample = 0, 0, []
    total = torch.zeros(features.width, dtype=torch.float64)
    squares = torch.outer(total, total)
    for batch in batches:
        pictures = batch if isinstance(batch, Tensor) else read_field(batch, field, "batch")
        vectors = features(pictures, cache).cpu()
        one, two = sums(vectors)
        total, squares, count = total + one, squares + two, count + len(vectors)
        sample.append(vectors[: MOST_KEPT - held])
        held += len(sample[-1])
    if count == 0:
        raise ValueError("there is no real picture to compare with")
    return FeatureStatistics.of_sums(count, total, squares, torch.cat(sample))
