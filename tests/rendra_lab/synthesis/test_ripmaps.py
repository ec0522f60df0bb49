"""Textures shrunk along each axis: means of what they cover, and themselves where nothing is shrunk."""

import pytest
import torch

from rendra_lab.synthesis.ripmaps import Ripmaps

TEXTURES = torch.rand(3, 8, 16, 2, generator=torch.Generator().manual_seed(4))


def sampled(which: int, u: float, v: float, across: float, down: float) -> torch.Tensor:
    maps = Ripmaps(TEXTURES)
    return maps.sample(torch.tensor([which]), torch.tensor([[u, v]]), torch.tensor([[across, down]]))[0]


def test_a_small_footprint_reads_the_texel_itself() -> None:
    got = sampled(1, (5 + 0.5) / 16, (2 + 0.5) / 8, 1 / 16, 1 / 8)
    torch.testing.assert_close(got, TEXTURES[1, 2, 5])


def test_between_texels_it_is_linear_and_the_texture_repeats() -> None:
    torch.testing.assert_close(sampled(0, 0.0, 0.5 / 8, 0.0, 0.0), (TEXTURES[0, 0, 15] + TEXTURES[0, 0, 0]) / 2)
    torch.testing.assert_close(sampled(0, 3.3, -1.7, 0.0, 0.0), sampled(0, 0.3, 0.3, 0.0, 0.0), atol=1e-5, rtol=0)


def test_a_footprint_of_everything_reads_the_mean() -> None:
    torch.testing.assert_close(sampled(2, 0.3, 0.9, 50.0, 50.0), TEXTURES[2].mean((0, 1)))


def test_each_axis_is_shrunk_on_its_own() -> None:
    row = sampled(2, 0.77, (3 + 0.5) / 8, 1.0, 1 / 8)
    torch.testing.assert_close(row, TEXTURES[2, 3].mean(0))
    column = sampled(2, (9 + 0.5) / 16, 0.1, 1 / 16, 1.0)
    torch.testing.assert_close(column, TEXTURES[2, :, 9].mean(0))


def test_no_samples_and_odd_sides() -> None:
    none = Ripmaps(TEXTURES).sample(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 2), torch.zeros(0, 2))
    assert none.shape == (0, 2)
    with pytest.raises(ValueError, match="powers of two, got 6 x 8"):
        Ripmaps(torch.zeros(1, 6, 8, 3))
