"""What poses people take: a mixture of Gaussians over the rotation vectors of a body's joints.

Bogo et al., "Keep it SMPL", ECCV 2016, Sec. 3.2: the sum over the components is replaced by its largest summand, as
in Olson and Agarwal, "Inference on networks of mixtures for robust robot mapping", 2013. The built-in mixture was
fitted to poses that `rendra_lab.synthesis.poses` generates, not to motion capture; see data/NOTICE.md.
Letters: N poses, G components, D numbers of a pose without its heading, 69 for SMPL.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from rendra.body.restricted_pickle import PickleRefused, read_pickle
from rendra_lab.errors import UserError

_KEYS = ("means", "covars", "weights")
_MOST_BYTES = 2**28  # of all arrays of a file; the authors' has 0.3 MB


class PosePriorError(UserError):
    """A file that holds no pose prior; says which file, which key, and what was expected."""


class PosePrior(nn.Module):
    """-log of the largest weighted component, as a sum of squares.

    A component g scores |x - mean|^2 / 2 in its own metric, and -log c with c = w / ((2 pi)^(D/2) s / s_least), where
    s is the root of its covariance's determinant and s_least the least one of all: so a sharp component costs least.

    Args:
        means: (G, D).
        covariances: (G, D, D), symmetric and positive definite.
        weights: (G,) positive, of sum 1.

    Raises:
        ValueError: what is named above does not hold, or numbers are not finite.
    """

    means: Tensor
    factors: Tensor  # (G, D, D) of Cholesky, of half the precisions
    constants: Tensor  # (G,) -log c

    def __init__(self, means: Tensor, covariances: Tensor, weights: Tensor) -> None:
        super().__init__()
        _check(means, covariances, weights)
        wide = covariances.double()
        precision = torch.linalg.inv((wide + wide.transpose(1, 2)) / 2)
        factors = torch.linalg.cholesky((precision + precision.transpose(1, 2)) / 2)
        half_logdet = torch.linalg.slogdet(wide).logabsdet / 2
        likely = weights.double().log() - (half_logdet - half_logdet.min())
        constants = means.shape[1] / 2 * math.log(2 * math.pi) - likely
        self.register_buffer("means", means.float(), False)
        self.register_buffer("factors", (math.sqrt(0.5) * factors).float(), False)
        self.register_buffer("constants", constants.float(), False)

    @classmethod
    def built_in(cls) -> PosePrior:
        """Eight Gaussians, D = 69, fitted to generated poses; free to use."""
        with (files("rendra_lab.tasks.smplify") / "data" / "pose_prior.npz").open("rb") as file:
            content = np.load(file, allow_pickle=False)
            return cls(*(torch.from_numpy(content[key]) for key in _KEYS))

    @classmethod
    def load(cls, path: str | Path) -> PosePrior:
        """The mixture of a file: `.npz`, or a pickle such as the authors' `gmm_08.pkl`; nothing in it is executed.

        Its keys are means (G, D), covars (G, D, D) and weights (G,).

        Raises:
            PosePriorError: no such file, a missing key, arrays of wrong shapes or numbers, covariances that are not
                positive definite, or a pickle that names anything but arrays.
        """
        path = Path(path)
        content = _read(path)
        missing = [key for key in _KEYS if key not in content]
        if missing:
            raise PosePriorError(
                f"{path} lacks {', '.join(missing)}: a pose prior has {', '.join(_KEYS)}, and this file has "
                f"{', '.join(sorted(map(str, content))) or 'nothing'}"
            )
        try:
            return cls(*(_floats(key, content[key]) for key in _KEYS))
        except ValueError as error:
            raise PosePriorError(f"{path}: {error}") from error

    @property
    def num_numbers(self) -> int:
        """D."""
        return self.means.shape[1]

    def residuals(self, pose: Tensor) -> Tensor:
        """Rows (N, D + 1): the whitened distance to the best component over sqrt(2), and the root of its -log c.

        Args:
            pose: (N, D) rotation vectors of all joints but the first.

        Raises:
            ValueError: poses of another size than the prior's.
        """
        apart, best = self._best(pose)
        rows = torch.arange(len(pose), device=pose.device)
        constant = self.constants.to(pose.dtype).index_select(0, best)
        return torch.cat([apart[rows, best], constant.sqrt()[:, None]], dim=1)

    def row_derivatives(self, changes: Tensor, pose: Tensor) -> Tensor:
        """How `residuals` (N, D + 1) change as the pose does: (N, D + 1, P) of changes (N, D, P)."""
        turned = self.factors.to(pose.dtype).index_select(0, self.best_component(pose)).transpose(1, 2) @ changes
        return torch.cat([turned, torch.zeros_like(turned[:, :1])], dim=1)

    def best_component(self, pose: Tensor) -> Tensor:
        """Which component (N,) poses (N, D) are taken for."""
        return self._best(pose)[1]

    def forward(self, pose: Tensor) -> Tensor:
        """-log of the largest weighted component (N,) of poses (N, D), but for a constant: the squared residuals."""
        return self.residuals(pose).square().sum(1)

    def _best(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        if pose.ndim != 2 or pose.shape[1] != self.num_numbers:
            raise ValueError(f"this pose prior is of poses (N, {self.num_numbers}), got {tuple(pose.shape)}")
        means, factors = self.means.to(pose.dtype), self.factors.to(pose.dtype)
        apart = torch.einsum("ngd,gde->nge", pose[:, None] - means, factors)
        return apart, (apart.detach().square().sum(-1) + self.constants.to(pose.dtype)).argmin(1)


def generated_prior() -> PosePrior:
    """What `prior=generated` is: `PosePrior.built_in`."""
    return PosePrior.built_in()


def prior_file(path: str | Path) -> PosePrior:
    """What `prior=file prior.path=FILE` is: `PosePrior.load`."""
    return PosePrior.load(path)


def _check(means: Tensor, covariances: Tensor, weights: Tensor) -> None:
    if means.ndim != 2 or 0 in means.shape:
        raise ValueError(f"means must be (G, D), got {tuple(means.shape)}")
    count, size = means.shape
    for name, value, shape in (("covars", covariances, (count, size, size)), ("weights", weights, (count,))):
        if tuple(value.shape) != shape:
            raise ValueError(f"{name} must be {shape} for means {(count, size)}, got {tuple(value.shape)}")
    for name, value in (("means", means), ("covars", covariances), ("weights", weights)):
        if not bool(value.isfinite().all()):
            raise ValueError(f"{name} holds numbers that are not finite")
    if not (bool((weights > 0).all()) and abs(float(weights.double().sum()) - 1) < 1e-3):
        raise ValueError(f"weights must be positive and sum to 1, got {[round(w, 4) for w in weights.tolist()]}")
    wide = covariances.double()
    lopsided = (wide - wide.transpose(1, 2)).abs().amax((1, 2)) > 1e-4 * wide.abs().amax((1, 2))
    failed = torch.linalg.cholesky_ex((wide + wide.transpose(1, 2)) / 2).info != 0
    if bool((lopsided | failed).any()):
        first = int((lopsided | failed).nonzero()[0])
        raise ValueError(f"covars must be symmetric and positive definite, and covars[{first}] is not")


def _read(path: Path) -> Mapping[str, Any]:
    if not path.is_file():
        raise PosePriorError(f"there is no pose prior {path}{' (it is a folder)' if path.is_dir() else ''}")
    if path.suffix != ".npz":
        try:
            content = read_pickle(path)
        except (PickleRefused, ValueError) as error:
            raise PosePriorError(str(error)) from error
        if not isinstance(content, Mapping):
            raise PosePriorError(f"{path} holds a {type(content).__name__}, not a dict of {', '.join(_KEYS)}")
        return content
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > _MOST_BYTES:
            raise PosePriorError(f"{path} claims {size:,} bytes of arrays; at most {_MOST_BYTES:,} are read")
        with np.load(path, allow_pickle=False) as content:
            return {name: content[name] for name in content.files}
    except (zipfile.BadZipFile, OSError, ValueError, EOFError) as error:
        if isinstance(error, PosePriorError):
            raise
        raise PosePriorError(f"{path} cannot be read: {error}") from error


def _floats(key: str, value: Any) -> Tensor:
    try:
        array = np.asarray(value)
        if array.dtype == object or array.dtype.kind not in "fiu":
            raise ValueError(f"its type is {array.dtype}")
        return torch.from_numpy(np.array(array, np.float64, order="C"))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{key} must be an array of numbers: {error}") from error
