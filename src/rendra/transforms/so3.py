"""The group of rotations and its Lie algebra. Matrices act on column vectors; N is the batch."""

import warnings

import torch
from torch import Tensor

from rendra.transforms.math import acos_linear_extrapolation
from rendra.transforms.rotation_conversions import axis_angle_to_matrix, matrix_to_axis_angle

HAT_INV_SKEW_SYMMETRIC_TOL = 1e-5


def so3_relative_angle(
    R1: Tensor, R2: Tensor, cos_angle: bool = False, cos_bound: float = 1e-4, eps: float = 1e-4
) -> Tensor:
    """Angle (N,) in radians of R1 R2ᵀ, for rotation matrices (N, 3, 3); see `so3_rotation_angle`."""
    return so3_rotation_angle(R1 @ R2.transpose(-1, -2), cos_angle=cos_angle, cos_bound=cos_bound, eps=eps)


def so3_rotation_angle(R: Tensor, eps: float = 1e-4, cos_angle: bool = False, cos_bound: float = 1e-4) -> Tensor:
    """Angles (N,) in radians of rotation matrices (N, 3, 3): acos((trace - 1) / 2).

    Args:
        R: rotation matrices.
        eps: how far the trace may leave [-1, 3].
        cos_angle: return the cosine instead, which is cheap and has no singular gradient.
        cos_bound: acos is continued by its tangent where the cosine is this close to -1 or 1, so that
            gradients stay finite (angles below 0.014 rad are then off by up to 0.007); 0 takes plain acos.
            For exact small angles take the norm of `so3_log_map`.

    Raises:
        ValueError: for a wrong shape, or a trace that no rotation has.
    """
    if R.dim() != 3 or R.shape[1:] != (3, 3):
        raise ValueError(f"Input has to be a batch of 3x3 Tensors; got shape {tuple(R.shape)}")
    trace = R.diagonal(dim1=-2, dim2=-1).sum(-1)
    if ((trace < -1.0 - eps) | (trace > 3.0 + eps)).any():
        raise ValueError(
            f"A matrix has trace outside valid range [-1-eps, 3+eps]: got {trace.min():.6g} to {trace.max():.6g}"
        )
    cosine = 0.5 * (trace - 1.0)
    if cos_angle:
        return cosine
    if cos_bound > 0.0:
        return acos_linear_extrapolation(cosine, (cos_bound - 1.0, 1.0 - cos_bound))
    return torch.acos(cosine)


def so3_exp_map(log_rot: Tensor, eps: float = 0.0001) -> Tensor:
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3), axis times angle in radians.

    `eps` is PyTorch3D's guard against division by zero; the formula here needs none, and it is ignored.

    Raises:
        ValueError: if the input is not (N, 3).
    """
    if log_rot.dim() != 2 or log_rot.shape[1] != 3:
        raise ValueError(f"Input tensor shape has to be Nx3; got {tuple(log_rot.shape)}")
    return axis_angle_to_matrix(log_rot)


def so3_exponential_map(log_rot: Tensor, eps: float = 0.0001) -> Tensor:
    """The old name of `so3_exp_map`."""
    warnings.warn(
        "so3_exponential_map is deprecated, use so3_exp_map instead", PendingDeprecationWarning, stacklevel=2
    )
    return so3_exp_map(log_rot, eps)


def so3_log_map(R: Tensor, eps: float = 0.0001, cos_bound: float = 1e-4) -> Tensor:
    """Rotation vectors (N, 3), of length in [0, pi], of rotation matrices (N, 3, 3).

    Values and gradients are right at every angle; at pi the sign of the axis is arbitrary. `eps` and
    `cos_bound` are PyTorch3D's, not needed and ignored.

    Raises:
        ValueError: if the input is not (N, 3, 3).
    """
    if R.dim() != 3 or R.shape[1:] != (3, 3):
        raise ValueError(f"Input has to be a batch of 3x3 Tensors; got shape {tuple(R.shape)}")
    return matrix_to_axis_angle(R)


def hat(v: Tensor) -> Tensor:
    """Skew-symmetric matrices (..., 3, 3) of vectors (..., 3): the cross product v × u is `hat` of v times u.

    Raises:
        ValueError: if the vectors do not have three coordinates.
    """
    if v.dim() == 0 or v.shape[-1] != 3:
        raise ValueError(f"Input vectors have to be 3-dimensional; got shape {tuple(v.shape)}")
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3))


def hat_inv(h: Tensor) -> Tensor:
    """The vectors (..., 3) whose `hat` are the skew-symmetric matrices (..., 3, 3).

    Raises:
        ValueError: for a wrong shape, or if an entry of h + hᵀ exceeds 1e-5.
    """
    if h.shape[-2:] != (3, 3):
        raise ValueError(f"Input has to be a batch of 3x3 Tensors; got shape {tuple(h.shape)}")
    if ((h + h.transpose(-1, -2)).abs() > HAT_INV_SKEW_SYMMETRIC_TOL).any():
        raise ValueError("One of input matrices is not skew-symmetric.")
    return torch.stack((h[..., 2, 1], h[..., 0, 2], h[..., 1, 0]), dim=-1)
