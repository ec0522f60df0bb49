"""SynSin: a new view from a single picture, learned from pairs of pictures alone.

Wiles, Gkioxari, Szeliski and Johnson, "SynSin: End-to-end View Synthesis from a Single Image", CVPR 2020,
arXiv:1912.08804. Shapes and units: as of `PairBatch`.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from rendra_lab.adversarial_task import AdversarialTask
from rendra_lab.errors import UserError
from rendra_lab.tasks.synsin.records import PairBatch, ViewPrediction
from rendra_lab.tasks.synsin.report import log_depth_image


class SynSin(AdversarialTask[PairBatch, ViewPrediction]):
    """Features and depth of a picture, splatted into another camera, and painted anew.

    Args:
        encoder: pictures (B, 3, H, W) to features (B, C, H, W).
        depth: pictures to depth (B, 1, H, W); None takes the true one, which tells how much depth is worth.
        renderer: splats features; see `PointSplatter`.
        decoder: splatted features to pictures.
        **parts: losses, metrics, optimizers, adversary of `AdversarialTask`.
    """

    def __init__(
        self, encoder: nn.Module, depth: nn.Module | None, renderer: nn.Module, decoder: nn.Module, **parts: Any
    ) -> None:
        super().__init__(**parts)
        self.encoder = encoder
        self.depth = depth
        self.renderer = renderer
        self.decoder = decoder

    def predict(self, batch: PairBatch) -> ViewPrediction:
        """The input, seen by the target's camera."""
        depth = self._depth(batch)
        features, opacity = self.renderer(
            self.encoder(batch.input), depth, batch.intrinsics, batch.target_intrinsics, batch.input_to_target
        )
        return ViewPrediction(self.decoder(features), depth, features, opacity)

    def shown(self, prediction: ViewPrediction, batch: PairBatch) -> tuple[Tensor, Tensor]:
        """The new views, and the pictures that were taken there."""
        return prediction.rgb, batch.target

    def panels(self, prediction: ViewPrediction, batch: PairBatch) -> dict[str, Tensor]:
        """Input, new view, target, and the depth of the input."""
        pictures = {"input": batch.input, "output": prediction.rgb, "target": batch.target}
        shown = {name: picture.movedim(1, -1) for name, picture in pictures.items()}
        return {**shown, "depth": log_depth_image(prediction.depth[:, 0])}

    def _depth(self, batch: PairBatch) -> Tensor:
        if self.depth is not None:
            return self.depth(batch.input)
        if batch.truth is None:
            raise UserError("module.depth=null takes the true depth: the data must know it, and tell it to training "
                            "(data.truth_in_training=true)")  # fmt: skip
        return batch.truth.depth
