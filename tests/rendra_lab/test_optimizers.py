"""Optimizers on problems whose answers are known."""

import itertools

import pytest
import torch
from assertions import assert_close
from torch import nn

from rendra_lab.optimizers import LevenbergMarquardt, UniformAdam, levenberg_marquardt_step


def fit(parameter, residuals, steps, **settings):
    optimizer = LevenbergMarquardt([parameter], **settings)
    optimizer.residuals = residuals
    costs = []
    for _ in range(steps):
        optimizer.step()
        costs.append(float(residuals().square().sum()))
    return costs


def test_a_linear_problem_is_solved_at_once():
    matrix, truth = torch.randn(20, 4), torch.randn(4)
    x = nn.Parameter(torch.zeros(4))
    fit(x, lambda: (matrix @ (x - truth)).detach(), 4, lr=10.0)
    assert_close(x.detach(), truth, atol=1e-2)


def test_rosenbrock_is_solved():
    x = nn.Parameter(torch.tensor([-1.2, 1.0]))
    costs = fit(x, lambda: torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]]).detach(), 60, difference=(1e-2, 1e-3))
    assert costs[-1] < 1e-6
    assert all(later <= earlier for earlier, later in itertools.pairwise(costs))


def test_no_step_is_longer_than_allowed():
    x = nn.Parameter(torch.zeros(3))
    target = torch.tensor([100.0, 0.0, 0.0])
    fit(x, lambda: (x - target).detach(), 1, lr=0.5)
    assert x.detach().norm() <= 0.5 + 1e-6


def test_a_parameter_without_effect_stays_and_breaks_nothing():
    x = nn.Parameter(torch.tensor([0.0, 7.0]))
    fit(x, lambda: (x[:1] - 2).detach(), 6, lr=5.0)
    assert_close(x.detach(), [2.0, 7.0], atol=1e-3)


def test_a_flat_objective_narrows_the_difference():
    x = nn.Parameter(torch.zeros(2))
    optimizer = LevenbergMarquardt([x], difference=(0.2, 0.05))
    optimizer.residuals = lambda: torch.ones(5)
    widths = []
    for _ in range(4):
        optimizer.step()
        widths.append(optimizer.param_groups[0]["difference"])
    assert widths == [0.1, 0.05, 0.05, 0.05]
    assert_close(x.detach(), [0.0, 0.0])


def test_problems_side_by_side_do_not_touch_each_other():
    truth = torch.randn(5, 3)

    def residuals(x):
        return (x - truth[:, None]) * torch.tensor([1.0, 5.0, 0.2])

    together, _, cost = levenberg_marquardt_step(residuals, torch.zeros(5, 3), torch.full((5,), 1e-2), 1e-3, 10.0)
    assert (cost < residuals(torch.zeros(5, 1, 3)).square().sum((1, 2))).all()
    for i in range(5):
        alone, _, _ = levenberg_marquardt_step(
            lambda x, i=i: (x - truth[i]) * torch.tensor([1.0, 5.0, 0.2]),
            torch.zeros(1, 3),
            torch.full((1,), 1e-2),
            1e-3,
            10.0,
        )
        assert_close(alone[0], together[i], atol=1e-4)


def test_bad_settings_are_named():
    with pytest.raises(ValueError, match="wide to a fine"):
        LevenbergMarquardt([nn.Parameter(torch.zeros(1))], difference=(0.1, 0.2))


def test_uniform_adam_is_adam_for_a_single_number():
    mine, theirs = nn.Parameter(torch.tensor([2.0])), nn.Parameter(torch.tensor([2.0]))
    pairs = [(mine, UniformAdam([mine], lr=0.1)), (theirs, torch.optim.Adam([theirs], lr=0.1, eps=0))]
    for _ in range(20):
        for x, optimizer in pairs:
            optimizer.zero_grad()
            (x**4).sum().backward()
            optimizer.step()
        assert_close(mine.detach(), theirs.detach(), atol=1e-6)


def test_uniform_adam_keeps_the_direction_of_the_gradient():
    x = nn.Parameter(torch.zeros(4, 3))
    slope = torch.randn(4, 3)
    x.grad = slope.clone()
    UniformAdam([x], lr=0.5).step()
    assert_close(x.detach(), -0.5 * slope / slope.abs().amax(), atol=1e-5)


def test_uniform_adam_leaves_alone_what_has_no_gradient_and_survives_a_zero_one():
    idle, flat = nn.Parameter(torch.ones(2)), nn.Parameter(torch.ones(2))
    flat.grad = torch.zeros(2)
    UniformAdam([idle, flat], lr=0.5).step()
    assert_close(torch.stack([idle, flat]).detach(), torch.ones(2, 2))


def test_uniform_adam_refuses_betas_outside_their_range():
    with pytest.raises(ValueError, match="betas"):
        UniformAdam([nn.Parameter(torch.zeros(1))], betas=(0.9, 1.0))
    with pytest.raises(ValueError, match="lr must be a number of at least 0, got -1"):
        UniformAdam([nn.Parameter(torch.zeros(1))], lr=-1.0)
