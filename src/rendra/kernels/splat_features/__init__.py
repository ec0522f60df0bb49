"""Clouds of features splatted into pictures in one pass, without fragments: every point a soft disc.

Letters: B clouds, P points each, C features, H x W pixels; x right, y down, the middle of the first pixel at 0.5.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rendra.kernels.splat_features import numba_cpu, reference

__all__ = ["ACCUMULATIONS", "Splat", "splat_features"]

ACCUMULATIONS = ("alphacomposite", "wsum", "wsumnorm", "naive")


class Splat(NamedTuple):
    """What the splats come to.

    Attributes:
        image: (B, C, H, W) features, zeros where no point fell; in memory pixel by pixel (`torch.channels_last`).
        opacity: (B, 1, H, W) in [0, 1]: 1 - prod (1 - a_k) of `alphacomposite`; min(sum a_k, 1) of `wsum` and
            `wsumnorm`; whether there is a point of `naive`.
    """

    image: Tensor
    opacity: Tensor


def splat_features(
    points: Tensor,
    depths: Tensor,
    features: Tensor,
    image_size: tuple[int, int],
    radius: float,
    points_per_pixel: int,
    accumulation: str = "alphacomposite",
    tau: float = 1.0,
    near: float = 0.0,
    stop_below: float = 1e-5,
) -> Splat:
    """Draw each point as a disc whose weight falls from its middle, and blend the nearest points of every pixel.

    At a pixel count the `points_per_pixel` points of least depth among those whose distance d to its middle is below
    the radius r, near first, of equal depth the one of lower index; a_k = (1 - sqrt(clamp(d^2 / r^2, 1e-3, 1)))^tau.

    - `alphacomposite`: sum a_k f_k prod_{l<k} (1 - a_l)
    - `wsum`: sum a_k f_k
    - `wsumnorm`: sum a_k f_k / max(sum a_k, 1e-4)
    - `naive`: the feature of the nearest point (points_per_pixel and tau do not count)

    Points whose depth is not above `near` or not finite, and points outside the picture by more than a radius, are
    left out. Differentiable in features and, through d, in points; not in depths, which only say who is in front.
    The same on any number of threads. Wiles et al., "SynSin", CVPR 2020, Sec. 3.2.

    Args:
        points: (B, P, 2) in pixels.
        depths: (B, P).
        features: (B, P, C), finite where the depth is.
        image_size: (H, W).
        radius: of a disc, pixels.
        points_per_pixel: most points that are blended.
        accumulation: one of the four above.
        tau: exponent of the weights, positive.
        near: depth of the nearest plane.
        stop_below: with `alphacomposite`, points in front of which less light is left than this weigh nothing: all
            that is left out weighs less than this together; 0 keeps all.

    Raises:
        ValueError: a shape, type, device or setting that cannot be.
    """
    _check_tensors(points, depths, features)
    _check_settings(image_size, radius, points_per_pixel, accumulation, tau, stop_below)
    if accumulation == "naive":
        points_per_pixel, tau = 1, 1.0
    order = _near_first(points.detach(), depths.detach(), near)
    blending = points_per_pixel, ACCUMULATIONS.index(accumulation), float(tau), float(stop_below)
    is_fast = points.device.type == "cpu" and points.dtype == torch.float32
    splat = _splat_on_cpu if is_fast else reference.splat_features
    height, width = image_size
    image, opacity = splat(points, order, features.contiguous(), height, width, float(radius), *blending)
    return Splat(image.permute(0, 3, 1, 2), opacity[:, None])


def _near_first(points: Tensor, depths: Tensor, near: float) -> Tensor:
    """Each cloud's points in order of depth (B, P), as rows of all clouds one after the other; -1 for none."""
    is_drawn = depths.isfinite() & (depths > near) & points.isfinite().all(-1)
    keys, order = torch.where(is_drawn, depths, math.inf).sort(dim=1, stable=True)
    first = torch.arange(len(points), device=points.device)[:, None] * points.shape[1]
    return torch.where(keys < math.inf, order + first, -1).int()


def _words(tensor: Tensor) -> str:
    return f"{tensor.dtype} of {tuple(tensor.shape)} on {tensor.device}"


def _check_tensors(points: Tensor, depths: Tensor, features: Tensor) -> None:
    if points.ndim != 3 or points.shape[2] != 2 or not points.is_floating_point():
        raise ValueError(f"points must be floats of shape (B, P, 2), got {_words(points)}")
    expected = f"{points.dtype} on {points.device}, like the points"
    for name, tensor, tail in (("depths", depths, ""), ("features", features, ", C")):
        is_alike = tensor.dtype == points.dtype and tensor.device == points.device
        if tensor.ndim != (3 if tail else 2) or tensor.shape[:2] != points.shape[:2] or not is_alike:
            shape = f"({len(points)}, {points.shape[1]}{tail})"
            raise ValueError(f"{name} must have shape {shape} and be {expected}, got {_words(tensor)}")


def _check_settings(
    image_size: tuple[int, int], radius: float, most: int, accumulation: str, tau: float, stop_below: float
) -> None:
    height, width = image_size
    if height < 1 or width < 1:
        raise ValueError(f"image_size must be (height, width) of at least one pixel, got {tuple(image_size)}")
    for name, value in (("radius", radius), ("tau", tau)):
        if not 0 < value < math.inf:
            raise ValueError(f"{name} must be positive and finite, got {value}")
    if most < 1:
        raise ValueError(f"points_per_pixel must be 1 or more, got {most}")
    if accumulation not in ACCUMULATIONS:
        raise ValueError(f"accumulation must be one of {', '.join(ACCUMULATIONS)}, got {accumulation!r}")
    if not 0 <= stop_below <= 1:
        raise ValueError(f"stop_below must be a transmittance in [0, 1], got {stop_below}")


def _rows(tensor: Tensor) -> np.ndarray:
    """The clouds (B, P, n) one after the other (B P, n), as kernels read them."""
    return tensor.contiguous().flatten(0, 1).numpy()


@torch.library.custom_op("rendra::splat_features", mutates_args=(), device_types="cpu")
def _splat_on_cpu(
    points: Tensor,
    order: Tensor,
    features: Tensor,
    height: int,
    width: int,
    radius: float,
    points_per_pixel: int,
    mode: int,
    tau: float,
    stop_below: float,
) -> tuple[Tensor, Tensor]:
    image = features.new_empty((len(points), height, width, features.shape[2]))
    opacity = features.new_empty((len(points), height, width))
    settings = numba_cpu.settings_of(height, width, radius, points_per_pixel, mode, tau, stop_below)
    inputs = _rows(points), order.contiguous().numpy(), _rows(features)
    numba_cpu.forward(*inputs, settings, image.numpy(), opacity.numpy())
    return image, opacity


@_splat_on_cpu.register_fake
def _(points, order, features, height, width, *settings):  # type: ignore[no-untyped-def]
    shape = len(points), height, width
    return features.new_empty((*shape, features.shape[2])), features.new_empty(shape)


@torch.library.custom_op("rendra::splat_features_backward", mutates_args=(), device_types="cpu")
def _gradient_on_cpu(
    points: Tensor,
    order: Tensor,
    features: Tensor,
    grad_image: Tensor,
    grad_opacity: Tensor,
    moves: bool,
    radius: float,
    points_per_pixel: int,
    mode: int,
    tau: float,
    stop_below: float,
) -> tuple[Tensor, Tensor]:
    _, height, width = grad_opacity.shape
    settings = numba_cpu.settings_of(height, width, radius, points_per_pixel, mode, tau, stop_below)
    inputs = _rows(points), order.contiguous().numpy(), _rows(features)
    upstream = grad_image.contiguous().numpy(), grad_opacity.contiguous().numpy()
    grad_points, grad_features = numba_cpu.backward(*inputs, settings, upstream, moves)
    return torch.from_numpy(grad_points).view(points.shape), torch.from_numpy(grad_features).view(features.shape)


@_gradient_on_cpu.register_fake
def _(points, order, features, *upstream_and_settings):  # type: ignore[no-untyped-def]
    return tuple(torch.empty_like(x, memory_format=torch.contiguous_format) for x in (points, features))


def _remember(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.save_for_backward(*inputs[:3])
    ctx.settings = inputs[5:]


def _gradient(ctx: Any, grad_image: Tensor, grad_opacity: Tensor) -> Any:
    moves = ctx.needs_input_grad[0]
    grad_points, grad_features = _gradient_on_cpu(*ctx.saved_tensors, grad_image, grad_opacity, moves, *ctx.settings)
    return grad_points if moves else None, None, grad_features, *[None] * 7


_splat_on_cpu.register_autograd(_gradient, setup_context=_remember)
