"""The pose prior against a direct evaluation, what it was fitted to, and files of others."""

import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from rendra.body import SMPL_JOINTS
from rendra_lab.synthesis.poses import draw_poses, limbs_apart
from rendra_lab.tasks.smplify.pose_prior import PosePrior, PosePriorError, generated_prior, prior_file

Arrays = dict[str, Any]


@pytest.fixture(scope="module")
def prior() -> PosePrior:
    return PosePrior.built_in()


@pytest.fixture(scope="module")
def held_out() -> Tensor:
    return draw_poses(600, seed=4321).joints[:, 1:].flatten(1)


def mixture(count: int = 3, size: int = 5, seed: int = 0) -> Arrays:
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(count, size, size)) / 3
    covars = roots @ roots.transpose(0, 2, 1) + np.exp(rng.normal(size=(count, 1, 1))) * 0.1 * np.eye(size)
    weights = rng.uniform(0.2, 1, count)
    return {"means": rng.normal(size=(count, size)), "covars": covars, "weights": weights / weights.sum()}


def made(arrays: Arrays) -> PosePrior:
    return PosePrior(*(torch.from_numpy(arrays[key]) for key in ("means", "covars", "weights")))


def direct(arrays: Arrays, x: np.ndarray) -> np.ndarray:
    """The formula, component by component: min over g of d^T S^-1 d / 2 - log c_g."""
    size = x.shape[1]
    roots = [math.sqrt(np.linalg.det(covar)) for covar in arrays["covars"]]
    columns = []
    for mean, covar, weight, root in zip(arrays["means"], arrays["covars"], arrays["weights"], roots, strict=True):
        c = weight / ((2 * math.pi) ** (size / 2) * (root / min(roots)))
        apart = x - mean
        columns.append(0.5 * np.einsum("nd,de,ne->n", apart, np.linalg.inv(covar), apart) - math.log(c))
    return np.stack(columns, axis=1)


def test_squared_rows_are_the_least_of_the_direct_formula() -> None:
    arrays = mixture()
    x = np.random.default_rng(1).normal(size=(40, 5))
    scores = direct(arrays, x)
    rows = made(arrays).residuals(torch.from_numpy(x))
    assert rows.shape == (40, 6)
    torch.testing.assert_close(rows.square().sum(1), torch.from_numpy(scores.min(1)), rtol=1e-5, atol=1e-5)
    assert made(arrays).best_component(torch.from_numpy(x)).tolist() == scores.argmin(1).tolist()
    assert len(set(scores.argmin(1).tolist())) > 1


def test_the_last_row_is_the_root_of_minus_log_c() -> None:
    arrays = mixture()
    mean = torch.from_numpy(arrays["means"])
    rows = made(arrays).residuals(mean)
    scores = direct(arrays, arrays["means"])
    torch.testing.assert_close(rows[:, -1].square(), torch.from_numpy(scores.min(1)), rtol=1e-5, atol=1e-5)


def test_one_gaussian_of_unit_variance_is_the_distance() -> None:
    prior = PosePrior(torch.zeros(1, 69), torch.eye(69)[None], torch.ones(1))
    pose = torch.randn(4, 69)
    rows = prior.residuals(pose)
    torch.testing.assert_close(rows[:, :-1].square().sum(1), pose.square().sum(1) / 2)
    torch.testing.assert_close(rows[:, -1].square(), torch.full((4,), 34.5 * math.log(2 * math.pi)))  # 63.4


def test_gradients_are_those_of_the_best_component() -> None:
    prior = made(mixture()).double()
    pose = torch.randn(6, 5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(prior.residuals, (pose,), atol=1e-5)
    jacobian = torch.autograd.functional.jacobian(lambda x: prior.residuals(x).sum(0), pose).movedim(0, 1)
    torch.testing.assert_close(prior.row_derivatives(torch.eye(5).double().expand(6, 5, 5), pose), jacobian)


def test_no_poses_and_poses_of_another_size(prior: PosePrior) -> None:
    assert prior.residuals(torch.zeros(0, 69)).shape == (0, 70)
    with pytest.raises(ValueError, match=r"poses \(N, 69\), got \(2, 72\)"):
        prior.residuals(torch.zeros(2, 72))


# what is built in


def test_the_built_in_prior_is_small_and_of_eight_components(prior: PosePrior) -> None:
    assert prior.means.shape == (8, 69)
    assert not list(prior.parameters())
    import rendra_lab.tasks.smplify as package

    assert (Path(package.__path__[0]) / "data" / "pose_prior.npz").stat().st_size < 200_000


def log_likelihood(prior: PosePrior, x: Tensor) -> Tensor:
    """Of the whole mixture, not its largest component."""
    means, factors = prior.means.double(), prior.factors.double()
    apart = torch.einsum("ngd,gde->nge", x.double()[:, None] - means, factors).square().sum(-1)
    half_logdet = -(factors * math.sqrt(2)).diagonal(dim1=1, dim2=2).log().sum(1)
    scores = -(apart + prior.constants.double()) - half_logdet.min()
    return scores.logsumexp(1).mean()


def test_held_out_poses_are_likelier_than_under_simpler_priors(prior: PosePrior, held_out: Tensor) -> None:
    seen = draw_poses(2000, seed=99).joints[:, 1:].flatten(1).double()
    covariance = torch.cov(seen.T) + 0.06**2 * torch.eye(69).double()
    one = torch.ones(1).double()
    single = PosePrior(seen.mean(0, keepdim=True), covariance[None], one)
    at_rest = PosePrior(torch.zeros(1, 69), (seen.square().mean() * torch.eye(69).double())[None], one)
    likely = [float(log_likelihood(each, held_out)) for each in (prior, single, at_rest)]
    assert likely[0] > likely[1] + 10 > likely[2] + 60


def spoiled(pose: Tensor, name: str, angles: tuple[float, float, float]) -> Tensor:
    changed = pose.clone()
    column = 3 * (SMPL_JOINTS.index(name) - 1)
    changed[:, column : column + 3] = torch.tensor(angles) * (math.pi / 180)
    return changed


@pytest.mark.parametrize(
    ("joint", "angles"),
    [
        ("left_knee", (-45, 0, 0)),
        ("right_elbow", (0, -50, 0)),
        ("left_shoulder", (0, 0, -125)),  # into the chest
        ("head", (0, 150, 0)),
        ("spine2", (0, 0, 70)),
    ],
)
def test_what_a_body_cannot_do_is_unlikely(
    prior: PosePrior, held_out: Tensor, joint: str, angles: tuple[float, float, float]
) -> None:
    assert float((prior(spoiled(held_out, joint, angles)) > prior(held_out)).float().mean()) > 0.97


def test_an_arm_through_the_trunk_is_less_likely_than_one_beside_it(prior: PosePrior, held_out: Tensor) -> None:
    hanging = spoiled(held_out, "left_shoulder", (0, 0, -75))
    before, inside = spoiled(hanging, "left_elbow", (0, -95, 0)), spoiled(hanging, "left_elbow", (75, -95, 0))
    whole = torch.cat([torch.zeros(len(inside), 3), inside], dim=1).reshape(-1, 24, 3)
    through = ~limbs_apart(whole)
    assert float(through.float().mean()) > 0.4
    assert float((prior(inside) > prior(before))[through].float().mean()) > 0.97


# files of others


def test_a_pickle_of_the_authors_layout_is_read(tmp_path: Path) -> None:
    arrays = mixture(8, 69)
    path = tmp_path / "gmm_08.pkl"
    path.write_bytes(pickle.dumps(arrays, protocol=2))
    read, pose = prior_file(path), torch.randn(3, 69)
    torch.testing.assert_close(read.residuals(pose), made(arrays).residuals(pose))
    assert isinstance(generated_prior(), PosePrior)


def test_a_npz_of_the_same_keys_is_read(tmp_path: Path) -> None:
    arrays = mixture()
    np.savez(tmp_path / "mine.npz", **arrays, notes=np.array("of ours"))
    assert PosePrior.load(tmp_path / "mine.npz").num_numbers == 5


def not_symmetric(arrays: Arrays) -> Arrays:
    arrays["covars"][1, 0, 1] += 5
    return arrays


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda a: {k: v for k, v in a.items() if k != "covars"}, "lacks covars.*has means, weights"),
        (lambda a: {}, "lacks means, covars, weights.*has nothing"),
        (lambda a: a | {"covars": -a["covars"]}, r"positive definite, and covars\[0\] is not"),
        (not_symmetric, r"covars\[1\] is not"),
        (lambda a: a | {"means": a["means"][0]}, r"means must be \(G, D\), got \(5,\)"),
        (
            lambda a: a | {"covars": a["covars"][:2]},
            r"covars must be \(3, 5, 5\) for means \(3, 5\), got \(2, 5, 5\)",
        ),
        (lambda a: a | {"weights": a["weights"][None]}, r"weights must be \(3,\)"),
        (lambda a: a | {"weights": a["weights"] * 2}, "positive and sum to 1"),
        (lambda a: a | {"weights": np.array([1.5, -0.25, -0.25])}, "positive and sum to 1"),
        (lambda a: a | {"means": a["means"] * np.nan}, "means holds numbers that are not finite"),
        (lambda a: a | {"means": np.array(["a", "b"])}, "means must be an array of numbers"),
        (lambda a: a | {"means": np.zeros((0, 5))}, r"means must be \(G, D\)"),
    ],
)
@pytest.mark.parametrize("suffix", [".pkl", ".npz"])
def test_what_is_no_prior_is_refused_in_one_line(change: Any, complaint: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"prior{suffix}"
    if suffix == ".pkl":
        path.write_bytes(pickle.dumps(change(mixture())))
    else:
        np.savez(path, **change(mixture()))
    with pytest.raises(PosePriorError, match=complaint) as caught:
        PosePrior.load(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


class _Hostile:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> Any:
        return Path.touch, (self.marker,)


def test_a_hostile_pickle_runs_nothing(tmp_path: Path) -> None:
    path, marker = tmp_path / "gmm_08.pkl", tmp_path / "marker"
    path.write_bytes(pickle.dumps({"means": _Hostile(marker)}))
    with pytest.raises(PosePriorError, match="only arrays are read"):
        PosePrior.load(path)
    assert not marker.exists()


@pytest.mark.parametrize("content", [b"", b"not a pickle", pickle.dumps([1, 2]), pickle.dumps({"means": 1})[:-3]])
@pytest.mark.parametrize("name", ["prior.pkl", "prior.npz"])
def test_broken_files_are_refused(content: bytes, name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(PosePriorError, match=name):
        PosePrior.load(tmp_path / name)


def test_no_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(PosePriorError, match=r"there is no pose prior .*none\.pkl"):
        PosePrior.load(tmp_path / "none.pkl")
    with pytest.raises(PosePriorError, match="it is a folder"):
        PosePrior.load(tmp_path)
