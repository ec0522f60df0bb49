"""The group of rigid motions and its Lie algebra.

A logarithm (N, 6) is [log_translation, log_rotation]. A motion (N, 4, 4) acts on row vectors, [x, 1] M, so
its rotation block is the TRANSPOSE of `so3_exp_map(log_rotation)` and its translation is the last row. The
formulas are those of Eade, "Lie Groups for 2D and 3D Transformations", section 3.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from rendra.transforms.math import cotangent_defect_ratio, sine_defect_ratio, versine_ratio
from rendra.transforms.so3 import so3_exp_map, so3_log_map


def se3_exp_map(log_transform: Tensor, eps: float = 1e-4) -> Tensor:
    """Rigid motions (N, 4, 4) of their logarithms (N, 6).

    t = V log_translation with V = I + (1-cos)/theta² hat + (theta-sin)/theta³ hat². `eps` is PyTorch3D's
    guard against division by zero; it is not needed here and ignored.

    Raises:
        ValueError: if the input is not (N, 6).
    """
    if log_transform.dim() != 2 or log_transform.shape[1] != 6:
        raise ValueError(f"Expected input to be of shape Nx6; got {tuple(log_transform.shape)}")
    shift, spin = log_transform[:, :3], log_transform[:, 3:]
    squared = spin.square().sum(-1, keepdim=True)
    once = torch.linalg.cross(spin, shift)
    twice = torch.linalg.cross(spin, once)
    translation = shift + versine_ratio(squared) * once + sine_defect_ratio(squared) * twice
    return affine_matrix(so3_exp_map(spin).transpose(1, 2), translation)


def se3_log_map(transform: Tensor, eps: float = 1e-4, cos_bound: float = 1e-4) -> Tensor:
    """Logarithms (N, 6) of rigid motions (N, 4, 4); the rotation part has a length in [0, pi].

    The inverse of V is applied in closed form, V⁻¹ = I - hat/2 + (1 - theta/2 cot(theta/2))/theta² hat²,
    which has no singularity up to pi. `eps` and `cos_bound` are PyTorch3D's, not needed and ignored.

    Raises:
        ValueError: for a wrong shape, or if the last column is not (0, 0, 0, ·).
    """
    if transform.dim() != 3 or transform.shape[1:] != (4, 4):
        raise ValueError(f"Input tensor shape has to be Nx4x4; got {tuple(transform.shape)}")
    if (transform[:, :3, 3].abs() > 1e-8).any():
        raise ValueError("All elements of `transform[:, :3, 3]` should be 0.")
    translation = transform[:, 3, :3]
    spin = so3_log_map(transform[:, :3, :3].transpose(1, 2))
    once = torch.linalg.cross(spin, translation)
    twice = torch.linalg.cross(spin, once)
    bend = cotangent_defect_ratio(spin.square().sum(-1, keepdim=True))
    return torch.cat((translation - 0.5 * once + bend * twice, spin), dim=-1)


def affine_matrix(linear: Tensor, translation: Tensor) -> Tensor:
    """Matrices (N, 4, 4) of x · linear + translation on row vectors, of (N, 3, 3) and (N, 3).

    A batch of 1 broadcasts, and the wider dtype wins.
    """
    upper, last = F.pad(linear, (0, 1)), F.pad(translation, (0, 1), value=1.0)[:, None]
    if upper.shape[0] != last.shape[0]:
        n = upper.shape[0] if last.shape[0] == 1 else last.shape[0]
        upper, last = upper.expand(n, 3, 4), last.expand(n, 1, 4)
    return torch.cat((upper, last), dim=1)
