"""Holes take the colours about them, and nothing else changes."""

from __future__ import annotations

import pytest
import torch

from rendra_lab.tasks.synsin.hole_filling import filled


def test_a_whole_picture_stays_as_it_is() -> None:
    colors = torch.rand(2, 3, 13, 7)
    torch.testing.assert_close(filled(colors, torch.ones(2, 1, 13, 7)), colors)


def test_a_hole_in_one_colour_disappears() -> None:
    colors, weight = torch.full((1, 3, 32, 24), 0.3), torch.ones(1, 1, 32, 24)
    weight[..., 4:28, 3:20] = 0
    holes = torch.where(weight > 0, colors, 17.0)
    torch.testing.assert_close(filled(holes, weight), colors)


def test_a_hole_between_two_colours_goes_from_one_to_the_other() -> None:
    colors, weight = torch.zeros(1, 1, 8, 32), torch.ones(1, 1, 8, 32)
    colors[..., 16:] = 1
    weight[..., 8:24] = 0
    row = filled(colors, weight)[0, 0, 4]
    assert bool((row >= 0).all() and (row <= 1).all())
    assert bool((row.diff() >= -1e-6).all())
    assert float(row[10]) < 0.5 < float(row[21])


def test_where_nothing_is_known_there_is_nothing() -> None:
    assert not bool(filled(torch.ones(1, 3, 5, 9), torch.zeros(1, 1, 5, 9)).any())


@pytest.mark.parametrize("size", [(1, 1), (3, 5)])
def test_gradients_are_those_of_finite_differences(size: tuple[int, int]) -> None:
    colors = torch.rand(1, 2, *size, dtype=torch.float64, requires_grad=True)
    weight = (0.2 + 0.6 * torch.rand(1, 1, *size, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(filled, (colors, weight))
