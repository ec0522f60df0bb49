"""
Eigenvectors and nearest rotations whose derivatives stay finite where eigenvalues or singular values coincide.

Those of `torch.linalg.eigh` and `svd` divide by the difference of two eigenvalues. Here a pair that is equal to
working precision contributes nothing: its eigenvectors are arbitrary, and a loss that is well defined does not
depend on them.
"""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


class _SymmetricEigen(torch.autograd.Function):
    """With A = V diag(l) V^T: dl_i = v_i^T dA v_i, dv_j = sum_i v_i (v_i^T dA v_j) / (l_j - l_i)."""

    @staticmethod
    def forward(ctx: Any, matrices: Tensor) -> tuple[Tensor, Tensor]:
        values, vectors = torch.linalg.eigh(matrices)
        ctx.save_for_backward(values, vectors)
        return values, vectors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_values: Tensor, grad_vectors: Tensor) -> Tensor:
        values, vectors = ctx.saved_tensors
        gaps = values[..., None, :] - values[..., :, None]
        inner = vectors.mT @ grad_vectors * _reciprocal(gaps, values.abs().amax(-1))
        inner = inner + torch.diag_embed(grad_values)
        return vectors @ ((inner + inner.mT) / 2) @ vectors.mT


def symmetric_eigen(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """
    Eigenvalues and eigenvectors of symmetric matrices, once differentiable.

    Args:
        matrices: (..., D, D), symmetric; the derivative is symmetric too.

    Returns:
        Eigenvalues (..., D), ascending, and the unit eigenvectors of each in the columns of (..., D, D). Signs,
        and directions where eigenvalues coincide, are arbitrary.
    """
    return _SymmetricEigen.apply(matrices)


class _NearestRotation(torch.autograd.Function):
    """
    With M = U diag(s) V^T, R = U diag(d) V^T and h = d s, R^T M = V diag(h) V^T is symmetric.

    Differentiating M = R H gives R^T dM - dM^T R = W H + H W with the antisymmetric W = R^T dR: in the basis V
    an equation for each entry, W_ij = (V^T (R^T dM - dM^T R) V)_ij / (h_i + h_j). Sums of singular values vanish
    only where the rotation is ambiguous, not where two of them are equal.
    """

    @staticmethod
    def forward(ctx: Any, matrices: Tensor, allow_reflection: bool) -> tuple[Tensor, Tensor]:
        left, values, right = torch.linalg.svd(matrices)
        signs = torch.ones_like(values)
        if not allow_reflection:
            signs[..., -1] = torch.linalg.det(left @ right).sign()
        rotations = left * signs[..., None, :] @ right
        stretch = values * signs
        ctx.save_for_backward(rotations, right.mT, stretch)
        ctx.mark_non_differentiable(stretch)
        return rotations, stretch

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Tensor, None]:
        rotations, basis, stretch = ctx.saved_tensors
        turn = rotations.mT @ grad
        turn = basis.mT @ (turn - turn.mT) @ basis
        turn = turn * _reciprocal(stretch[..., None, :] + stretch[..., :, None], stretch.abs().amax(-1))
        return rotations @ basis @ turn @ basis.mT, None


def nearest_rotation(matrices: Tensor, allow_reflection: bool = False) -> tuple[Tensor, Tensor]:
    """
    The rotation R that maximises tr(R^T M): the solution of the orthogonal Procrustes problem, once differentiable.

    Args:
        matrices: M, (..., D, D).
        allow_reflection: also accept a determinant of -1.

    Returns:
        R (..., D, D), and the eigenvalues (..., D) of R^T M, descending but for the last one, which is negative
        where a reflection would have been nearer; they carry no gradient.
    """
    return _NearestRotation.apply(matrices, allow_reflection)


def _reciprocal(gaps: Tensor, scale: Tensor) -> Tensor:
    """1 / gaps, and 0 for what vanishes at working precision beside `scale`."""
    vanishing = gaps.abs() <= 4 * torch.finfo(gaps.dtype).eps * scale[..., None, None]
    return gaps.masked_fill(vanishing, torch.inf).reciprocal()
