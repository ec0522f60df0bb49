"""Mask R-CNN: what stands in a picture, where, and which pixels it covers.

He, Gkioxari, Dollar and Girshick, "Mask R-CNN", ICCV 2017, arXiv:1703.06870. Shapes and units: as of `PhotoBatch`.
"""

from rendra_lab.detection.detector_task import DetectorTask


class MaskRCNN(DetectorTask):
    """A two-stage detector with a head for masks."""
