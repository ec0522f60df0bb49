"""The loss of the head for depth; those of voxels and meshes are in `rendra_lab.shape_losses`."""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional as F

from rendra_lab.detection.records import DepthVerdicts


def depth_extent(verdicts: DepthVerdicts) -> Tensor:
    """Smooth L1 (beta 1) of the logarithms, the mean over regions; 0 without any: a scalar.

    Source: the published code of Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739.
    """
    errors = F.smooth_l1_loss(verdicts.values, verdicts.targets, reduction="sum")
    return errors / max(len(verdicts.values), 1)
