"""What a ray sees of the samples along it.

A density is here what scripts mean by it: the opacity of one sample, in [0, 1], whatever its distance to the next
(alpha of a layer). From a physical density sigma, whose unit is one over length, `opacity_from_density` makes it.

Letters: S samples along a ray, first the nearest; C channels.
"""

import warnings
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

__all__ = ["AbsorptionOnlyRaymarcher", "EmissionAbsorptionRaymarcher", "opacity_from_density"]

OPACITY_TOLERANCE = 1e-5  # how far rounding may take an opacity out of [0, 1]


def opacity_from_density(
    rays_densities: Tensor, lengths: Tensor, directions: Tensor | None = None, last_step: float | None = None
) -> Tensor:
    """The opacities 1 - exp(-sigma_j delta_j) of samples with physical densities.

    What ray marchers take in place of densities if a picture is not to depend on the number of samples
    (Mildenhall et al., "NeRF", ECCV 2020, Eq. 3):

        images = EmissionAbsorptionRaymarcher()(opacity_from_density(sigma, bundle.lengths, bundle.directions), rgb)

    Args:
        rays_densities: sigma, (..., S, 1), at least 0, in one over the unit of delta.
        lengths: t, (..., S), ascending, as in a ray bundle; delta_j = t_{j+1} - t_j.
        directions: (..., 3): delta is measured in the world, times their norms; None: in units of lengths.
        last_step: t_S - t_{S-1}, which the lengths do not say: None takes the step before (the only sample of a ray
            then has none, and opacity 0), a large number makes what is there opaque, as NeRF's 1e10 does.

    Returns:
        (..., S, 1), in [0, 1).

    Raises:
        ValueError: shapes that do not fit together.
    """
    if rays_densities.ndim < 2 or rays_densities.shape[-1] != 1 or rays_densities.shape[:-1] != lengths.shape:
        raise ValueError(
            "rays_densities and lengths must have shapes (..., S, 1) and (..., S), got "
            f"{tuple(rays_densities.shape)} and {tuple(lengths.shape)}"
        )
    if directions is not None and directions.shape != (*lengths.shape[:-1], 3):
        raise ValueError(
            f"directions must have shape (..., 3) = {(*lengths.shape[:-1], 3)}, got {tuple(directions.shape)}"
        )
    steps = lengths.diff(dim=-1)
    if last_step is not None:
        steps = F.pad(steps, (0, 1), value=last_step)
    else:
        steps = torch.cat((steps, steps[..., -1:]), dim=-1) if steps.shape[-1] else torch.zeros_like(lengths)
    if directions is not None:
        steps = steps * directions.norm(dim=-1, keepdim=True)
    return -torch.expm1(-rays_densities * steps[..., None])


class _Raymarcher(nn.Module):
    """Where the range of opacities is looked at."""

    _has_looked = False

    def _opacities(self, rays_densities: Tensor) -> Tensor:
        """The checked densities, (..., S).

        Their range is looked at on a CPU always, elsewhere once: looking there waits for the device.
        """
        densities = _squeezed(rays_densities)
        if densities.numel() > 0 and (densities.device.type == "cpu" or not self._has_looked):
            self._has_looked = True
            low, high = (bound.item() for bound in densities.detach().aminmax())
            if low < -OPACITY_TOLERANCE or high > 1 + OPACITY_TOLERANCE:
                warnings.warn(f"rays_densities must lie in [0, 1], they range from {low:g} to {high:g}", stacklevel=5)
        return densities


class EmissionAbsorptionRaymarcher(_Raymarcher):
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
            rays_densities: (..., S, 1), each in [0, 1]; others are warned of,
                on a GPU in the first call only.
            rays_features: (..., S, C).
            eps: keeps the product above 0 behind an opaque sample, where the dtype is fine enough to hold it.
            **kwargs: ignored, as are the rays that renderers pass.

        Returns:
            (..., C + 1): sum_j w_j f_j, and at last the opacity 1 - prod_k (1 - d_k).

        Raises:
            ValueError: if an input is no tensor, or has another shape.
        """
        densities = self._opacities(rays_densities)
        _check_features(rays_features, densities)
        weights = densities * _transmittance(1.0 + eps - densities, self.surface_thickness)
        features = (weights[..., None] * rays_features).sum(-2)
        return torch.cat((features, _opacity(densities)), dim=-1)


class AbsorptionOnlyRaymarcher(_Raymarcher):
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
        return _opacity(self._opacities(rays_densities))


def _opacity(densities: Tensor) -> Tensor:
    """How much of the light from behind all samples (..., S) is lost: (..., 1)."""
    return 1.0 - (1.0 - densities).prod(dim=-1, keepdim=True)


def _transmittance(passes: Tensor, shift: int) -> Tensor:
    """What the samples at least `shift` before each let through together: a cumulative product, moved behind."""
    shift = min(shift, passes.shape[-1])
    before = passes[..., : passes.shape[-1] - shift].cumprod(-1)
    return F.pad(before, (shift, 0), value=1.0)


def _squeezed(rays_densities: Tensor) -> Tensor:
    """Densities without their last dimension, (..., S)."""
    if not isinstance(rays_densities, Tensor):
        raise ValueError(f"rays_densities has to be a tensor, got {type(rays_densities).__name__}")
    if rays_densities.ndim < 2 or rays_densities.shape[-1] != 1:
        raise ValueError(f"rays_densities must have shape (..., S, 1), got {tuple(rays_densities.shape)}")
    return rays_densities[..., 0]


def _check_features(rays_features: Tensor, densities: Tensor) -> None:
    if not isinstance(rays_features, Tensor):
        raise ValueError(f"rays_features has to be a tensor, got {type(rays_features).__name__}")
    if rays_features.shape[:-1] != densities.shape:
        raise ValueError(
            "rays_densities and rays_features must have shapes (..., S, 1) and (..., S, C); "
            f"got {(*densities.shape, 1)} and {tuple(rays_features.shape)}"
        )
