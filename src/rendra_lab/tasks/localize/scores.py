"""How far an estimated displacement is from the true one. Shapes: (1, 3) both, in the units of the meshes."""

from __future__ import annotations

from torch import Tensor


def displacement_error(displacement: Tensor, truth: Tensor) -> Tensor:
    """The Euclidean distance of the estimate from the truth."""
    return (displacement - truth).norm(dim=1).mean()


def estimated_coordinate(displacement: Tensor, axis: int) -> Tensor:
    """One coordinate of the estimate: axis 0, 1 or 2."""
    return displacement[:, axis].mean()


def true_coordinate(displacement: Tensor, truth: Tensor, axis: int) -> Tensor:
    """One coordinate of the truth, to stand beside the estimate's."""
    return truth[:, axis].mean()
