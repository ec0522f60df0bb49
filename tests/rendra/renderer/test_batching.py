"""Compaction: there and back, with every kind of filling."""

import pytest
import torch
from assertions import assert_close

from rendra.renderer.batching import Compaction, per_image, ragged


@pytest.mark.parametrize("share", [-1.0, 0.5, 2.0])
@pytest.mark.parametrize("shape", [(3, 7), (1, 4), (0, 5), (2, 0)])
def test_put_undoes_take(shape: tuple[int, int], share: float) -> None:
    mask = torch.rand(shape) < share
    values = torch.randn(*shape, 2, 3)
    marked = Compaction(mask)
    rows = marked.take(values)
    assert_close(rows, values[mask])
    assert marked.counts.tolist() == mask.sum(1).tolist()
    assert_close(marked.put(rows, 7.0), torch.where(mask[..., None, None], values, torch.full_like(values, 7.0)))


def test_fill_may_differ_between_images() -> None:
    mask = torch.tensor([[True, False], [False, True]])
    fill = torch.tensor([[[1.0]], [[2.0]]])
    result = Compaction(mask).put(torch.zeros(2, 1), fill)
    assert_close(result[..., 0], [[0.0, 1.0], [2.0, 0.0]])


def test_ragged_rows_pad_and_come_back() -> None:
    counts = torch.tensor([2, 0, 3])
    rows = torch.arange(5.0)[:, None]
    padded = ragged(counts).put(rows, -1.0)
    assert_close(padded[..., 0], [[0.0, 1.0, -1.0], [-1.0, -1.0, -1.0], [2.0, 3.0, 4.0]])
    assert_close(ragged(counts).take(padded), rows)
    assert ragged(torch.zeros(0, dtype=torch.long)).put(torch.zeros(0, 3)).shape == (0, 0, 3)


def test_gradients_pass_both_ways() -> None:
    mask = torch.rand(2, 5) < 0.5
    values = torch.randn(2, 5, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: Compaction(mask).put(Compaction(mask).take(v)), values)


def test_values_of_images_get_dimensions_in_the_middle() -> None:
    assert per_image(torch.zeros(4, 3), 5).shape == (4, 1, 1, 1, 3)
    assert per_image(torch.zeros(4), 3).shape == (4, 1, 1)
    assert per_image(torch.zeros(4, 7, 3), 3).shape == (4, 7, 3)
