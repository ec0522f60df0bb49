"""Overlap of the parts of a body: closed forms, the sum over all pairs, and derivatives made in four ways."""

import math

import pytest
import torch
from far_device import Far, far  # noqa: F401
from torch import Tensor
from torch.func import jvp, vmap

from rendra_lab.tasks.smplify import interpenetration
from rendra_lab.tasks.smplify.body_spheres import CAPSULE_PAIRS, PARTS, Balls
from rendra_lab.tasks.smplify.interpenetration import Interpenetration

_TWO = (PARTS.index("left_hand"), PARTS.index("right_hand"))


def crowd(bodies: int = 3, seed: int = 0) -> Balls:
    """Two balls for each part, in no order, many of which overlap."""
    generator = torch.Generator().manual_seed(seed)
    middles = 0.8 * torch.rand(bodies, 40, 3, generator=generator, dtype=torch.float64)
    radii = 0.1 + 0.3 * torch.rand(bodies, 40, generator=generator, dtype=torch.float64)
    return Balls(middles, radii, tuple(torch.randperm(40, generator=generator).remainder(20).tolist()))


def pair(apart: float, radius: float = 0.1) -> Balls:
    return Balls(torch.tensor([[[0.0, 0, 3], [apart, 0, 3]]]), torch.tensor([[radius, 2 * radius]]), _TWO)


def test_two_balls_are_the_formula() -> None:
    rows = Interpenetration(alpha=0.3, softness=0.1).residuals(pair(0.05))
    squared = math.exp(-(0.05**2) / (0.03**2 + 0.06**2))
    expected = torch.zeros(1, 23)
    expected[0, CAPSULE_PAIRS.index(("left_hand", "right_hand"))] = squared / math.sqrt(squared + 0.01)
    torch.testing.assert_close(rows, expected)


def test_rows_are_sums_over_all_pairs_of_balls() -> None:
    balls, term = crowd(), Interpenetration()
    rows = term.residuals(balls)
    for body in range(3):
        for row, (a, b) in enumerate(CAPSULE_PAIRS):
            i, j = balls.places(a), balls.places(b)
            squared = torch.cdist(balls.middles[body, i], balls.middles[body, j]).square()
            widths = 0.09 * (balls.radii[body, i, None].square() + balls.radii[body, None, j].square())
            overlap = (-squared / widths).exp().sum()
            assert float(rows[body, row]) == pytest.approx(float(overlap / (overlap + 1e-4).sqrt()), abs=1e-5)
    assert int((rows > 0.1).sum()) > 10


def test_the_term_is_the_papers_less_a_little() -> None:
    """The sum of all g^2, less at most softness^2 for each pair of capsules."""
    balls = crowd()
    soft, hard = Interpenetration(softness=1e-2), Interpenetration(softness=1e-5)
    lost = hard.residuals(balls).square() - soft.residuals(balls).square()
    assert float(lost.min()) >= -1e-9
    assert float(lost.max()) <= 1e-4
    assert float(soft(balls)) == pytest.approx(float(soft.residuals(balls).square().sum()))


def test_gradients_are_those_of_finite_differences() -> None:
    balls, term = crowd(2, seed=1), Interpenetration()
    assert torch.autograd.gradcheck(
        lambda middles: term.residuals(Balls(middles, balls.radii, balls.parts)),
        balls.middles.requires_grad_(),
        check_forward_ad=False,
        atol=1e-4,  # what is left out below 1e-4
    )


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")  # torch.func imports what uses it
def test_written_derivatives_are_the_forward_ones() -> None:
    balls, term = crowd(), Interpenetration()
    changes = torch.randn(3, 40, 3, 7, generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def along(change: Tensor) -> Tensor:
        return jvp(lambda value: term.residuals(Balls(value, balls.radii, balls.parts)), (balls.middles,), (change,))[
            1
        ]

    expected = vmap(along, in_dims=-1, out_dims=-1)(changes)
    torch.testing.assert_close(term.row_derivatives(changes, balls), expected)
    step = 1e-6 * changes[..., 0]
    high, low = (term.residuals(Balls(balls.middles + s * step, balls.radii, balls.parts)) for s in (1, -1))
    torch.testing.assert_close((high - low) / 2e-6, expected[..., 0], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("apart", [0.0, 0.3, 1e3])
def test_slopes_are_finite_everywhere(apart: float) -> None:
    """Where balls coincide, where they just touch, and where nothing does."""
    balls, term = pair(apart), Interpenetration()
    middles = balls.middles.requires_grad_()
    value = term(Balls(middles, balls.radii, balls.parts))
    value.backward()
    assert middles.grad is not None
    assert bool(middles.grad.isfinite().all())
    if apart > 0.2:
        assert float(value.detach()) < 1e-5
        assert float(middles.grad.abs().max()) < 1e-4


def test_a_step_downhill_draws_hands_apart() -> None:
    middles = pair(0.05).middles.requires_grad_()
    Interpenetration()(Balls(middles, pair(0.05).radii, _TWO)).backward()
    assert middles.grad is not None
    assert float(middles.grad[0, 0, 0]) > 0 > float(middles.grad[0, 1, 0])
    assert float(middles.grad[..., 1:].abs().max()) == 0


def test_radii_do_not_learn() -> None:
    balls = pair(0.05)
    radii = balls.radii.requires_grad_()
    assert not Interpenetration()(Balls(balls.middles, radii, _TWO)).requires_grad


def test_no_body() -> None:
    balls, term = crowd(0), Interpenetration()
    assert term.residuals(balls).shape == (0, 23)
    assert term.row_derivatives(torch.zeros(0, 40, 3, 5, dtype=torch.float64), balls).shape == (0, 23, 5)
    assert float(term(balls)) == 0


def test_bad_input_is_named() -> None:
    with pytest.raises(ValueError, match=r"alpha and softness must be positive, got 0\.3 and 0"):
        Interpenetration(softness=0.0)
    balls = crowd()
    with pytest.raises(NotImplementedError, match="takes a batch of bodies at once"):
        vmap(lambda middles: Interpenetration().residuals(Balls(middles[None], balls.radii[:1], balls.parts)))(
            balls.middles
        )


def test_stays_on_its_device(far: torch.device) -> None:  # noqa: F811
    balls = crowd()
    interpenetration._pairs_of_parts.cache_clear()
    there = Balls(Far(balls.middles), Far(balls.radii), balls.parts)
    rows = Interpenetration().residuals(there)
    interpenetration._pairs_of_parts.cache_clear()
    assert isinstance(rows, Far)
    torch.testing.assert_close(rows.held, Interpenetration().residuals(balls))
