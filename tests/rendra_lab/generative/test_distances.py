"""Fréchet's and the kernel distance, on features that are given."""

import math

import numpy as np
import pytest
import scipy.linalg
import torch
from torch import Tensor

from rendra_lab.generative.feature_statistics import FeatureStatistics
from rendra_lab.generative.frechet import distance_of_statistics, frechet_distance
from rendra_lab.generative.kernel_distance import kernel_distance


def vectors(count: int, width: int, seed: int) -> Tensor:
    """Correlated, with another variance along each axis."""
    generator = torch.Generator().manual_seed(seed)
    mix = torch.randn(width, width, generator=generator, dtype=torch.float64) / width**0.5
    return torch.randn(count, width, generator=generator, dtype=torch.float64) @ mix + seed


def published(first: Tensor, second: Tensor) -> float:
    """The formula as it stands, by a general root of a matrix."""
    m, n = first.mean(0).numpy(), second.mean(0).numpy()
    c, d = np.cov(first.numpy(), rowvar=False), np.cov(second.numpy(), rowvar=False)
    root = scipy.linalg.sqrtm(c @ d)
    return float(((m - n) ** 2).sum() + np.trace(c + d - 2 * root.real))


def frechet(first: Tensor, second: Tensor) -> float:
    return distance_of_statistics(FeatureStatistics.of_vectors(first), FeatureStatistics.of_vectors(second))


def test_it_is_the_published_formula() -> None:
    first, second = vectors(300, 64, 1), vectors(200, 64, 2)
    assert frechet(first, second) == pytest.approx(published(first, second), rel=1e-6)


def test_covariances_along_the_same_axes_have_a_closed_form() -> None:
    a, b = torch.tensor([4.0, 1.0, 0.25]), torch.tensor([1.0, 9.0, 0.0])
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    c, d = (turn @ each.double().diag() @ turn.T for each in (a, b))
    m, n = torch.zeros(3), torch.tensor([1.0, 2.0, 2.0])
    expected = 9 + float((a.sqrt() - b.sqrt()).square().sum())
    assert frechet_distance(m, c, n, d) == pytest.approx(expected, abs=1e-9)


def test_in_one_dimension_it_is_the_difference_of_means_and_of_deviations() -> None:
    one, four = torch.ones(1, 1), 4 * torch.ones(1, 1)
    assert frechet_distance(torch.zeros(1), one, torch.full((1,), 3.0), four) == pytest.approx(9 + 1)


@pytest.mark.parametrize("count", [20, 64, 500])
def test_a_set_is_at_no_distance_from_itself_however_singular(count: int) -> None:
    known = vectors(count, 64, 3)
    assert frechet(known, known) < 1e-9 * float(known.square().sum(1).mean())
    assert frechet(known, known.flip(0)) < 1e-9 * float(known.square().sum(1).mean())


def test_it_is_symmetric_and_does_not_change_when_space_is_turned_and_moved() -> None:
    first, second = vectors(90, 16, 1), vectors(80, 16, 2)
    turn = torch.linalg.qr(torch.randn(16, 16, dtype=torch.float64))[0]
    value = frechet(first, second)
    assert frechet(second, first) == pytest.approx(value, rel=1e-9)
    assert frechet(first @ turn + 5, second @ turn + 5) == pytest.approx(value, rel=1e-8)


def test_means_that_are_far_away_cost_no_digits() -> None:
    known = vectors(400, 8, 1)
    other = vectors(400, 8, 2) - 1
    assert frechet(known + 1000, other + 1000) == pytest.approx(frechet(known, other), rel=1e-6)


def unbiased(first: Tensor, second: Tensor) -> float:
    """The sum over pairs, pair by pair."""

    def kernel(a: Tensor, b: Tensor) -> float:
        return float((a @ b / len(a) + 1) ** 3)

    m, n = len(first), len(second)
    within = sum(kernel(first[i], first[j]) for i in range(m) for j in range(m) if i != j) / (m * (m - 1))
    beside = sum(kernel(second[i], second[j]) for i in range(n) for j in range(n) if i != j) / (n * (n - 1))
    return within + beside - 2 * sum(kernel(a, b) for a in first for b in second) / (m * n)


def test_the_kernel_distance_is_the_sum_over_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = vectors(9, 5, 1), vectors(7, 5, 2)
    expected = unbiased(first, second)
    assert kernel_distance(first, second) == pytest.approx(expected, rel=1e-10)
    monkeypatch.setattr("rendra_lab.generative.kernel_distance._ROWS", 4)
    assert kernel_distance(first, second) == pytest.approx(expected, rel=1e-10)


def test_the_kernel_distance_has_no_bias_where_the_other_has() -> None:
    pairs = [torch.randn(2, 12, 4, dtype=torch.float64) for _ in range(60)]  # both sets standard normal
    kernels = [kernel_distance(*pair) for pair in pairs]
    assert abs(float(np.mean(kernels))) < 4 * float(np.std(kernels)) / math.sqrt(len(pairs))
    assert min(kernels) < 0
    assert np.mean([frechet(*pair) for pair in pairs]) > 0.3


def test_of_two_points_each_the_kernel_distance_is_known() -> None:
    zeros, ones = torch.zeros(2, 4), torch.ones(2, 4)
    assert kernel_distance(zeros, ones) == pytest.approx(1 + 8 - 2)
    assert kernel_distance(ones, ones) == pytest.approx(0)
