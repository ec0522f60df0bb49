"""Terms: which fields they read, what they weigh, and least squares."""

import pytest
import torch
from assertions import assert_close
from torchmetrics import MeanMetric

from rendra_lab import losses, metrics
from rendra_lab.base_task import weighted_sum
from rendra_lab.terms import LossTerm, MetricTerm, PiecewiseLinear

PREDICTION = {"rgb": torch.tensor([1.0, 2.0, 4.0]), "other": torch.tensor(3.0)}
BATCH = {"rgb": torch.tensor([1.0, 1.0, 1.0]), "mask": torch.tensor([1.0, 1.0, 0.0])}


def test_a_loss_reads_the_named_fields() -> None:
    assert_close(LossTerm(losses.absolute_error)(PREDICTION, BATCH), 4 / 3)
    assert_close(LossTerm(losses.mean_square, prediction="other", target=None)(PREDICTION, BATCH), 9.0)
    assert_close(LossTerm(losses.absolute_error, context={"mask": "mask"})(PREDICTION, BATCH), 0.5)


@pytest.mark.parametrize("mask", [None, {"mask": "mask"}])
def test_squared_residuals_sum_to_the_weighted_loss(mask: dict[str, str] | None) -> None:
    term = LossTerm(losses.SquaredError(), weight=2.5, context=mask)
    assert_close(term.residuals(PREDICTION, BATCH).square().sum(), 2.5 * term(PREDICTION, BATCH))


def test_residuals_are_refused_where_there_are_none() -> None:
    with pytest.raises(TypeError, match="absolute_error is not a sum of squares"):
        LossTerm(losses.absolute_error).residuals(PREDICTION, BATCH)
    with pytest.raises(ValueError, match="weight of at least 0"):
        LossTerm(losses.SquaredError(), weight=-1).residuals(PREDICTION, BATCH)


def test_a_weight_may_follow_a_schedule() -> None:
    term = LossTerm(losses.absolute_error, weight=[[10, 1.0], [20, 3.0], [20, 0.0], [40, 1.0]])
    assert [term.weight_at(step) for step in (0, 10, 15, 20, 30, 99)] == [1.0, 1.0, 2.0, 0.0, 0.5, 1.0]


@pytest.mark.parametrize("knots", [[], [[1]], [[5, 1.0], [4, 1.0]]])
def test_bad_schedules_are_refused(knots: list) -> None:
    with pytest.raises(ValueError, match="schedule"):
        PiecewiseLinear(knots)


def test_metrics_are_functions_or_torchmetrics() -> None:
    assert_close(MetricTerm(metrics.mean_absolute_error)(PREDICTION, BATCH), 4 / 3)
    mean = MetricTerm(MeanMetric(), prediction="other", target=None)
    assert mean(PREDICTION, BATCH) is mean.fn
    assert float(mean.fn.compute()) == 3.0


def test_only_functions_are_measured_in_training() -> None:
    assert not MetricTerm(metrics.psnr).in_training
    assert MetricTerm(metrics.psnr, in_training=True).in_training
    with pytest.raises(TypeError, match="MeanMetric averages over an epoch"):
        MetricTerm(MeanMetric(), in_training=True)


def test_a_metric_is_never_differentiated() -> None:
    prediction = {"rgb": torch.ones(3, requires_grad=True)}
    assert not MetricTerm(metrics.mean_absolute_error)(prediction, BATCH).requires_grad


def test_a_term_needs_something_to_call() -> None:
    with pytest.raises(TypeError, match="got int"):
        LossTerm(3)  # type: ignore[arg-type]


def test_a_costly_term_counts_as_much_when_it_is_counted_now_and_then() -> None:
    term = LossTerm(losses.absolute_error, weight=[[0, 1.0], [8, 3.0]], every=4)
    assert [term.is_due(step) for step in range(6)] == [True, False, False, False, True, False]
    assert [term.weight_at(step) for step in (0, 1, 4, 8, 9)] == [4.0, 0.0, 8.0, 12.0, 0.0]
    with pytest.raises(ValueError, match="every=0"):
        LossTerm(losses.absolute_error, every=0)


def test_an_objective_leaves_out_what_is_not_due() -> None:
    terms = torch.nn.ModuleDict(
        {"always": LossTerm(losses.absolute_error), "lazy": LossTerm(losses.mean_square, target=None, every=2)}
    )
    total, values = weighted_sum(terms, PREDICTION, BATCH, 3)
    assert list(values) == ["always"]
    assert_close(total, 4 / 3)
    total, values = weighted_sum(terms, PREDICTION, BATCH, 4)
    assert_close(total, 4 / 3 + 2 * 7.0)
    del terms["always"]
    with pytest.raises(ValueError, match="no loss is due at step 3: lazy; one of them needs every=1"):
        weighted_sum(terms, PREDICTION, BATCH, 3)


def test_a_loss_may_take_the_batch_alone() -> None:
    term = LossTerm(lambda real, mask: (real * mask).sum(), prediction=None, context={"mask": "mask"})
    assert_close(term(PREDICTION, BATCH), 2.0)
    assert [term.reads(name) for name in ("rgb", "mask", "other")] == [True, True, False]
