"""Nearest points between batches of clouds: the K nearest, those in a ball, and the sums of a chamfer loss."""

import numpy as np
import torch
from torch import Tensor

from rendra.kernels.knn import numba_cpu, reference

__all__ = ["nearest_points", "nearest_sums", "points_in_ball"]


def nearest_points(
    p1: Tensor, p2: Tensor, lengths1: Tensor, lengths2: Tensor, norm: int, K: int
) -> tuple[Tensor, Tensor]:
    """The K points of `p2` that are nearest to each of `p1`, exactly; `reference.py` states each rule.

    Distances are differentiable with respect to both clouds; the same on any number of threads.

    Args:
        p1: (N, P1, D) the points that ask, padded.
        p2: (N, P2, D) the points that are searched, padded.
        lengths1: (N,) int64, how many points of each cloud of `p1` count.
        lengths2: (N,) int64, the same for `p2`.
        norm: 2 for squared Euclidean distances, 1 for sums of absolute differences.
        K: how many neighbours.

    Returns:
        dists (N, P1, K), nearest first, zero where there is no neighbour; idx (N, P1, K) int64, -1 there.

    Raises:
        ValueError: a shape, type, device, length, norm or K that cannot be.
    """
    _check_clouds(p1, p2, lengths1, lengths2)
    _check_norm(norm)
    _check_count(K)
    if not _is_fast(p1):
        return reference.nearest_points(p1, p2, lengths1, lengths2, norm, K)
    return _search_on_cpu(p1, p2, lengths1, lengths2, norm, K, -1.0)


def points_in_ball(
    p1: Tensor, p2: Tensor, lengths1: Tensor, lengths2: Tensor, K: int, radius: float
) -> tuple[Tensor, Tensor]:
    """The first K points of `p2`, in the order of their index, that are closer than `radius` to each of `p1`.

    Distances are differentiable with respect to both clouds; the same on any number of threads.

    Args:
        p1: (N, P1, D) the points that ask, padded.
        p2: (N, P2, D) the points that are searched, padded.
        lengths1: (N,) int64, how many points of each cloud of `p1` count.
        lengths2: (N,) int64, the same for `p2`.
        K: how many neighbours at most.
        radius: in the units of the points; a point at this distance is outside.

    Returns:
        dists (N, P1, K), squared, zero where there is no neighbour; idx (N, P1, K) int64, -1 there.

    Raises:
        ValueError: a shape, type, device, length, radius or K that cannot be.
    """
    _check_clouds(p1, p2, lengths1, lengths2)
    _check_count(K)
    if not radius >= 0:
        raise ValueError(f"radius must be zero or positive, got {radius}")
    if not _is_fast(p1):
        return reference.points_in_ball(p1, p2, lengths1, lengths2, K, radius)
    return _search_on_cpu(p1, p2, lengths1, lengths2, 2, K, float(radius))


def nearest_sums(
    x: Tensor, y: Tensor, x_lengths: Tensor, y_lengths: Tensor, x_weights: Tensor, y_weights: Tensor, norm: int
) -> Tensor:
    """Per cloud, x_weights * sum_i min_j d(x_i, y_j) + y_weights * sum_j min_i d(y_j, x_i).

    Both searches share their preparation, and the gradient is found on the way forward: half the time of two calls
    of `nearest_points`. Differentiable with respect to both clouds; the same on any number of threads.

    Args:
        x: (N, P1, D) points, padded.
        y: (N, P2, D) points, padded.
        x_lengths: (N,) int64, how many points of each cloud of `x` count.
        y_lengths: (N,) int64, the same for `y`.
        x_weights: (N,) factor of the distances from `x` to `y`; no gradient flows into it.
        y_weights: (N,) the same from `y` to `x`; where it is zero, that way is not searched.
        norm: 2 for squared Euclidean distances, 1 for sums of absolute differences.

    Returns:
        (N,); zero for a way from or to an empty cloud.

    Raises:
        ValueError: a shape, type, device, length or norm that cannot be.
    """
    _check_clouds(x, y, x_lengths, y_lengths)
    _check_norm(norm)
    x_weights, y_weights = x_weights.detach(), y_weights.detach()
    if not _is_fast(x):
        return reference.nearest_sums(x, y, x_lengths, y_lengths, x_weights, y_weights, norm)
    if x.shape[2] > 3:
        there, _ = _search_on_cpu(x, y, x_lengths, y_lengths, norm, 1, -1.0)
        back, _ = _search_on_cpu(y, x, y_lengths, x_lengths, norm, 1, -1.0)
        return x_weights * there.sum((1, 2)) + y_weights * back.sum((1, 2))
    wants = [torch.is_grad_enabled() and cloud.requires_grad for cloud in (x, y)]
    return _sums_on_cpu(x, y, x_lengths, y_lengths, x_weights, y_weights, norm, *wants)[0]


def _is_fast(points: Tensor) -> bool:
    return points.device.type == "cpu" and points.dtype == torch.float32 and points.shape[2] > 0


def _check_clouds(p1: Tensor, p2: Tensor, lengths1: Tensor, lengths2: Tensor) -> None:
    if p1.ndim != 3 or p2.ndim != 3 or p1.shape[0] != p2.shape[0] or p1.shape[2] != p2.shape[2]:
        raise ValueError(
            f"the clouds must have shapes (N, P1, D) and (N, P2, D), got {tuple(p1.shape)} and {tuple(p2.shape)}"
        )
    if not p1.is_floating_point() or p1.dtype != p2.dtype or p1.device != p2.device:
        raise ValueError(
            "the clouds must be floats of one type on one device, got "
            f"{p1.dtype} on {p1.device} and {p2.dtype} on {p2.device}"
        )
    for lengths, cloud in ((lengths1, p1), (lengths2, p2)):
        if lengths.shape != cloud.shape[:1] or lengths.dtype != torch.int64 or lengths.device != cloud.device:
            raise ValueError(
                f"lengths must be int64 of shape ({len(cloud)},) on {cloud.device}, got {lengths.dtype} of "
                f"{tuple(lengths.shape)} on {lengths.device}"
            )
        # elsewhere than on the CPU, asking would wait for the device
        if lengths.device.type == "cpu" and any(not 0 <= length <= cloud.shape[1] for length in lengths.tolist()):
            raise ValueError(f"lengths must be between 0 and {cloud.shape[1]}, got {lengths.tolist()}")


def _check_norm(norm: int) -> None:
    if norm not in (1, 2):
        raise ValueError(f"Support for 1 or 2 norm; got {norm}")


def _check_count(K: int) -> None:
    if K < 1:
        raise ValueError(f"K must be at least 1, got {K}")


def _arrays(first: Tensor, second: Tensor) -> tuple[np.ndarray, np.ndarray]:
    return first.detach().contiguous().numpy(), second.detach().contiguous().numpy()


def _axes(points: Tensor) -> np.ndarray:
    """The three coordinates that trees over such points know: the widest; -1 where there are fewer."""
    D = points.shape[2]
    if D <= 3:
        return np.array([*range(D), -1, -1])[:3]
    spread = points.detach().reshape(-1, D).double().std(0, correction=0).nan_to_num(0.0, 0.0, 0.0)
    return spread.argsort(descending=True, stable=True)[:3].numpy()


@torch.library.custom_op("rendra::knn", mutates_args=(), device_types="cpu")
def _search_on_cpu(
    p1: Tensor, p2: Tensor, lengths1: Tensor, lengths2: Tensor, norm: int, K: int, radius: float
) -> tuple[Tensor, Tensor]:
    shape = (*p1.shape[:2], K)
    dists, idx = p1.new_zeros(shape), p1.new_full(shape, -1, dtype=torch.int64)
    numba_cpu.search(
        _arrays(p1, p2), _arrays(lengths1, lengths2), _axes(p2), norm, radius, dists.numpy(), idx.numpy()
    )
    return dists, idx


@_search_on_cpu.register_fake
def _(p1, p2, lengths1, lengths2, norm, K, radius):  # type: ignore[no-untyped-def]
    shape = (*p1.shape[:2], K)
    return p1.new_empty(shape), p1.new_empty(shape, dtype=torch.int64)


@torch.library.custom_op("rendra::knn_backward", mutates_args=(), device_types="cpu")
def _gradient_on_cpu(p1: Tensor, p2: Tensor, norm: int, idx: Tensor, upstream: Tensor) -> tuple[Tensor, Tensor]:
    grads = numba_cpu.backward(_arrays(p1, p2), norm, *_arrays(idx, upstream))
    return torch.from_numpy(grads[0]), torch.from_numpy(grads[1])


@_gradient_on_cpu.register_fake
def _(p1, p2, norm, idx, upstream):  # type: ignore[no-untyped-def]
    contiguous = torch.contiguous_format
    return torch.empty_like(p1, memory_format=contiguous), torch.empty_like(p2, memory_format=contiguous)


def _remember(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    ctx.save_for_backward(inputs[0], inputs[1], output[1])
    ctx.norm = inputs[4]
    ctx.mark_non_differentiable(output[1])


def _gradient(ctx, grad_dists, _):  # type: ignore[no-untyped-def]
    p1, p2, idx = ctx.saved_tensors
    return *_gradient_on_cpu(p1, p2, ctx.norm, idx, grad_dists), *[None] * 5


_search_on_cpu.register_autograd(_gradient, setup_context=_remember)


@torch.library.custom_op("rendra::nearest_sums", mutates_args=(), device_types="cpu")
def _sums_on_cpu(
    x: Tensor,
    y: Tensor,
    x_lengths: Tensor,
    y_lengths: Tensor,
    x_weights: Tensor,
    y_weights: Tensor,
    norm: int,
    wants_x: bool,
    wants_y: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """The sums, and their gradients: one that is not wanted has no elements."""
    nothing = (0, 0, 0)
    x_slope, y_slope = x.new_empty(x.shape if wants_x else nothing), y.new_empty(y.shape if wants_y else nothing)
    weights = _arrays(x_weights.to(x.dtype), y_weights.to(x.dtype))
    sums, _ = numba_cpu.nearest_sums(
        _arrays(x, y), _arrays(x_lengths, y_lengths), weights, _axes(x), norm, _arrays(x_slope, y_slope)
    )
    return torch.from_numpy(sums), x_slope, y_slope


@_sums_on_cpu.register_fake
def _(x, y, x_lengths, y_lengths, x_weights, y_weights, norm, wants_x, wants_y):  # type: ignore[no-untyped-def]
    nothing = (0, 0, 0)
    slopes = x.new_empty(x.shape if wants_x else nothing), y.new_empty(y.shape if wants_y else nothing)
    return x.new_empty(len(x)), *slopes


def _remember_slopes(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    ctx.save_for_backward(*output[1:])
    ctx.wants = inputs[7:9]
    ctx.mark_non_differentiable(*output[1:])


def _scaled_slopes(ctx, grad_sums, *_):  # type: ignore[no-untyped-def]
    grads = [
        slope * grad_sums[:, None, None] if wanted else None
        for slope, wanted in zip(ctx.saved_tensors, ctx.wants, strict=True)
    ]
    return *grads, *[None] * 7


_sums_on_cpu.register_autograd(_scaled_slopes, setup_context=_remember_slopes)
