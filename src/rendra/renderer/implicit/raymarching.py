"""What a ray sees of the samples along it.

A density is here what scripts mean by it: the opacity of one sample, in [0, 1], whatever its distance to the next
(alpha of a layer). From a physical density sigma it is 1 - exp(-sigma delta).

Letters: S samples along a ray, first the nearest; C channels.
"""

import warnings
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class EmissionAbsorptionRaymarcher(nn.Module):
    """Samples that shine and hide what is behind them (Max, "Optical models for direct volume rendering", 1995).

    Args:
        surface_thickness: t >= 1. A sample is hidden by those t and more before it; a surface that several samples
            share does then not hide itself.
    """

    def __init__(self, surface_thickness: int = 1) -> None:
        super().__init__()
        if surface_thickness < 1:
            raise ValueError(f"surface_thickness must be at least 1, got {surface_thickness}")
        self.surface_thickness = surface_thickness

    def forward(self, rays_densities: Tensor, rays_features: Tensor, eps: float = 1e-10, **kwargs: Any) -> Tensor:
        """Composite features and opacity.

        With d the densities and f the features, w_j = d_j prod_{k <= j - t} (1 + eps - d_k).

        Args:
            rays_densities: (..., S, 1), each in [0, 1]; others are warned of.
            rays_features: (..., S, C).
            eps: keeps the product above 0 behind an opaque sample, where the dtype is fine enough to hold it.
            **kwargs: ignored, as are the rays that renderers pass.

        Returns:
            (..., C + 1): sum_j w_j f_j, and at last the opacity 1 - prod_k (1 - d_k).

        Raises:
            ValueError: if an input is no tensor, or has another shape.
        """
        densities = _opacities(rays_densities)
        _check_features(rays_features, densities)
        weights = densities * _transmittance(1.0 + eps - densities, self.surface_thickness)
        features = (weights[..., None] * rays_features).sum(-2)
        return torch.cat((features, _opacity(densities)), dim=-1)


class AbsorptionOnlyRaymarcher(nn.Module):
    """Samples that only hide: silhouettes."""

    def forward(self, rays_densities: Tensor, **kwargs: Any) -> Tensor:
        """The opacity 1 - prod_k (1 - d_k) of every ray.

        Args:
            rays_densities: d, (..., S, 1), each in [0, 1]; others are warned of.
            **kwargs: ignored, as are the features and rays that renderers pass.

        Returns:
            (..., 1).

        Raises:
            ValueError: if the input is no tensor, or has another shape.
        """
        return _opacity(_opacities(rays_densities))


def _opacity(densities: Tensor) -> Tensor:
    """How much of the light from behind all samples (..., S) is lost: (..., 1)."""
    return 1.0 - (1.0 - densities).prod(dim=-1, keepdim=True)


def _transmittance(passes: Tensor, shift: int) -> Tensor:
    """What the samples at least `shift` before each let through together: a cumulative product, moved behind."""
    shift = min(shift, passes.shape[-1])
    before = passes[..., : passes.shape[-1] - shift].cumprod(-1)
    return F.pad(before, (shift, 0), value=1.0)


def _opacities(rays_densities: Tensor) -> Tensor:
    """The checked densities, (..., S)."""
    if not isinstance(rays_densities, Tensor):
        raise ValueError(f"rays_densities has to be a tensor, got {type(rays_densities).__name__}")
    if rays_densities.ndim < 2 or rays_densities.shape[-1] != 1:
        raise ValueError(f"rays_densities must have shape (..., S, 1), got {tuple(rays_densities.shape)}")
    densities = rays_densities[..., 0]
    if densities.numel() > 0:
        low, high = densities.detach().aminmax()
        if low < 0 or high > 1:
            warnings.warn(
                f"rays_densities must lie in [0, 1], they range from {low.item():g} to {high.item():g}", stacklevel=4
            )
    return densities


def _check_features(rays_features: Tensor, densities: Tensor) -> None:
    if not isinstance(rays_features, Tensor):
        raise ValueError(f"rays_features has to be a tensor, got {type(rays_features).__name__}")
    if rays_features.shape[:-1] != densities.shape:
        raise ValueError(
            "rays_densities and rays_features must have shapes (..., S, 1) and (..., S, C); "
            f"got {(*densities.shape, 1)} and {tuple(rays_features.shape)}"
        )
