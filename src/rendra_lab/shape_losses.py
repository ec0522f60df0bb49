"""What voxels and refined meshes are judged by in training.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 3.1 (mesh losses). Losses of meshes are
means over those that are valid; the paper's stages count on average for ShapeNet, and as a sum for Pix3D.
Units: of the vertices, squared.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, cast

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.loss import chamfer_distance, mesh_edge_loss
from rendra.ops import sample_points_from_meshes
from rendra.structures import Meshes
from rendra_lab.detection.records import CellVerdicts, MeshVerdicts
from rendra_lab.settings import Positive

OverStages = Literal["mean", "sum"]


def voxel_cross_entropy(verdicts: CellVerdicts) -> Tensor:
    """The mean of binary cross entropies of all cells: a scalar, 0 where there are none."""
    total = F.binary_cross_entropy_with_logits(verdicts.logits, verdicts.targets, reduction="sum")
    return total / max(verdicts.logits.numel(), 1)


def stage_chamfer(verdicts: MeshVerdicts, samples: Positive = 5000, over_stages: OverStages = "mean") -> Tensor:
    """Mean squared distances between points of each surface and the nearest of the other's, both ways summed.

    Args:
        verdicts: the stages, and points of the true surfaces.
        samples: points on each predicted surface; of each true one as many take part, or all if there are fewer.
        over_stages: mean or sum.

    Returns:
        A scalar; 0 where no mesh is valid.
    """

    def loss(meshes: Meshes, points: Tensor, _: Tensor) -> Tensor:
        return cast(Tensor, chamfer_distance(sample_points_from_meshes(meshes, samples), points)[0])

    return _over_stages(verdicts, samples, over_stages, loss)


def stage_normals(verdicts: MeshVerdicts, samples: Positive = 5000, over_stages: OverStages = "mean") -> Tensor:
    """Mean 1 - |cos| between the normals of points and of the nearest of the other surface, both ways summed.

    Arguments and result as of `stage_chamfer`; without unit.
    """

    def loss(meshes: Meshes, points: Tensor, normals: Tensor) -> Tensor:
        drawn, drawn_normals = sample_points_from_meshes(meshes, samples, return_normals=True)
        return cast(Tensor, chamfer_distance(drawn, points, x_normals=drawn_normals, y_normals=normals)[1])

    return _over_stages(verdicts, samples, over_stages, loss)


def stage_edges(verdicts: MeshVerdicts, over_stages: OverStages = "mean") -> Tensor:
    """The mean squared length of edges: a scalar; 0 where no mesh is valid."""
    return _over_stages(verdicts, 1, over_stages, lambda meshes, *_: mesh_edge_loss(meshes))


def _over_stages(
    verdicts: MeshVerdicts, samples: int, over_stages: OverStages, loss: Callable[[Meshes, Tensor, Tensor], Tensor]
) -> Tensor:
    """The loss of valid meshes, added up or averaged over the stages; with a gradient even where there are none."""
    if over_stages not in ("mean", "sum"):
        raise ValueError(f"stages are combined by mean or sum, got {over_stages!r}")
    valid = verdicts.is_valid.nonzero()[:, 0]
    if not len(valid):
        return cast(Tensor, sum(stage.verts_packed().sum() * 0 for stage in verdicts.stages))
    chosen = torch.randperm(verdicts.points.shape[1], device=valid.device)[:samples]
    points, normals = (
        truth.index_select(0, valid).index_select(1, chosen) for truth in (verdicts.points, verdicts.normals)
    )
    kept = valid.tolist()
    stages = [stage if len(kept) == len(stage) else stage[kept] for stage in verdicts.stages]
    total = torch.stack([loss(stage, points, normals) for stage in stages]).sum()
    return total / len(stages) if over_stages == "mean" else total
