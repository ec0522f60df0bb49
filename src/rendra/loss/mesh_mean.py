"""The mean that the losses on meshes share: first within each mesh, then over all of them."""

import torch
from torch import Tensor

from rendra.structures.meshes import Meshes


def mean_over_meshes(values: Tensor, owner: Tensor, num_meshes: int) -> Tensor:
    """Mean over N meshes of the mean of each mesh's values; a mesh without a value counts as 0.

    Args:
        values: (M,) of all meshes.
        owner: (M,) int64, the mesh of each.
        num_meshes: N, at least 1.

    Returns:
        A scalar.
    """
    if num_meshes == 1:
        return values.sum() / max(len(values), 1)
    counts = torch.bincount(owner, minlength=num_meshes)
    return (values / counts[owner]).sum() / num_meshes


def nothing(meshes: Meshes) -> Tensor:
    """The loss of meshes without a face: zero, with a gradient to ask for. (1,)"""
    return torch.zeros(1, dtype=meshes.verts_packed().dtype, device=meshes.device, requires_grad=True)
