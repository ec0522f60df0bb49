"""What tasks have in common whose network is a detector in two stages."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from torch import Tensor

from rendra_lab.base_task import Task, with_rate
from rendra_lab.detection.drawing import panels_of
from rendra_lab.detection.records import DetectorPrediction, PhotoBatch
from rendra_lab.detection.two_stage_detector import TwoStageDetector
from rendra_lab.settings import Size


class DetectorTask(Task[PhotoBatch, DetectorPrediction]):
    """A detector that learns from annotated photographs.

    Args:
        detector: finds what stands in pictures.
        backbone_lr: learning rate of the backbone, which may have learned elsewhere; None: the optimizer's.
        **parts: losses, optimizer, metrics and scheduler of `Task`.
    """

    def __init__(self, detector: TwoStageDetector, backbone_lr: Size | None = None, **parts: Any) -> None:
        super().__init__(**parts)
        self.detector = detector
        self.backbone_lr = backbone_lr

    def predict(self, batch: PhotoBatch) -> DetectorPrediction:
        """In training mode what all heads say beside the truth, in evaluation mode detections."""
        return self.detector(batch)

    def panels(self, prediction: DetectorPrediction, batch: PhotoBatch) -> dict[str, Tensor]:
        """What was found with a score of at least 0.5, and what is annotated."""
        return {} if prediction.detections is None else panels_of(batch, prediction.detections)

    def parameter_groups(self) -> Iterable[Any]:
        """All that learns; the backbone apart if it has a rate of its own."""
        return with_rate(super().parameter_groups(), self.detector.backbone, self.backbone_lr)
