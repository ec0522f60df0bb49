"""The loader of fits: as long as it says, and resumable."""

from pathlib import Path

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer

from rendra_lab.data.repeated import Repeated, StepByStep


def test_it_yields_the_same_batch_as_often_as_it_says() -> None:
    batch = object()
    loader = Repeated(batch, 3)
    for _ in range(2):
        given = list(loader)
        assert len(given) == len(loader) == 3
        assert all(one is batch for one in given)
    with pytest.raises(ValueError, match="times=0"):
        Repeated(batch, 0)


class Numbered(StepByStep[int]):
    """What a step gets is its number."""

    def __len__(self) -> int:
        return 5

    def batch_of(self, step: int) -> int:
        return step


def test_steps_are_counted_through_all_epochs() -> None:
    loader = Numbered()
    assert [*loader, *loader] == list(range(10))
    resumed = Numbered()
    resumed.load_state_dict(loader.state_dict())
    assert list(resumed) == [10, 11, 12, 13, 14]


class Seen(LightningModule):
    """Writes down what each of its steps got."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.steps: list[int] = []

    def training_step(self, batch: int, batch_idx: int) -> torch.Tensor:
        self.steps.append(batch)
        return self.weight.sum()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


@pytest.mark.parametrize("limit", [1.0, 3])
@pytest.mark.parametrize("stop", [2, 3, 5, 6])
def test_a_resumed_fit_goes_on_with_the_next_step(limit: float, stop: int, tmp_path: Path) -> None:
    """Wherever in its epochs it was stopped, and also where these are cut short."""

    def fit(steps: int, ckpt_path: Path | None = None) -> list[int]:
        quiet = dict.fromkeys(
            ("logger", "enable_progress_bar", "enable_model_summary", "enable_checkpointing"), False
        )
        trainer = Trainer(accelerator="cpu", max_steps=steps, max_epochs=-1, limit_train_batches=limit, **quiet)
        task = Seen()
        trainer.fit(task, Numbered(), ckpt_path=None if ckpt_path is None else str(ckpt_path))
        trainer.save_checkpoint(tmp_path / "last.ckpt")
        return task.steps

    assert fit(stop) + fit(12, tmp_path / "last.ckpt") == list(range(12))
