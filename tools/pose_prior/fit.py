"""Fits the built-in pose prior: a mixture of Gaussians, by EM, to poses that this project generates.

    .venv/bin/python tools/pose_prior/fit.py src/rendra_lab/tasks/smplify/data/pose_prior.npz

Prints the mean log-likelihood of held-out poses: of the mixture, one Gaussian, and an isotropic one about the T-pose.
Dempster, Laird and Rubin, "Maximum likelihood from incomplete data via the EM algorithm", 1977; begun by k-means++
(Arthur and Vassilvitskii, 2007). Letters: N poses, D = 69 numbers of a pose without its heading, G components.
"""

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from rendra_lab.synthesis.poses import draw_poses

NUM_POSES = 20_000
NUM_HELD_OUT = 5_000
NUM_COMPONENTS = 8
LEAST_SPREAD = 0.06  # radians, added to every direction: the model's joints are not those of bones
LEAST_SHARE = 0.02  # of the poses that a component explains; one with less begins anew
RESTARTS = 6
ROUNDS = 80


@dataclass
class Mixture:
    """Of G Gaussians in D dimensions."""

    means: np.ndarray  # (G, D)
    covars: np.ndarray  # (G, D, D)
    weights: np.ndarray  # (G,)

    def scores(self, x: np.ndarray) -> np.ndarray:
        """Log of the weighted densities (N, G)."""
        columns = []
        for mean, covar, weight in zip(self.means, self.covars, self.weights, strict=True):
            factor = np.linalg.cholesky(covar)
            apart = np.linalg.solve(factor, (x - mean).T)
            logdet = np.log(np.diag(factor)).sum()
            columns.append(math.log(weight) - logdet - 0.5 * ((apart**2).sum(0) + x.shape[1] * math.log(2 * math.pi)))
        return np.stack(columns, axis=1)

    def log_likelihood(self, x: np.ndarray) -> float:
        """Mean over the rows of x."""
        return float(log_sum(self.scores(x)).mean())


def log_sum(scores: np.ndarray) -> np.ndarray:
    """log sum exp over the last axis."""
    top = scores.max(-1)
    return top + np.log(np.exp(scores - top[..., None]).sum(-1))


def from_shares(x: np.ndarray, shares: np.ndarray) -> Mixture:
    """The M step: shares (N, G) of the components in each pose."""
    amounts = shares.sum(0)
    means = shares.T @ x / amounts[:, None]
    floor = LEAST_SPREAD**2 * np.eye(x.shape[1])
    covars = np.stack([((x - mean) * share[:, None]).T @ (x - mean) / share.sum() + floor
                       for mean, share in zip(means, shares.T, strict=True)])  # fmt: skip
    return Mixture(means, covars, amounts / amounts.sum())


def first_shares(x: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Every pose to the nearest of centres that k-means++ draws and ten rounds of k-means move."""
    centres = x[rng.integers(len(x))][None]
    while len(centres) < count:
        gap = ((x[:, None] - centres) ** 2).sum(-1).min(1)
        centres = np.concatenate([centres, x[rng.choice(len(x), p=gap / gap.sum())][None]])
    for _ in range(10):
        nearest = ((x[:, None] - centres) ** 2).sum(-1).argmin(1)
        centres = np.stack([x[nearest == g].mean(0) if (nearest == g).any() else centres[g] for g in range(count)])
    return np.eye(count)[nearest]


def fit(x: np.ndarray, count: int, seed: int) -> Mixture:
    """The best of several fits by EM."""
    best, best_score = from_shares(x, np.ones((len(x), 1))), -np.inf
    for restart in range(RESTARTS if count > 1 else 1):
        mixture = from_shares(x, first_shares(x, count, np.random.default_rng(seed + restart)))
        for _ in range(ROUNDS):
            scores = mixture.scores(x)
            mixture = from_shares(x, np.exp(scores - log_sum(scores)[:, None]))
        score = mixture.log_likelihood(x)
        if score > best_score and mixture.weights.min() >= LEAST_SHARE:
            best, best_score = mixture, score
    return best


def poses(count: int, seed: int) -> np.ndarray:
    """(count, 69) rotation vectors."""
    return draw_poses(count, seed).joints[:, 1:].flatten(1).double().numpy()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(1)  # the same poses on any machine
    seen, unseen = poses(NUM_POSES, given.seed), poses(NUM_HELD_OUT, given.seed + 1000)
    mixture, single = fit(seen, NUM_COMPONENTS, given.seed), fit(seen, 1, given.seed)
    rest = Mixture(np.zeros((1, seen.shape[1])), (seen**2).mean() * np.eye(seen.shape[1])[None], np.ones(1))
    for name, model in {"mixture": mixture, "one Gaussian": single, "isotropic about the T-pose": rest}.items():
        print(f"{name}: {model.log_likelihood(unseen):.2f} nats held out, {model.log_likelihood(seen):.2f} seen")
    print("weights", np.round(mixture.weights, 3))
    means, weights = mixture.means.astype(np.float32), mixture.weights.astype(np.float32)
    covars = ((mixture.covars + mixture.covars.transpose(0, 2, 1)) / 2).astype(np.float32)
    given.output.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(given.output, means=means, covars=covars, weights=weights)


if __name__ == "__main__":
    main()
