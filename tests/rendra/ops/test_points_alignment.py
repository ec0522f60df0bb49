"""Known similarities are recovered, whatever moves X moves the answer, and derivatives are right."""

import warnings

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401
from torch import Tensor

from rendra.ops import corresponding_points_alignment, iterative_closest_point
from rendra.ops.points_alignment import SimilarityTransform
from rendra.structures import Pointclouds
from rendra.transforms import axis_angle_to_matrix


def random_similarity(n: int, dim: int = 3, reflect: bool = False, scale: bool = True) -> SimilarityTransform:
    R = torch.linalg.qr(torch.randn(n, dim, dim, dtype=torch.float64)).Q
    R[..., -1] *= torch.linalg.det(R).sign()[:, None] * (-1 if reflect else 1)
    s = torch.rand(n, dtype=torch.float64) + 0.5 if scale else torch.ones(n, dtype=torch.float64)
    return SimilarityTransform(R, torch.randn(n, dim, dtype=torch.float64), s)


def moved(transform: SimilarityTransform, points: Tensor) -> Tensor:
    return transform.s[:, None, None] * (points @ transform.R) + transform.T[:, None]


def assert_same(actual: SimilarityTransform, expected: SimilarityTransform, atol: float = 1e-9) -> None:
    for own, known in zip(actual, expected, strict=True):
        assert_close(own, known, atol=atol)


@pytest.mark.parametrize("dim", [2, 3, 4])
@pytest.mark.parametrize("reflect", [False, True])
def test_a_known_similarity_is_recovered(dim: int, reflect: bool) -> None:
    known = random_similarity(5, dim, reflect)
    X = torch.randn(5, 12, dim, dtype=torch.float64)
    found = corresponding_points_alignment(X, moved(known, X), estimate_scale=True, allow_reflection=reflect)
    assert_same(found, known)


def test_umeyamas_example() -> None:
    """Section IV of the paper: three points of the plane and their mirror image, turned."""
    X = torch.tensor([[[0.0, 0], [1, 0], [0, 2]]])
    Y = torch.tensor([[[0.0, 0], [-1, 0], [0, 2]]])
    found = corresponding_points_alignment(X, Y, estimate_scale=True)
    assert_close(found.R[0].T, [[0.832, 0.555], [-0.555, 0.832]], atol=5e-4)
    assert_close(found.s, [0.721], atol=5e-4)
    assert_close(found.T, [[-0.800, 0.400]], atol=5e-4)


def test_nothing_near_the_answer_is_better() -> None:
    X, Y = torch.randn(1, 10, 3, dtype=torch.float64), torch.randn(1, 10, 3, dtype=torch.float64)
    weights = torch.rand(1, 10, dtype=torch.float64)

    def error(transform: SimilarityTransform) -> Tensor:
        return ((moved(transform, X) - Y).square().sum(2) * weights).sum(1)

    found = corresponding_points_alignment(X, Y, weights, estimate_scale=True)
    for _ in range(50):
        turn = axis_angle_to_matrix(0.05 * torch.randn(1, 3, dtype=torch.float64))
        step = 0.05 * torch.randn(4, dtype=torch.float64)
        other = SimilarityTransform(found.R @ turn, found.T + step[:3], found.s * (1 + step[3]))
        assert error(other) >= error(found)


def test_weights_count_as_repetitions_do_and_zero_leaves_out() -> None:
    X, Y = torch.randn(1, 6, 3, dtype=torch.float64), torch.randn(1, 6, 3, dtype=torch.float64)
    counts = torch.tensor([1, 3, 2, 0, 1, 4])
    repeated = corresponding_points_alignment(
        X.repeat_interleave(counts, 1), Y.repeat_interleave(counts, 1), estimate_scale=True
    )
    assert_same(corresponding_points_alignment(X, Y, counts[None].double(), True), repeated)
    assert_same(corresponding_points_alignment(X, Y, [counts.double()], True), repeated)


def test_clouds_of_different_sizes_are_each_aligned_alone() -> None:
    known = random_similarity(3)
    clouds = [torch.randn(n, 3, dtype=torch.float64) for n in (5, 9, 4)]
    targets = [known.s[i] * cloud @ known.R[i] + known.T[i] for i, cloud in enumerate(clouds)]
    weights = [torch.rand(len(c), dtype=torch.float64) for c in clouds]
    for given in (None, weights):
        found = corresponding_points_alignment(Pointclouds(clouds), Pointclouds(targets), given, estimate_scale=True)
        assert_same(found, known)


@pytest.mark.parametrize("shape", ["random", "cube", "square"])
def test_derivatives(shape: str) -> None:
    X = {
        "random": torch.randn(1, 5, 3),
        "cube": torch.cartesian_prod(*3 * [torch.tensor([-1.0, 1])])[None],
        "square": torch.tensor([[[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]]),
    }[shape].double()
    Y = moved(random_similarity(1), X).requires_grad_()
    X.requires_grad_()
    weights = torch.rand(X.shape[:2], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda *p: corresponding_points_alignment(*p, estimate_scale=True), (X, Y, weights)
    )


def test_an_open_rotation_is_told_and_stays_finite() -> None:
    line = (torch.arange(5.0)[:, None] * torch.tensor([1.0, 2, 3]))[None].requires_grad_()
    with pytest.warns(UserWarning, match="unique rotation"):
        found = corresponding_points_alignment(line, 2 * line.detach(), estimate_scale=True)
    sum(part.sum() for part in found).backward()
    assert_finite(line.grad)
    flat = torch.randn(1, 6, 3) * torch.tensor([1.0, 1, 0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        corresponding_points_alignment(flat, flat)  # a plane fixes its rotation
    with pytest.warns(UserWarning, match="unique rotation"):
        corresponding_points_alignment(flat, flat, allow_reflection=True)


def test_icp_recovers_a_small_similarity_of_a_shuffled_part() -> None:
    Y = torch.randn(3, 300, 3, dtype=torch.float64)
    turn = axis_angle_to_matrix(0.05 * torch.randn(3, 3, dtype=torch.float64))
    known = SimilarityTransform(
        turn, 0.02 * torch.randn(3, 3, dtype=torch.float64), torch.tensor([1.0, 1.02, 0.98]).double()
    )
    sizes = [250, 300, 120]
    back = [((Y[i] - known.T[i]) / known.s[i] @ known.R[i].T)[torch.randperm(300)[:n]] for i, n in enumerate(sizes)]
    solution = iterative_closest_point(Pointclouds(back), Pointclouds(list(Y)), estimate_scale=True)
    assert solution.converged
    assert_same(solution.RTs, known, atol=1e-6)
    assert isinstance(solution.Xt, Pointclouds)
    assert solution.Xt.num_points_per_cloud().tolist() == sizes
    assert_close(solution.rmse, torch.zeros(3), atol=1e-6)
    assert_same(solution.t_history[-1], solution.RTs)


def test_icp_never_gets_worse_and_keeps_its_promises() -> None:
    X, Y = torch.randn(2, 40, 3), torch.randn(2, 70, 3)
    errors = []
    for steps in range(1, 6):
        solution = iterative_closest_point(X, Y, max_iterations=steps)
        assert len(solution.t_history) <= steps
        assert_close(moved(solution.RTs, X), solution.Xt)
        nearest = torch.cdist(solution.Xt, Y).amin(2).square().mean(1).sqrt()
        assert (nearest <= solution.rmse + 1e-5).all()  # matched before the last step
        errors.append(solution.rmse)
    assert (torch.stack(errors).diff(dim=0) <= 1e-5).all()


def test_icp_starts_where_it_is_told() -> None:
    Y = torch.randn(1, 60, 3, dtype=torch.float64)
    known = random_similarity(1, scale=False)
    X = (Y - known.T[:, None]) @ known.R.mT
    near = iterative_closest_point(X, Y, init_transform=known)
    assert near.converged
    assert len(near.t_history) == 2
    assert_same(near.RTs, known)
    none = iterative_closest_point(X, Y, init_transform=known, max_iterations=0)
    assert none.rmse is None
    assert none.t_history == []
    assert_close(none.Xt, Y, atol=1e-9)


def test_icp_says_what_it_does_when_asked(capsys) -> None:
    X = torch.randn(1, 9, 3, requires_grad=True)
    solution = iterative_closest_point(X, torch.randn(1, 9, 3), max_iterations=2, verbose=True)
    assert capsys.readouterr().out.count("rmse") == 2
    solution.rmse.sum().backward()
    assert_finite(X.grad)


def test_perfect_matches_have_finite_derivatives() -> None:
    X = torch.randn(1, 9, 3, requires_grad=True)
    solution = iterative_closest_point(X, X.detach())
    (solution.rmse.sum() + solution.Xt.sum()).backward()
    assert_finite(X.grad)


def test_alignment_stays_on_its_device(far) -> None:  # noqa: F811
    X = torch.rand(2, 6, 3, device=far)
    known = axis_angle_to_matrix(0.01 * torch.ones(2, 3)).to(far)
    found = corresponding_points_alignment(X, X @ known, X[..., 0], estimate_scale=True)
    solution = iterative_closest_point(X, X @ known, max_iterations=3)
    assert all(isinstance(part, Far) for part in (*found, solution.Xt, solution.rmse, *solution.RTs))


CLOUD = torch.zeros(2, 5, 3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: corresponding_points_alignment(CLOUD, CLOUD[:, :4]), r"\(2, 5, 3\) with \[5, 5\] points"),
        (lambda: corresponding_points_alignment(CLOUD[0], CLOUD), "Pointclouds objects or tensors"),
        (lambda: corresponding_points_alignment(CLOUD, CLOUD, torch.ones(2, 4)), r"\(2, 5\); got \(2, 4\)"),
        (lambda: corresponding_points_alignment(CLOUD, CLOUD, [torch.ones(5)]), r"\[5, 5\]; got \[5\]"),
        (lambda: iterative_closest_point(CLOUD, CLOUD[:1]), "same number of batches and data dimensions"),
        (lambda: iterative_closest_point(CLOUD, CLOUD, (1, 2)), r"R \(2, 3, 3\), T \(2, 3\) and s \(2,\)"),
        (
            lambda: iterative_closest_point(
                CLOUD, CLOUD, SimilarityTransform(torch.eye(3), torch.ones(3), torch.ones(1))
            ),
            "has to be a named tuple",
        ),
    ],
)
def test_what_does_not_fit_is_named(call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
