"""Samples along rays, packed one ray after the other, to the features, opacity and depth of each ray.

Letters: R rays, M samples of all rays, C channels. The samples of ray r are [ray_first[r], ray_first[r + 1]), first
the nearest. Nothing is padded: a ray has as many samples as it needs, or none.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.kernels.composite import numba_cpu, reference
from rendra.kernels.validation import check_ray_first

__all__ = ["Composite", "alphas_of", "compact", "composite_alphas", "composite_densities", "visible"]


class Composite(NamedTuple):
    """What rays saw.

    Attributes:
        features: (R, C) sum of w_j f_j; what lies behind all samples is not in it: add (1 - opacity) * background.
        opacity: (R,) sum of w_j, in [0, 1].
        depth: (R,) sum of w_j t_j; divided by the opacity it is the mean distance of what is seen.
        weights: (M,) w_j.
    """

    features: Tensor
    opacity: Tensor
    depth: Tensor
    weights: Tensor


def composite_alphas(
    alphas: Tensor, features: Tensor, positions: Tensor, ray_first: Tensor, stop_below: float = 0.0
) -> Composite:
    """Front-to-back compositing of opacities: w_j = a_j prod_{k<j} (1 - a_k).

    Differentiable in all tensors of floats, through all four results; the same on any number of threads. Max,
    "Optical models for direct volume rendering", 1995.

    Args:
        alphas: (M,) opacity of each sample, in [0, 1].
        features: (M, C) colours or anything else.
        positions: (M,) distance of each sample along its ray.
        ray_first: (R + 1,) int64, index of each ray's first sample, and M at the end.
        stop_below: a sample in front of which less transmittance is left than this weighs nothing; 0 keeps all.

    Raises:
        ValueError: a shape, type, device or limit that cannot be.
    """
    _check(alphas, features, {"positions": positions}, ray_first, stop_below, "alphas")
    return _composite(alphas, None, features, positions, ray_first, stop_below)


def composite_densities(
    densities: Tensor,
    deltas: Tensor,
    features: Tensor,
    positions: Tensor,
    ray_first: Tensor,
    stop_below: float = 0.0,
) -> Composite:
    """Front-to-back compositing of physical densities: a_j = 1 - exp(-sigma_j delta_j), and as `composite_alphas`.

    Keeps its precision, and that of its gradients, where sigma delta is tiny (1 - exp would cancel) and where it is
    huge (1 - alpha would). Mildenhall et al., "NeRF", ECCV 2020, Eq. 3.

    Args:
        densities: (M,) sigma, not negative, in 1 / length.
        deltas: (M,) length of each sample, not negative.
        features, positions, ray_first, stop_below: as there.

    Raises:
        ValueError: a shape, type, device or limit that cannot be.
    """
    _check(densities, features, {"deltas": deltas, "positions": positions}, ray_first, stop_below, "densities")
    return _composite(densities, deltas, features, positions, ray_first, stop_below)


def alphas_of(densities: Tensor, deltas: Tensor) -> Tensor:
    """Opacity 1 - exp(-sigma delta) of samples of that length, exact also where it is tiny."""
    return -torch.expm1(-densities * deltas)


def visible(alphas: Tensor, ray_first: Tensor, threshold: float) -> Tensor:
    """Which samples (M,) have transmittance prod_{k<j} (1 - a_k) >= threshold before them.

    Ask before the costly half of a field is evaluated: colours and gradients are needed of these samples alone. What
    `composite_alphas` weighs with stop_below=threshold are these; none but they. Not differentiable.

    Args:
        alphas: (M,) opacity of each sample, in [0, 1].
        ray_first: (R + 1,) int64, index of each ray's first sample, and M at the end.
        threshold: least transmittance, in [0, 1].

    Raises:
        ValueError: a shape, type, device or threshold that cannot be.
    """
    _check_values("alphas", alphas)
    check_ray_first(ray_first, alphas)
    _check_fraction("threshold", threshold)
    alphas = alphas.detach()
    if alphas.device.type != "cpu" or alphas.dtype != torch.float32:
        return reference.visible(alphas, ray_first, threshold)
    return _visible_on_cpu(alphas, ray_first, float(threshold))


def compact(mask: Tensor, ray_first: Tensor) -> tuple[Tensor, Tensor]:
    """Drop samples of rays.

    Args:
        mask: (M,) bool, which samples stay.
        ray_first: (R + 1,) int64, index of each ray's first sample, and M at the end.

    Returns:
        kept (K,): int64, index of each sample that stays: `x.index_select(0, kept)` are its values;
        ray_first (R + 1,): that of the samples that stay.

    Raises:
        ValueError: a shape, type or device that cannot be.
    """
    if mask.ndim != 1 or mask.dtype != torch.bool:
        raise ValueError(f"mask must be bool of shape (M,), got {mask.dtype} of {tuple(mask.shape)}")
    check_ray_first(ray_first, mask)
    stays_before = F.pad(mask.cumsum(0), (1, 0))
    return mask.nonzero().squeeze(1), stays_before.index_select(0, ray_first)


def _composite(
    values: Tensor, deltas: Tensor | None, features: Tensor, positions: Tensor, ray_first: Tensor, stop: float
) -> Composite:
    if values.device.type != "cpu" or values.dtype != torch.float32:
        return Composite(*reference.composite(values, deltas, features, positions, ray_first, stop))
    return Composite(*_composite_on_cpu(values, deltas, features, positions, ray_first, float(stop)))


def _check(
    values: Tensor, features: Tensor, others: dict[str, Tensor], ray_first: Tensor, stop_below: float, name: str
) -> None:
    _check_values(name, values)
    expected = f"{values.dtype} on {values.device}, like the {name}"
    if features.ndim != 2 or len(features) != len(values) or not _alike(features, values):
        raise ValueError(f"features must have shape ({len(values)}, C) and be {expected}, got {_words(features)}")
    for other, tensor in others.items():
        if tensor.shape != values.shape or not _alike(tensor, values):
            raise ValueError(f"{other} must have shape ({len(values)},) and be {expected}, got {_words(tensor)}")
    check_ray_first(ray_first, values)
    _check_fraction("stop_below", stop_below)


def _check_values(name: str, values: Tensor) -> None:
    if values.ndim != 1 or not values.is_floating_point():
        raise ValueError(f"{name} must be floats of shape (M,), got {values.dtype} of {tuple(values.shape)}")


def _check_fraction(name: str, value: float) -> None:
    if not 0 <= value <= 1:
        raise ValueError(f"{name} must be a transmittance in [0, 1], got {value}")


def _alike(tensor: Tensor, other: Tensor) -> bool:
    return tensor.dtype == other.dtype and tensor.device == other.device


def _words(tensor: Tensor) -> str:
    return f"{tuple(tensor.shape)} of {tensor.dtype} on {tensor.device}"


def _arrays(*tensors: Tensor | None) -> tuple[Any, ...]:
    return tuple(None if tensor is None else tensor.contiguous().numpy() for tensor in tensors)


@torch.library.custom_op("rendra::visible", mutates_args=(), device_types="cpu")
def _visible_on_cpu(alphas: Tensor, ray_first: Tensor, threshold: float) -> Tensor:
    mask = torch.empty_like(alphas, dtype=torch.bool, memory_format=torch.contiguous_format)
    numba_cpu.visible(alphas.contiguous().numpy(), ray_first.contiguous().numpy(), threshold, mask.numpy())
    return mask


@_visible_on_cpu.register_fake
def _(alphas, ray_first, threshold):  # type: ignore[no-untyped-def]
    return torch.empty_like(alphas, dtype=torch.bool, memory_format=torch.contiguous_format)


@torch.library.custom_op("rendra::composite", mutates_args=(), device_types="cpu")
def _composite_on_cpu(
    values: Tensor, deltas: Tensor | None, features: Tensor, positions: Tensor, ray_first: Tensor, stop_below: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    outputs = _empty_outputs(features, ray_first)
    packed = _arrays(values, deltas, features, positions)
    numba_cpu.forward(packed, ray_first.contiguous().numpy(), stop_below, _arrays(*outputs))
    return outputs


@_composite_on_cpu.register_fake
def _(values, deltas, features, positions, ray_first, stop_below):  # type: ignore[no-untyped-def]
    return _empty_outputs(features, ray_first)


def _empty_outputs(features: Tensor, ray_first: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    num_rays = len(ray_first) - 1
    per_ray = features.new_empty(num_rays), features.new_empty(num_rays)
    return features.new_empty((num_rays, features.shape[1])), *per_ray, features.new_empty(len(features))


@torch.library.custom_op("rendra::composite_backward", mutates_args=(), device_types="cpu")
def _gradient_on_cpu(
    values: Tensor,
    deltas: Tensor | None,
    features: Tensor,
    positions: Tensor,
    ray_first: Tensor,
    weights: Tensor,
    stop_below: float,
    grad_out: Tensor,
    grad_opacity: Tensor,
    grad_depth: Tensor,
    grad_weights: Tensor | None,
    all_inputs: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    grads = _empty_gradients(features, deltas is not None, all_inputs)
    packed = _arrays(values, deltas, features, positions)
    upstream: Any = _arrays(grad_out, grad_opacity, grad_depth, grad_weights)
    first, seen = _arrays(ray_first, weights)
    numba_cpu.backward(packed, first, seen, stop_below, upstream, _arrays(*grads))
    return grads


@_gradient_on_cpu.register_fake
def _(values, deltas, features, *others):  # type: ignore[no-untyped-def]
    return _empty_gradients(features, deltas is not None, others[-1])


def _empty_gradients(features: Tensor, has_deltas: bool, all_inputs: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of values, deltas, features and positions; the second and fourth of size 0 where they are not asked for."""
    total = len(features)
    return (
        features.new_empty(total),
        features.new_empty(total if has_deltas and all_inputs else 0),
        torch.empty_like(features, memory_format=torch.contiguous_format),
        features.new_empty(total if all_inputs else 0),
    )


def _remember(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    ctx.save_for_backward(*inputs[:5], output[3])
    ctx.stop_below = inputs[5]
    ctx.set_materialize_grads(False)


def _gradient(ctx, *upstream):  # type: ignore[no-untyped-def]
    values, deltas, features, positions, ray_first, weights = ctx.saved_tensors
    num_rays, needs = len(ray_first) - 1, ctx.needs_input_grad
    shapes = (num_rays, features.shape[1]), (num_rays,), (num_rays,)
    per_ray = [
        features.new_zeros(shape) if grad is None else grad for shape, grad in zip(shapes, upstream[:3], strict=True)
    ]
    grad_values, grad_deltas, grad_features, grad_positions = _gradient_on_cpu(
        values, deltas, features, positions, ray_first, weights, ctx.stop_below, *per_ray, upstream[3],
        needs[1] or needs[3],
    )  # fmt: skip
    return (
        grad_values,
        grad_deltas if needs[1] else None,
        grad_features,
        grad_positions if needs[3] else None,
        None,
        None,
    )


_composite_on_cpu.register_autograd(_gradient, setup_context=_remember)
