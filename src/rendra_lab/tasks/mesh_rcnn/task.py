"""Mesh R-CNN: what stands in a photograph, where, and the whole mesh of each thing, hidden sides too.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 4.2 (the Pix3D experiments). Shapes, axes
and units: as of `PhotoBatch` and `Detections`.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from rendra_lab.base_task import Task
from rendra_lab.detection.drawing import panels_of
from rendra_lab.detection.records import DetectorPrediction, PhotoBatch
from rendra_lab.detection.two_stage_detector import TwoStageDetector


class MeshRCNN(Task[PhotoBatch, DetectorPrediction]):
    """A detector in two stages whose heads tell masks, depth extents, voxels and meshes too.

    Args:
        detector: with `ShapeHeads` among its heads.
        **parts: losses, metrics, optimizer, scheduler of `Task`.
    """

    def __init__(self, detector: TwoStageDetector, **parts: Any) -> None:
        super().__init__(**parts)
        self.detector = detector

    def predict(self, batch: PhotoBatch) -> DetectorPrediction:
        """Detections; in training what all heads say, beside the truth."""
        return self.detector(batch)

    def panels(self, prediction: DetectorPrediction, batch: PhotoBatch) -> dict[str, Tensor]:
        """What was found with a score of at least 0.5, and what is annotated."""
        return {} if prediction.detections is None else panels_of(batch, prediction.detections)
