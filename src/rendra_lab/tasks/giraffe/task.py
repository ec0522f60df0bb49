"""GIRAFFE: scenes made of objects, learned from pictures without poses, masks or labels.

Niemeyer and Geiger, "GIRAFFE: Representing Scenes as Compositional Generative Neural Feature Fields", CVPR 2021,
arXiv:2011.12100. Shapes and letters: as of `records`.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rendra_lab.adversarial_task import AdversarialTask
from rendra_lab.random_state import stream
from rendra_lab.settings import Count, Fraction
from rendra_lab.tasks.giraffe.generator import Generator
from rendra_lab.tasks.giraffe.records import MadePictures, PictureBatch
from rendra_lab.tasks.giraffe.sample_grids import SampleGrid
from rendra_lab.weight_average import average_of, follow

_SCENES, _NOISE, _EVALUATION = range(3)  # what a stream of random numbers is for


class Giraffe(AdversarialTask[PictureBatch, MadePictures]):
    """A generator of scenes and an adversary that sees their pictures among real ones.

    Training draws its scenes from a stream that follows from seed, step and process alone. What is evaluated and
    shown is made by `averaged`, without noise; the scenes of an evaluation are the same each time.

    Args:
        generator: makes scenes and pictures of them; it is trained.
        grid: draws scenes that stay the same.
        decay: of the average of the generator's weights; 0.999 reaches about a thousand steps back, and before the
            nine thousandth an average of fewer, a ninth of all: weights of the beginning would be smears for long.
        seed: of the scenes.
        **parts: losses, metrics, optimizers, adversary of `AdversarialTask`; the adversary makes logits (B, 1) of
            pictures (B, 3, S, S).

    Attributes:
        averaged: the `Generator` whose weights are the moving average of those of `generator`.
    """

    def __init__(
        self, generator: Generator, grid: SampleGrid, decay: Fraction = 0.999, seed: Count = 0, **parts: Any
    ) -> None:
        super().__init__(**parts)
        self.generator = generator
        self.averaged = average_of(generator)
        self.grid = grid
        self.decay = decay
        self.seed = seed
        self._place = 0  # of a batch in an evaluation

    def predict(self, batch: PictureBatch) -> MadePictures:
        """As many pictures as there are real ones."""
        if not self.training:
            scenes = self.averaged.sample(len(batch.rgb), self._stream(_EVALUATION, self._place))
            return self.averaged(scenes)
        moment = self.global_step, self.turn
        scenes = self.generator.sample(len(batch.rgb), self._stream(_SCENES, *moment))
        return self.generator(scenes, noise=self._stream(_NOISE, *moment, device=self.device))

    def shown(self, prediction: MadePictures, batch: PictureBatch) -> tuple[Tensor, Tensor]:
        """Pictures of scenes that were never there, and of those that were."""
        return prediction.rgb, batch.rgb

    def verdicts(self, fake: Tensor, real: Tensor) -> dict[str, Tensor]:
        """Mean logits: equal where the adversary is at a loss, far apart where the generator is."""
        return {"score_made": fake.mean(), "score_real": real.mean()}

    def follow(self) -> None:
        """The average follows; the less far back it reaches the fewer steps there were."""
        steps = self.global_step
        follow(self.averaged, self.generator, min(self.decay, (1 + steps) / (10 + steps)))

    def panels(self, prediction: MadePictures, batch: PictureBatch) -> dict[str, Tensor]:
        """The scenes of the grid, and real pictures."""
        return {**self.grid.drawn(self.averaged), "real": batch.rgb[: self.grid.samples].movedim(1, -1)}

    def on_validation_batch_start(self, batch: PictureBatch, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Lightning's hook: every batch has scenes of its own."""
        self._place = batch_idx

    def on_test_batch_start(self, batch: PictureBatch, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Lightning's hook: every batch has scenes of its own."""
        self._place = batch_idx

    def _stream(self, *key: int, device: torch.device | str = "cpu") -> torch.Generator:
        return stream(self.seed, self.global_rank, *key, device=device)
