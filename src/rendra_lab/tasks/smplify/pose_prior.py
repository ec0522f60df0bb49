"""What poses people take: a mixture of Gaussians over the rotation vectors of a body's joints.

Bogo et al., "Keep it SMPL", ECCV 2016, Sec. 3.2: the sum over the components is replaced by its largest summand
(Olson and Agarwal, "Inference on networks of mixtures for robust robot mapping", 2013).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


class PosePrior(nn.Module):
    """-log of the largest weighted component, as a sum of squares.

    Args:
        means: (G, D).
        covariances: (G, D, D), positive definite.
        weights: (G,) positive, of sum 1.
    """

    means: Tensor
    factors: Tensor
    constants: Tensor

    def __init__(self, means: Tensor, covariances: Tensor, weights: Tensor) -> None:
        super().__init__()
        wide = covariances.double()
        self.register_buffer("means", means.float(), False)
        precision = torch.linalg.inv(wide)
        factors = torch.linalg.cholesky((precision + precision.transpose(1, 2)) / 2)
        self.register_buffer("factors", (math.sqrt(0.5) * factors).float(), False)
        logdet = torch.linalg.slogdet(wide).logabsdet / 2
        scores = weights.double().log() - (logdet - logdet.min()) - means.shape[1] / 2 * math.log(2 * math.pi)
        self.register_buffer("constants", (-scores).float(), False)

    def residuals(self, pose: Tensor) -> Tensor:
        """Rows (N, D + 1): the whitened distance to the best component over sqrt(2), and the root of its -log c."""
        apart = torch.einsum("ngd,gde->nge", pose[:, None] - self.means, self.factors)
        best = (apart.detach().square().sum(-1) + self.constants).argmin(1)
        rows = torch.arange(len(pose), device=pose.device)
        return torch.cat([apart[rows, best], self.constants[best].sqrt()[:, None]], dim=1)
