"""NaN in losses and gradients: noticed in its step, kept for inspection, stopped or left out."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from rendra_lab_toy import ToyBatch, ToyPrediction, ToyTask
from torch import nn

from rendra_lab import nan_evidence
from rendra_lab.base_task import BaseTask
from rendra_lab.data.repeated import Repeated
from rendra_lab.errors import UserError
from rendra_lab.experiment import run
from rendra_lab.nan_guard import NanGuard, NotFiniteError
from rendra_lab.random_state import Streams
from rendra_lab.replay import replay

Compose = Callable[..., Any]


def plant(monkeypatch: pytest.MonkeyPatch, steps: set[int], value: float = float("nan"), kind: str = "loss") -> None:
    """The toy's colours become NaN at some steps, or their gradient alone does."""
    inner = ToyTask.predict

    def predict(self: ToyTask, batch: ToyBatch) -> ToyPrediction:
        seen = inner(self, batch)
        if not (self.training and self.global_step in steps):
            return seen
        if kind == "gradient":
            seen.rgb.register_hook(lambda gradient: gradient * value)
            return seen
        return ToyPrediction(seen.rgb * value, seen.silhouette)

    monkeypatch.setattr(ToyTask, "predict", predict)


def record_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "metrics.json").read_text())


@pytest.mark.parametrize("kind", ["loss", "gradient"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_fit_stops_in_the_step(
    kind: str, value: float, compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant(monkeypatch, {7}, value, kind)
    folder = tmp_path / "toy" / "run"
    guilty = "train/loss, train/loss_texture" if kind == "loss" else "the gradient of color is"
    with pytest.raises(
        NotFiniteError, match=rf"^{guilty}.* not finite at step 7; kept in .*step_000007.*on_nan=skip"
    ):
        run(compose(folder, "task=toy", "debug=fast", "trainer.max_steps=20"))
    assert record_of(folder)["status"] == "failed"
    assert record_of(folder)["steps"] == 7
    last = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    assert last["global_step"] == 7
    assert all(weight.isfinite().all() for weight in last["state_dict"].values())
    kept = folder / "nan" / "step_000007"
    assert "python scripts/replay_step.py" in (kept / "README.txt").read_text()
    batch = nan_evidence.read_batch(kept)
    assert isinstance(batch, ToyBatch)
    assert torch.equal(batch.silhouette, torch.full((1, 16, 16), 0.9))
    before = torch.load(kept / "before.ckpt", weights_only=True)
    assert torch.equal(before["state_dict"]["color"], last["state_dict"]["color"])
    assert guilty in (replay(kept) or "")
    monkeypatch.undo()
    monkeypatch.setenv("RENDRA_LAB_PACKAGES", "rendra_lab_toy")
    assert replay(kept) is None  # the toy is whole again


@pytest.mark.parametrize("kind", ["loss", "gradient"])
def test_a_step_left_out_never_was(
    kind: str, compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = tmp_path / "toy" / "whole"
    settings = ["task=toy", "debug=fast", "optimizer=adamw", "on_nan=skip", "logger=csv"]
    run(compose(whole, *settings, "trainer.max_steps=18"))
    plant(monkeypatch, {4, 9}, kind=kind)
    folder = tmp_path / "toy" / "skipped"
    run(compose(folder, *settings, "trainer.max_steps=20", "trainer.log_every_n_steps=1"))
    ends = [torch.load(each / "checkpoints" / "last.ckpt", weights_only=True) for each in (whole, folder)]
    for name, weight in ends[0]["state_dict"].items():
        assert torch.equal(weight, ends[1]["state_dict"][name])
    first, second = (end["optimizer_states"][0]["state"] for end in ends)
    assert all(torch.equal(first[0][key], second[0][key]) for key in ("step", "exp_avg", "exp_avg_sq"))
    assert record_of(folder)["metrics"]["train/skipped_steps"] == 2
    assert sorted(path.name for path in (folder / "nan").iterdir()) == ["step_000004", "step_000009"]


def test_a_fit_that_never_recovers_stops(compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant(monkeypatch, set(range(3, 100)))
    folder = tmp_path / "toy" / "run"
    with pytest.raises(NotFiniteError, match="the last of 5 in a row"):
        run(compose(folder, "task=toy", "debug=fast", "trainer.max_steps=90", "on_nan=skip",
                    "callbacks.nan_guard.patience=5"))  # fmt: skip
    assert len(list((folder / "nan").iterdir())) == 3
    assert record_of(folder)["steps"] == 7


def test_weights_that_an_update_has_spoilt_are_not_saved(
    compose: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ToyTask, "on_train_batch_end", lambda self, *_: self.color.data.fill_(float("nan")))
    folder = tmp_path / "toy" / "run"
    with pytest.raises(NotFiniteError, match="the weight color is not finite after step 1, and not saved"):
        run(compose(folder, "task=toy", "debug=fast", "trainer.max_steps=1"))
    assert not list((folder / "checkpoints").glob("*.ckpt"))


def test_a_word_that_is_no_policy(compose: Compose, tmp_path: Path) -> None:
    with pytest.raises((UserError, Exception), match="on_nan must be stop or skip, got 'halt'"):
        run(compose(tmp_path / "toy" / "run", "task=toy", "debug=fast", "on_nan=halt"))


def test_large_numbers_are_no_alarm_and_large_batches_not_kept(tmp_path: Path) -> None:
    from rendra_lab.nan_guard import _seem_finite

    assert not _seem_finite((), [torch.full((100,), 1e30)])  # its square is none: looked at again, one by one
    assert _seem_finite([torch.tensor(1.0)], [torch.zeros(0), torch.ones(3, dtype=torch.float64)])
    batch = ToyBatch(torch.zeros(1, 8, 8, 3), torch.zeros(1, 8, 8))
    state = Streams.now()
    nan_evidence.write(tmp_path, 3, ["train/loss"], batch, state, "a: 1\n", max_bytes=100)
    assert nan_evidence.read_batch(tmp_path) is None
    assert "larger than 0.0001 MB" in (tmp_path / "README.txt").read_text()
    nan_evidence.write(tmp_path, 3, ["train/loss"], {"x": object()}, state, "a: 1\n", max_bytes=100)
    assert "holds object" in (tmp_path / "README.txt").read_text()


def test_a_batch_that_names_a_foreign_class_is_refused(tmp_path: Path) -> None:
    for name, message in (("os:system", "may not be a os:system"), ("rendra_lab.report:say", "no kind of batch")):
        torch.save({"record": name, "fields": {}}, tmp_path / "batch.pt")
        with pytest.raises(UserError, match=message):
            nan_evidence.read_batch(tmp_path)


class Rivals(BaseTask):
    """Two weights, two optimizers, each stepped by hand; the second one's gradient fails at its third step."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.second = nn.Parameter(torch.ones(2)), nn.Parameter(torch.ones(2))
        self.automatic_optimization = False

    def predict(self, batch: Any) -> Any:
        return self.first + self.second

    def training_step(self, batch: Any, batch_idx: int) -> None:
        for optimizer, weight, spoilt in zip(
            self.optimizers(), (self.first, self.second), (False, batch_idx == 2), strict=True
        ):
            loss = weight.square().sum() * (float("nan") if spoilt else 1.0)
            self.step_losses = {"train/loss": loss.detach()}
            optimizer.zero_grad()
            self.manual_backward(loss)
            optimizer.step()

    def configure_optimizers(self) -> Any:
        return torch.optim.SGD([self.first], lr=0.1), torch.optim.SGD([self.second], lr=0.1)


def test_each_of_two_optimizers_is_guarded(tmp_path: Path) -> None:
    task, guard = Rivals(), NanGuard("skip")
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = pl.Trainer(max_epochs=1, accelerator="cpu", callbacks=[guard], enable_model_summary=False, **quiet)
    trainer.fit(task, Repeated(torch.zeros(1), 4))
    assert guard.skipped == 1
    assert task.first.tolist() == pytest.approx([0.8**4] * 2)
    assert task.second.tolist() == pytest.approx([0.8**3] * 2)
