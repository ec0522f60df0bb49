"""Features of points from multi-resolution grids, dense or hashed, and from tri-planes."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from rendra.kernels.encode_grid import numba_cpu, reference
from rendra.kernels.encode_grid.layout import check_layout, grid_offsets, grid_resolutions
from rendra.kernels.parallel import num_threads

__all__ = ["COMBINATIONS", "encode_grid", "encode_planes", "grid_offsets", "grid_resolutions"]

COMBINATIONS = ("product", "sum", "concat")


def encode_grid(points: Tensor, table: Tensor, resolutions: Sequence[int], offsets: Sequence[int]) -> Tensor:
    """Trilinear features of points from L grids that share one table.

    Mueller et al., "Instant neural graphics primitives with a multiresolution hash encoding", SIGGRAPH 2022. A level
    whose (N + 1)^3 vertices fit in its rows is a dense grid, any other one is hashed (Eq. 4).

    Differentiable once, in points and table; the same on any number of threads.

    Args:
        points: (M, 3) in [0, 1]^3. Coordinates outside are clamped, and get no gradient; a NaN gives NaN.
        table: (T, F) the features of all levels, one level after the other.
        resolutions: L numbers of cells along an axis, N; `grid_resolutions` makes them.
        offsets: L + 1 numbers: first row of each level, and T; `grid_offsets` makes them. The rows of a level that
            is hashed are a power of two.

    Returns:
        features (M, L F): those of the first level first.

    Raises:
        ValueError: a shape, type, device or layout that cannot be.
    """
    _check_points(points)
    if table.ndim != 2 or table.dtype != points.dtype or table.device != points.device or not table.shape[1]:
        raise ValueError(
            f"table must be {points.dtype} of shape (T, F) on {points.device}, like the points; got {table.dtype} of "
            f"{tuple(table.shape)} on {table.device}"
        )
    levels, starts = tuple(resolutions), tuple(offsets)
    check_layout(levels, starts, *table.shape)
    if points.device.type != "cpu" or points.dtype != torch.float32:
        return reference.encode_grid(points, table, levels, starts)
    return _encode_on_cpu(points, table, levels, starts)


def encode_planes(points: Tensor, planes: Tensor, combine: str = "product") -> Tensor:
    """Bilinear features of points from the planes of (x, y), (x, z) and (y, z), combined.

    Fridovich-Keil et al., "K-Planes", CVPR 2023: the product (Sec. 3.1) can say "here and nowhere else along this
    line", the sum, as in EG3D (Chan et al., CVPR 2022), cannot.

    Differentiable once, in points and planes; the same on any number of threads.

    Args:
        points: (M, 3) in [0, 1]^3. Coordinates outside are clamped, and get no gradient; a NaN gives NaN.
        planes: (3, R, R, F). planes[p, j, i] is the feature at i / (R - 1) of the plane's first coordinate and
            j / (R - 1) of its second.
        combine: product, sum or concat.

    Returns:
        features (M, F); (M, 3 F) for concat, plane by plane.

    Raises:
        ValueError: a shape, type, device or combination that cannot be.
    """
    _check_points(points)
    if combine not in COMBINATIONS:
        raise ValueError(f"combine must be one of {', '.join(COMBINATIONS)}, got {combine!r}")
    if planes.dtype != points.dtype or planes.device != points.device:
        raise ValueError(
            f"planes must be {points.dtype} on {points.device}, like the points; got {planes.dtype} on "
            f"{planes.device}"
        )
    _check_planes(tuple(planes.shape))
    if points.device.type != "cpu" or points.dtype != torch.float32:
        return reference.encode_planes(points, planes, combine)
    features, _ = _sample_on_cpu(points, planes, combine == "product")
    return features.unflatten(1, (3, -1)).sum(1) if combine == "sum" else features


def _check_planes(shape: tuple[int, ...]) -> None:
    if len(shape) != 4 or shape[0] != 3 or shape[1] != shape[2] or not 2 <= shape[1] <= 2**20 or shape[3] < 1:
        raise ValueError(f"planes must have shape (3, R, R, F) with R from 2 to 2^20, got {shape}")
    if math.prod(shape) >= 2**32:
        raise ValueError(f"planes hold fewer than 2^32 numbers, got {shape}")


def _check_points(points: Tensor) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or not points.is_floating_point():
        raise ValueError(f"points must be floats of shape (M, 3), got {points.dtype} of {tuple(points.shape)}")


def _flat(tensor: Tensor) -> np.ndarray:
    return tensor.contiguous().view(-1).numpy()


def _layout(resolutions: Sequence[int], offsets: Sequence[int], table: Tensor) -> tuple[np.ndarray, np.ndarray, int]:
    return np.array(resolutions, dtype=np.int64), np.array(offsets, dtype=np.int64), table.shape[1]


def _shares(levels: int) -> np.ndarray:
    """Levels of each thread (threads, most): dealt out from the finest, the costliest, there and back again."""
    threads = min(num_threads(), levels)
    turns = -(-levels // threads)
    dealt = np.full((turns, threads), -1, dtype=np.int64)
    dealt.flat[:levels] = np.arange(levels)[::-1]
    dealt[1::2] = dealt[1::2, ::-1]
    return np.ascontiguousarray(dealt.T)


@torch.library.custom_op("rendra::encode_grid", mutates_args=(), device_types="cpu")
def _encode_on_cpu(points: Tensor, table: Tensor, resolutions: Sequence[int], offsets: Sequence[int]) -> Tensor:
    out = points.new_empty((len(points), len(resolutions) * table.shape[1]))
    numba_cpu.encode_grid(_flat(points), _flat(table), *_layout(resolutions, offsets, table), _flat(out))
    return out


@_encode_on_cpu.register_fake
def _(points, table, resolutions, offsets):  # type: ignore[no-untyped-def]
    return points.new_empty((len(points), len(resolutions) * table.shape[1]))


@torch.library.custom_op("rendra::encode_grid_backward", mutates_args=(), device_types="cpu")
def _gradient_on_cpu(
    points: Tensor,
    table: Tensor,
    upstream: Tensor,
    resolutions: Sequence[int],
    offsets: Sequence[int],
    for_points: bool,
    for_table: bool,
) -> tuple[Tensor, Tensor]:
    """Gradients of points and table; empty where not asked for."""
    grad_points = points.new_empty(points.shape if for_points else 0)
    grad_table = table.new_empty(table.shape if for_table else 0)
    layout = _layout(resolutions, offsets, table)
    if for_points:
        numba_cpu.points_gradient(_flat(points), _flat(table), *layout, _flat(upstream), _flat(grad_points))
    if for_table:
        shares = _shares(len(resolutions))
        numba_cpu.table_gradient(_flat(points), *layout, _flat(upstream), shares, _flat(grad_table))
    return grad_points, grad_table


@_gradient_on_cpu.register_fake
def _(points, table, upstream, resolutions, offsets, for_points, for_table):  # type: ignore[no-untyped-def]
    return points.new_empty(points.shape if for_points else 0), table.new_empty(table.shape if for_table else 0)


def _remember(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    points, table, *ctx.layout = inputs
    ctx.save_for_backward(points, table)


def _gradient(ctx, upstream):  # type: ignore[no-untyped-def]
    asked = ctx.needs_input_grad[:2]
    grads = _gradient_on_cpu(*ctx.saved_tensors, upstream, *ctx.layout, *asked)
    return *(grad if needed else None for grad, needed in zip(grads, asked, strict=True)), None, None


@torch.library.custom_op("rendra::encode_planes", mutates_args=(), device_types="cpu")
def _sample_on_cpu(points: Tensor, planes: Tensor, multiply: bool) -> tuple[Tensor, Tensor]:
    """The product (M, F) and its factors (M, 3 F); without `multiply` the factors, and nothing."""
    side, width = planes.shape[1], planes.shape[3]
    values = points.new_empty((len(points), 3 * width))
    numba_cpu.sample_planes(_flat(points), _flat(planes), side, width, _flat(values))
    if not multiply:
        return values, points.new_empty(0)
    product = points.new_empty((len(points), width))
    numba_cpu.multiply_planes(_flat(values), width, _flat(product))
    return product, values


@_sample_on_cpu.register_fake
def _(points, planes, multiply):  # type: ignore[no-untyped-def]
    values = points.new_empty((len(points), 3 * planes.shape[3]))
    return (points.new_empty((len(points), planes.shape[3])), values) if multiply else (values, points.new_empty(0))


@torch.library.custom_op("rendra::encode_planes_backward", mutates_args=(), device_types="cpu")
def _planes_gradient_on_cpu(
    points: Tensor, planes: Tensor, values: Tensor, upstream: Tensor, for_points: bool, for_planes: bool
) -> tuple[Tensor, Tensor]:
    """Gradients of points and planes; empty where not asked for."""
    side, width = planes.shape[1], planes.shape[3]
    flowing = _flat(upstream)
    if upstream.shape[1] == width:
        flowing = np.empty(3 * flowing.size, dtype=np.float32)
        numba_cpu.multiply_planes_gradient(_flat(values), width, _flat(upstream), flowing)
    grad_points = points.new_empty(points.shape if for_points else 0)
    grad_planes = planes.new_empty(planes.shape if for_planes else 0)
    if for_points:
        numba_cpu.planes_points_gradient(_flat(points), _flat(planes), side, width, flowing, _flat(grad_points))
    if for_planes:
        numba_cpu.planes_gradient(_flat(points), side, width, flowing, _flat(grad_planes))
    return grad_points, grad_planes


@_planes_gradient_on_cpu.register_fake
def _(points, planes, values, upstream, for_points, for_planes):  # type: ignore[no-untyped-def]
    return points.new_empty(points.shape if for_points else 0), planes.new_empty(planes.shape if for_planes else 0)


def _remember_planes(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    ctx.save_for_backward(*inputs[:2], output[1])
    ctx.mark_non_differentiable(output[1])


def _gradient_of_planes(ctx, upstream, _):  # type: ignore[no-untyped-def]
    asked = ctx.needs_input_grad[:2]
    grads = _planes_gradient_on_cpu(*ctx.saved_tensors, upstream, *asked)
    return *(grad if needed else None for grad, needed in zip(grads, asked, strict=True)), None


def _refuse_second_order(ctx, *_):  # type: ignore[no-untyped-def]
    raise RuntimeError(
        "encodings by grids and planes are differentiable once on the CPU in float32: a loss on their gradient needs "
        "float64 points and tables, or the gradient by finite differences"
    )


_encode_on_cpu.register_autograd(_gradient, setup_context=_remember)
_gradient_on_cpu.register_autograd(_refuse_second_order)
_sample_on_cpu.register_autograd(_gradient_of_planes, setup_context=_remember_planes)
_planes_gradient_on_cpu.register_autograd(_refuse_second_order)
