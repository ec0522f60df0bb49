"""The losses of the heads for depth and meshes.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 3.3 and 4.2, with the weights of the
published code. That of voxels is the one of masks.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.loss import chamfer_distance, mesh_edge_loss
from rendra.ops import sample_points_from_meshes
from rendra.structures import Meshes
from rendra_lab.detection.records import DepthVerdicts, MeshVerdicts
from rendra_lab.settings import Amount


def depth(verdicts: DepthVerdicts) -> Tensor:
    """Smooth L1 (beta 1) of the logarithms, their mean over regions; 0 without any: a scalar."""
    errors = F.smooth_l1_loss(verdicts.values, verdicts.targets, reduction="sum")
    return errors / max(len(verdicts.values), 1)


def mesh_stages(verdicts: MeshVerdicts, chamfer: Amount = 1.0, normal: Amount = 0.1, edge: Amount = 1.0) -> Tensor:
    """Distance, disagreement of normals and lengths of edges of all stages, weighted and summed: a scalar.

    Each is a mean over the meshes that are valid; 0 where none is, with a gradient of zeros for every weight of the
    head. As many points are drawn on the meshes as of the true surfaces.

    Args:
        verdicts: meshes and truth.
        chamfer: weight of the mean squared distances, both ways added.
        normal: weight of 1 - |cos| between normals of nearest points, both ways added.
        edge: weight of the mean squared length of edges.
    """
    valid = verdicts.is_valid.nonzero()[:, 0]
    if not len(valid):
        return torch.stack([0.0 * stage.verts_packed().sum() for stage in verdicts.stages]).sum()
    points, normals = (each.index_select(0, valid) for each in (verdicts.points, verdicts.normals))
    weights = (chamfer, normal, edge)
    stages = [_only(stage, valid) for stage in verdicts.stages]
    return torch.stack([_one_stage(stage, points, normals, weights) for stage in stages]).sum()


def _only(meshes: Meshes, chosen: Tensor) -> Meshes:
    return meshes if len(chosen) == len(meshes) else meshes[chosen]


def _one_stage(meshes: Meshes, points: Tensor, normals: Tensor, weights: tuple[float, float, float]) -> Tensor:
    drawn, turned = sample_points_from_meshes(meshes, points.shape[1], return_normals=True)
    distance, disagreement = chamfer_distance(drawn, points, x_normals=turned, y_normals=normals)
    terms = (distance, disagreement, mesh_edge_loss(meshes))
    return torch.stack([weight * torch.as_tensor(term) for weight, term in zip(weights, terms, strict=True)]).sum()
