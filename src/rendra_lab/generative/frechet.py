"""Fréchet's distance of two sets of pictures: of the normal distributions that have their features' moments.

Heusel et al., "GANs Trained by a Two Time-Scale Update Rule", NeurIPS 2017, arXiv:1706.08500, Eq. 6.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from rendra_lab.generative.feature_statistics import FeatureStatistics, sums, symmetric_root
from rendra_lab.generative.features import FeatureNetwork, InceptionFeatures
from rendra_lab.generative.picture_sets import PictureSetDistance, Who


class FrechetDistance(PictureSetDistance):
    """|m - n|^2 + tr(C + D - 2 (C D)^(1/2)) of the means m, n and covariances C, D of both sets' features.

    It is called fid with InceptionV3, and fd_ with the network's name otherwise; values of different networks have
    nothing to do with each other. The fewer pictures, the larger it comes out: compare values of equal counts.
    """

    made_total: Tensor
    made_squares: Tensor
    real_total: Tensor
    real_squares: Tensor

    def __init__(self, features: FeatureNetwork, cache: str | Path | None = None) -> None:
        super().__init__(features, cache)
        for who in ("made", "real"):
            total = torch.zeros(features.width, dtype=torch.float64)
            self.add_state(f"{who}_total", total, dist_reduce_fx="sum")
            self.add_state(f"{who}_squares", torch.outer(total, total), dist_reduce_fx="sum")

    @property
    def name(self) -> str:
        """fid, or fd_ and the network."""
        return "fid" if isinstance(self.features, InceptionFeatures) else f"fd_{self.features.name}"

    def _add(self, who: Who, vectors: Tensor) -> None:
        total, squares = sums(vectors)
        setattr(self, f"{who}_total", getattr(self, f"{who}_total") + total)
        setattr(self, f"{who}_squares", getattr(self, f"{who}_squares") + squares)

    def _distance(self) -> float:
        made = FeatureStatistics.of_sums(int(self.made_count), self.made_total, self.made_squares)
        real = self._known
        if real is None:
            real = FeatureStatistics.of_sums(int(self.real_count), self.real_total, self.real_squares)
        return distance_of_statistics(made, real)

    def _least(self) -> int:
        return self.features.width + 1


def distance_of_statistics(first: FeatureStatistics, second: FeatureStatistics) -> float:
    """Fréchet's distance of two sets; the root of a covariance is made once for each."""
    return _distance(first.mean, first.covariance, first.root, second.mean, second.covariance, second.root)


def frechet_distance(mean: Tensor, covariance: Tensor, other_mean: Tensor, other_covariance: Tensor) -> float:
    """Fréchet's distance of two normal distributions.

    tr (C D)^(1/2) is the sum of the singular values of C^(1/2) D^(1/2): no root of a matrix that is not symmetric,
    and exact where covariances are singular, so that nothing is added to their diagonals.

    Args:
        mean: (D,) of one.
        covariance: (D, D), symmetric, without negative eigenvalues.
        other_mean: (D,) of the other.
        other_covariance: (D, D).
    """
    moments = [each.detach().double().cpu() for each in (mean, covariance, other_mean, other_covariance)]
    m, c, n, d = moments
    return _distance(m, c, symmetric_root(c), n, d, symmetric_root(d))


def _distance(m: Tensor, c: Tensor, root_c: Tensor, n: Tensor, d: Tensor, root_d: Tensor) -> float:
    shared = torch.linalg.svdvals(root_c @ root_d).sum()
    return max(float((m - n).square().sum() + c.trace() + d.trace() - 2 * shared), 0.0)
