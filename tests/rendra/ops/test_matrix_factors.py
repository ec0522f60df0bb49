"""Factors reproduce their matrix, and derivatives hold where those of torch are infinite."""

import pytest
import torch
from assertions import assert_close, assert_finite
from torch import Tensor

from rendra.ops.matrix_factors import nearest_rotation, symmetric_eigen
from rendra.transforms import random_rotations


def symmetric(n: int, size: int = 3) -> Tensor:
    matrices = torch.randn(n, size, size, dtype=torch.float64)
    return matrices + matrices.mT


def test_eigenvectors_rebuild_the_matrix() -> None:
    matrices = symmetric(20)
    values, vectors = symmetric_eigen(matrices)
    assert_close(vectors * values[:, None] @ vectors.mT, matrices, atol=1e-12)
    assert (values.diff(dim=1) >= 0).all()


def test_derivatives_of_eigenvectors() -> None:
    matrices = symmetric(3).requires_grad_()
    assert torch.autograd.gradcheck(lambda m: symmetric_eigen((m + m.mT) / 2)[0], matrices)
    # squares: LAPACK is free to pick the sign
    assert torch.autograd.gradcheck(lambda m: symmetric_eigen((m + m.mT) / 2)[1].square(), matrices)


@pytest.mark.parametrize("diagonal", [[1.0, 1, 2], [3, 3, 3], [0, 0, 0]], ids=str)
def test_derivatives_are_finite_though_eigenvalues_coincide(diagonal: list[float]) -> None:
    matrix = torch.diag(torch.tensor(diagonal, dtype=torch.float64)).requires_grad_()
    values, vectors = symmetric_eigen(matrix)
    (grad,) = torch.autograd.grad((vectors.sum() + values.sum()), matrix)
    assert_finite(grad)
    (trace,) = torch.autograd.grad(symmetric_eigen(matrix)[0].sum(), matrix)
    assert_close(trace, torch.eye(3), atol=1e-12)  # the trace is smooth everywhere


def test_a_rotation_is_its_own_nearest() -> None:
    rotations = random_rotations(10, dtype=torch.float64)
    stretched = rotations @ torch.diag(torch.tensor([3.0, 2, 0.5], dtype=torch.float64))
    found, stretch = nearest_rotation(stretched)
    assert_close(found, rotations, atol=1e-12)
    assert_close(stretch, torch.tensor([[3.0, 2, 0.5]]).expand(10, 3), atol=1e-12)


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_no_other_rotation_is_nearer(size: int) -> None:
    matrices = torch.randn(30, size, size, dtype=torch.float64)
    for allow_reflection in (False, True):
        found, stretch = nearest_rotation(matrices, allow_reflection)
        assert_close(found @ found.mT, torch.eye(size).expand_as(found), atol=1e-12)
        score = (found * matrices).sum((1, 2))
        assert_close(score, stretch.sum(1), atol=1e-10)
        others = torch.linalg.qr(torch.randn(200, 1, size, size, dtype=torch.float64)).Q
        if not allow_reflection:
            assert_close(torch.linalg.det(found), torch.ones(30), atol=1e-10)
            others[..., -1] *= torch.linalg.det(others).sign()[..., None]
        assert ((others * matrices).sum((2, 3)) <= score + 1e-10).all()


ROTATIONS = [(d, r) for d in (None, [1.0, 1, 1], [2.0, 2, -1]) for r in (False, True)] + [([2.0, 1, 0], False)]


@pytest.mark.parametrize(("diagonal", "allow_reflection"), ROTATIONS, ids=str)
def test_derivatives_of_rotations(diagonal: list[float] | None, allow_reflection: bool) -> None:
    if diagonal is None:
        matrices = torch.randn(3, 3, 3, dtype=torch.float64)
    else:
        turned = random_rotations(2, dtype=torch.float64)
        matrices = (turned[0] @ torch.diag(torch.tensor(diagonal, dtype=torch.float64)) @ turned[1])[None]
    matrices.requires_grad_()
    assert torch.autograd.gradcheck(lambda m: nearest_rotation(m, allow_reflection)[0], matrices)


def test_derivatives_are_finite_where_the_rotation_is_open() -> None:
    for matrix in (torch.zeros(3, 3), torch.diag(torch.tensor([1.0, 0, 0])), torch.diag(torch.tensor([2.0, 1, -1]))):
        matrix.requires_grad_()
        nearest_rotation(matrix)[0].sum().backward()
        assert_finite(matrix.grad)
