"""Mesh R-CNN: what stands in a photograph, where, and the whole mesh of each thing, hidden sides too.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 4.2 (the Pix3D experiments). Shapes, axes
and units: as of `PhotoBatch` and `Detections`.
"""

from rendra_lab.detection.detector_task import DetectorTask


class MeshRCNN(DetectorTask):
    """A two-stage detector whose heads tell masks, depth extents, voxels and meshes: `ShapeHeads` is among them."""
