"""Points to fragments: which points each pixel sees as discs, how deep, how far from its centre."""

import torch
from torch import Tensor

from rendra.kernels.rasterize_points import numba_cpu, reference
from rendra.kernels.validation import check_image_size, check_points

__all__ = ["rasterize_points"]


def rasterize_points(
    points: Tensor,
    radius: Tensor,
    cloud_to_packed_first_idx: Tensor,
    num_points_per_cloud: Tensor,
    image_size: tuple[int, int],
    points_per_pixel: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """The `points_per_pixel` nearest discs of every pixel; `reference.py` states each rule.

    Differentiable with respect to `points` through depth and distances; not through visibility, nor to `radius`.
    Exact for any number of points a pixel and any image size; the same on any number of threads.

    Args:
        points: (P, 3) packed points: x, y in NDC, z the depth in view space.
        radius: (P,) of the discs, NDC distance.
        cloud_to_packed_first_idx: (N,) index of the first point of each cloud.
        num_points_per_cloud: (N,) number of points of each cloud.
        image_size: (H, W) in pixels.
        points_per_pixel: K, without an upper limit.

    Returns:
        idx (N, H, W, K) int64, index of the packed point, nearest first; zbuf (N, H, W, K), depth; dists
        (N, H, W, K), squared NDC distance from the pixel's centre. All are -1 where a pixel has fewer than K hits.

    Raises:
        ValueError: a shape, type, size, radius or index that cannot be.
    """
    check_points(points, radius, cloud_to_packed_first_idx, num_points_per_cloud)
    check_image_size(image_size)
    if points_per_pixel < 1:
        raise ValueError(f"points_per_pixel must be at least 1, got {points_per_pixel}")
    if points.device.type != "cpu" or points.dtype != torch.float32:
        return reference.rasterize_points(
            points, radius, cloud_to_packed_first_idx, num_points_per_cloud, image_size, points_per_pixel
        )
    return _rasterize_on_cpu(
        points, radius.detach(), cloud_to_packed_first_idx, num_points_per_cloud, *image_size, points_per_pixel
    )


@torch.library.custom_op("rendra::rasterize_points", mutates_args=(), device_types="cpu")
def _rasterize_on_cpu(
    points: Tensor,
    radius: Tensor,
    first_point: Tensor,
    num_points: Tensor,
    height: int,
    width: int,
    layers: int,
) -> tuple[Tensor, Tensor, Tensor]:
    outputs = _outputs(points, first_point, height, width, layers)
    numba_cpu.forward(
        points.contiguous().numpy(),
        radius.contiguous().numpy(),
        first_point.contiguous().numpy(),
        num_points.contiguous().numpy(),
        (outputs[0].numpy(), outputs[1].numpy(), outputs[2].numpy()),
    )
    return outputs


@_rasterize_on_cpu.register_fake
def _(points, radius, first_point, num_points, height, width, layers):  # type: ignore[no-untyped-def]
    return _outputs(points, first_point, height, width, layers)


def _outputs(
    points: Tensor, first_point: Tensor, height: int, width: int, layers: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Uninitialised results: the kernel writes each element once."""
    shape = (len(first_point), height, width, layers)
    return points.new_empty(shape, dtype=torch.int64), points.new_empty(shape), points.new_empty(shape)


@torch.library.custom_op("rendra::rasterize_points_backward", mutates_args=(), device_types="cpu")
def _gradient_on_cpu(points: Tensor, idx: Tensor, grad_zbuf: Tensor | None, grad_dists: Tensor | None) -> Tensor:
    grads = [None if grad is None else grad.contiguous().numpy() for grad in (grad_zbuf, grad_dists)]
    return torch.from_numpy(numba_cpu.backward(points.contiguous().numpy(), idx.numpy(), grads[0], grads[1]))


@_gradient_on_cpu.register_fake
def _(points, idx, grad_zbuf, grad_dists):  # type: ignore[no-untyped-def]
    return torch.empty_like(points, memory_format=torch.contiguous_format)


def _remember(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    ctx.save_for_backward(inputs[0], output[0])
    ctx.mark_non_differentiable(output[0])
    ctx.set_materialize_grads(False)


def _gradient(ctx, _, *grads):  # type: ignore[no-untyped-def]
    return _gradient_on_cpu(*ctx.saved_tensors, *grads), *[None] * 6


_rasterize_on_cpu.register_autograd(_gradient, setup_context=_remember)
