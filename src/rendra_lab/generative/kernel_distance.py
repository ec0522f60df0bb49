"""The kernel distance of two sets of pictures: their maximum mean discrepancy, without bias for small sets.

Binkowski et al., "Demystifying MMD GANs", ICLR 2018, arXiv:1801.01401, Sec. 4.
"""

from __future__ import annotations

from pathlib import Path

from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from rendra_lab.generative.feature_statistics import MOST_KEPT
from rendra_lab.generative.features import FeatureNetwork
from rendra_lab.generative.picture_sets import PictureSetDistance, Who

_ROWS = 2_048  # of the matrix of kernels that exist at once


class KernelDistance(PictureSetDistance):
    """The squared maximum mean discrepancy of both sets' features x, y of D numbers, kernel (x.y / D + 1)^3.

    Unbiased: the mean over sets of any size is the true one, and values below 0 happen where the sets are alike.
    Published values are means over random subsets of 1,000; this is over all pairs at once, the same in expectation
    and steadier. At most 5,000 of the reference pictures count, the first.
    It is called kid_ and the network's name.
    """

    made_vectors: list[Tensor]
    real_vectors: list[Tensor]

    def __init__(self, features: FeatureNetwork, cache: str | Path | None = None) -> None:
        super().__init__(features, cache)
        for who in ("made", "real"):
            self.add_state(f"{who}_vectors", [], dist_reduce_fx="cat")

    @property
    def name(self) -> str:
        """kid_ and the network."""
        return f"kid_{self.features.name}"

    def counts(self) -> tuple[int, int]:
        """How many made and how many real pictures count."""
        made, real = super().counts()
        return made, real if self._known is None else min(real, MOST_KEPT)

    def _add(self, who: Who, vectors: Tensor) -> None:
        getattr(self, f"{who}_vectors").append(vectors)

    def _distance(self) -> float:
        made = dim_zero_cat(self.made_vectors)
        real = dim_zero_cat(self.real_vectors) if self._known is None else self._known.sample.to(made.device)
        return kernel_distance(made, real)


def kernel_distance(first: Tensor, second: Tensor) -> float:
    """The unbiased estimate of the squared maximum mean discrepancy of vectors (M, D) and (N, D), M and N above 1.

    (sum_{i != j} k(x_i, x_j)) / (M (M - 1)) + (sum_{i != j} k(y_i, y_j)) / (N (N - 1)) - 2 mean k(x_i, y_j) with
    k(a, b) = (a.b / D + 1)^3; in float64.
    """
    x, y = first.double(), second.double()
    return _mean_of_pairs(x) + _mean_of_pairs(y) - 2 * _sum_of_kernels(x, y) / (len(x) * len(y))


def _mean_of_pairs(x: Tensor) -> float:
    with_itself = float((x.square().mean(1) + 1).pow(3).sum())
    return (_sum_of_kernels(x, x) - with_itself) / (len(x) * (len(x) - 1))


def _sum_of_kernels(x: Tensor, y: Tensor) -> float:
    return sum(float((some @ y.T / x.shape[1] + 1).pow(3).sum()) for some in x.split(_ROWS))
