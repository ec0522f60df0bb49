"""Losses of detectors: closed forms, and zeros where nothing was drawn."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from rendra_lab.detection import detector_losses as losses
from rendra_lab.detection.records import AnchorVerdicts, BoxVerdicts, CellVerdicts


def anchors(logits: Tensor, labels: Tensor, deltas: Tensor, goals: Tensor) -> AnchorVerdicts:
    return AnchorVerdicts(logits, labels, deltas, goals)


def test_who_knows_nothing_pays_the_logarithm_of_two() -> None:
    none = torch.zeros(0, 4)
    verdicts = anchors(torch.zeros(6), torch.tensor([1.0, 0, 0, 1, 0, 0]), none, none)
    assert float(losses.anchor_objectness(verdicts)) == pytest.approx(math.log(2))
    assert float(losses.cells(CellVerdicts(torch.zeros(2, 3, 3, 3), torch.rand(2, 3, 3, 3)))) == pytest.approx(
        math.log(2)
    )
    classes = BoxVerdicts(torch.zeros(5, 4), torch.tensor([0, 1, 2, 3, 3]), none, none)
    assert float(losses.region_classes(classes)) == pytest.approx(math.log(4))


def test_who_is_right_pays_nothing() -> None:
    deltas = torch.rand(2, 4)
    verdicts = anchors(torch.tensor([50.0, 50, -50]), torch.tensor([1.0, 1, 0]), deltas, deltas)
    assert float(losses.anchor_objectness(verdicts)) == pytest.approx(0, abs=1e-12)
    assert float(losses.anchor_boxes(verdicts)) == 0


@pytest.mark.parametrize(("error", "beta", "expected"), [(0.05, 1 / 9, 4.5 * 0.05**2), (2.0, 1 / 9, 2 - 1 / 18)])
def test_smooth_l1_is_shared_by_all_that_were_drawn(error: float, beta: float, expected: float) -> None:
    deltas, logits = torch.zeros(2, 4), torch.zeros(8)
    deltas[1, 2] = error
    verdicts = anchors(logits, torch.zeros(8), deltas, torch.zeros(2, 4))
    assert float(losses.anchor_boxes(verdicts)) == pytest.approx(expected / 8)
    boxes = BoxVerdicts(torch.zeros(8, 3), torch.zeros(8, dtype=torch.int64), deltas, torch.zeros(2, 4))
    assert float(losses.region_boxes(boxes, beta)) == pytest.approx(expected / 8)
    wide = error**2 / 2 if error < 1 else error - 0.5
    assert float(losses.region_boxes(boxes)) == pytest.approx(wide / 8)


@pytest.mark.parametrize(
    ("loss", "make"),
    [
        (losses.anchor_objectness, lambda x: anchors(x, x.detach(), x.reshape(0, 4), torch.zeros(0, 4))),
        (losses.anchor_boxes, lambda x: anchors(x, x.detach(), x.reshape(0, 4), torch.zeros(0, 4))),
        (losses.region_classes, lambda x: BoxVerdicts(x.reshape(0, 3), x.detach().long(), x.reshape(0, 4), x)),
        (losses.region_boxes, lambda x: BoxVerdicts(x.reshape(0, 3), x.detach().long(), x.reshape(0, 4),
                                                    torch.zeros(0, 4))),
        (losses.cells, lambda x: CellVerdicts(x.reshape(0, 2, 2), torch.zeros(0, 2, 2))),
    ],
)  # fmt: skip
def test_nothing_drawn_costs_nothing(loss: Callable[..., Tensor], make: Callable[[Tensor], Any]) -> None:
    x = torch.zeros(0, requires_grad=True)
    value = loss(make(x))
    assert value.shape == ()
    assert float(value.detach()) == 0
    value.backward()
    assert x.grad is not None


def test_gradients_are_those_of_finite_differences() -> None:
    goals = torch.rand(3, 4, dtype=torch.float64)
    labels = torch.tensor([1.0, 1, 1, 0, 0], dtype=torch.float64)

    def total(logits: Tensor, deltas: Tensor, table: Tensor) -> Tensor:
        first = anchors(logits, labels, deltas, goals)
        second = BoxVerdicts(table, torch.tensor([2, 0, 1, 3, 3]), deltas, goals)
        return (
            losses.anchor_objectness(first) + losses.anchor_boxes(first) + losses.region_classes(second)
            + losses.region_boxes(second) + losses.cells(CellVerdicts(table, table.detach().sigmoid()))
        )  # fmt: skip

    given = [torch.randn(*shape, dtype=torch.float64, requires_grad=True) for shape in ((5,), (3, 4), (5, 4))]
    assert torch.autograd.gradcheck(lambda a, b, c: total(a, b, c.double()), [*given[:2], given[2].detach()])
