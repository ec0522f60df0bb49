"""The groups SO(3) and SE(3): axioms, anchors from PyTorch3D 0.7.9, gradients at the singular angles."""

import math

import pytest
import torch
from assertions import assert_close, assert_finite

from rendra.transforms import random_rotations, se3_exp_map, se3_log_map
from rendra.transforms.math import (
    acos_linear_extrapolation,
    cotangent_defect_ratio,
    sine_defect_ratio,
    sine_ratio,
    versine_ratio,
)
from rendra.transforms.so3 import (
    hat,
    hat_inv,
    so3_exp_map,
    so3_exponential_map,
    so3_log_map,
    so3_relative_angle,
    so3_rotation_angle,
)


def test_anchors() -> None:
    rotation = [[0.8776, -0.4794, 0.0], [0.4794, 0.8776, 0.0], [0.0, 0.0, 1.0]]
    assert_close(so3_exp_map(torch.tensor([[0, 0, 0.5]])), [rotation], atol=5e-5)
    motion = [[0.8776, 0.4794, 0, 0], [-0.4794, 0.8776, 0, 0], [0, 0, 1, 0], [0.4692, 2.1625, 3, 1]]
    assert_close(se3_exp_map(torch.tensor([[1, 2, 3, 0, 0, 0.5]])), [motion], atol=5e-5)


def test_hat_is_the_cross_product_and_comes_back() -> None:
    u, v = torch.randn(2, 7, 3, dtype=torch.float64)
    assert_close((hat(v) @ u[..., None])[..., 0], torch.linalg.cross(v, u))
    assert_close(hat_inv(hat(v)), v)
    assert hat_inv(torch.zeros(0, 3, 3)).shape == (0, 3)


def test_the_logarithm_inverts_the_exponential() -> None:
    vector = 2 * torch.rand(50, 3, dtype=torch.float64) - 1
    assert_close(so3_log_map(so3_exp_map(vector)), vector, atol=1e-12)
    matrix = random_rotations(50, dtype=torch.float64)
    assert_close(so3_exp_map(so3_log_map(matrix)), matrix, atol=1e-13)
    assert_close(so3_exp_map(-vector), so3_exp_map(vector).mT, atol=1e-14)


def test_relative_angle_is_the_angle_between() -> None:
    first = random_rotations(20, dtype=torch.float64)
    vector = torch.nn.functional.normalize(torch.randn(20, 3, dtype=torch.float64), dim=-1)
    angle = torch.linspace(0.2, 3.1, 20, dtype=torch.float64)
    second = first @ so3_exp_map(angle[:, None] * vector)
    assert_close(so3_relative_angle(first, second), angle)
    assert_close(so3_relative_angle(first, second, cos_angle=True), angle.cos())
    assert_close(so3_rotation_angle(so3_exp_map(angle[:, None] * vector), cos_bound=0.0), angle)


def test_the_rotation_angle_has_finite_gradients() -> None:
    matrix = so3_exp_map(torch.tensor([[0, 0, 0], [math.pi, 0, 0]])).requires_grad_()
    so3_rotation_angle(matrix).sum().backward()
    assert_finite(matrix.grad)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rigid_motions_come_back(dtype: torch.dtype) -> None:
    log = 2 * torch.rand(50, 6, dtype=dtype) - 1
    log[0] = 0
    log[1, 3:] = 0
    log[2:10, 3:] *= 10.0 ** -torch.arange(1, 9, dtype=dtype)[:, None]
    log[10, 3:] = torch.tensor([0, 0, math.pi * 0.999])
    assert_close(se3_log_map(se3_exp_map(log)), log, atol=1e-5 if dtype == torch.float32 else 1e-11)


def test_the_motion_equals_the_matrix_exponential() -> None:
    log = torch.randn(20, 6, dtype=torch.float64)
    twist = torch.zeros(20, 4, 4, dtype=torch.float64)
    twist[:, :3, :3], twist[:, :3, 3] = hat(log[:, 3:]), log[:, :3]
    assert_close(se3_exp_map(log), torch.linalg.matrix_exp(twist).mT, atol=1e-12)


@pytest.mark.parametrize("spin", [[0, 0, 0], [1e-9, 0, 0], [0, math.pi, 0], [0.3, -0.2, 0.5]])
def test_gradients_of_rigid_motions(spin: list[float]) -> None:
    log = torch.tensor([[1, 2, 3, *spin]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(se3_exp_map, (log,), eps=1e-5)
    motion = se3_exp_map(log).detach().requires_grad_()
    se3_log_map(motion).sum().backward()
    assert_finite(motion.grad)
    if spin[1] < 3:
        assert torch.autograd.gradcheck(lambda x: se3_log_map(se3_exp_map(x)), (log,), eps=1e-5)


@pytest.mark.parametrize(
    ("ratio", "exact"),
    [
        (sine_ratio, lambda t: math.sin(t) / t),
        (versine_ratio, lambda t: 2 * math.sin(t / 2) ** 2 / t**2),
        (sine_defect_ratio, lambda t: (t - math.sin(t)) / t**3),
        (cotangent_defect_ratio, lambda t: (1 - t / 2 / math.tan(t / 2)) / t**2),
    ],
)
def test_ratios_are_smooth_across_their_seams(ratio, exact) -> None:
    angles = torch.tensor([0.0099, 0.0101, 0.4999, 0.5001, 1.0, 3.0], dtype=torch.float64)
    well = angles > 0.4  # below, the closed forms themselves lose digits
    expected = torch.tensor([exact(float(a)) for a in angles], dtype=torch.float64)
    assert_close(ratio(angles.square())[well], expected[well], atol=0, rtol=1e-13)
    assert_close(ratio(angles.square()), expected, atol=0, rtol=1e-9)
    squared = torch.tensor([0.0, 1e-4, 0.25, 0.9], dtype=torch.float64) + 1e-9
    assert torch.autograd.gradcheck(ratio, (squared.requires_grad_(),), eps=1e-7, atol=1e-6)


def test_acos_is_continued_by_its_tangent() -> None:
    x = torch.tensor([-2.0, -1.0, -0.5, 0.5, 1.0, 2.0], dtype=torch.float64, requires_grad=True)
    y = acos_linear_extrapolation(x)
    y.sum().backward()
    assert_finite(x.grad)
    assert_close(y[2:4], x[2:4].acos())
    bound = 1 - 1e-4
    assert_close(y[5], math.acos(bound) - (2 - bound) / math.sqrt(1 - bound**2))
    assert_close(y[0], math.pi - y[5].detach())
    for bounds in ((0.5, -0.5), (-1.0, 0.5), (0.0, 1.0)):
        with pytest.raises(ValueError, match="bound"):
            acos_linear_extrapolation(x, bounds)


def test_the_old_name_still_works() -> None:
    with pytest.warns(PendingDeprecationWarning, match="so3_exp_map"):
        assert_close(so3_exponential_map(torch.zeros(1, 3)), torch.eye(3)[None])


def test_wrong_input_is_refused() -> None:
    for function, shape in ((so3_exp_map, (2, 4)), (so3_log_map, (3, 3)), (so3_rotation_angle, (1, 4, 4))):
        with pytest.raises(ValueError, match="Input"):
            function(torch.zeros(shape))
    for function, shape in ((se3_exp_map, (2, 5)), (se3_log_map, (4, 4)), (hat, (2, 2)), (hat_inv, (3, 2))):
        with pytest.raises(ValueError, match=r"got (shape )?\("):
            function(torch.zeros(shape))
    with pytest.raises(ValueError, match="not skew-symmetric"):
        hat_inv(torch.eye(3)[None])
    with pytest.raises(ValueError, match="trace"):
        so3_rotation_angle(2 * torch.eye(3)[None])
    with pytest.raises(ValueError, match="should be 0"):
        se3_log_map(torch.ones(1, 4, 4))


def test_empty_batches_pass() -> None:
    assert so3_log_map(so3_exp_map(torch.zeros(0, 3))).shape == (0, 3)
    assert se3_log_map(se3_exp_map(torch.zeros(0, 6))).shape == (0, 6)
    assert so3_rotation_angle(torch.zeros(0, 3, 3)).shape == (0,)
