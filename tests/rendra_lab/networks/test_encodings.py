"""Encodings as modules: widths, starts, laws."""

import math

import numpy as np
import pytest
import torch
from assertions import assert_close

from rendra_lab.networks.encodings import HashGrid, SphericalHarmonics, TriPlane


@pytest.mark.parametrize(
    "module",
    [
        HashGrid(levels=3, features=2, log2_table_size=6, coarsest=2, finest=9),
        HashGrid(levels=1, features=4, coarsest=5, finest=5),
        TriPlane((4, 7), 3),
        TriPlane((5,), 2, "sum"),
        TriPlane((5, 6), 2, "concat"),
        SphericalHarmonics(),
        SphericalHarmonics(2),
    ],
)
def test_width_and_type_are_what_comes_out(module):
    for dtype in (torch.float64, torch.float32):
        found = module.to(dtype)(torch.rand(11, 3, dtype=dtype))
        assert found.shape == (11, module.width)
        assert found.dtype == dtype
    assert module(torch.rand(0, 3)).shape == (0, module.width)


def test_a_hash_grid_starts_near_zero():
    table = HashGrid().table
    assert table.shape[1] == 2
    assert table.abs().max() <= 1e-4
    assert table.std().item() == pytest.approx(1e-4 / math.sqrt(3), rel=0.02)


def test_multiplied_planes_start_away_from_zero():
    for planes in TriPlane((8,), 4).planes:
        assert 0.1 <= planes.min() < planes.max() <= 0.5
    for planes in TriPlane((8,), 4, "sum").planes:
        assert -0.1 <= planes.min() < 0 < planes.max() <= 0.1


@pytest.mark.parametrize(
    "module", [HashGrid(levels=4, features=4, log2_table_size=8, coarsest=4, finest=16), TriPlane((8, 16), 8)]
)
def test_an_encoding_learns_a_ball(module):
    """A linear readout of the features comes to tell inside from outside; the features themselves must learn."""
    readout = torch.nn.Linear(module.width, 1)
    optimizer = torch.optim.Adam([*module.parameters(), *readout.parameters()], lr=2e-2)
    for _ in range(60):
        points = torch.rand(2000, 3)
        inside = ((points - 0.5).norm(dim=1) < 0.35).float()
        loss = torch.nn.functional.binary_cross_entropy_with_logits(readout(module(points)).squeeze(1), inside)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss.item() < 0.25


def sphere_quadrature():
    """Nodes and weights that are exact for polynomials up to degree 11."""
    heights, weights = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(6))
    turns = torch.arange(12, dtype=torch.float64) * (math.pi / 6)
    z, phi = torch.cartesian_prod(heights, turns).unbind(1)
    ring = (1 - z * z).sqrt()
    return torch.stack([ring * phi.cos(), ring * phi.sin(), z], -1), weights.repeat_interleave(12) * (math.pi / 6)


def test_spherical_harmonics_are_orthonormal():
    directions, weights = sphere_quadrature()
    values = SphericalHarmonics()(directions)
    assert_close(values.T @ (weights[:, None] * values), torch.eye(16, dtype=torch.float64), atol=1e-12, rtol=0)


def test_spherical_harmonics_follow_the_addition_theorem():
    """sum_m Y_lm(a) Y_lm(b) = (2 l + 1) / (4 pi) P_l(a . b): each value stands in the band it belongs to."""
    a, b = torch.nn.functional.normalize(torch.randn(2, 30, 3, dtype=torch.float64), dim=-1)
    products, cosine = SphericalHarmonics()(a) * SphericalHarmonics()(b), (a * b).sum(-1)
    legendre = [torch.ones_like(cosine), cosine, (3 * cosine**2 - 1) / 2, (5 * cosine**3 - 3 * cosine) / 2]
    for band, values in enumerate(products.split([1, 3, 5, 7], 1)):
        assert_close(values.sum(1), (2 * band + 1) / (4 * math.pi) * legendre[band], atol=1e-12, rtol=0)


def test_spherical_harmonics_run_from_minus_to_plus():
    """At phi = 30 degrees on the equator: sin(|m| phi) for m < 0, cos(m phi) for m > 0, all of positive sign."""
    phi = math.pi / 6
    found = SphericalHarmonics()(torch.tensor([[math.cos(phi), math.sin(phi), 0.0]], dtype=torch.float64))[0]
    for band in range(1, 4):
        first, last = found[band * band].item(), found[band * band + 2 * band].item()
        assert first * math.cos(band * phi) == pytest.approx(last * math.sin(band * phi), abs=1e-12)
        assert first > 0


@pytest.mark.parametrize(
    ("build", "complaint"),
    [
        (lambda: HashGrid(levels=0), "at least one level"),
        (lambda: HashGrid(features=0), "at least one feature"),
        (lambda: HashGrid(coarsest=64, finest=32), "coarsest <= finest"),
        (lambda: HashGrid(log2_table_size=40), "log2_table_size"),
        (lambda: TriPlane(()), "resolutions of at least 2"),
        (lambda: TriPlane((1, 4)), "resolutions of at least 2"),
        (lambda: TriPlane(combine="max"), "product, sum, concat, got 'max'"),
        (lambda: SphericalHarmonics(5), "1 to 4 bands, got 5"),
    ],
)
def test_what_cannot_be_is_refused(build, complaint):
    with pytest.raises(ValueError, match=complaint):
        build()
