"""Positions as waves, so that a network of smooth functions can draw sharp edges."""

import math
from typing import Any

import torch
from torch import Tensor, nn


class HarmonicEmbedding(nn.Module):
    """Sines and cosines of every coordinate at frequencies w_k = omega_0 2^k (Mildenhall et al., "NeRF", Eq. 4).

    Of x (..., D) with n frequencies it makes (..., 2 D n), or (..., 2 D n + D) with the input:
        sin(w_0 x_0), ..., sin(w_n-1 x_0), sin(w_0 x_1), ..., sin(w_n-1 x_D-1), the cosines in the same order, x

    Args:
        n_harmonic_functions: n.
        omega_0: the lowest frequency, radians per unit of x. There is no factor of pi.
        logspace: double from one frequency to the next; False: go from omega_0 to omega_0 2^(n-1) in equal steps.
        append_input: put x at the end.
    """

    _frequencies: Tensor  # (n,) in units of omega_0

    def __init__(
        self,
        n_harmonic_functions: int = 6,
        omega_0: float = 1.0,
        logspace: bool = True,
        append_input: bool = True,
    ) -> None:
        super().__init__()
        if n_harmonic_functions < 0:
            raise ValueError(f"n_harmonic_functions must not be negative, got {n_harmonic_functions}")
        steps = torch.arange(n_harmonic_functions, dtype=torch.float32)
        if logspace:
            frequencies = 2.0**steps
        else:
            frequencies = torch.linspace(1.0, 2.0 ** (n_harmonic_functions - 1), n_harmonic_functions)
        self.register_buffer("_frequencies", frequencies, persistent=False)
        self.n_harmonic_functions = n_harmonic_functions
        self.omega_0 = omega_0
        self.append_input = append_input

    def forward(self, x: Tensor, diag_cov: Tensor | None = None, **kwargs: Any) -> Tensor:
        """Embed positions, or Gaussians around them.

        Args:
            x: (..., D).
            diag_cov: (..., D) variances: waves too short for them fade, as the mean over a Gaussian does, by
                exp(-w_k^2 variance / 2) (Barron et al., "Mip-NeRF", ICCV 2021, Eq. 14).
            **kwargs: ignored.

        Returns:
            (..., `get_output_dim(D)`).
        """
        angles = ((x * self.omega_0)[..., None] * self._frequencies).flatten(-2)  # (..., D n)
        waves = torch.cat((angles, angles + math.pi / 2), dim=-1).sin()  # cos a = sin(a + pi/2), to the last digit
        if diag_cov is not None:
            squares = (self.omega_0 * self._frequencies).square()
            fade = (-0.5 * diag_cov[..., None] * squares).flatten(-2).exp()
            waves = waves * torch.cat((fade, fade), dim=-1)
        return torch.cat((waves, x), dim=-1) if self.append_input else waves

    @staticmethod
    def get_output_dim_static(input_dims: int, n_harmonic_functions: int, append_input: bool) -> int:
        """The length of the embedding of a vector of length `input_dims`."""
        return input_dims * (2 * n_harmonic_functions + append_input)

    def get_output_dim(self, input_dims: int = 3) -> int:
        """The length of the embedding of a vector of length `input_dims`."""
        return self.get_output_dim_static(input_dims, self.n_harmonic_functions, self.append_input)
