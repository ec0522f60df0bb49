"""A generator that makes the same picture again and again is noticed while it trains.

Two numbers, each of made pictures as a share of what it is among as many real ones: the median distance of two,
which falls when all become alike, and the median distance to the nearest other, which falls also when there are a few
kinds. Distances are those of coarse pictures, so that noise and sharp edges, which differ from one copy to the next,
hide nothing.
"""

from __future__ import annotations

from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor
from torch.nn import functional as F

from rendra_lab import report
from rendra_lab.callbacks import every
from rendra_lab.random_state import stream
from rendra_lab.settings import Count, Fraction, Positive
from rendra_lab.tasks.giraffe.records import PictureBatch
from rendra_lab.tasks.giraffe.task import Giraffe

_COARSE_PX = 16
_FEWEST = 8  # pictures that say something
_RECOVERED = 1.5  # times the share below which it is said: then it is over


class ModeCollapseWatcher(Callback):
    """Compares samples with real pictures during the fit, and says when they become too much alike.

    Logs `train/variety_pairs` and `train/variety_nearest`, 1 where samples are as different as real pictures. A
    generator of which one of them falls below a share is said to collapse, and said to have recovered when both are
    well above it again.

    Args:
        every_n_steps: interval; 0 never looks.
        from_step: before it nothing is said: all generators begin with pictures that are alike.
        samples: pictures of either kind that are compared.
        share: of the real pictures' distances.
        seed: of the scenes that are drawn, the same each time.
    """

    def __init__(
        self,
        every_n_steps: Count = 100,
        from_step: Count = 1000,
        samples: Positive = 64,
        share: Fraction = 0.25,
        seed: Count = 0,
    ) -> None:
        self.every_n_steps = every_n_steps
        self.from_step = from_step
        self.samples = samples
        self.share = share
        self.seed = seed
        self._real: list[Tensor] = []
        self._since: int | None = None  # the step at which it was said

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Keeps the newest real pictures, coarsely."""
        if self.every_n_steps and isinstance(batch, PictureBatch):
            newest = torch.cat([*self._real, coarse(batch.rgb)])
            self._real = [newest[-self.samples :]]

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Looks, where it is due."""
        if not isinstance(pl_module, Giraffe) or not every(trainer.global_step, self.every_n_steps):
            return
        real = torch.cat([each.unique(dim=0) for each in self._real] or [torch.zeros(0)])
        if len(real) < _FEWEST:
            return
        pairs, nearest = self.varieties(pl_module, real)
        pl_module.log("train/variety_pairs", pairs, rank_zero_only=True)
        pl_module.log("train/variety_nearest", nearest, rank_zero_only=True)
        if trainer.is_global_zero:
            self._judge(trainer.global_step, pairs, nearest)

    @torch.no_grad()
    def varieties(self, task: Giraffe, real: Tensor) -> tuple[float, float]:
        """Both numbers, of the trained generator's samples beside as many different real pictures as `coarse`."""
        scenes = task.generator.sample(len(real), stream(self.seed))
        made = distances(coarse(task.generator(scenes).rgb))
        true = distances(real)
        return _ratio(made[0], true[0]), _ratio(made[1], true[1])

    def state_dict(self) -> dict[str, Any]:
        """For the checkpoint."""
        return {"since": self._since, "real": self._real}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """From a checkpoint."""
        self._since, self._real = state_dict["since"], state_dict["real"]

    def _judge(self, step: int, pairs: float, nearest: float) -> None:
        least = min(pairs, nearest)
        numbers = (
            f"two samples differ {pairs:.2f} times as much as two real pictures, and from their nearest others "
            f"{nearest:.2f} times as much"
        )
        if self._since is None and step >= self.from_step and least < self.share:
            self._since = step
            report.say(
                f"step {step}: mode collapse: {numbers}; look at images/. A greater adversary_loss.r1.weight, a "
                "lower optimizer.lr, or going on from an earlier checkpoint (ckpt_path) may help"
            )
        elif self._since is not None and least > _RECOVERED * self.share:
            report.say(f"step {step}: the mode collapse of step {self._since} is over: {numbers}")
            self._since = None


def coarse(pictures: Tensor) -> Tensor:
    """Means of 16 x 16 cells of pictures (B, 3, S, S): (B, 768), on the CPU."""
    return F.adaptive_avg_pool2d(pictures.detach().float(), _COARSE_PX).flatten(1).cpu()


def distances(pictures: Tensor) -> tuple[float, float]:
    """The median distance of two of (B, D) vectors, and the median distance to the nearest other one."""
    between = torch.cdist(pictures, pictures)
    others = between[~torch.eye(len(pictures), dtype=torch.bool)].reshape(len(pictures), -1)
    return float(others.median()), float(others.amin(1).median())


def _ratio(made: float, real: float) -> float:
    """1 where nothing differs, as among copies of one real picture."""
    return made / real if real > 0 else 1.0
