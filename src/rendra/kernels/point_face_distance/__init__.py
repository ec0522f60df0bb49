"""Nearest face of every point, and nearest point of every face, with squared Euclidean distances."""

import torch
from torch import Tensor

from rendra.kernels.point_face_distance import numba_cpu, reference

__all__ = ["nearest_face", "nearest_point"]


def nearest_face(
    points: Tensor, points_first_idx: Tensor, tris: Tensor, tris_first_idx: Tensor, min_triangle_area: float = 0.0
) -> tuple[Tensor, Tensor, Tensor]:
    """The nearest face of every point, among the faces of its own mesh.

    The distance is differentiable in points and faces. Equal distances go to the lower index. The same on any number
    of threads.

    Args:
        points: (P, 3) the points of N clouds, one cloud after the other.
        points_first_idx: (N,) index of each cloud's first point.
        tris: (F, 3, 3) corners of the faces of N meshes, one mesh after the other.
        tris_first_idx: (N,) index of each mesh's first face.
        min_triangle_area: a smaller face counts as its three edges alone.

    Returns:
        squared (P,): squared distance to the nearest face. 0 where the mesh has no face, NaN where none is at a
            finite distance.
        index (P,): that face among the F; -1 where there is none.
        weights (P, 3): barycentric coordinates of the nearest point on that face; 0 where there is none.

    Raises:
        ValueError: a shape, type, device, index or area that cannot be.
    """
    _check(points, points_first_idx, tris, tris_first_idx, min_triangle_area)
    if points.device.type != "cpu" or points.dtype != torch.float32:
        return reference.nearest_face(points, points_first_idx, tris, tris_first_idx, min_triangle_area)
    arguments = points, points_first_idx, tris, tris_first_idx, float(min_triangle_area), True
    return _nearest_on_cpu(*arguments)


def nearest_point(
    points: Tensor, points_first_idx: Tensor, tris: Tensor, tris_first_idx: Tensor, min_triangle_area: float = 0.0
) -> tuple[Tensor, Tensor, Tensor]:
    """The nearest point of every face, among the points of its own cloud.

    Arguments, rules and errors are those of `nearest_face`.

    Returns:
        squared (F,): squared distance of the nearest point; 0 where the cloud has no point, NaN where none is at a
            finite distance.
        index (F,): that point among the P; -1 where there is none.
        weights (F, 3): barycentric coordinates of the point on the face nearest to it; 0 where there is none.
    """
    _check(points, points_first_idx, tris, tris_first_idx, min_triangle_area)
    if points.device.type != "cpu" or points.dtype != torch.float32:
        return reference.nearest_point(points, points_first_idx, tris, tris_first_idx, min_triangle_area)
    arguments = points, points_first_idx, tris, tris_first_idx, float(min_triangle_area), False
    return _nearest_on_cpu(*arguments)


def _check(points: Tensor, points_first: Tensor, tris: Tensor, tris_first: Tensor, min_area: float) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or not points.is_floating_point():
        raise ValueError(f"points must be floats of shape (P, 3), got {points.dtype} of {tuple(points.shape)}")
    if tris.ndim != 3 or tris.shape[1:] != (3, 3) or tris.dtype != points.dtype or tris.device != points.device:
        raise ValueError(
            f"faces must be {points.dtype} of shape (F, 3, 3) on {points.device}, like the points; got {tris.dtype} "
            f"of {tuple(tris.shape)} on {tris.device}"
        )
    if points_first.ndim != 1 or points_first.shape != tris_first.shape:
        raise ValueError(
            "points_first_idx and the faces' first_idx must both have shape (N,), got "
            f"{tuple(points_first.shape)} and {tuple(tris_first.shape)}"
        )
    for name, first, total in (("points", points_first, len(points)), ("faces", tris_first, len(tris))):
        if first.dtype != torch.int64 or first.device != points.device:
            raise ValueError(
                f"first_idx of the {name} must be int64 on {points.device}, got {first.dtype} on {first.device}"
            )
        _check_segments(name, first.tolist(), total)
    if not min_area >= 0:
        raise ValueError(f"min_triangle_area must be zero or positive, got {min_area}")


def _check_segments(name: str, first: list[int], total: int) -> None:
    """Segments must follow each other from 0 on, and hold everything."""
    ends = [*first, total][1:]
    if (first[0] if first else total) != 0 or any(a > b for a, b in zip(first, ends, strict=True)):
        raise ValueError(
            f"first_idx of the {total} {name} must start at 0 and never fall or pass the end, got {first}"
        )


@torch.library.custom_op("rendra::nearest_on_faces", mutates_args=(), device_types="cpu")
def _nearest_on_cpu(
    points: Tensor, points_first: Tensor, tris: Tensor, tris_first: Tensor, min_area: float, by_point: bool
) -> tuple[Tensor, Tensor, Tensor]:
    nearest = numba_cpu.nearest_face if by_point else numba_cpu.nearest_point
    squared, index, weights = nearest(
        points.contiguous().numpy(), points_first.contiguous().numpy(), tris.contiguous().numpy(),
        tris_first.contiguous().numpy(), min_area,
    )  # fmt: skip
    return torch.from_numpy(squared), torch.from_numpy(index), torch.from_numpy(weights)


@_nearest_on_cpu.register_fake
def _(points, points_first, tris, tris_first, min_area, by_point):  # type: ignore[no-untyped-def]
    queries = points if by_point else tris
    index = queries.new_empty(len(queries), dtype=torch.int64)
    return queries.new_empty(len(queries)), index, queries.new_empty((len(queries), 3))


@torch.library.custom_op("rendra::nearest_on_faces_backward", mutates_args=(), device_types="cpu")
def _gradient_on_cpu(
    points: Tensor, tris: Tensor, index: Tensor, weights: Tensor, by_point: bool, upstream: Tensor
) -> tuple[Tensor, Tensor]:
    grads = numba_cpu.backward(
        points.contiguous().numpy(), tris.contiguous().numpy(), by_point, index.numpy(), weights.numpy(),
        upstream.contiguous().numpy(),
    )  # fmt: skip
    return torch.from_numpy(grads[0]), torch.from_numpy(grads[1])


@_gradient_on_cpu.register_fake
def _(points, tris, index, weights, by_point, upstream):  # type: ignore[no-untyped-def]
    contiguous = torch.contiguous_format
    return torch.empty_like(points, memory_format=contiguous), torch.empty_like(tris, memory_format=contiguous)


def _remember(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    ctx.save_for_backward(inputs[0], inputs[2], *output[1:])
    ctx.by_point = inputs[5]
    ctx.mark_non_differentiable(*output[1:])


def _gradient(ctx, grad_squared, *_):  # type: ignore[no-untyped-def]
    grad_points, grad_tris = _gradient_on_cpu(*ctx.saved_tensors, ctx.by_point, grad_squared)
    return grad_points, None, grad_tris, None, None, None


_nearest_on_cpu.register_autograd(_gradient, setup_context=_remember)
