"""Random cameras are recovered from what they see."""

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401
from torch import Tensor

from rendra.ops import efficient_pnp
from rendra.ops.perspective_n_points import EpnpSolution
from rendra.structures import Pointclouds
from rendra.transforms import random_rotations


def scene(n: int, points: int, thickness: float = 1.0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """World points, where cameras see them, and the cameras' R and T."""
    x = torch.rand(n, points, 3) * torch.tensor([2.0, 2, 2 * thickness]) - 1
    x = x @ random_rotations(n) + torch.randn(n, 1, 3)
    R = random_rotations(n)
    T = torch.randn(n, 3) * 0.5 + torch.tensor([0.0, 0, 6]) - (x.mean(1, keepdim=True) @ R)[:, 0]
    seen = x @ R + T[:, None]
    return x, seen[..., :2] / seen[..., 2:], R, T


def assert_pose(solution: EpnpSolution, R: Tensor, T: Tensor, atol: float) -> None:
    assert_close(solution.R, R, atol=atol)
    assert_close(solution.T, T, atol=10 * atol)


@pytest.mark.parametrize("thickness", [1.0, 0.1, 0.0], ids="thickness {}".format)
@pytest.mark.parametrize("points", [6, 9, 100])
def test_a_noise_free_pose_is_exact(points: int, thickness: float) -> None:
    x, y, R, T = scene(50, points, thickness)
    solution = efficient_pnp(x, y)
    assert_pose(solution, R, T, atol=5e-3 if points == 6 else 1e-3)
    assert solution.err_2d.max() < 2e-5
    assert_close(solution.x_cam, x @ R + T[:, None], atol=2e-2)
    if points > 6:
        assert_pose(efficient_pnp(x, y, skip_quadratic_eq=True), R, T, atol=1e-3)


def test_five_points_suffice_and_the_first_eigenvector_alone_does_not() -> None:
    x, y, R, T = scene(40, 5)
    assert_pose(efficient_pnp(x, y), R, T, atol=1e-3)
    assert (efficient_pnp(x, y, skip_quadratic_eq=True).R - R).abs().amax((1, 2)).median() > 0.1


def test_noise_in_the_image_costs_as_much_in_the_pose() -> None:
    x, y, R, T = scene(50, 50)
    solution = efficient_pnp(x, y + 1e-3 * torch.randn_like(y))
    assert (solution.R - R).flatten(1).norm(dim=1).median() < 5e-3
    assert 1e-3 < solution.err_2d.mean() < 1.6e-3  # the mean length of that noise is 1.25e-3


def test_errors_are_those_of_the_returned_pose() -> None:
    x, y, *_ = scene(5, 20)
    weights = torch.rand(5, 20)
    y = y + 0.01 * torch.randn_like(y)
    found = efficient_pnp(x, y, weights)
    placed = x @ found.R + found.T[:, None]
    share = weights / weights.sum(1, keepdim=True)
    offset = (placed[..., :2] / placed[..., 2:] - y).norm(dim=2)
    assert_close(found.err_2d, (offset * share).sum(1), atol=1e-5)
    assert_close(found.err_3d, ((placed - found.x_cam).square().sum(2) * share).sum(1), atol=1e-5)
    assert_close(torch.linalg.det(found.R), torch.ones(5))


def test_outliers_without_weight_do_no_harm() -> None:
    x, y, R, T = scene(10, 12)
    weights = torch.ones(10, 12)
    weights[:, ::3] = 0
    spoilt = torch.where(weights[..., None] == 0, 50 * torch.randn_like(y), y)
    assert_pose(efficient_pnp(x, spoilt, weights), R, T, atol=1e-3)
    assert (efficient_pnp(x, spoilt).R - R).abs().amax((1, 2)).median() > 0.05


def test_clouds_of_different_sizes_are_each_solved_alone() -> None:
    x, y, R, T = scene(3, 12)
    clouds = Pointclouds([x[0, :8], x[1], x[2, :6]])
    assert_pose(efficient_pnp(clouds, y), R, T, atol=1e-3)  # the padding's images are ignored


def test_derivatives_are_those_of_the_pose() -> None:
    x, y, *_ = (part.double() for part in scene(1, 7))
    x, y = x.requires_grad_(), (y + 0.01 * torch.randn_like(y)).requires_grad_()
    assert torch.autograd.gradcheck(lambda *p: efficient_pnp(*p)[1:3], (x, y), eps=1e-6, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("kind", ["exact", "cube", "plane", "one point"])
def test_derivatives_are_finite(kind: str) -> None:
    x, y, R, T = scene(1, 8, 0.0 if kind == "plane" else 1.0)
    if kind == "cube":
        x = torch.cartesian_prod(*3 * [torch.tensor([-1.0, 1])])[None]
        seen = x + torch.tensor([0.0, 0, 5])
        y = seen[..., :2] / seen[..., 2:]
    if kind == "one point":
        x, y = torch.zeros_like(x), torch.zeros_like(y)
    x, y = x.requires_grad_(), y.clone().requires_grad_()
    sum(part.sum() for part in efficient_pnp(x, y)).backward()
    assert_finite(x.grad)
    assert_finite(y.grad)


def test_types_and_empty_batches() -> None:
    x, y, *_ = scene(2, 8)
    assert all(part.dtype == torch.float64 for part in efficient_pnp(x.double(), y.double()))
    empty = efficient_pnp(x[:0], y[:0])
    assert [part.shape for part in empty] == [(0, 8, 3), (0, 3, 3), (0, 3), (0,), (0,)]


def test_poses_stay_on_their_device(far) -> None:  # noqa: F811
    x, y, *_ = (part.to(far) for part in scene(2, 8))
    assert all(isinstance(part, Far) for part in efficient_pnp(x, y))


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (((2, 6, 2), (2, 6, 2)), r"\(N, P, 3\) and \(N, P, 2\).*got \(2, 6, 2\)"),
        (((2, 6, 3), (2, 5, 2)), r"got \(2, 6, 3\) and \(2, 5, 2\)"),
        (((2, 6, 3), (2, 6, 2), (6,)), r"\(2, 6\); got \(6,\)"),
        (((2, 3, 3), (2, 3, 2)), r"at least 4 points, got \[3, 3\]"),
    ],
)
def test_what_does_not_fit_is_named(shapes, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        efficient_pnp(*map(torch.ones, shapes))
