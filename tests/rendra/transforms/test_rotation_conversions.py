"""Rotation conversions: round trips, published formulas, and gradients where the textbook has none."""

import itertools
import math
from collections.abc import Callable

import pytest
import torch
from assertions import assert_close, assert_finite
from torch import Tensor

from rendra import transforms as t

CONVENTIONS = ["".join(c) for c in itertools.product("XYZ", repeat=3) if c[0] != c[1] != c[2]]
TOLERANCE = {torch.float32: 3e-6, torch.float64: 1e-13}


def special_vectors(dtype: torch.dtype = torch.float64) -> Tensor:
    """Rotation vectors at and around the identity and the half turn, about axes and diagonals."""
    axes = torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, -1], [1, 2, 3], [-3, 1, 1]])
    axes = torch.nn.functional.normalize(axes.to(torch.float64), dim=-1)
    angles = torch.tensor([0, 1e-12, 1e-8, 1e-5, 1e-3, 0.1, 1, 3, math.pi - 1e-4, math.pi - 1e-9, math.pi])
    return (angles.to(torch.float64)[:, None, None] * axes).reshape(-1, 3).to(dtype)


def gradient(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    x = x.clone().requires_grad_()
    out = function(x)
    (out * torch.linspace(0.5, 1.5, out.numel(), dtype=out.dtype).view_as(out)).sum().backward()
    assert x.grad is not None
    return x.grad


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_representation_comes_back(dtype: torch.dtype) -> None:
    tol = TOLERANCE[dtype]
    matrix = torch.cat((t.random_rotations(50, dtype=dtype), t.axis_angle_to_matrix(special_vectors(dtype))))
    assert_close(t.quaternion_to_matrix(t.matrix_to_quaternion(matrix)), matrix, atol=tol)
    assert_close(t.axis_angle_to_matrix(t.matrix_to_axis_angle(matrix)), matrix, atol=tol)
    assert_close(t.rotation_6d_to_matrix(t.matrix_to_rotation_6d(matrix)), matrix, atol=tol)
    quaternion = t.matrix_to_quaternion(matrix)
    assert_close(quaternion.norm(dim=-1), torch.ones(len(matrix)), atol=tol)
    assert (quaternion[:, 0] >= 0).all()
    for fast in (False, True):
        vector = t.quaternion_to_axis_angle(quaternion)
        assert_close(t.axis_angle_to_matrix(vector, fast=fast), matrix, atol=tol)
        assert_close(t.matrix_to_axis_angle(matrix, fast=fast), vector, atol=tol)
    assert_close(t.quaternion_to_matrix(t.axis_angle_to_quaternion(vector)), matrix, atol=tol)


def test_small_angles_keep_their_relative_accuracy() -> None:
    vector = special_vectors()[7:35]
    back = t.matrix_to_axis_angle(t.axis_angle_to_matrix(vector))
    assert ((back - vector).norm(dim=-1) <= 1e-11 * vector.norm(dim=-1)).all()
    back = t.quaternion_to_axis_angle(t.axis_angle_to_quaternion(vector))
    assert ((back - vector).norm(dim=-1) <= 1e-14 * vector.norm(dim=-1)).all()


def test_a_rotation_is_orthogonal_and_proper_and_equals_the_matrix_exponential() -> None:
    vector = special_vectors()
    matrix = t.axis_angle_to_matrix(vector)
    assert_close(matrix @ matrix.mT, torch.eye(3).expand(len(vector), 3, 3), atol=1e-14)
    assert_close(torch.linalg.det(matrix), torch.ones(len(vector)), atol=1e-14)
    assert_close(matrix, torch.linalg.matrix_exp(t.hat(vector)), atol=1e-13)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_half_turn_has_its_axis_up_to_sign(dtype: torch.dtype) -> None:
    axis = torch.nn.functional.normalize(torch.randn(20, 3, dtype=dtype), dim=-1)
    matrix = 2 * axis[:, :, None] * axis[:, None, :] - torch.eye(3, dtype=dtype)
    vector = t.matrix_to_axis_angle(matrix)
    assert_close(vector.norm(dim=-1), torch.full((20,), math.pi), atol=1e-6)
    assert_close((vector * axis).sum(-1).abs(), torch.full((20,), math.pi), atol=1e-6)


def test_quaternions_multiply_like_matrices() -> None:
    a, b = t.random_quaternions(20, dtype=torch.float64), t.random_quaternions(20, dtype=torch.float64)
    product = t.quaternion_multiply(a, b)
    assert_close(t.quaternion_to_matrix(product), t.quaternion_to_matrix(a) @ t.quaternion_to_matrix(b))
    assert (product[:, 0] >= 0).all()
    identity = t.quaternion_raw_multiply(a, t.quaternion_invert(a))
    assert_close(identity, torch.tensor([1.0, 0, 0, 0]).expand(20, 4), atol=1e-14)
    i, j = torch.eye(4)[1], torch.eye(4)[2]
    assert_close(t.quaternion_raw_multiply(i, j), torch.eye(4)[3])  # ij = k
    point = torch.randn(20, 3, dtype=torch.float64)
    turned = (t.quaternion_to_matrix(a) @ point[..., None])[..., 0]
    assert_close(t.quaternion_apply(a, point), turned, atol=1e-14)
    assert t.quaternion_apply(a[:, None], point[None]).shape == (20, 20, 3)
    assert_close(t.quaternion_apply(3 * a, point), 9 * turned, atol=1e-13)


def test_a_quaternion_and_its_opposite_are_one_rotation() -> None:
    q = t.random_quaternions(20, dtype=torch.float64)
    assert_close(t.standardize_quaternion(-q), q)
    assert_close(t.quaternion_to_matrix(-2.5 * q), t.quaternion_to_matrix(q))
    vector = t.quaternion_to_axis_angle(-q)
    assert_close(t.axis_angle_to_matrix(vector), t.quaternion_to_matrix(q), atol=1e-13)
    assert_close(t.quaternion_to_axis_angle(torch.tensor([[-1.0, 0, 0, 0]])), torch.zeros(1, 3))


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_euler_angles_come_back(convention: str, dtype: torch.dtype) -> None:
    proper = convention[0] == convention[2]
    angles = torch.rand(40, 3, dtype=dtype) * torch.tensor([6.0, 2.8, 6.0], dtype=dtype)
    angles -= torch.tensor([3.0, -0.1 if proper else 1.4, 3.0], dtype=dtype)
    matrix = t.euler_angles_to_matrix(angles, convention)
    assert_close(t.matrix_to_euler_angles(matrix, convention), angles, atol=100 * TOLERANCE[dtype])


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_gimbal_lock_still_rebuilds_the_matrix(convention: str) -> None:
    proper = convention[0] == convention[2]
    for middle in (0.0, math.pi) if proper else (-math.pi / 2, math.pi / 2):
        matrix = t.euler_angles_to_matrix(torch.tensor([0.7, middle, -0.4], dtype=torch.float64), convention)
        angles = t.matrix_to_euler_angles(matrix, convention)
        assert angles[2] == 0
        assert_close(t.euler_angles_to_matrix(angles, convention), matrix, atol=1e-14)
        assert_finite(gradient(lambda m: t.matrix_to_euler_angles(m, convention), matrix))


def test_euler_angles_multiply_from_the_left() -> None:
    a, b, c = torch.randn(3, 5)
    zero = torch.zeros(5)
    about = [torch.stack(v, -1) for v in ((zero, zero, a), (zero, b, zero), (c, zero, zero))]
    expected = torch.stack([t.axis_angle_to_matrix(v) for v in about])
    actual = t.euler_angles_to_matrix(torch.stack((a, b, c), -1), "ZYX")
    assert_close(actual, expected[0] @ expected[1] @ expected[2])


@pytest.mark.parametrize(
    ("angles", "convention", "message"),
    [
        (torch.zeros(3), "XY", "3 letters"),
        (torch.zeros(3), "XYA", "Invalid letter"),
        (torch.zeros(3), "XXY", "neighbouring"),
        (torch.zeros(4), "XYZ", "Invalid input euler angles"),
    ],
)
def test_a_wrong_convention_is_refused(angles: Tensor, convention: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        t.euler_angles_to_matrix(angles, convention)


def test_wrong_shapes_are_refused() -> None:
    for function in (t.matrix_to_quaternion, t.matrix_to_axis_angle):
        with pytest.raises(ValueError, match=r"Invalid rotation matrix shape.*\(2, 4, 4\)"):
            function(torch.zeros(2, 4, 4))
    with pytest.raises(ValueError, match="Invalid rotation matrix shape"):
        t.matrix_to_euler_angles(torch.zeros(3, 4), "XYZ")
    with pytest.raises(ValueError, match="not in 3D"):
        t.quaternion_apply(torch.zeros(4), torch.zeros(2))


@pytest.mark.parametrize("shape", [(), (0,), (2, 3), (2, 0, 1)])
def test_any_batch_shape_passes(shape: tuple[int, ...]) -> None:
    q = t.standardize_quaternion(torch.nn.functional.normalize(torch.randn(*shape, 4), dim=-1))
    matrix = t.quaternion_to_matrix(q)
    assert matrix.shape == (*shape, 3, 3)
    assert_close(t.matrix_to_quaternion(matrix), q)
    assert t.matrix_to_axis_angle(matrix).shape == (*shape, 3)
    assert t.matrix_to_euler_angles(matrix, "ZYX").shape == (*shape, 3)
    assert t.matrix_to_rotation_6d(matrix).shape == (*shape, 6)
    assert t.axis_angle_to_matrix(torch.randn(*shape, 3)).shape == (*shape, 3, 3)
    assert t.euler_angles_to_matrix(torch.randn(*shape, 3), "XYX").shape == (*shape, 3, 3)


def test_random_rotations_are_uniform() -> None:
    q = t.random_quaternions(20000)
    assert (q[:, 0] >= 0).all()
    # the second moments of a uniform direction in 4D are 1/4 on the diagonal
    assert_close(q.T @ q / 20000, torch.eye(4) / 4, atol=0.015)
    assert t.random_rotation(dtype=torch.float64).dtype == torch.float64
    assert t.random_rotations(0).shape == (0, 3, 3)


TO_MATRIX_AND_BACK = [
    lambda v: t.axis_angle_to_matrix(v),
    lambda v: t.axis_angle_to_quaternion(v),
    lambda v: t.quaternion_to_matrix(t.axis_angle_to_quaternion(v)),
    lambda v: t.matrix_to_quaternion(t.axis_angle_to_matrix(v)),
    lambda v: t.matrix_to_axis_angle(t.axis_angle_to_matrix(v)),
    lambda v: t.rotation_6d_to_matrix(t.matrix_to_rotation_6d(t.axis_angle_to_matrix(v))),
    lambda v: t.matrix_to_euler_angles(t.axis_angle_to_matrix(v), "ZXZ"),
    lambda v: t.matrix_to_euler_angles(t.axis_angle_to_matrix(v), "YXZ"),
]


@pytest.mark.parametrize("function", TO_MATRIX_AND_BACK)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_everywhere(function: Callable[[Tensor], Tensor], dtype: torch.dtype) -> None:
    assert_finite(gradient(function, special_vectors(dtype)))


@pytest.mark.parametrize("function", TO_MATRIX_AND_BACK)
def test_gradients_are_right_away_from_singularities(function: Callable[[Tensor], Tensor]) -> None:
    vector = torch.tensor([[0.3, -0.4, 0.5], [1.0, 2.0, -1.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(function, (vector,))


@pytest.mark.parametrize("function", TO_MATRIX_AND_BACK[:5])
def test_gradients_are_right_at_the_identity(function: Callable[[Tensor], Tensor]) -> None:
    vector = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(function, (vector,), eps=1e-5)
    assert torch.autograd.gradgradcheck(function, (vector,), eps=1e-5, atol=1e-4)


def test_the_logarithm_moves_by_what_is_added_to_it() -> None:
    # d log(exp(v)) / dv is the identity, at the singular angles too
    vector = special_vectors()[(special_vectors().norm(dim=-1) < 3.14)]
    jacobian = torch.func.vmap(torch.func.jacrev(lambda v: t.matrix_to_axis_angle(t.axis_angle_to_matrix(v))))
    assert_close(jacobian(vector), torch.eye(3).expand(len(vector), 3, 3), atol=1e-9)
