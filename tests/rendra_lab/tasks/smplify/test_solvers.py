"""Solvers of many least-squares problems: linear ones in a step, Rosenbrock's valley, and each on its own."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rendra_lab.tasks.smplify.solvers import BatchedDogleg, BatchedLevenbergMarquardt, LeastSquares, Problem

Solver = Callable[[Any], LeastSquares]


def free_levenberg(params: Any) -> LeastSquares:
    return BatchedLevenbergMarquardt(params, damping=1e-10)


def free_dogleg(params: Any) -> LeastSquares:
    return BatchedDogleg(params, radius=1e6)


SOLVERS = pytest.mark.parametrize("solver", [BatchedLevenbergMarquardt, BatchedDogleg])


class Lines:
    """a x - b, for each problem."""

    def __init__(self, a: Tensor, b: Tensor) -> None:
        self.a, self.b = a, b
        self.rows_at_work = torch.arange(len(a))

    def rows(self, x: Tensor) -> Tensor:
        return (self.a @ x[..., None])[..., 0] - self.b

    def linearized(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.rows(x), self.a


class Valley:
    """Rosenbrock's: 10 (y - x^2) and 1 - x; the bottom is at (1, 1)."""

    def __init__(self, rows_at_work: Tensor) -> None:
        self.rows_at_work = rows_at_work

    def rows(self, x: Tensor) -> Tensor:
        return torch.stack([10 * (x[:, 1] - x[:, 0].square()), 1 - x[:, 0]], dim=1)

    def linearized(self, x: Tensor) -> tuple[Tensor, Tensor]:
        jacobian = x.new_zeros(len(x), 2, 2)
        jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 1, 0] = -20 * x[:, 0], 10.0, -1.0
        return self.rows(x), jacobian


def random_lines(count: int = 3, seed: int = 0) -> Lines:
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(count, 7, 4, generator=generator, dtype=torch.float64)
    return Lines(a, torch.randn(count, 7, generator=generator, dtype=torch.float64))


def solved(solver: Solver, problem: Problem, start: Tensor, steps: int) -> Tensor:
    x = nn.Parameter(start.clone())
    optimizer = solver([x])
    optimizer.problem = problem
    for _ in range(steps):
        optimizer.step()
    return x.detach()


def starts() -> Tensor:
    return torch.tensor([[-1.2, 1.0], [0.0, 0.0], [3.0, -2.0]], dtype=torch.float64)


@pytest.mark.parametrize("solver", [free_levenberg, free_dogleg])
def test_linear_problems_take_one_step(solver: Solver) -> None:
    problem = random_lines()
    expected = torch.linalg.lstsq(problem.a, problem.b[..., None]).solution[..., 0]
    found = solved(solver, problem, torch.zeros(3, 4, dtype=torch.float64), 1)
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


@SOLVERS
def test_the_valley_is_walked_to_its_bottom(solver: Solver) -> None:
    found = solved(solver, Valley(torch.arange(3)), starts(), 60)
    torch.testing.assert_close(found, torch.ones_like(found), atol=1e-6, rtol=0)


@SOLVERS
def test_no_step_makes_an_objective_larger(solver: Solver) -> None:
    problem, x = Valley(torch.arange(3)), nn.Parameter(starts())
    optimizer = solver([x])
    optimizer.problem = problem
    cost = problem.rows(x.detach()).square().sum(1)
    for _ in range(25):
        optimizer.step()
        now = problem.rows(x.detach()).square().sum(1)
        assert bool((now <= cost).all())
        cost = now


@SOLVERS
def test_each_problem_is_solved_as_if_alone(solver: Solver) -> None:
    together = solved(solver, Valley(torch.arange(3)), starts(), 7)
    alone = torch.cat([solved(solver, Valley(torch.arange(1)), start[None], 7) for start in starts()])
    torch.testing.assert_close(together, alone, atol=1e-10, rtol=0)


@SOLVERS
def test_problems_that_were_given_up_stay_where_they_are(solver: Solver) -> None:
    found = solved(solver, Valley(torch.tensor([0, 2])), starts(), 60)
    assert torch.equal(found[1], starts()[1])
    torch.testing.assert_close(found[[0, 2]], torch.ones(2, 2, dtype=torch.float64), atol=1e-6, rtol=0)


@SOLVERS
def test_a_number_that_nothing_pulls_at_stays(solver: Solver) -> None:
    a = torch.tensor(
        [[[1.0, 0.0]], [[0.0, 0.0]]], dtype=torch.float64
    )  # one row; none of the second's numbers counts
    problem = Lines(a, torch.ones(2, 1, dtype=torch.float64))
    found = solved(solver, problem, torch.full((2, 2), 5.0, dtype=torch.float64), 40)
    assert float(found[0, 0]) == pytest.approx(1, abs=1e-4)
    torch.testing.assert_close(found[:, 1], torch.full((2,), 5.0, dtype=torch.float64), atol=1e-9, rtol=0)
    assert float(found[1, 0]) == 5


@SOLVERS
def test_rows_that_are_no_numbers_move_nobody_else(solver: Solver) -> None:
    problem = random_lines()
    expected = torch.linalg.lstsq(problem.a, problem.b[..., None]).solution[..., 0]
    problem.b[1] = torch.nan
    found = solved(solver, problem, torch.zeros(3, 4, dtype=torch.float64), 40)
    assert torch.equal(found[1], torch.zeros(4, dtype=torch.float64))
    torch.testing.assert_close(found[[0, 2]], expected[[0, 2]], atol=1e-5, rtol=0)


@SOLVERS
def test_the_loss_of_the_closure_is_handed_back(solver: Solver) -> None:
    x = nn.Parameter(torch.zeros(3, 4, dtype=torch.float64))
    optimizer = solver([x])
    optimizer.problem = random_lines()
    assert optimizer.step(lambda: "loss") == "loss"
    assert solved(solver, random_lines(0), torch.zeros(0, 4, dtype=torch.float64), 2).shape == (0, 4)


def test_impossible_settings_are_refused() -> None:
    x = nn.Parameter(torch.zeros(2, 3))
    with pytest.raises(ValueError, match=r"damping must be positive and tries at least 1, got 0.0 and 3"):
        BatchedLevenbergMarquardt([x], damping=0.0)
    with pytest.raises(ValueError, match=r"radius must be positive and tries at least 1, got 1.0 and 0"):
        BatchedDogleg([x], radius=1.0, tries=0)
    with pytest.raises(ValueError, match="BatchedDogleg moves one parameter"):
        BatchedDogleg([x, nn.Parameter(torch.zeros(1))])
