"""Mask R-CNN: what stands in a picture, where, and which pixels it covers.

He, Gkioxari, Dollar and Girshick, "Mask R-CNN", ICCV 2017, arXiv:1703.06870. Shapes and units: as of `PhotoBatch`.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from rendra_lab.base_task import Task
from rendra_lab.detection.drawing import panels_of
from rendra_lab.detection.records import DetectorPrediction, PhotoBatch
from rendra_lab.detection.two_stage_detector import TwoStageDetector


class MaskRCNN(Task[PhotoBatch, DetectorPrediction]):
    """A two-stage detector with a head for masks.

    Args:
        detector: finds what stands in pictures.
        **parts: losses, optimizer, metrics and scheduler of `Task`.
    """

    def __init__(self, detector: TwoStageDetector, **parts: Any) -> None:
        super().__init__(**parts)
        self.detector = detector

    def predict(self, batch: PhotoBatch) -> DetectorPrediction:
        """In training mode verdicts for the losses, in evaluation mode detections."""
        return self.detector(batch)

    def panels(self, prediction: DetectorPrediction, batch: PhotoBatch) -> dict[str, Tensor]:
        """What was found with a score of at least 0.5, and what is annotated."""
        return {} if prediction.detections is None else panels_of(batch, prediction.detections)
