"""What a task inherits: its objective, its optimizer, and looks that leave no trace."""

from functools import partial
from typing import Any

import pytest
import torch
from assertions import assert_close
from jaxtyping import TypeCheckError
from lightning.pytorch import Trainer
from rendra_lab_toy import ToyBatch, ToyData, ToyTask

from rendra_lab import losses, metrics, schedulers
from rendra_lab.records import FieldError
from rendra_lab.terms import LossTerm, MetricTerm


def task(**changes: Any) -> ToyTask:
    parts: dict[str, Any] = {
        "losses": {
            "texture": LossTerm(losses.SquaredError(), weight=2.0),
            "silhouette": LossTerm(losses.SquaredError(), 0.5, "silhouette", "silhouette"),
        },
        "metrics": {"psnr": MetricTerm(metrics.psnr)},
        "optimizer": partial(torch.optim.SGD, lr=0.1),
    }
    return ToyTask(**{**parts, **changes})


def batch() -> ToyBatch:
    return ToyBatch(torch.ones(1, 4, 4, 3), torch.zeros(1, 4, 4))


def trainer(steps: int = 3) -> Trainer:
    silent = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)
    return Trainer(max_steps=steps, max_epochs=-1, accelerator="cpu", **silent)


def test_the_objective_is_the_weighted_sum() -> None:
    toy = task()
    total, terms = toy.objective(toy.predict(batch()), batch())
    assert_close(terms["texture"], 0.81)
    assert_close(total, 2.0 * 0.81 + 0.5 * 0.01)


def test_the_residuals_square_to_the_objective() -> None:
    toy = task()
    total, _ = toy.objective(toy.predict(batch()), batch())
    assert_close(toy.residuals(batch()).square().sum(), total)


def test_terms_set_to_null_are_off() -> None:
    toy = task(losses={"texture": LossTerm(losses.absolute_error), "silhouette": None})
    assert list(toy.losses) == ["texture"]


def test_a_task_without_losses_or_optimizer_says_so() -> None:
    with pytest.raises(ValueError, match="at least one loss"):
        task(losses={})
    with pytest.raises(ValueError, match="needs an optimizer"):
        task(optimizer=None)


def test_a_wrong_field_names_the_term() -> None:
    toy = task(losses={"color": LossTerm(losses.absolute_error, prediction="rbg")})
    with pytest.raises(FieldError, match=r"LossTerm 'color': .*no field 'rbg'; it has: rgb, silhouette"):
        toy.objective(toy.predict(batch()), batch())


def test_looking_changes_neither_modes_nor_random_numbers_nor_gradients() -> None:
    toy = task().train()
    toy.metrics.eval()
    state = torch.get_rng_state()
    panels = toy.show(batch())
    assert set(panels) == {"target", "prediction"}
    assert not panels["prediction"].requires_grad
    assert toy.training
    assert not toy.metrics.training
    assert torch.equal(torch.get_rng_state(), state)
    assert not toy.show_meshes(batch())["triangle"].textures.verts_features_packed().requires_grad


def test_watched_metrics_are_logged_in_training() -> None:
    watched = {"psnr": MetricTerm(metrics.psnr, in_training=True), "mae": MetricTerm(metrics.mean_absolute_error)}
    run, toy = trainer(steps=1), task(metrics=watched)
    data = ToyData(steps=1)
    data.setup("fit")
    expected = toy.score(toy.predict(data.batch), data.batch)["psnr"]
    run.fit(toy, datamodule=data)
    assert {"train/loss", "train/psnr"} <= set(run.callback_metrics)
    assert "train/mae" not in run.callback_metrics
    assert_close(run.callback_metrics["train/psnr"], expected)
    assert {"val/psnr", "val/mae"} <= set(run.callback_metrics)


class Recorder(torch.optim.SGD):
    """Notes what it is handed."""

    needs_residuals = True
    residuals: Any = None

    def step(self, closure: Any = None) -> Any:
        loss = closure()
        assert_close(self.residuals().square().sum(), loss)
        return loss


def test_an_optimizer_that_needs_residuals_gets_them() -> None:
    trainer().fit(task(optimizer=partial(Recorder, lr=0.1)), datamodule=ToyData(steps=3))


@pytest.mark.parametrize(
    ("scheduler", "factor"),
    [
        (partial(schedulers.cosine, final_factor=0.5), 0.5),
        (partial(schedulers.cosine, final_factor=0.5, warmup_steps=2), 0.5),
        (partial(schedulers.exponential, final_factor=0.1), 0.1),
        (partial(schedulers.restarted, final_factor=0.2), 0.2),
        (partial(torch.optim.lr_scheduler.StepLR, step_size=2, gamma=0.5), 0.25),
    ],
)
def test_schedulers_reach_their_end_with_the_run(scheduler: Any, factor: float) -> None:
    run = trainer(steps=4)
    run.fit(task(scheduler=scheduler), datamodule=ToyData(steps=4))
    assert run.optimizers[0].param_groups[0]["lr"] == pytest.approx(0.1 * factor)


def test_a_restart_is_another_optimizer_taking_over() -> None:
    x, y = (torch.nn.Parameter(torch.tensor([1.0, -2.0])) for _ in range(2))
    restarted, other = torch.optim.Adam([x], lr=0.1), torch.optim.Adam([y], lr=0.1)
    scheduler = schedulers.restarted(restarted, total_steps=8, at=0.5, final_factor=0.3)
    for step in range(8):
        if step == 4:
            other = torch.optim.Adam([y], lr=0.03)
        for parameter, optimizer in ((x, restarted), (y, other)):
            optimizer.zero_grad()
            (parameter**4).sum().backward()
            optimizer.step()
        scheduler.step()
        assert torch.allclose(x, y)


@pytest.mark.parametrize("at", [-0.1, 1.5])
def test_a_restart_lies_within_the_run(at: float) -> None:
    with pytest.raises(ValueError, match="share of the run"):
        schedulers.restarted(torch.optim.Adam([torch.zeros(1)]), total_steps=8, at=at)


def test_a_scheduler_without_an_end_is_refused() -> None:
    with pytest.raises(ValueError, match="needs an end"):
        trainer(steps=-1).fit(task(scheduler=schedulers.cosine), datamodule=ToyData(steps=4))


def test_a_rate_that_falls_to_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="above 0, got 0"):
        schedulers.exponential(torch.optim.SGD([torch.zeros(1)], lr=1.0), 4, final_factor=0)


def test_shapes_of_records_are_checked_here() -> None:
    with pytest.raises(TypeCheckError):
        ToyBatch(torch.ones(1, 4, 4, 3), torch.zeros(1, 4, 5))
